"""Volumes, their direct volume rendering into light sources or pictures, and analytic test volumes."""

from holotorch.scene.adaptive import adaptive_report, render_adaptively, sample_adaptively
from holotorch.scene.layers import SlabLayers, SourceLayers
from holotorch.scene.lighting import Lighting, Scattering
from holotorch.scene.phantoms import (
    c60,
    c60_atoms,
    exponential_medium,
    gaussian_ball,
    homogeneous_slab,
    marschner_lobb,
    shells,
)
from holotorch.scene.phases import PointPhases, point_phases, random_phase, smooth_phase
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.transfer_presets import bone, industrial, skin, soft_tissue, transfer_from_json, vessels
from holotorch.scene.volume import Volume

__all__ = [
    "DVRSampler",
    "Lighting",
    "PointPhases",
    "Scattering",
    "SlabLayers",
    "SourceLayers",
    "TransferFunction",
    "Volume",
    "adaptive_report",
    "bone",
    "c60",
    "c60_atoms",
    "exponential_medium",
    "gaussian_ball",
    "homogeneous_slab",
    "industrial",
    "marschner_lobb",
    "point_phases",
    "random_phase",
    "render_adaptively",
    "sample_adaptively",
    "shells",
    "smooth_phase",
    "skin",
    "soft_tissue",
    "transfer_from_json",
    "vessels",
]
