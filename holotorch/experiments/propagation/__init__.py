"""Propagators side by side."""
