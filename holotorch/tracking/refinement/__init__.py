"""Refinement of poses from the pixels around the band edges."""
