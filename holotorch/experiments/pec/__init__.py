"""Proximity effect correction of one picture."""
