"""Readers of volume and picture formats, and limits of the memory that reading a file may take."""
