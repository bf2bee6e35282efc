"""AxialHologram against its own definition, near and far; what it predicts; planes as they come."""

import math
import warnings

import numpy as np
import pytest
import torch
from oracles import holograms

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.hologram import AxialHologram, DirectHologram
from holotorch.hologram.nodes import Nodes, _spreading_error, choose_nodes

WAVE = 520e-9
PITCH = 3.74e-6


def sources(*shape: int, dtype: torch.dtype = torch.complex128) -> torch.Tensor:
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(3))


def relative(got: torch.Tensor, wanted) -> float:
    wanted = torch.as_tensor(wanted)
    return ((got.to(torch.complex128) - wanted).norm() / wanted.norm()).item()


def even(low: float, high: float, count: int) -> list[float]:
    return np.linspace(low, high, count).tolist()


def uneven(low: float, high: float, count: int) -> list[float]:
    return np.sort(np.random.default_rng(1).uniform(low, high, count)).tolist()


FAR = [
    ("even, 40 planes", even(30e-3, 31e-3, 40), 1),
    ("uneven", uneven(30e-3, 33e-3, 25), 2),
    ("one plane", [50e-3], 1),
    ("158 mm", even(157e-3, 158e-3, 9), 2),
]


@pytest.mark.parametrize(("name", "depths", "stride"), FAR, ids=lambda value: value if isinstance(value, str) else "")
@pytest.mark.parametrize("cone", ["taper", "full"])
@pytest.mark.parametrize("tolerance", [3e-3, 1e-4])
def test_far_away_it_is_the_direct_sum(name, depths, stride, cone, tolerance):
    """Where the cone is much wider than all pairs the taper is the plain wave."""
    grid, layers = Grid((64, 48), PITCH), sources(len(depths), 24, 30)
    operator = AxialHologram(grid, WAVE, depths, cone=cone, stride=stride, tolerance=tolerance)
    error = relative(operator(layers), DirectHologram(grid, WAVE, depths, cone="full", stride=stride)(layers))
    design = operator.design((24, 30))
    assert design.adequate and error < tolerance
    # The estimate is for noise, on each axis alone, and the worse of the nearest and the farthest plane.
    assert error / 3 < design.predicted_error or design.predicted_error < 1e-7
    assert design.predicted_error < 3 * error


NEAR = [("taper", 3e-3), ("taper", 1e-4), ("taper", 1e-5), ("band", 3e-3)]


@pytest.mark.parametrize(("cone", "tolerance"), NEAR)
@pytest.mark.parametrize("depths", [even(0.9e-3, 1.2e-3, 9), uneven(0.6e-3, 1.3e-3, 7)], ids=["even", "uneven"])
def test_near_it_is_its_own_definition(cone, tolerance, depths):
    grid, layers = Grid((64, 48), PITCH), sources(len(depths), 32, 20)
    operator = AxialHologram(grid, WAVE, depths, cone=cone, stride=2, tolerance=tolerance)
    wanted = holograms.direct(layers.numpy(), grid.shape, grid.pitch, WAVE, depths, cone, stride=2)
    error, design = relative(operator(layers), wanted), operator.design((32, 20))
    assert error < tolerance and design.adequate
    assert error / 3 < design.predicted_error < 3 * error or design.predicted_error < 1e-7


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("shape", [(32, 32), (13, 40)])
def test_it_keeps_its_definition_around_the_border(tolerance, shape):
    """From a cone half as wide as all pairs to one three times as wide, where the taper changes less and less."""
    grid = Grid((40, 33), PITCH)
    for part in (0.5, 1.0, 1.2, 1.5, 2.0, 3.0):
        depth = part * 36 * PITCH / math.tan(math.asin(WAVE / 2 / PITCH))
        layers = sources(1, *shape)
        operator = AxialHologram(grid, WAVE, [depth], tolerance=tolerance)
        direct = DirectHologram(grid, WAVE, [depth], cone="taper")(layers)
        assert relative(operator(layers), direct) < tolerance


def test_the_plain_wave_is_judged_as_such():
    """Beyond the border the fading of steep light is an error, which is foreseen; within it ``full`` is refused."""
    grid, layers = Grid(48, PITCH), sources(1, 48, 48)
    border = 48 * PITCH / math.tan(math.asin(WAVE / 2 / PITCH))
    for part in (1.02, 1.1, 1.3, 1.6, 2.5):
        operator = AxialHologram(grid, WAVE, [part * border], cone="full", tolerance=1e-3)
        predicted = operator.design((48, 48)).predicted_error
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            error = relative(operator(layers), DirectHologram(grid, WAVE, [part * border], cone="full")(layers))
        assert error / 3 < predicted < 3 * error
        assert part > 1.1 or not operator.design((48, 48)).adequate
    with pytest.raises(ValueError, match="within every source's cone, from 0.00258 m on for layers of .48, 48."):
        AxialHologram(grid, WAVE, [0.9 * border], cone="full")(layers)


def test_what_a_sharp_band_cannot_reach_is_said():
    operator = AxialHologram(Grid(64, PITCH), WAVE, [1e-3], cone="band", tolerance=1e-5)
    design = operator.design((64, 64))
    assert not design.adequate and design.predicted_error > 1e-5
    with pytest.warns(SamplingWarning, match="relative error is about .*, and its tolerance 1.0e-05: use Conv"):
        operator(sources(1, 64, 64))


