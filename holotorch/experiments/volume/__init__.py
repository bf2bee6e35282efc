"""Holograms of volumes."""
