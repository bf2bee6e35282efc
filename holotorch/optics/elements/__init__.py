"""Lenses, apertures, pixels of finite size, and elements in a row."""
