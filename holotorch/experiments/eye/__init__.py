"""An observer's view of the hologram of a volume."""
