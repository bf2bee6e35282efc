"""Reading and writing of files; other packages open none. Import from the modules: the package itself loads nothing."""
