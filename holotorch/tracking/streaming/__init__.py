"""Transmission of poses over the network."""
