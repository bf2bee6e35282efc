"""The catheter, and solvers that estimate its pose from band edges in a frame."""
