"""Propagation of light, optical elements, eyes, and the images that a display shows."""

from holotorch.core.deprecation import renamed
from holotorch.optics.elements.converging import ConvergingFresnel, converging_fresnel
from holotorch.optics.elements.lens import Aperture, Lens, lens_limit, lens_phase, pupil
from holotorch.optics.elements.path import OpticalPath
from holotorch.optics.elements.pixels import PixelShape, order_efficiency
from holotorch.optics.free_space.cropped import CroppedKernel
from holotorch.optics.free_space.depths import DepthStack
from holotorch.optics.free_space.geometry import diffraction_angle, least_padding, unaliased_distance
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, fresnel_kernel
from holotorch.optics.free_space.propagators import AngularSpectrum, Fraunhofer, Fresnel, SpectralFilter
from holotorch.optics.free_space.rayleigh_sommerfeld import RayleighSommerfeld
from holotorch.optics.free_space.resampled import ResampledKernel
from holotorch.optics.free_space.zoomed import ZoomedFilter
from holotorch.optics.light.coherence import (
    chromatic_defocus,
    depth_of_focus,
    optimum_fwhm,
    path_difference,
    predicted_contrast,
    samples_needed,
)
from holotorch.optics.light.incoherent import disc_source, incoherent_sum, tilted_wave
from holotorch.optics.light.spectral import neighbours, spectral_image
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.light.wavelength_sampling import least_followed, neighbour_error, seen_light
from holotorch.optics.picture import equal_power, gamut_map, linear_srgb, tone_map
from holotorch.optics.planning.plan import plan_propagation
from holotorch.optics.planning.propagate import Propagator, propagate
from holotorch.optics.viewing.display import Display
from holotorch.optics.viewing.display_geometry import (
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
from holotorch.optics.viewing.elementwise import least_oversampling, propagate_elements
from holotorch.optics.viewing.eye import Eye, EyeLens, chromatic_refraction, zernike
from holotorch.optics.viewing.imaging import propagate_collapsed, retinal_scale
from holotorch.optics.viewing.retina import Retina, plan_retina, retinal_image

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
    "diffraction_angle",
    "disc_source",
    "equal_power",
    "eye_box",
    "eyepiece_distance",
    "fresnel_distance",
    "fresnel_kernel",
    "fresnel_number",
    "gamut_map",
    "image_distance",
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
    "propagate_collapsed",
    "propagate_elements",
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
    "tilted_wave",
    "tone_map",
    "unaliased_distance",
    "vignetting",
    "visible_half_width",
    "volume_size",
    "zernike",
]

__getattr__ = renamed(
    __name__,
    {
        "imaged": "propagate_collapsed",
        "through_elements": "propagate_elements",
        "exposed": "tone_map",
        "desaturated": "gamut_map",
    },
)
