"""Holograms of point sources on planes: exact sum, faster methods, reconstruction and phase-only encodings."""

from holotorch.hologram.axial import AxialHologram
from holotorch.hologram.convolution import ConvolutionHologram
from holotorch.hologram.encoding import double_phase, encoding_loss, error_diffused, iterated, kinoform
from holotorch.hologram.incoherent_views import incoherent_views
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
    "incoherent_views",
    "iterated",
    "kinoform",
    "perspective",
    "plan_hologram",
    "refocused",
]
