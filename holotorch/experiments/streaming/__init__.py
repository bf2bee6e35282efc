"""Sending and receiving of poses over the network."""
