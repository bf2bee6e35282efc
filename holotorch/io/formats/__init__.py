"""Readers of volume formats, decoding of pictures, and limits of the memory that reading a file may take."""
