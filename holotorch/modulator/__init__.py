"""Devices that modulate the phase of light: thermally driven phased arrays and liquid-crystal panels."""

from holotorch.modulator.crosstalk import ThermalCrosstalk
from holotorch.modulator.dispersion import BirefringenceTable, Cauchy, fit_cauchy, phase_scale
from holotorch.modulator.heat_cycle import HeatCycle
from holotorch.modulator.panel import PhaseModulator
from holotorch.modulator.phased_array import PhasedArray
from holotorch.modulator.quantised import quantised
from holotorch.modulator.response import Response

__all__ = [
    "BirefringenceTable",
    "Cauchy",
    "HeatCycle",
    "PhaseModulator",
    "PhasedArray",
    "Response",
    "ThermalCrosstalk",
    "fit_cauchy",
    "phase_scale",
    "quantised",
]
