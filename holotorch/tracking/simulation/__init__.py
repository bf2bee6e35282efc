"""Synthetic frames of catheters whose poses are known exactly."""
