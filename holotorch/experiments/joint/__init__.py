"""Experiment of kind ``joint``: a volume on a phased array whose heat spreads, as an eye sees it at every focus."""
