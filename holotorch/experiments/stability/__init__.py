"""Stability: every method across the border of its validity, with what it predicts and what it says there."""
