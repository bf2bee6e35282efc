"""Light behind a lens, against quadrature over the band, closed-form beams and the full diffraction integral."""

import math

import numpy as np
import pytest
import torch
from oracles import converging as oracle

from holotorch import Grid
from holotorch.core.fourier import centred_fft2
from holotorch.optics import CroppedKernel, Fresnel
from holotorch.optics.elements.converging import ConvergingFresnel, converging_fresnel
from holotorch.optics.free_space.kernels import carrier

# These grids are small, their lenses strong and their result compared with paraxial light.
pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")

WAVES = (630e-9, 530e-9)
WAVE_TENSOR = torch.tensor(WAVES, dtype=torch.float64)
GRID = Grid((12, 17), (8e-6, 7e-6))
SQUEEZED = Grid((13, 16), (4e-6, 9e-6))
FOCUS = 2e-3
PLACES = {  # distance, focus
    "before the focus": (0.6e-3, FOCUS),
    "just before": ((1 - 1e-3) * FOCUS, FOCUS),
    "in the focus": (FOCUS, FOCUS),
    "just beyond": ((1 + 1e-3) * FOCUS, FOCUS),
    "far beyond": (7e-3, FOCUS),
    "backwards": (-1.2e-3, FOCUS),
    "diverging": (1e-3, -1.5e-3),
    "diverging, backwards to the focus": (-1.5e-3, -1.5e-3),
    "diverging, backwards beyond it": (-4e-3, -1.5e-3),
    "no lens": (3e-3, math.inf),
}
NEAR = ("just before", "in the focus", "just beyond", "diverging, backwards to the focus")
TARGETS = {
    "scaled": (None, (0.0, 0.0)),
    "scaled, aside": (None, (-13e-6, 35e-6)),
    "finer": (Grid((9, 14), (1.5e-6, 1.1e-6)), (0.0, 0.0)),
    "coarser, aside": (Grid((7, 10), (11e-6, 14e-6)), (21e-6, -40e-6)),
}


def white(grid: Grid, *batch: int) -> torch.Tensor:
    return torch.exp(2j * torch.pi * torch.rand(*batch, len(WAVES), *grid.shape, dtype=torch.float64))


def coordinates(grid: Grid, offset=(0.0, 0.0)) -> list[np.ndarray]:
    return [axis.numpy().ravel() + shift for axis, shift in zip(grid.coordinates(), offset, strict=True)]


