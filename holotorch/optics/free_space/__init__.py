"""Free space: transfer functions, impulse responses, and one class per propagation method."""
