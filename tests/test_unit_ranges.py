"""Every public length is refused where it cannot be meant: by a message that names it, its unit and the cure.

``ENTRIES`` says how each constructor or function is called with one length, with a real value of it, and with the
multiples by which forgotten prefixes change it. NaN, infinity, 0 and negative values are tried as well, where the
quantity does not allow them.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from holotorch import Grid
from holotorch.core import quantities as q
from holotorch.core.quantities import Quantity
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram, plan_hologram, refocused
from holotorch.modulator import (
    BirefringenceTable,
    Cauchy,
    PhasedArray,
    PhaseModulator,
    ThermalCrosstalk,
    fit_cauchy,
    phase_scale,
)
from holotorch.optics import (
    AngularSpectrum,
    Aperture,
    ConvergingFresnel,
    CroppedKernel,
    Display,
    Eye,
    EyeLens,
    Fraunhofer,
    Fresnel,
    Lens,
    Propagator,
    RayleighSommerfeld,
    ResampledKernel,
    Spectrum,
    diffraction_angle,
    least_padding,
    placement,
    plan_propagation,
    plan_retina,
    planar_fov,
    propagate,
    propagate_collapsed,
    retinal_image,
    tilted_wave,
    unaliased_distance,
)
from holotorch.optics.elements.converging import converging_fresnel
from holotorch.optics.elements.lens import lens_limit, lens_phase, pupil
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, fresnel_kernel
from holotorch.optics.light.coherence import chromatic_defocus, depth_of_focus, optimum_fwhm, path_difference
from holotorch.optics.viewing.display_geometry import (
    accommodation_range,
    eye_box,
    eyepiece_distance,
    fresnel_distance,
    fresnel_number,
    magnified_fov,
    region,
    section,
    smallest_spot,
    vignetting,
    visible_half_width,
    volume_size,
)
from holotorch.optics.viewing.imaging import retinal_scale
from holotorch.perception.geometry import CurvedScreen, FlatScreen
from holotorch.scene import SourceLayers, Volume
from holotorch.scene.phantoms import shells
from holotorch.scene.phases import smooth_phase
from holotorch.tracking import Camera, Catheter, solve_pose
from holotorch.tracking.camera.boards import Chessboard
from holotorch.tracking.pose.alignment import tool_points

pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")

GRID, WAVE = Grid((12, 16), 8e-6), 530e-9
FIELD = torch.ones(1, *GRID.shape, dtype=torch.complex64)
VIEW = Display(20e-3, 25e-3, 50e-3)
CAMERA = Camera(torch.tensor([[1000.0, 0, 320], [0, 1000.0, 240], [0, 0, 1]]), torch.zeros(5))
PIXELS = torch.tensor([[[100.0, 100.0], [150, 150], [200, 200], [250, 250]]], dtype=torch.float64)
EDGES = (0.070, 0.108, 0.146, 0.184)
COLOURS = ((200, 40, 45), (40, 150, 70), (40, 70, 190))
NANO, MICRO, MILLI = 1e9, 1e6, 1e3


def double(values: Any) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclasses.dataclass(frozen=True)
class Entry:
    """One length of one call: how it is passed, what it is, a real value of it, and multiples that are refused."""

    name: str
    call: Callable[[Any], Any]
    kind: Quantity
    real: float
    wrong: tuple[float, ...] = (MICRO, MILLI)


def wavelength(name: str, call: Callable[[Any], Any]) -> Entry:
    return Entry(f"{name}: wavelength", call, q.WAVELENGTH, WAVE, (NANO, MICRO, MILLI))


def distance(name: str, call: Callable[[Any], Any], kind: Quantity = q.DISTANCE, real: float = 30e-3) -> Entry:
    return Entry(f"{name}: {kind.name}", call, kind, real, (NANO, MICRO))


ENTRIES = [
    Entry("Grid: pitch", lambda v: Grid(8, v), q.PITCH, 8e-6, (NANO, MICRO, MILLI)),
    Entry("Grid: one pitch of two", lambda v: Grid(8, (8e-6, v)), q.PITCH, 3.74e-6, (NANO, MICRO, MILLI)),
    Entry("planar_fov: pitch", lambda v: planar_fov(v, WAVE), q.PITCH, 8e-6, (NANO, MICRO, MILLI)),
    wavelength("AngularSpectrum", lambda v: AngularSpectrum(GRID, v, 1e-3)),
    wavelength("Fresnel", lambda v: Fresnel(GRID, (WAVE, v), 1e-3)),
    wavelength("Fraunhofer", lambda v: Fraunhofer(GRID, v)),
    wavelength("RayleighSommerfeld", lambda v: RayleighSommerfeld(GRID, v, 1e-3)),
    wavelength("CroppedKernel", lambda v: CroppedKernel(GRID, v, 1e-3)),
    wavelength("ConvergingFresnel", lambda v: ConvergingFresnel(GRID, v, 1e-2, 2e-2)),
    wavelength("ResampledKernel", lambda v: ResampledKernel(GRID, v, 1e-2, Grid(8, 6e-6))),
    wavelength("Propagator", lambda v: Propagator(GRID, v, 1e-3)),
    wavelength("propagate", lambda v: propagate(FIELD, GRID, v, 1e-3)),
    wavelength("propagate, tensor", lambda v: propagate(FIELD, GRID, torch.tensor([v], dtype=torch.float64), 1e-3)),
    wavelength("plan_propagation", lambda v: plan_propagation(GRID, v, 1e-3)),
    wavelength("Lens", lambda v: Lens(GRID, v, 0.1)),
    wavelength("Aperture", lambda v: Aperture(GRID, v, 30e-6)),
    wavelength("EyeLens", lambda v: EyeLens(GRID, v, Eye())),
    wavelength("Spectrum", lambda v: Spectrum.gaussian(v, 5e-9)),
    wavelength("propagate_collapsed", lambda v: propagate_collapsed(FIELD, GRID, v, VIEW, Eye())),
    wavelength("retinal_image", lambda v: retinal_image(FIELD, GRID, v, VIEW, Eye())),
    wavelength("plan_retina", lambda v: plan_retina(GRID, v, VIEW, Eye())),
    wavelength("tilted_wave", lambda v: tilted_wave(GRID, v, (0.0, 0.0))),
    wavelength("planar_fov", lambda v: planar_fov(8e-6, v)),
    wavelength("fresnel_distance", lambda v: fresnel_distance(1e-3, v, 1.0)),
    wavelength("depth_of_focus", lambda v: depth_of_focus(v, 0.05)),
    wavelength("chromatic_defocus", lambda v: chromatic_defocus(0.03, v, 1e-9)),
    wavelength("optimum_fwhm", lambda v: optimum_fwhm(v, 0.05, 0.03)),
    wavelength("PhasedArray", lambda v: PhasedArray(v, ThermalCrosstalk(0.6))),
    wavelength("PhaseModulator", lambda v: PhaseModulator(GRID, v)),
    wavelength("PhaseModulator: light", lambda v: PhaseModulator(GRID, WAVE)(FIELD.real, light=v)),
    wavelength("phase_scale: light", lambda v: phase_scale(v, WAVE, Cauchy())),
    wavelength("phase_scale: design", lambda v: phase_scale(WAVE, v, Cauchy())),
    wavelength("BirefringenceTable", lambda v: BirefringenceTable((630e-9, v), (0.2, 0.3))),
    wavelength("fit_cauchy", lambda v: fit_cauchy((630e-9, v), (6.0, 7.5))),
    wavelength("DirectHologram", lambda v: DirectHologram(GRID, v, [1e-2])),
    wavelength("ConvolutionHologram", lambda v: ConvolutionHologram(GRID, v, [1e-2])),
    wavelength("AxialHologram", lambda v: AxialHologram(GRID, v, [1e-2])),
    wavelength("plan_hologram", lambda v: plan_hologram(GRID, v, [1e-2], (8, 8))),
    wavelength("refocused", lambda v: refocused(FIELD, GRID, v, 1e-2)),
    wavelength("angular_spectrum_kernel", lambda v: angular_spectrum_kernel(GRID, v, 1e-3)),
    wavelength("fresnel_kernel", lambda v: fresnel_kernel(GRID, v, 1e-3)),
    wavelength("carrier", lambda v: carrier(v, 1e-3)),
    wavelength("lens_phase", lambda v: lens_phase(GRID, v, 0.1)),
    wavelength("lens_limit", lambda v: lens_limit(8e-6, v, 0.1)),
    wavelength("diffraction_angle", lambda v: diffraction_angle(GRID, v)),
    wavelength("least_padding", lambda v: least_padding(GRID, v, 1e-3)),
    wavelength("unaliased_distance", lambda v: unaliased_distance(GRID, v, 2)),
    wavelength("smallest_spot", lambda v: smallest_spot(v, 0.1, 1e-3)),
    wavelength("region", lambda v: region(0.0, 0.1, 8e-3, 8e-6, v)),
    distance("angular_spectrum_kernel", lambda v: angular_spectrum_kernel(GRID, WAVE, v)),
    distance("fresnel_kernel", lambda v: fresnel_kernel(GRID, WAVE, v)),
    distance("carrier", lambda v: carrier(WAVE, v)),
    distance("least_padding", lambda v: least_padding(GRID, WAVE, v)),
    distance("region", lambda v: region(0.0, v, 8e-3, 8e-6, WAVE)),
    distance("section", lambda v: section(0.0, v, 8e-3, 8e-6, WAVE)),
    distance("smallest_spot", lambda v: smallest_spot(WAVE, v, 1e-3)),
    Entry("lens_phase: focal_length", lambda v: lens_phase(GRID, WAVE, v), q.FOCAL_LENGTH, 0.1, (NANO, MICRO)),
    Entry("lens_limit: focal_length", lambda v: lens_limit(8e-6, WAVE, v), q.FOCAL_LENGTH, 0.1, (NANO, MICRO)),
    Entry("lens_limit: pitch", lambda v: lens_limit(v, WAVE, 0.1), q.PITCH, 8e-6, (NANO, MICRO, MILLI)),
    Entry("pupil: radius", lambda v: pupil(GRID, v), q.APERTURE_RADIUS, 1e-3),
    wavelength("angular_spectrum_kernel, tensor", lambda v: angular_spectrum_kernel(GRID, double(v), 1e-3)),
    wavelength("fresnel_kernel, tensor", lambda v: fresnel_kernel(GRID, double([WAVE, v]), 1e-3)),
    wavelength("carrier, tensor", lambda v: carrier(double(v), 1e-3)),
    wavelength("lens_phase, tensor", lambda v: lens_phase(GRID, double(v), 0.1)),
    wavelength("converging_fresnel", lambda v: converging_fresnel(FIELD[0], GRID, v, 1e-2, 2e-2, GRID)),
    wavelength("converging_fresnel, tensor", lambda v: converging_fresnel(FIELD, GRID, double([v]), 1e-2, 2e-2, GRID)),
    distance("angular_spectrum_kernel, tensor", lambda v: angular_spectrum_kernel(GRID, WAVE, double(v))),
    distance("carrier, tensor", lambda v: carrier(WAVE, double([v]))),
    distance("converging_fresnel", lambda v: converging_fresnel(FIELD[0], GRID, WAVE, v, 2e-2, GRID)),
    distance("converging_fresnel, tensor", lambda v: converging_fresnel(FIELD, GRID, WAVE, double([v]), 2e-2, GRID)),
    Entry(
        "converging_fresnel: focus",
        lambda v: converging_fresnel(FIELD[0], GRID, WAVE, 1e-2, v, GRID),
        q.FOCAL_LENGTH,
        0.2,
        (MICRO,),
    ),
    Entry(
        "converging_fresnel: offset",
        lambda v: converging_fresnel(FIELD[0], GRID, WAVE, 1e-2, 2e-2, GRID, offset=(0.0, v)),
        q.OFFSET,
        1e-3,
        (NANO, MICRO),
    ),
    Entry("pupil: radius, tensor", lambda v: pupil(GRID, double([v, 1e-3])), q.APERTURE_RADIUS, 1e-3),
    Entry("pupil: softness", lambda v: pupil(GRID, 1e-3, softness=v), q.SOFTNESS, 20e-6, (MILLI, MICRO)),
    Entry(
        "lens_phase: focal_length, tensor", lambda v: lens_phase(GRID, WAVE, double(v)), q.FOCAL_LENGTH, 0.1, (NANO,)
    ),
    Entry("retinal_scale: plane", lambda v: retinal_scale(VIEW, Eye(), v), q.PLANE, 30e-3, (NANO, MICRO, MILLI)),
    Entry(
        "propagate_collapsed: plane",
        lambda v: propagate_collapsed(FIELD, GRID, WAVE, VIEW, Eye(), plane=v),
        q.PLANE,
        2e-3,
        (NANO, MICRO),
    ),
    Entry("plan_retina: reach", lambda v: plan_retina(GRID, WAVE, VIEW, Eye(), reach=v), q.WIDTH, 8e-3, (NANO, MICRO)),
    Entry("eyepiece_distance", lambda v: eyepiece_distance(v, 0.12, 0.01, 0.05), q.PLANE, 30e-3, (NANO, MICRO, MILLI)),
    Entry(
        "accommodation_range: near",
        lambda v: accommodation_range(v, 36e-3, 45e-3, 50e-3, 50e-3),
        q.PLANE,
        20e-3,
        (NANO, MICRO, MILLI),
    ),
    Entry(
        "accommodation_range: eyepiece_distance",
        lambda v: accommodation_range(20e-3, 30e-3, v, 50e-3, 50e-3),
        q.SPACING,
        45e-3,
        (NANO, MICRO, MILLI),
    ),
    Entry("smallest_spot: section", lambda v: smallest_spot(WAVE, 0.1, v), q.SPACING, 8e-3, (NANO, MICRO)),
    Entry("vignetting: second", lambda v: vignetting(1e-3, 0.5, v, 2e-3, 0.03), q.PLANE, 0.1, (NANO, MICRO)),
    Entry("visible_half_width: second", lambda v: visible_half_width(0.5, v, 2e-3, 0.03), q.PLANE, 0.1, (NANO, MICRO)),
    Entry("placement: width", lambda v: placement(1e-2, v, 8e-6, WAVE), q.WIDTH, 8e-3, (NANO, MICRO)),
    Entry("eye_box: size", lambda v: eye_box(v, 0.5, 0.1, 0.03), q.SPACING, 8e-3, (NANO, MICRO)),
    Entry(
        "visible_half_width: pupil_radius",
        lambda v: visible_half_width(0.5, 0.1, v, 0.03),
        q.PUPIL_RADIUS,
        1.5e-3,
    ),
    Entry("vignetting: height", lambda v: vignetting(v, 0.5, 0.1, 2e-3, 0.03), q.OFFSET, 5e-3, (NANO, MICRO)),
    Entry(
        "volume_size: eye_distance",
        lambda v: volume_size(0.7, 0.12, 0.01, v),
        q.SPACING,
        50e-3,
        (NANO, MICRO, MILLI),
    ),
    distance("AngularSpectrum", lambda v: AngularSpectrum(GRID, WAVE, v)),
    distance("Fresnel", lambda v: Fresnel(GRID, WAVE, v)),
    distance("RayleighSommerfeld", lambda v: RayleighSommerfeld(GRID, WAVE, v)),
    distance("CroppedKernel", lambda v: CroppedKernel(GRID, WAVE, v)),
    distance("Propagator", lambda v: Propagator(GRID, WAVE, v)),
    distance("propagate", lambda v: propagate(FIELD, GRID, WAVE, v)),
    distance("propagate, tensor", lambda v: propagate(FIELD, GRID, WAVE, double(v))),
    distance("plan_propagation", lambda v: plan_propagation(GRID, WAVE, v)),
    distance("path_difference", lambda v: path_difference(v, 0.05)),
    distance("fresnel_number", lambda v: fresnel_number(1e-3, WAVE, v), dataclasses.replace(q.DISTANCE, zero=False)),
    distance("DirectHologram", lambda v: DirectHologram(GRID, WAVE, [v]), q.DEPTH),
    distance("ConvolutionHologram", lambda v: ConvolutionHologram(GRID, WAVE, [1e-2, v]), q.DEPTH),
    distance("AxialHologram", lambda v: AxialHologram(GRID, WAVE, [v]), q.DEPTH),
    distance("plan_hologram", lambda v: plan_hologram(GRID, WAVE, [v], (8, 8)), q.DEPTH),
    distance("refocused", lambda v: refocused(FIELD, GRID, WAVE, v), q.DEPTH),
    distance("SourceLayers", lambda v: SourceLayers(GRID, (v,), 1, lambda: iter(())), q.DEPTH),
    distance("FlatScreen", lambda v: FlatScreen((500, 800), (0.5, 0.8), v), q.DEPTH, 0.6),
    Entry("Display: lens_distance", lambda v: Display(v, 20e-3, 50e-3), q.SPACING, 30e-3, (NANO, MICRO, MILLI)),
    Entry("Display: eye_distance", lambda v: Display(20e-3, 20e-3, v), q.SPACING, 50e-3, (NANO, MICRO, MILLI)),
    Entry("Display: focal_length", lambda v: Display(20e-3, v, 50e-3), q.FOCAL_LENGTH, 25e-3, (NANO, MICRO)),
    Entry("Display: lens_radius", lambda v: Display(20e-3, 20e-3, 50e-3, v), q.APERTURE_RADIUS, 10e-3),
    Entry("Lens: focal_length", lambda v: Lens(GRID, WAVE, v), q.FOCAL_LENGTH, 0.1, (NANO, MICRO)),
    Entry("Lens: radius", lambda v: Lens(GRID, WAVE, 0.1, radius=v), q.APERTURE_RADIUS, 1e-3),
    Entry("Aperture: radius", lambda v: Aperture(GRID, WAVE, v), q.APERTURE_RADIUS, 1e-3),
    Entry("magnified_fov: focal_length", lambda v: magnified_fov(8e-3, v), q.FOCAL_LENGTH, 25e-3, (NANO, MICRO)),
    Entry("ConvergingFresnel: focus", lambda v: ConvergingFresnel(GRID, WAVE, 1e-2, v), q.FOCAL_LENGTH, 0.2, (MICRO,)),
    Entry("Eye: pupil_radius", lambda v: Eye(pupil_radius=v), q.PUPIL_RADIUS, 1.5e-3),
    Entry("Eye: axial_length", lambda v: Eye(axial_length=v), q.EYE_LENGTH, 24e-3),
    Entry("Eye: accommodation", lambda v: Eye(accommodation=v), q.ACCOMMODATION, 0.25, ()),
    Entry("Eye: aberrations", lambda v: Eye(aberrations={4: v}), q.WAVEFRONT_ERROR, 0.2e-6, (MICRO, NANO)),
    Entry("Eye: softness", lambda v: Eye(softness=v), q.SOFTNESS, 20e-6, (MILLI, MICRO)),
    Entry("Spectrum: fwhm", lambda v: Spectrum.lorentzian(WAVE, v), q.BANDWIDTH, 5e-9, (NANO, MICRO)),
    Entry("Cauchy: b", lambda v: Cauchy(0.18, v), q.CAUCHY_B, 8.5e-15, (1e12, 1e18)),
    Entry("ThermalCrosstalk: sigma_px", ThermalCrosstalk, q.SIGMA_PX, 0.66, (1e3,)),
    Entry("Volume: spacing", lambda v: Volume(torch.zeros(2, 2, 2), (v, 1e-3, 1e-3), "m"), q.VOXEL, 0.5e-3),
    Entry("shells: width", lambda v: shells(8, width=v), q.WIDTH, 20e-3, (NANO, MICRO, MILLI)),
    Entry("smooth_phase: length", lambda v: smooth_phase(GRID, v), q.WIDTH, 1e-3, (NANO, MICRO)),
    Entry("FlatScreen: size", lambda v: FlatScreen((500, 800), (v, 0.8), 0.6), q.SCREEN, 0.5, (MICRO, MILLI)),
    Entry(
        "CurvedScreen: radius", lambda v: CurvedScreen((300, 800), (0.3, 0.8), 0.5, v), q.SCREEN, 1.0, (MICRO, MILLI)
    ),
    Entry("Catheter: radius", lambda v: Catheter(EDGES, COLOURS, v, 0.35), q.TOOL_RADIUS, 1e-3),
    Entry("Catheter: length", lambda v: Catheter(EDGES, COLOURS, 1e-3, v), q.TOOL_LENGTH, 0.35),
    Entry("Catheter: edges", lambda v: Catheter((*EDGES[:3], v), COLOURS, 1e-3, 0.35), q.TOOL_POSITION, 0.184),
    Entry(
        "solve_pose: positions_m",
        lambda v: solve_pose(PIXELS, torch.tensor([*EDGES[:3], v], dtype=torch.float64), CAMERA),
        q.TOOL_POSITION,
        0.184,
    ),
    Entry(
        "solve_pose: offset",
        lambda v: solve_pose(PIXELS, torch.tensor(EDGES), CAMERA, offset=v),
        q.TOOL_OFFSET,
        1e-3,
    ),
    Entry(
        "tool_points: tip",
        lambda v: tool_points(torch.tensor([0.0, 0.0, v]), torch.tensor([0.0, 0.0, 1.0])),
        q.POSITION,
        0.5,
    ),
    Entry("tool_points: length", lambda v: tool_points(torch.zeros(3), torch.ones(3), v), q.TOOL_LENGTH, 0.127),
    Entry("Chessboard: square", lambda v: Chessboard(9, 6, v), q.BOARD_SQUARE, 25e-3),
]
every_entry = pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)


@every_entry
def test_a_real_value_passes(entry: Entry):
    entry.call(entry.real)


@every_entry
def test_a_forgotten_prefix_is_refused(entry: Entry):
    for multiple in entry.wrong:
        with pytest.raises(ValueError) as caught:
            entry.call(entry.real * multiple)
        message = str(caught.value)
        assert f"must lie {entry.kind.range}, got " in message, message
        assert f" {entry.kind.unit}; " in message and message.split("; ")[-1].split()[-2:], message
        assert "pass" in message.split("; ")[-1], message


@every_entry
def test_no_number_at_all_is_refused(entry: Entry):
    tried = {math.nan: False, math.inf: entry.kind.infinite, -math.inf: entry.kind.infinite, 0.0: entry.kind.zero}
    tried[-entry.real] = entry.kind.negative
    for value, allowed in tried.items():
        if allowed:
            continue
        with pytest.raises(ValueError, match=r"must (be (finite|above zero|at least zero|other than zero)|lie )"):
            entry.call(value)
