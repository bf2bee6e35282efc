"""Differentiable optics for VR and AR displays, in PyTorch.

Units are metres, radians and seconds; temperatures are differences in kelvin. A field is a complex tensor
``[..., C, H, W]`` with one channel per wavelength and axes (y, x); the optical axis lies on sample ``n // 2``;
frequencies are in FFT order. ``exp(+ikz)`` travels towards +z, a converging lens is ``exp(-i k r^2 / 2f)``, and the far
field is a unitary DFT.

This module offers the names that most scripts need first. Each name loads its module, and ``torch``, when it is first
used. Importing the package opens no file and changes no global state.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holotorch.core.grid import Grid
    from holotorch.correction import APG, PECProblem
    from holotorch.hologram import AxialHologram
    from holotorch.modulator import PhasedArray, ThermalCrosstalk
    from holotorch.optics import Eye, Lens, Propagator, propagate
    from holotorch.scene import DVRSampler, Volume
    from holotorch.tracking import CatheterTracker

__version__ = "0.2.0"
__all__ = [
    "APG",
    "AxialHologram",
    "CatheterTracker",
    "DVRSampler",
    "Eye",
    "Grid",
    "Lens",
    "PECProblem",
    "PhasedArray",
    "Propagator",
    "ThermalCrosstalk",
    "Volume",
    "__version__",
    "propagate",
]
_PACKAGES = {
    "core.grid": ("Grid",),
    "correction": ("APG", "PECProblem"),
    "hologram": ("AxialHologram",),
    "modulator": ("PhasedArray", "ThermalCrosstalk"),
    "optics": ("Eye", "Lens", "Propagator", "propagate"),
    "scene": ("DVRSampler", "Volume"),
    "tracking": ("CatheterTracker",),
}


def __getattr__(name: str) -> object:
    for package, names in _PACKAGES.items():
        if name in names:
            return getattr(import_module(f"holotorch.{package}"), name)
    raise AttributeError(f"module 'holotorch' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
