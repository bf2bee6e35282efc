"""Planned propagation to other windows and pitches, about a tilted carrier, and for measured content."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from oracles import dense

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import phasor
from holotorch.core.fourier import fft2, filter_spectrum, ifft2
from holotorch.optics import CroppedKernel, Propagator, plan_propagation, propagate
from holotorch.optics.free_space.plane_pair import PlanePair, plane_pair
from holotorch.optics.free_space.resampled import resample, resampling_factors
from holotorch.optics.free_space.zoomed import chirps, zoomed
from holotorch.optics.planning.candidates import candidates
from holotorch.optics.planning.content import field_content
from holotorch.optics.planning.propagate import kernel_of

pytestmark = pytest.mark.filterwarnings("ignore:no method reaches:holotorch.core.checks.SamplingWarning")
GRID, WAVE = Grid((24, 20), (8e-6, 7e-6)), 530e-9
CROSS_OVER = 2 * 24 * 8e-6**2 / WAVE
WINDOWS = {
    "aside": (GRID, (100e-6, -40e-6)),
    "narrow and aside": (Grid((9, 30), GRID.pitch), (0.0, 50e-6)),
    "wide": (Grid((51, 44), GRID.pitch), (0.0, 0.0)),
    "other pitch": (Grid((15, 20), (3e-6, 12e-6)), (20e-6, 0.0)),
}
TILTS = {"5 deg": (0.0, math.sin(math.radians(5))), "17 deg": (0.0, math.sin(math.radians(17))), "both": (0.05, -0.08)}


def white(grid: Grid = GRID) -> torch.Tensor:
    return phasor(2 * math.pi * torch.rand(grid.shape, dtype=torch.float64))


def error(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((got - wanted).norm() / wanted.norm()).item()


@cache
def matrix(out: Grid, offset: tuple, distance: float, tilt: tuple = (0.0, 0.0)) -> np.ndarray:
    nodes = 200 + int(400 * abs(distance) / CROSS_OVER)
    return dense.band_limited_to_points(
        GRID.shape, GRID.pitch, out.shape, out.pitch, offset, WAVE, distance, nodes, tilt
    )


def exact(field: torch.Tensor, out: Grid, offset: tuple, distance: float, tilt: tuple = (0.0, 0.0)) -> torch.Tensor:
    return torch.from_numpy((matrix(out, offset, distance, tilt) @ field.numpy().ravel()).reshape(out.shape))


def follow(tilt: tuple, distance: float) -> tuple[float, float]:
    """Where light of this direction arrives."""
    cosine = math.sqrt(1 - tilt[0] ** 2 - tilt[1] ** 2)
    return distance * tilt[0] / cosine, distance * tilt[1] / cosine


def every_method(planes, distance, field=None):
    content = field_content(planes.grid, [WAVE], [distance], field=field)
    return candidates(planes, [WAVE], [distance], content, torch.complex128)


@pytest.mark.parametrize("crossovers", [0.05, 0.8, 1.2, -1.0, 3.0])
@pytest.mark.parametrize("window", WINDOWS)
def test_white_phases_arrive_right_in_any_window(window, crossovers):
    (out, offset), distance, field = WINDOWS[window], crossovers * CROSS_OVER, white()
    wanted = exact(field, out, offset, distance)
    got = propagate(field, GRID, WAVE, distance, tolerance=2e-3, out_grid=out, offset=offset)
    assert error(got, wanted) <= 2 * 2e-3  # twice the expectation for one small field
    module = Propagator(GRID, WAVE, distance, tolerance=2e-3, out_grid=out, offset=offset)
    assert module.out_grid == out and error(module(field[None])[0], got) <= 1e-12
    y = torch.randn(1, *out.shape, dtype=torch.complex128)
    straight, back = (module(field[None]).conj() * y).sum(), (field.conj() * module.adjoint(y)).sum()
    assert abs(straight - back) <= 1e-12 * field.norm() * y.norm()


@pytest.mark.parametrize("crossovers", [0.05, 0.3, 1.0, -1.0, 3.0])
@pytest.mark.parametrize("window", WINDOWS)
def test_every_way_into_a_window_errs_as_predicted(window, crossovers):
    (out, offset), distance, field = WINDOWS[window], crossovers * CROSS_OVER, white()
    wanted = exact(field, out, offset, distance)
    path = plane_pair(GRID, out, offset, (0.0, 0.0), [WAVE])
    waves, far = (torch.tensor(value, dtype=torch.float64) for value in (WAVE, distance))
    checked = 0
    for way in every_method(path, distance):
        if not 1e-6 < way.error < 0.1:
            continue
        if path.same_pitch:
            got = filter_spectrum(field, kernel_of(path, way, waves, far, torch.complex128), out.shape)
        elif way.method == "angular spectrum, zoomed":
            kernel = kernel_of(PlanePair(GRID, GRID), way, waves, far, torch.complex128)
            got = zoomed(field, kernel, chirps(GRID, Grid(way.padded, GRID.pitch), out, offset))
        else:
            got = resample(field, resampling_factors(path, waves, far, padded=None if way.paraxial else way.padded))
        checked += 1
        assert way.error / 10 <= error(got, wanted) <= 3 * way.error, way
    assert checked >= 2


@pytest.mark.parametrize("crossovers", [0.1, 0.3, 1.0, -0.3, 3.0])
@pytest.mark.parametrize("tilt", TILTS)
def test_tilted_light_arrives_as_predicted(tilt, crossovers):
    """Every way whose prediction is neither rounding nor nonsense, against quadrature over the shifted band."""
    sines, distance, field = TILTS[tilt], crossovers * CROSS_OVER, white()
    offset = follow(sines, distance)
    wanted = exact(field, GRID, offset, distance, sines)
    path = plane_pair(GRID, None, offset, sines, [WAVE])
    waves, far = (torch.tensor(value, dtype=torch.float64) for value in (WAVE, distance))
    ways = [way for way in every_method(path, distance) if way.error < 0.1]
    assert ways
    for way in ways:
        got = filter_spectrum(field, kernel_of(path, way, waves, far, torch.complex128))
        assert way.error / 6 <= error(got, wanted) <= 3 * way.error, way
    if crossovers == 0.1:
        got = propagate(field, GRID, WAVE, distance, tolerance=3e-3, tilt=sines, offset=offset)
        assert error(got, wanted) <= 2 * 3e-3


def test_a_tilt_is_a_carrier_taken_out_of_both_fields():
    # A smooth field and a tilt that its own grid can carry: with and without taking the carrier out.
    grid, distance, frequency = Grid((96, 80), 8e-6), 4e-3, (0.0, 2.2e4)
    sines = (0.0, frequency[1] * WAVE)
    y, x = grid.coordinates()
    envelope = torch.exp(-(y**2 + x**2) / 80e-6**2)
    carrier = phasor(2 * math.pi * frequency[1] * x)
    wanted = propagate(envelope * carrier, grid, WAVE, distance, tolerance=1e-6)
    got = propagate(envelope.to(torch.complex128), grid, WAVE, distance, tolerance=1e-6, tilt=sines, measure=True)
    assert error(got * carrier, wanted) <= 1e-6


@pytest.mark.parametrize("distance", [3e-4, -8e-3])
def test_gradients_in_tilt_distance_and_wavelength(distance):
    grid = Grid((5, 6), (8e-6, 7e-6))
    base = torch.tensor([0.03, -0.05], dtype=torch.float64)
    offset = follow(tuple(base.tolist()), distance)

    def run(field, tilt, wavelength_factor, distance_factor):
        waves, far = WAVE * wavelength_factor, distance * distance_factor
        return propagate(field, grid, waves, far, tolerance=0.05, tilt=tilt, offset=offset)

    field = torch.randn(5, 6, dtype=torch.complex128, requires_grad=True)
    one = torch.ones((), dtype=torch.float64)
    step = 1e-7 if abs(distance) < 1e-3 else 1e-9
    turned = 2 * math.pi * abs(distance) / WAVE * step  # as in test_propagate.py
    inputs = (field, base.clone().requires_grad_(), one.clone().requires_grad_(), one.clone().requires_grad_())
    assert torch.autograd.gradcheck(run, inputs, eps=step, atol=1e-12 / step, rtol=1e-6 + turned**2)


def test_gradient_in_pitch_by_scaling_every_length():
    field, distance, step = white(), 2e-3, 1e-6

    def at(scale: float) -> torch.Tensor:
        grid = Grid(GRID.shape, (scale * GRID.pitch[0], scale * GRID.pitch[1]))
        return propagate(field, grid, WAVE, distance, tolerance=1e-2)

    scale = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(GRID.shape, dtype=torch.complex128)
    value = (weight * propagate(field, GRID, WAVE / scale, distance / scale, tolerance=1e-2)).sum().real
    (got,) = torch.autograd.grad(value, scale)
    # The carrier turns with neither: distance / wavelength stays. Rounding of the quotient: 1e-12 / step.
    wanted = ((weight * (at(1 + step) - at(1 - step))).sum().real / (2 * step)).item()
    assert got.item() == pytest.approx(wanted, rel=1e-5)


def fields(grid: Grid) -> dict[str, torch.Tensor]:
    y, x = grid.coordinates()
    square = y**2 + x**2
    fy, fx = grid.frequencies()
    low = torch.exp(-((fy * grid.pitch[0]) ** 2 + (fx * grid.pitch[1]) ** 2) / 0.06**2)
    smooth = ifft2(fft2(torch.randn(grid.shape, dtype=torch.float64).to(torch.complex128)) * low).real
    return {
        "beam": torch.exp(-square / (0.15 * min(grid.extent)) ** 2).to(torch.complex128),
        "slm": phasor(2 * smooth / smooth.std()),
        "disc": (square < (0.3 * min(grid.extent)) ** 2).to(torch.complex128),
        "white": white(grid),
        "single row": torch.nn.functional.pad(white(grid)[:1], (0, 0, 20, grid.shape[0] - 21)),
    }


@pytest.mark.parametrize("kind", ["beam", "slm", "disc", "white", "single row"])
def test_measured_content_predicts_the_error_of_the_very_field(kind):
    checked = 0
    for shape, pitch, crossovers in (((60, 71), 8e-6, 0.1), ((64, 50), 3.74e-6, 0.5), ((64, 64), 8e-6, 1.5)):
        grid = Grid(shape, pitch)
        distance = crossovers * 2 * min(shape) * pitch**2 / WAVE
        field = fields(grid)[kind]
        wide = Grid((4 * shape[0], 4 * shape[1]), pitch)
        large = torch.nn.functional.pad(field, (0, 3 * shape[1], 0, 3 * shape[0]))
        wanted = CroppedKernel(wide, WAVE, distance)(large[None])[0, : shape[0], : shape[1]]
        waves, far = (torch.tensor(value, dtype=torch.float64) for value in (WAVE, distance))
        for way in every_method(PlanePair(grid, grid), distance, field):
            if not 1e-5 < way.error < 0.05:
                continue
            out = filter_spectrum(field, kernel_of(PlanePair(grid, grid), way, waves, far, torch.complex128))
            checked += 1
            assert way.error / 10 <= error(out, wanted) <= 3 * way.error, way
    assert checked >= (1 if kind == "beam" else 5)


def test_measuring_pays_for_smooth_fields():
    grid = Grid(128, 8e-6)
    beam = fields(grid)["beam"].to(torch.complex64)
    blind, seen = (plan_propagation(grid, WAVE, 5e-3, field=field) for field in (None, beam))
    assert seen.flops < 0.6 * blind.flops and seen.predicted_error <= 1e-3
    assert propagate(beam, grid, WAVE, 5e-3, measure=True).dtype == torch.complex64
    module = Propagator(grid, WAVE, 5e-3, example=beam)
    assert module.plan == seen
    # Black is no content: every way is right, and the cheapest will do.
    black = propagate(torch.zeros_like(beam), grid, WAVE, 5e-3, measure=True)
    assert black.abs().max() == 0


def test_spread_says_the_same_as_band():
    grid, distance = Grid(128, 8e-6), 5e-3
    reach = 100e-6
    band = reach / math.hypot(reach, distance) / WAVE
    assert plan_propagation(grid, WAVE, distance, spread=(reach, reach)) == plan_propagation(
        grid, WAVE, distance, band=(band, band)
    )
    assert plan_propagation(grid, WAVE, 0.0, spread=(reach, reach)).method == "identity"


def test_what_a_plan_says_of_other_windows():
    plan = plan_propagation(Grid(512, 8e-6), WAVE, 0.2, out_grid=Grid(64, 2e-6))
    assert plan.method == "resampled kernel" and plan.adequate
    assert plan.window == ((64, 64), (2e-6, 2e-6), (0.0, 0.0)) and plan.precision == "complex64"
    # A smooth field nearby, read at many points: its spectrum is summed rather than every pair of samples.
    many = plan_propagation(
        Grid(2048, 8e-6), WAVE, 0.02, out_grid=Grid(2048, 5e-6), band=(1e4, 1e4), margin=(2e-3, 2e-3)
    )
    assert many.method == "angular spectrum, zoomed" and many.adequate
    stepped = plan_propagation(Grid(64, 8e-6), WAVE, [1e-3, 5e-2], out_grid=Grid(64, 8e-6), offset=(1e-3, 0.0))
    assert stepped.method == "cropped kernel"


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"band": (1e4, 1e4), "spread": (1e-3, 1e-3)}, ValueError, "band= or by spread=, not by both"),
        ({"spread": (0.0, 1e-3)}, ValueError, "spread must be above zero in metres"),
        ({"tilt": (0.7, 0.7)}, ValueError, r"tilt of sines \(0\.7, 0\.7\) brings part of the grid's band to a sine of"),
        (
            {"tilt": (0.1,)},
            TypeError,
            r"tilt must be two numbers \(y, x\) in sines of the carrier's direction, got \(0",
        ),
        ({"tilt": 0.1}, TypeError, r"tilt must be two numbers \(y, x\) in sines of the carrier's direction, got 0.1"),
        ({"offset": 1e-4}, TypeError, r"offset must be two numbers \(y, x\) in metres, got 0.0001"),
        ({"out_grid": (32, 32)}, TypeError, r"out_grid must be a Grid, such as .*got \(32, 32\)"),
        (
            {"wavelength": 530.0},
            ValueError,
            "wavelength must lie within 10 nm .. 300 um, got 530 m; 530 looks like nanometres",
        ),
        ({"tilt": (0.1, math.nan)}, ValueError, "tilt must be finite"),
        ({"offset": (0.0, math.inf)}, ValueError, "offset must be finite"),
        ({"distance": 0.0, "out_grid": Grid(8, 4e-6)}, ValueError, "distance must not be 0"),
    ],
)
def test_bad_input_is_named(change, kind, message):
    arguments = {"field": white().to(torch.complex64), "grid": GRID, "wavelength": WAVE, "distance": 1e-3}
    with pytest.raises(kind, match=message):
        propagate(**{**arguments, **change})


def test_beyond_what_a_tilt_allows_the_error_is_said():
    sines = (0.2, 0.2)
    with pytest.warns(SamplingWarning, match="no method reaches a tolerance"):
        propagate(white(), GRID, WAVE, CROSS_OVER / 2, tolerance=1e-6, tilt=sines, offset=follow(sines, CROSS_OVER / 2))
