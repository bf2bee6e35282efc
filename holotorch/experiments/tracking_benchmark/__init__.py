"""Catheter trackers side by side on synthetic frames."""
