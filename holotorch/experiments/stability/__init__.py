"""Stability: every method within and beyond the limits of its validity, with predicted errors and warnings."""
