"""The tracking pipeline of the thesis."""
