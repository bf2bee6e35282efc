"""Comparison of the methods of free-space propagation."""
