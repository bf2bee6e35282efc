"""Detection of the bands of a catheter in frames, and its tracking over a sequence."""