def test_nodes_do_not_grow_with_the_planes():
    grid = Grid(256, PITCH)
    counts = [
        AxialHologram(grid, 636e-9, even(9e-3, 11e-3, planes)).design((256, 256)).nodes.count
        for planes in (100, 400, 1600)
    ]
    assert max(counts) < 1.5 * min(counts) and max(counts) < 60  # wide windows cost more for many planes, nodes less
    few = AxialHologram(grid, 636e-9, even(9e-3, 11e-3, 12)).design((256, 256)).nodes
    assert few.count == 12 and few.width == 1  # planes that are even are their own nodes


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("depths", [(0.02, 0.023), (0.1, 0.1001), tuple(uneven(0.03, 0.034, 200))])
def test_exponentials_on_nodes_are_as_good_as_said(tolerance, depths):
    low, high = 1.56e6, 1.572e6  # cycles per metre of red light within 7 degrees
    nodes = choose_nodes(tuple(depths), low, high, tolerance)
    frequency = torch.linspace(low, high, 50, dtype=torch.float64)
    response = nodes.response(frequency - nodes.centre)
    worst = 0.0
    for depth, begin, weights in zip(depths, *nodes.weights(depths), strict=True):
        assert begin >= 0 and begin + nodes.width <= nodes.count
        total = sum(
            w * torch.exp(2j * math.pi * nodes.depth(begin + k) * (frequency - nodes.centre))
            for k, w in enumerate(weights)
        )
        wanted = torch.exp(2j * math.pi * (depth * frequency))
        worst = max(worst, (total / response - wanted).abs().max().item())
    # Root mean square below the tolerance: the ends of the band are worse. The phase of 3e5 rad itself keeps 1e-10.
    assert worst < 5 * tolerance + 1e-9
    assert nodes.width == 1 or nodes.error(low, high) <= tolerance


def test_the_window_is_the_transform_it_is_said_to_be():
    nodes = Nodes(0.0, 1e-4, 100, 6, 1.5, 0.0)
    z = np.linspace(-3e-4, 3e-4, 20001)
    values = np.i0(nodes._beta * np.sqrt(np.clip(1 - (z / 3e-4) ** 2, 0, None)))
    for frequency in (0.0, 1500.0, 3300.0, 9000.0):
        wanted = np.trapezoid(values * np.cos(2 * np.pi * frequency * z), z) / 1e-4
        got = nodes.response(torch.tensor([frequency], dtype=torch.float64)).item()
        assert got == pytest.approx(wanted, rel=1e-6, abs=1e-6 * values.sum() / 1e4)


@pytest.mark.parametrize("falling", [False, True])
def test_planes_may_come_one_by_one_from_either_side(falling):
    depths = uneven(2e-3, 6e-3, 60)
    layers = sources(60, 12, 10, dtype=torch.complex64)
    amplitude, phase = layers.abs(), layers[0].angle()
    amplitude[7:30] = 0  # a gap of many nodes
    whole = AxialHologram(Grid(24, PITCH), WAVE, depths)(amplitude * torch.exp(1j * phase))
    order = slice(None, None, -1) if falling else slice(None)
    operator = AxialHologram(Grid(24, PITCH), WAVE, depths[order])
    planes = amplitude.flip(0) if falling else amplitude
    # float32 sums of 60 planes on some 40 nodes.
    assert relative(operator.accumulate(iter(planes), phase), whole) < 3e-6
    assert relative(operator.accumulate(planes * torch.exp(1j * phase)), whole) < 3e-6


def test_planes_out_of_order_and_none_are_named():
    operator = AxialHologram(Grid(24, PITCH), WAVE, [1e-3, 3e-3, 2e-3])
    with pytest.raises(ValueError, match="rising or falling depth"):
        operator.accumulate(sources(3, 8, 8))
    with pytest.raises(ValueError, match="no planes"):
        operator.accumulate([])
    dark = AxialHologram(Grid(24, PITCH), WAVE, [1e-3, 2e-3, 3e-3]).accumulate(torch.zeros(3, 8, 8))
    assert dark.shape == (24, 24) and not dark.any()
    assert operator(sources(3, 8, 8)).isfinite().all()  # a tensor may hold them in any order


def test_complex64_is_good_to_a_millionth():
    depths, layers = even(20e-3, 22e-3, 300), sources(300, 32, 32)
    operator = AxialHologram(Grid(64, PITCH), WAVE, depths, stride=2)
    # Horner's rule multiplies rounding of 6e-8 over some 50 nodes.
    assert relative(operator(layers.to(torch.complex64)), operator(layers)) < 3e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cone": "box"}, "works in frequency, with cone='taper', 'band' or 'full', got 'box'"),
        ({"depths": [0.0]}, "depth of a plane must be above zero"),
        ({"tolerance": 0.0}, "tolerance must be above zero"),
    ],
)
def test_impossible_arguments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        AxialHologram(**{"grid": Grid(8, PITCH), "wavelength": WAVE, "depths": [1e-3], **change})


def test_a_pitch_below_the_wavelength_is_refused():
    for cone in ("taper", "full"):
        with pytest.raises(ValueError, match="needs a pitch of at least 0.9 wavelengths, .* ConvolutionHologram"):
            AxialHologram(Grid(32, 0.4e-6), WAVE, [5e-6, 6e-6], cone=cone)


@pytest.mark.parametrize("oversampling", [1.25, 1.5, 2.0])
@pytest.mark.parametrize("width", [4, 6, 8])
def test_the_error_of_spreading_depends_on_the_window_alone(width, oversampling):
    low, high = 1.2e6, 1.9e6
    nodes = Nodes(0.02, 1 / (oversampling * (high - low)), 30, width, oversampling, (low + high) / 2)
    assert _spreading_error(width, oversampling) == pytest.approx(nodes.error(low, high), rel=1e-3)
