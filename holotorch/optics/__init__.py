"""Propagation of light, optical elements, light sources, and the images that a viewer of a display sees.

Closed formulas are reached through their modules: ``viewing.display_geometry`` (fields of view, distances and visible
regions of a display), ``light.coherence`` (speckle contrast and spectral width) and ``elements.lens``.
"""

from holotorch.core.deprecation import renamed
from holotorch.optics.elements.converging import ConvergingFresnel
from holotorch.optics.elements.lens import Aperture, Lens
from holotorch.optics.elements.path import OpticalPath
from holotorch.optics.elements.pixels import PixelShape
from holotorch.optics.free_space.cropped import CroppedKernel
from holotorch.optics.free_space.depths import DepthStack
from holotorch.optics.free_space.geometry import diffraction_angle, least_padding, unaliased_distance
from holotorch.optics.free_space.propagators import AngularSpectrum, Fraunhofer, Fresnel, SpectralFilter
from holotorch.optics.free_space.rayleigh_sommerfeld import RayleighSommerfeld
from holotorch.optics.free_space.resampled import ResampledKernel
from holotorch.optics.free_space.zoomed import ZoomedFilter
from holotorch.optics.light.incoherent import disc_source, incoherent_sum, tilted_wave
from holotorch.optics.light.spectral import spectral_image
from holotorch.optics.light.spectral_retina import SpectralRetina
from holotorch.optics.light.spectrum import Spectrum
from holotorch.optics.picture import equal_power, gamut_map, linear_srgb, tone_map
from holotorch.optics.planning.plan import plan_propagation
from holotorch.optics.planning.propagate import Propagator, propagate
from holotorch.optics.viewing.display import Display
from holotorch.optics.viewing.display_geometry import placement, planar_fov
from holotorch.optics.viewing.elementwise import propagate_elements
from holotorch.optics.viewing.eye import Eye, EyeLens
from holotorch.optics.viewing.imaging import propagate_collapsed
from holotorch.optics.viewing.pupil_views import PupilViews, View
from holotorch.optics.viewing.retina import Retina, plan_retina, retinal_image
from holotorch.optics.viewing.retina_views import RetinaViews

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
    "PupilViews",
    "RayleighSommerfeld",
    "ResampledKernel",
    "Retina",
    "RetinaViews",
    "SpectralFilter",
    "SpectralRetina",
    "Spectrum",
    "View",
    "ZoomedFilter",
    "diffraction_angle",
    "disc_source",
    "equal_power",
    "gamut_map",
    "incoherent_sum",
    "least_padding",
    "linear_srgb",
    "placement",
    "plan_propagation",
    "plan_retina",
    "planar_fov",
    "propagate",
    "propagate_collapsed",
    "propagate_elements",
    "retinal_image",
    "spectral_image",
    "tilted_wave",
    "tone_map",
    "unaliased_distance",
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
