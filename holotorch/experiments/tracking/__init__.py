"""Catheter tracking: configurations, inputs, runs and their reports."""
