"""Sampling grids, Fourier transforms, complex helpers and argument checks that every other part stands on."""
