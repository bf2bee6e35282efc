"""From a frame to a pose."""
