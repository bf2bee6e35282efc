"""Devices that put a phase on light."""

from holotorch.modulator.crosstalk import ThermalCrosstalk
from holotorch.modulator.phased_array import PhasedArray
from holotorch.modulator.quantised import quantised

__all__ = ["PhasedArray", "ThermalCrosstalk", "quantised"]