def relative(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((got - wanted).norm() / wanted.norm()).item()


def wanted_of(field: torch.Tensor, grid: Grid, place, out_grid: Grid, offset, wavelength: float) -> torch.Tensor:
    columns, rows = (
        oracle.behind_lens(reached, source, pitch, wavelength, *place)
        for reached, source, pitch in zip(coordinates(out_grid, offset), coordinates(grid), grid.pitch, strict=True)
    )
    return torch.from_numpy(columns @ field.numpy() @ rows.T) * carrier(wavelength, place[0])


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("grid", [GRID, SQUEEZED], ids=["even x odd", "odd x even"])
def test_equals_quadrature(place, target, grid):
    distance, focus = PLACES[place]
    out_grid, offset = TARGETS[target]
    if out_grid is None and place in NEAR:
        with pytest.raises(ValueError, match="so near to the focus"):
            ConvergingFresnel(grid, WAVES, distance, focus)
        return
    operator, field = ConvergingFresnel(grid, WAVES, distance, focus, out_grid=out_grid, offset=offset), white(grid)
    assert operator.scaled == (out_grid is None)
    got = operator(field)
    for c, wave in enumerate(WAVES):
        wanted = wanted_of(field[c], grid, (distance, focus), operator.out_grid, offset, wave)
        # Both round their phases: the chirp across the band, wavelength |z / m| B^2 / 2 turns, and the carrier.
        steep = wave * abs(distance / (operator.magnification or 1)) / (8 * min(grid.pitch) ** 2)
        rounding = 1e-12 + 2 * np.pi * 4e-16 * (steep + abs(distance) / wave)
        assert (got[c] - wanted).norm() <= rounding * wanted.norm()


@pytest.mark.parametrize("place", [place for place in PLACES if place not in NEAR])
@pytest.mark.parametrize("grid", [GRID, SQUEEZED, Grid((1, 9), 8e-6)], ids=["even x odd", "odd x even", "a line"])
def test_transforms_and_matrices_agree(place, grid):
    offset = (-13e-6, 35e-6)
    operator, field = ConvergingFresnel(grid, WAVES, *PLACES[place], offset=offset), white(grid, 2)
    assert operator.scaled
    got = converging_fresnel(field, grid, WAVE_TENSOR, *PLACES[place], operator.out_grid, offset=offset)
    # Chirps of up to 1e3 turns, as above, rounded twice.
    assert relative(got, operator(field)) <= 2 * np.pi * 4e-16 * 1e4
    # A grid of the same pitch and shape, given in words, is the same.
    again = ConvergingFresnel(grid, WAVES, *PLACES[place], out_grid=operator.out_grid, offset=offset)
    assert torch.equal(again(field), operator(field))


@pytest.mark.parametrize("distance", [1e-6, 2e-3, -30e-3])
@pytest.mark.parametrize("focus", [math.inf, -math.inf])
def test_without_a_lens_it_is_the_paraxial_cropped_kernel(distance, focus):
    offset, field = (4e-6, -50e-6), white(GRID)
    wanted = CroppedKernel(GRID, WAVES, distance, paraxial=True, offset=offset)(field)
    operator = ConvergingFresnel(GRID, WAVES, distance, focus, offset=offset)
    assert operator.out_grid == GRID
    assert relative(operator(field), wanted) <= 1e-12
    got = converging_fresnel(field, GRID, WAVE_TENSOR, distance, focus, GRID, offset=offset)
    # At 1 um the chirp of the outermost sample makes 2e4 turns, which cancel in all but the rim.
    assert relative(got, wanted) <= 2 * np.pi * 4e-16 * 2e4 * 10


@pytest.mark.parametrize("focus", [1e-3, -1e-3])
@pytest.mark.parametrize("distance", [0.3e-3, 1e-3, -1e-3, 1.001e-3, 4e-3])
def test_gaussian_beam(distance, focus):
    # With waists of pitch sqrt(n / pi) both the window and the band cut at exp(-pi n / 4) = 3e-17.
    grid, out_grid, offset = Grid((50, 49), (6e-6, 7e-6)), Grid((20, 31), (4e-6, 3e-6)), (-5e-6, 11e-6)
    waists = [pitch * math.sqrt(size / math.pi) for size, pitch in zip(grid.shape, grid.pitch, strict=True)]
    y, x = (np.exp(-((place / waist) ** 2)) for place, waist in zip(coordinates(grid), waists, strict=True))
    field = torch.from_numpy(np.outer(y, x)).to(torch.complex128)[None]
    places = zip(waists, coordinates(out_grid, offset), strict=True)
    y, x = (oracle.gaussian_behind_lens(waist, WAVES[0], distance, focus, place) for waist, place in places)
    wanted = torch.from_numpy(np.outer(y, x)) * carrier(WAVES[0], distance)
    got = ConvergingFresnel(grid, WAVES[0], distance, focus, out_grid=out_grid, offset=offset)(field)
    # Chirps at the rim of the grid of up to 2e2 turns, and carriers of 6e3.
    assert (got - wanted).abs().max() <= 2 * np.pi * 4e-16 * 6e3 * wanted.abs().max()


def test_a_lens_that_the_grid_cannot_sample():
    # Beyond r = wavelength focus / (2 pitch) = 24 um, well inside the waist, the sampled phase of the lens turns back.
    grid, distance, focus = Grid(50, 8e-6), 0.4e-3, 0.6e-3
    waist = 8e-6 * math.sqrt(50 / math.pi)
    squares = [axis.square() for axis in grid.coordinates()]
    field = torch.exp(-(squares[0] + squares[1]) / waist**2).to(torch.complex128)[None]
    line = oracle.gaussian_behind_lens(waist, WAVES[0], distance, focus, coordinates(grid)[0])
    wanted = torch.from_numpy(np.outer(line, line)) * carrier(WAVES[0], distance)
    got = ConvergingFresnel(grid, WAVES[0], distance, focus, out_grid=grid)(field)[0]
    assert relative(got, wanted) <= 1e-11
    lens = torch.exp(-1j * torch.pi / (WAVES[0] * focus) * (squares[0] + squares[1]))
    assert relative(Fresnel(grid, WAVES[0], distance)(field * lens)[0], wanted) >= 0.3


@pytest.mark.parametrize("distance", [2e-3, -2e-3])
@pytest.mark.parametrize("grid", [GRID, SQUEEZED], ids=["even x odd", "odd x even"])
def test_in_the_focus_it_is_the_fourier_transform(distance, grid):
    wave, (height, width) = WAVES[0], grid.shape
    out_grid = Grid(grid.shape, (wave * 2e-3 / grid.extent[0], wave * 2e-3 / grid.extent[1]))
    field = white(grid)[:1]
    got = ConvergingFresnel(grid, wave, distance, distance, out_grid=out_grid)(field)
    spectrum = centred_fft2(field) if distance > 0 else centred_fft2(field.conj()).conj()
    y, x = out_grid.coordinates()
    chirp = torch.exp(1j * torch.pi * (y.square() + x.square()) / (wave * distance))
    # The outermost sample of an even axis lies on the edge of the band, which has half the height there.
    half = torch.ones(grid.shape, dtype=torch.float64)
    half[0] *= 0.5 if height % 2 == 0 else 1.0
    half[:, 0] *= 0.5 if width % 2 == 0 else 1.0
    area = math.prod(grid.pitch) * math.sqrt(height * width)
    wanted = carrier(wave, distance) * chirp * half * spectrum * area / (1j * wave * distance)
    assert relative(got, wanted) <= 1e-11  # carriers and chirps of 3e3 turns


@pytest.mark.parametrize("distance", [FOCUS, -FOCUS])
def test_continuous_through_the_focus(distance):
    out_grid, field, wave = Grid((9, 14), (3e-6, 2.1e-6)), white(GRID)[:1], WAVES[0]
    wanted = ConvergingFresnel(GRID, wave, distance, distance, out_grid=out_grid)(field)
    # Each weight differs by its two rims, 1 / (pi u) of 1 / sqrt(2) or less; the result by two axes of such.
    depths = [0.5 / pitch - reach / (wave * FOCUS) for pitch, reach in zip(GRID.pitch, (12e-6, 14.7e-6), strict=True)]
    for m in (1e-12, -1e-12, 1e-10, -1e-10):
        operator = ConvergingFresnel(GRID, wave, distance, distance / (1 - m), out_grid=out_grid)
        assert operator.magnification == pytest.approx(m, rel=1e-3)
        rims = 2 * 2 * math.sqrt(2) / (math.pi * math.sqrt(2 * wave * FOCUS / abs(m)) * min(depths))
        bound = rims * math.prod(GRID.pitch) * math.prod(GRID.shape) / (wave * FOCUS)
        # And the phases move by m times those of the lens at the rim of the grid, 4 rad.
        assert (operator(field) - wanted).abs().max() <= bound * (1 + 4 * abs(m)) + 1e-10


def test_gradcheck_through_wavelength_distance_and_focus():
    out_grid, field = Grid((3, 4), (5e-6, 6e-6)), white(Grid((4, 5), 8e-6))[:1].requires_grad_()

    def result(field, wave, distance, focus):
        lengths = 530e-9 * wave, 1e-3 * distance, 1e-3 * focus
        out = converging_fresnel(field, Grid((4, 5), 8e-6), *lengths, out_grid, offset=(0.0, 9e-6))
        return out / carrier(lengths[0], lengths[1])[..., None, None]  # whose 1e4 rad drown the rest

    one = torch.ones((), dtype=torch.float64)
    for focus in (0.7, 1.6, -0.9, math.inf):
        lengths = [one.clone().requires_grad_(), one.clone().requires_grad_(), one * focus]
        lengths[2].requires_grad_(math.isfinite(focus))
        assert torch.autograd.gradcheck(result, (field, *lengths), eps=1e-6, atol=1e-6, rtol=1e-6)


def test_gradient_in_the_focus_is_that_of_the_lens():
    out_grid, field, focus = Grid((3, 4), (5e-6, 6e-6)), white(GRID)[0], torch.tensor(FOCUS, dtype=torch.float64)
    y, x = GRID.coordinates()
    bend = 1j * torch.pi * (y.square() + x.square()) / (WAVES[0] * FOCUS**2)  # of exp(-i pi r^2 / (wavelength focus))

    def result(focus):
        return converging_fresnel(field, GRID, WAVES[0], FOCUS, focus, out_grid)

    got = torch.autograd.functional.jvp(lambda f: torch.view_as_real(result(f)), focus, torch.ones_like(focus))[1]
    assert isinstance(got, torch.Tensor)
    wanted = converging_fresnel(field * bend, GRID, WAVES[0], FOCUS, FOCUS, out_grid)
    assert relative(torch.view_as_complex(got), wanted) <= 1e-11


def test_lengths_as_batches():
    field, out_grid = white(GRID, 3), Grid((9, 14), 3e-6)
    distances = torch.tensor([[1e-3], [FOCUS], [-4e-3]], dtype=torch.float64)
    got = converging_fresnel(field, GRID, WAVE_TENSOR, distances, FOCUS, out_grid)
    for i, distance in enumerate(distances.ravel().tolist()):
        wanted = ConvergingFresnel(GRID, WAVES, distance, FOCUS, out_grid=out_grid)(field[i])
        assert relative(got[i], wanted) <= 1e-12
