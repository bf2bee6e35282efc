"""Experiment of kind ``measure``: the dissertation's protocols of accuracy and latency, for a user's own camera."""
