"""Volumes, how they become light sources, and test scenes of known value."""

from holotorch.scene.phantoms import (
    c60,
    c60_atoms,
    exponential_medium,
    gaussian_ball,
    homogeneous_slab,
    marschner_lobb,
    shells,
)
from holotorch.scene.volume import Volume

__all__ = [
    "Volume",
    "c60",
    "c60_atoms",
    "exponential_medium",
    "gaussian_ball",
    "homogeneous_slab",
    "marschner_lobb",
    "shells",
]
