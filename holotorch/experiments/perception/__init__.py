"""Far-periphery perception."""
