"""Poses over the network."""
