"""Tolerances that a run divides among its parts, and the speed of the machine, for plans of all kinds."""
