"""Readers of volume and picture formats, and the memory that a file may take."""
