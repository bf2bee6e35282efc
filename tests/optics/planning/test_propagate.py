"""The planned way: right at every distance, cheap where it may be, honest about its error."""

import math
import warnings

import numpy as np
import pytest
import torch
from oracles import dense, diffraction

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import phasor
from holotorch.optics import CroppedKernel, Propagator, plan_propagation, propagate
from holotorch.optics.free_space.plane_pair import PlanePair
from holotorch.optics.planning.candidates import candidates
from holotorch.optics.planning.content import FieldContent
from holotorch.optics.planning.propagate import kernel_of

pytestmark = [
    pytest.mark.filterwarnings("ignore:no method reaches:holotorch.core.checks.SamplingWarning"),
    # Of noise in the far field one mode lands, which is dim by chance.
    pytest.mark.filterwarnings("ignore:only .* of the light lands:holotorch.core.checks.SamplingWarning"),
]
DISTANCES = (1e-3, 10e-3, 100e-3, 500e-3, 2.0, -100e-3)


def noise(grid: Grid, share: float, seed: int) -> torch.Tensor:
    """Noise of the band ``share`` of the grid's own, cut out of a field eight times as wide; complex128 [H, W]."""
    generator = torch.Generator().manual_seed(seed)
    wide = [8 * size for size in grid.shape]
    fy, fx = (torch.fft.fftfreq(size, dtype=torch.float64).abs() <= share / 2 for size in wide)
    spectrum = torch.randn(*wide, dtype=torch.complex128, generator=generator) * fy[:, None] * fx
    field = torch.fft.ifft2(spectrum)[: grid.shape[0], : grid.shape[1]]
    return field / field.abs().square().mean().sqrt()


def beam(grid: Grid, waist: float, tilt: float = 0.0, focus: float = math.inf, wavelength: float = 530e-9):
    """Gaussian beam of the given waist (1/e amplitude radius), tilted by ``tilt`` cycles per metre, or focused."""
    y, x = grid.coordinates()
    square = y**2 + x**2
    return torch.exp(-square / waist**2) * phasor(2 * math.pi * tilt * x - math.pi * square / (wavelength * focus))


