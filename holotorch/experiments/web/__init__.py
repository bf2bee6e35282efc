"""Servers of pages for the browser of this computer: whom they answer, and the files that they serve."""
