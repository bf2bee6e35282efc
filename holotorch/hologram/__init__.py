"""Holograms of light sources on planes: the exact sum, ways that cost less, what they show, and encodings."""

from holotorch.hologram.axial import AxialHologram
from holotorch.hologram.convolution import ConvolutionHologram
from holotorch.hologram.encoding import double_phase, encoding_loss, error_diffused, iterated, kinoform
from holotorch.hologram.plan import HologramPlan, plan_hologram
from holotorch.hologram.pointwise import DirectHologram
from holotorch.hologram.reconstruction import focal_stack, perspective, refocused

__all__ = [
    "AxialHologram",
    "ConvolutionHologram",
    "DirectHologram",
    "HologramPlan",
    "double_phase",
    "encoding_loss",
    "error_diffused",
    "focal_stack",
    "iterated",
    "kinoform",
    "perspective",
    "plan_hologram",
    "refocused",
]
