"""Propagation of light, lenses and eyes, and what a display shows."""

from holotorch.optics.coherence import (
    chromatic_defocus,
    depth_of_focus,
    optimum_fwhm,
    path_difference,
    predicted_contrast,
    samples_needed,
)
from holotorch.optics.colour import desaturated, linear_srgb
from holotorch.optics.converging import ConvergingFresnel, converging_fresnel
from holotorch.optics.cropped import CroppedKernel
from holotorch.optics.depths import DepthStack
from holotorch.optics.display import Display
from holotorch.optics.elements import least_oversampling, through_elements
from holotorch.optics.exposure import equal_power, exposed
from holotorch.optics.eye import Eye, EyeLens, chromatic_refraction, zernike
from holotorch.optics.followed import least_followed, neighbour_error, seen_light
from holotorch.optics.geometry import diffraction_angle, least_padding, unaliased_distance
from holotorch.optics.imaging import imaged, retinal_scale
from holotorch.optics.incoherent import disc_source, incoherent_sum, tilted_wave
from holotorch.optics.kernels import angular_spectrum_kernel, carrier, fresnel_kernel
from holotorch.optics.lens import Aperture, Lens, lens_limit, lens_phase, pupil
from holotorch.optics.path import OpticalPath
from holotorch.optics.pixels import PixelShape, order_efficiency
from holotorch.optics.plan import plan_propagation
from holotorch.optics.propagate import Propagator, propagate
from holotorch.optics.propagators import AngularSpectrum, Fraunhofer, Fresnel, SpectralFilter
from holotorch.optics.rayleigh_sommerfeld import RayleighSommerfeld
from holotorch.optics.resampled import ResampledKernel
from holotorch.optics.retina import Retina, plan_retina, retinal_image
from holotorch.optics.spectral import neighbours, spectral_image
from holotorch.optics.spectrum import Spectrum
from holotorch.optics.viewing import (
    accommodation_range,
    eye_box,
    eyepiece_distance,
    fresnel_distance,
    fresnel_number,
    image_distance,
    magnified_fov,
    object_distance,
    placement,
    planar_fov,
    region,
    region_apex,
    scene_fov,
    section,
    smallest_spot,
    vignetting,
    visible_half_width,
    volume_size,
)
from holotorch.optics.zoomed import ZoomedFilter

__all__ = [
    "AngularSpectrum",
    "Aperture",
    "ConvergingFresnel",
    "CroppedKernel",
    "DepthStack",
    "Display",
    "Eye",
    "EyeLens",
    "Fraunhofer",
    "Fresnel",
    "Lens",
    "OpticalPath",
    "PixelShape",
    "Propagator",
    "RayleighSommerfeld",
    "ResampledKernel",
    "Retina",
    "SpectralFilter",
    "Spectrum",
    "ZoomedFilter",
    "accommodation_range",
    "angular_spectrum_kernel",
    "carrier",
    "chromatic_defocus",
    "chromatic_refraction",
    "converging_fresnel",
    "depth_of_focus",
    "desaturated",
    "diffraction_angle",
    "disc_source",
    "equal_power",
    "exposed",
    "eye_box",
    "eyepiece_distance",
    "fresnel_distance",
    "fresnel_kernel",
    "fresnel_number",
    "image_distance",
    "imaged",
    "incoherent_sum",
    "least_followed",
    "least_oversampling",
    "least_padding",
    "lens_limit",
    "lens_phase",
    "linear_srgb",
    "magnified_fov",
    "neighbour_error",
    "neighbours",
    "object_distance",
    "optimum_fwhm",
    "order_efficiency",
    "path_difference",
    "placement",
    "plan_propagation",
    "plan_retina",
    "planar_fov",
    "predicted_contrast",
    "propagate",
    "pupil",
    "region",
    "region_apex",
    "retinal_image",
    "retinal_scale",
    "samples_needed",
    "scene_fov",
    "section",
    "seen_light",
    "smallest_spot",
    "spectral_image",
    "through_elements",
    "tilted_wave",
    "unaliased_distance",
    "vignetting",
    "visible_half_width",
    "volume_size",
    "zernike",
]
