"""Holograms of light sources on planes: the exact sum, and ways that cost less."""

from holotorch.hologram.axial import AxialHologram
from holotorch.hologram.convolution import ConvolutionHologram
from holotorch.hologram.pointwise import DirectHologram

__all__ = ["AxialHologram", "ConvolutionHologram", "DirectHologram"]
