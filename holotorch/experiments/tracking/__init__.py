"""Catheter tracking: recordings, cameras, runs."""
