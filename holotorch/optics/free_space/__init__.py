"""Free space: transfer functions, impulse responses, and one class per way to propagate."""
