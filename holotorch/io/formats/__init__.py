"""Formats of volumes and pictures, and what a file may cost."""
