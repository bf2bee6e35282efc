"""Sampling grids, Fourier transforms, linear operators and argument checks, on which all other packages depend."""
