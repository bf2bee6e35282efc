"""Devices that put a phase on light."""

from holotorch.modulator.crosstalk import ThermalCrosstalk
from holotorch.modulator.phased_array import PhasedArray

__all__ = ["PhasedArray", "ThermalCrosstalk"]
