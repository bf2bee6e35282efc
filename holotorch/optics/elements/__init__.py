"""Lenses, apertures, pixels of finite size, and sequences of elements."""
