"""Layouts over a wide field, scaled for equal perception time."""
