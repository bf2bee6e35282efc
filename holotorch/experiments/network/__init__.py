"""A network that predicts heater phases: trained through the display, and scored beside iterative solvers."""
