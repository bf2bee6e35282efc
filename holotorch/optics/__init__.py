"""Propagation of light between parallel planes."""

from holotorch.optics.converging import ConvergingFresnel, converging_fresnel
from holotorch.optics.cropped import CroppedKernel
from holotorch.optics.depths import DepthStack
from holotorch.optics.geometry import diffraction_angle, least_padding, unaliased_distance
from holotorch.optics.kernels import angular_spectrum_kernel, carrier, fresnel_kernel
from holotorch.optics.pixels import PixelShape, order_efficiency
from holotorch.optics.plan import plan_propagation
from holotorch.optics.propagate import Propagator, propagate
from holotorch.optics.propagators import AngularSpectrum, Fraunhofer, Fresnel, SpectralFilter
from holotorch.optics.rayleigh_sommerfeld import RayleighSommerfeld
from holotorch.optics.resampled import ResampledKernel
from holotorch.optics.zoomed import ZoomedFilter

__all__ = [
    "AngularSpectrum",
    "ConvergingFresnel",
    "CroppedKernel",
    "DepthStack",
    "Fraunhofer",
    "Fresnel",
    "PixelShape",
    "Propagator",
    "RayleighSommerfeld",
    "ResampledKernel",
    "SpectralFilter",
    "ZoomedFilter",
    "angular_spectrum_kernel",
    "carrier",
    "converging_fresnel",
    "diffraction_angle",
    "fresnel_kernel",
    "least_padding",
    "order_efficiency",
    "plan_propagation",
    "propagate",
    "unaliased_distance",
]