def error(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((got - wanted).norm() / wanted.norm()).item()


@pytest.mark.parametrize(("dtype", "limit"), [(torch.complex64, 2e-5), (torch.complex128, 1e-8)])
@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize(("shape", "pitch"), [((256, 256), 8e-6), ((256, 256), 3.74e-6), ((301, 255), 8e-6)])
def test_smooth_beams_against_the_hankel_integral(dtype, limit, distance, shape, pitch):
    """No FFT in the oracle. The beam's waist is a tenth of the window, so that its rim is at exp(-25)."""
    grid, wavelength = Grid(shape, pitch), 530e-9
    waist = min(grid.extent) / 10
    y, x = (axis.numpy() for axis in grid.coordinates())
    radius = np.hypot(y, x)[::9, ::9]
    wanted = diffraction.gaussian_beam(waist, wavelength, abs(distance), radius.ravel()).reshape(radius.shape)
    wanted = torch.from_numpy(wanted if distance > 0 else wanted.conj())
    field = beam(grid, waist).to(dtype)
    got = propagate(field, grid, wavelength, distance, tolerance=1e-6)
    assert got.dtype == dtype
    assert error(got[::9, ::9].to(torch.complex128), wanted) <= limit


@pytest.mark.parametrize(("dtype", "middle", "worst"), [(torch.complex64, 2e-7, 5e-7), (torch.complex128, 1e-9, 1e-8)])
def test_large_smooth_beams_reach_what_the_dtype_holds(dtype, middle, worst):
    """36 cases of 256 to 1024 px: rounding of float32, or a carrier of up to 2.4e7 rad in float64, and nothing else."""
    found = []
    for size, pitch in ((256, 8e-6), (256, 3.74e-6), (512, 8e-6), (512, 3.74e-6), (1024, 8e-6), (1024, 3.74e-6)):
        grid, wavelength = Grid(size, pitch), 530e-9
        field, waist, step = beam(grid, size * pitch / 10).to(dtype), size * pitch / 10, size // 12
        y, x = (axis.numpy() for axis in grid.coordinates())
        radius = np.hypot(y, x)[::step, ::step]
        for distance in DISTANCES:
            wanted = diffraction.gaussian_beam(waist, wavelength, abs(distance), radius.ravel()).reshape(radius.shape)
            wanted = torch.from_numpy(wanted if distance > 0 else wanted.conj())
            got = propagate(field, grid, wavelength, distance, tolerance=1e-6)[::step, ::step]
            found.append(error(got.to(torch.complex128), wanted))
    assert len(found) == 36 and np.median(found) <= middle and max(found) <= worst


@pytest.mark.parametrize("crossovers", [0.03, 0.3, 0.8, 0.9, 1.0, 1.1, 1.2, 3.0, 10.0])
@pytest.mark.parametrize("pitch", [8e-6, 3.74e-6])
def test_white_phase_around_the_cross_over_distance(crossovers, pitch):
    grid, wavelength = Grid((24, 20), pitch), 530e-9
    distance = crossovers * 2 * grid.extent[1] * pitch / wavelength
    field = phasor(2 * math.pi * torch.rand(grid.shape, dtype=torch.float64))
    matrix = dense.band_limited_propagation(
        grid.shape, grid.pitch, wavelength, distance, False, 250 if crossovers < 5 else 800
    )
    wanted = torch.from_numpy((matrix @ field.numpy().ravel()).reshape(grid.shape))
    for dtype in (torch.complex64, torch.complex128):
        got = propagate(field.to(dtype), grid, wavelength, distance, tolerance=5e-3)
        assert error(got.to(torch.complex128), wanted) <= 5e-3 * 2  # twice the expectation for one small field


def test_each_axis_has_its_own_cross_over_distance():
    # 97 x 640 px at 60 mm: one axis is three times beyond its cross-over distance, the other at half of it.
    grid, wavelength = Grid((97, 640), 8e-6), 530e-9
    y, x = (axis.numpy() for axis in grid.coordinates())
    field = np.exp(-((y / 90e-6) ** 2) - (x / 600e-6) ** 2 + 0j)
    got = propagate(torch.from_numpy(field), grid, wavelength, 60e-3, tolerance=1e-6)
    # Separable and paraxial to 1e-7 for these waists: the product of two one-dimensional Gaussian beams.
    wanted = np.exp(2j * np.pi * (60e-3 / wavelength % 1)) * np.ones(grid.shape)
    for axis, waist in ((y, 90e-6), (x, 600e-6)):
        q = 1 + 1j * wavelength * 60e-3 / (np.pi * waist**2)
        wanted = wanted / np.sqrt(q) * np.exp(-((axis / waist) ** 2) / q)
    assert error(got, torch.from_numpy(wanted)) <= 2e-5


@pytest.mark.parametrize("distance", [20e-3, 50e-3])
def test_beams_that_leave_the_window_and_lens_foci(distance):
    grid, wavelength = Grid(192, 8e-6), 530e-9
    wide = Grid(768, 8e-6)
    for tilt, focus in ((3.5e4, math.inf), (0.0, distance), (-2e4, -40e-3)):
        small, large = (beam(g, 190e-6, tilt, focus) for g in (grid, wide))
        reference = CroppedKernel(wide, wavelength, distance)(large[None])[0, 288:480, 288:480]
        assert error(propagate(small, grid, wavelength, distance, tolerance=1e-6), reference) <= 1e-5


def test_prediction_is_within_a_factor_of_ten_and_never_below_a_third_over_random_cases():
    """Every adequate and inadequate way of 24 cases, more than 200 in all, against a padding of twice the largest."""
    generator = np.random.default_rng(3)
    checked, cheapest = 0, 0
    for case in range(24):
        pitch, share = float(generator.choice([3.74e-6, 8e-6])), float(generator.uniform(0.2, 1.0))
        grid = Grid((int(generator.integers(40, 90)), int(generator.integers(40, 90))), pitch)
        wavelength = float(generator.choice([450e-9, 530e-9, 636e-9]))
        distance = 10 ** generator.uniform(-2, 0.7) * 2 * max(grid.extent) * pitch / wavelength
        field = noise(grid, share, case)
        wide = Grid((4 * grid.shape[0], 4 * grid.shape[1]), pitch)
        padded = torch.nn.functional.pad(field, (0, 3 * grid.shape[1], 0, 3 * grid.shape[0]))
        exact = CroppedKernel(wide, wavelength, distance)(padded[None])[0, : grid.shape[0], : grid.shape[1]]
        band = (share / (2 * pitch), share / (2 * pitch))
        path = PlanePair(grid, grid)
        found = candidates(path, [wavelength], [distance], FieldContent(band))
        truths = {}
        for way in found:
            waves, far = torch.tensor(wavelength, dtype=torch.float64), torch.tensor(distance, dtype=torch.float64)
            kernel = kernel_of(path, way, waves, far, torch.complex64)
            out = torch.fft.ifft2(torch.fft.fft2(field.to(torch.complex64), s=kernel.shape[-2:]) * kernel)
            truths[id(way)] = error(out[: grid.shape[0], : grid.shape[1]].to(torch.complex128), exact)
            if 1e-6 < way.error < 0.05:  # above rounding, and short of nonsense
                checked += 1
                assert way.error / 10 <= truths[id(way)] <= 3 * way.error, (case, way, truths[id(way)])
        adequate = [way for way in found if truths[id(way)] <= 1e-3]
        chosen = next(way for way in sorted(found, key=lambda w: (w.flops, not w.paraxial)) if way.error <= 1e-3)
        cheapest += chosen.flops <= min(way.flops for way in adequate) * 1.001
    assert checked >= 200
    assert cheapest >= 0.9 * 24


def test_plan_says_what_why_and_what_came_next():
    plan = plan_propagation(Grid(256, 8e-6), 530e-9, 0.1)
    assert plan.method == "cropped kernel" and plan.padded == (512, 512) and plan.pad == (2, 2)
    assert plan.adequate and plan.predicted_error < 1e-3 and plan.memory_bytes > 0 and plan.flops > 0
    assert "is the cheapest adequate of" in plan.reason and "lost by its predicted error" in plan.runner_up
    assert plan_propagation(Grid(256, 8e-6), 530e-9, 0.0).method == "identity"
    near = plan_propagation(Grid(1024, 8e-6), 530e-9, 1e-3)
    assert near.method == "angular spectrum" and max(near.pad) <= 1.5
    # Full-band content keeps its sinc tails at any distance, and their phase is beyond Fresnel; a third of it has few.
    far = plan_propagation(Grid(64, 8e-6), 530e-9, -0.5, band=(2e4, 2e4))
    assert far.method == "Fresnel"
    smooth = plan_propagation(Grid(256, 8e-6), 530e-9, 5e-3, band=(5e3, 5e3), tolerance=1e-2)
    assert smooth.flops < plan_propagation(Grid(256, 8e-6), 530e-9, 5e-3, tolerance=1e-2).flops


def test_propagator_equals_propagate_and_keeps_its_plan():
    grid, field = Grid((30, 41), 8e-6), noise(Grid((30, 41), 8e-6), 1.0, 1).to(torch.complex64)
    for distance in (0.0, 1e-6, 1e-4, 5e-3, -0.5):
        module = Propagator(grid, 530e-9, distance)
        got, wanted = module(field[None])[0], propagate(field, grid, 530e-9, distance)
        # The module rounds its kernel once, the function its factors: three roundings of 6e-8.
        assert error(got, wanted) <= 5e-7
        assert module.plan == plan_propagation(grid, 530e-9, distance)


def test_many_distances_and_wavelengths_in_one_call():
    grid, field = Grid((30, 41), 8e-6), noise(Grid((30, 41), 8e-6), 1.0, 1)
    distances = torch.tensor([1e-3, 0.0, -20e-3, 0.4], dtype=torch.float64)
    stack = propagate(field, grid, 530e-9, distances, tolerance=1e-3)
    assert stack.shape == (4, 30, 41)
    for one, distance in zip(stack, distances, strict=True):
        assert (
            error(one, propagate(field, grid, 530e-9, distance.item(), tolerance=1e-9 if distance == 0 else 1e-4))
            < 2e-3
        )
    waves = torch.tensor([630e-9, 530e-9, 445e-9], dtype=torch.float64)
    colours = propagate(torch.stack([field] * 3), grid, waves, 5e-3)
    batch = propagate(torch.stack([field] * 3).expand(2, 3, 30, 41), grid, waves, 5e-3)
    assert colours.shape == (3, 30, 41) and torch.equal(batch[1], colours)
    for one, wave in zip(colours, waves, strict=True):
        assert error(one, CroppedKernel(grid, wave.item(), 5e-3)(field[None])[0]) < 2e-3
    table = propagate(field, grid, waves[:, None], distances)
    assert table.shape == (3, 4, 30, 41)


@pytest.mark.parametrize("distance", [2e-4, 5e-3, -0.4])
def test_gradients_through_field_wavelength_and_distance(distance):
    grid = Grid((5, 6), (8e-6, 7e-6))

    def run(field, wavelength_factor, distance_factor):
        return propagate(field, grid, 530e-9 * wavelength_factor, distance * distance_factor, tolerance=1e-2)

    field = torch.randn(5, 6, dtype=torch.complex128, requires_grad=True)
    one = torch.ones((), dtype=torch.float64)
    # The difference quotient errs by (turned angle)^2 / 6 of the gradient, and by the rounding of 1e-16 / step.
    step = 1e-6 if abs(distance) < 1e-3 else 1e-8 if abs(distance) < 0.1 else 1e-10
    turned = 2 * math.pi * abs(distance) / 530e-9 * step
    inputs = (field, one.clone().requires_grad_(), one.clone().requires_grad_())
    assert torch.autograd.gradcheck(run, inputs, eps=step, atol=1e-12 / step, rtol=1e-6 + turned**2)


@pytest.mark.parametrize("distance", [0.3e-6, -0.3e-6, 5e-6, 100e-6])
def test_pitches_below_half_a_wavelength_decay_and_warn_of_what_is_lost(distance):
    grid, wavelength = Grid((24, 20), 0.2e-6), 530e-9
    field = noise(grid, 1.0, 4)
    try:
        out = propagate(field, grid, wavelength, distance, tolerance=0.5)
    except ValueError as refusal:
        assert "no method reaches a tolerance of 5.0e-01" in str(refusal)
        return
    assert torch.isfinite(torch.view_as_real(out)).all()
    assert out.norm() <= field.norm() * 1.001  # evanescent waves decay for either sign


@pytest.mark.parametrize("distance", [1e-6, 1e3, -1e3])
def test_extreme_distances_stay_finite(distance):
    grid = Grid((1, 33), 8e-6)
    out = propagate(noise(grid, 1.0, 2).to(torch.complex64), grid, 530e-9, distance, tolerance=1e-2)
    assert torch.isfinite(torch.view_as_real(out)).all()


def test_says_when_the_tolerance_cannot_be_met():
    grid = Grid(96, 8e-6)
    field = beam(grid, 90e-6)
    with pytest.warns(
        SamplingWarning, match=r"no method reaches a tolerance of 1\.0e-07 .*; .* comes to .*margin="
    ) as caught:
        propagate(field, grid, 530e-9, 5e-3, tolerance=1e-7)
    assert caught[0].filename == __file__
    # Described as what it is, a smooth beam, the same tolerance is met without a word.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        propagate(field, grid, 530e-9, 5e-3, tolerance=1e-7, band=(1.5e4, 1.5e4), margin=(300e-6, 300e-6))


def test_no_warning_is_raised_on_the_planned_way():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = propagate(noise(Grid(24, 8e-6), 1.0, 2), Grid(24, 8e-6), 530e-9, 0.3, tolerance=1e-2)
    assert 0 < out.norm() < 24


GOOD: dict = {
    "field": torch.ones(8, 8, dtype=torch.complex64),
    "grid": Grid(8, 8e-6),
    "wavelength": 530e-9,
    "distance": 1e-3,
}


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"field": torch.ones(8, 8)}, TypeError, "field must be complex"),
        ({"field": torch.ones(8, 8, dtype=torch.int64)}, TypeError, "field must be complex"),
        (
            {"field": torch.ones(8, dtype=torch.complex64)},
            ValueError,
            r"field must end in \(H, W\) = \(8, 8\), got \(8,\)",
        ),
        ({"field": torch.full((8, 8), complex(math.nan, 0))}, ValueError, "field must be finite"),
        ({"wavelength": 0.0}, ValueError, "wavelength must be above zero"),
        ({"wavelength": -1e-9}, ValueError, "wavelength must be above zero"),
        ({"wavelength": math.nan}, ValueError, "wavelength must be finite"),
        ({"wavelength": torch.tensor([530e-9, 0.0])}, ValueError, "wavelength must be above zero"),
        ({"distance": math.inf}, ValueError, "distance must be finite"),
        ({"distance": torch.tensor(math.nan)}, ValueError, "distance must be finite"),
        ({"distance": "1 mm"}, TypeError, "distance must be a number in metres"),
        ({"tolerance": 0.0}, ValueError, "tolerance must be above zero"),
        ({"margin": (-1.0, 0.0)}, ValueError, "margin must be at least 0 metres"),
        ({"band": (0.0, 1e4)}, ValueError, "band must be above zero in cycles per metre"),
    ],
)
def test_bad_input_is_named(change, kind, message):
    with pytest.raises(kind, match=message):
        propagate(**{**GOOD, **change})


def test_memory_is_said_before_it_is_taken():
    with pytest.raises(ValueError, match=r"needs 2\.15 GB per channel, more than the 1 GB allowed; propagate tiles"):
        plan_propagation(Grid(4096, 8e-6), 530e-9, 0.3, memory_limit=10**9)
    with pytest.raises(ValueError, match="propagate tiles"):
        Propagator(Grid(256, 8e-6), 530e-9, 0.3, memory_limit=10**6)
