"""Sweeps: a grid of runs of one configuration, one after the other, side by side, or on a cluster."""
