"""Reading and writing of files. Import from the modules of this package; the package itself imports none of them."""
