"""DirectHologram and ConvolutionHologram: the same sum, against pairs that are summed one by one."""

import numpy as np
import pytest
import torch
from oracles import holograms

from holotorch import Grid
from holotorch.core import checks
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram

BOTH = [DirectHologram, ConvolutionHologram]
GRID = Grid((21, 16), (3.74e-6, 5e-6))
WAVE = 520e-9


def sources(*shape: int, dtype: torch.dtype = torch.complex128) -> torch.Tensor:
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(3))


def relative(got: torch.Tensor, wanted) -> float:
    wanted = torch.as_tensor(wanted)
    return ((got.to(torch.complex128) - wanted).norm() / wanted.norm()).item()


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize("cone", ["full", "box", "disc"])
@pytest.mark.parametrize(("stride", "shape"), [(1, (13, 20)), (2, (7, 9)), (3, (9, 4))])
def test_equals_the_sum_over_pairs(kind, cone, stride, shape):
    depths = (0.05e-3, 0.21e-3, 2e-3, 30e-3)  # narrower than the window, about as wide, far wider
    layers = sources(4, *shape)
    layers[1] = 0
    layers[2, :, :2] = 0
    wanted = holograms.direct(layers.numpy(), GRID.shape, GRID.pitch, WAVE, depths, cone, stride)
    assert relative(kind(GRID, WAVE, depths, cone=cone, stride=stride)(layers), wanted) < 1e-12


# Of the convolution's waves 2e-7 wraps around, or may be left out where the closed form takes over.
LIMITED = [(DirectHologram, "taper", 1e-10), (DirectHologram, "band", 1e-10), (ConvolutionHologram, "taper", 5e-7)]


@pytest.mark.parametrize(("kind", "cone", "tolerance"), LIMITED)
@pytest.mark.parametrize(("stride", "shape"), [(1, (13, 20)), (2, (7, 9)), (3, (9, 4))])
def test_a_limited_spectrum_has_one_definition(kind, cone, tolerance, stride, shape):
    """Narrower than the window, about as wide, and wider."""
    depths, layers = (0.05e-3, 0.21e-3, 2e-3, 7e-3), sources(4, *shape)
    wanted = holograms.direct(layers.numpy(), GRID.shape, GRID.pitch, WAVE, depths, cone, stride)
    assert relative(kind(GRID, WAVE, depths, cone=cone, stride=stride)(layers), wanted) < tolerance


def test_the_plain_wave_takes_over_where_the_taper_changes_nothing():
    grid, layers = Grid((9, 12), 3.74e-6), sources(1, 7, 5)
    sizes = []
    for depth in (75e-3, 95e-3):
        operator = ConvolutionHologram(grid, WAVE, [depth], cone="taper")
        wanted = holograms.direct(layers.numpy(), grid.shape, grid.pitch, WAVE, [depth], "full")
        assert relative(operator(layers), wanted) < 5e-7  # 2e-7 wraps around, 2e-7 is the taper's
        sizes.append(max(operator.padded((7, 5))))
    assert sizes[0] > 1000 and sizes[1] < 50


@pytest.mark.parametrize("cone", ["taper", "band"])
def test_a_limited_spectrum_at_the_finest_pitch(cone):
    """0.9 wavelengths, where light at the corner of the band leaves at 52 degrees."""
    grid, layers = Grid((20, 17), (0.47e-6, 0.5e-6)), sources(1, 9, 12)
    wanted = holograms.direct(layers.numpy(), grid.shape, grid.pitch, WAVE, [4e-6], cone)
    assert relative(DirectHologram(grid, WAVE, [4e-6], cone=cone)(layers), wanted) < 1e-10
    if cone == "taper":
        assert relative(ConvolutionHologram(grid, WAVE, [4e-6], cone=cone)(layers), wanted) < 1e-6


# Phases of k z up to 2e6 rad are reduced before they are added, so float64 keeps 1e-12; complex64 rounds by 6e-8 times
# the root of some hundred additions.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.complex64, 1e-6), (torch.complex128, 1e-11)])
@pytest.mark.parametrize("wavelength", [636e-9, 520e-9, 455e-9])
@pytest.mark.parametrize("depth", [2e-3, 20e-3, 158e-3])
def test_both_agree_in_every_colour_near_and_far(dtype, tolerance, wavelength, depth):
    grid, depths = Grid((96, 80), 3.74e-6), [depth, depth * 1.01, depth * 1.013]  # unevenly spaced
    layers = sources(3, 40, 48)
    layers[:, 5:-5, 5:-5] = 0  # corners and rims only
    exact = DirectHologram(grid, wavelength, depths, stride=2)(layers)
    assert relative(ConvolutionHologram(grid, wavelength, depths, stride=2)(layers.to(dtype)), exact) < tolerance


def test_a_carrier_of_a_million_radians_is_right():
    """Against 30 digits: one source on the axis, 158 mm away, at 455 nm."""
    from decimal import Decimal, getcontext

    getcontext().prec = 40
    aside, far = Decimal("3.74e-6") * 7, Decimal("0.158")
    r = (far * far + aside * aside).sqrt()
    turns = float((r / Decimal("455e-9")) % 1)
    field = DirectHologram(Grid((1, 15), 3.74e-6), 455e-9, [0.158])(torch.ones(1, 1, 1, dtype=torch.complex128))
    wanted = np.exp(2j * np.pi * turns) / float(r)
    # 3.5e5 turns in float64 leave 4e-11 of one: 2.4e-10 rad.
    assert abs(field[0, 14].item() - wanted) < 5e-10 * abs(wanted)


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize("cone", ["box", "taper"])
def test_adjoint_to_fewer_sources_and_second_derivatives(kind, cone):
    operator = kind(GRID, WAVE, (0.3e-3, 1e-3), cone=cone, stride=2)
    layers, field = sources(2, 2, 6, 5), sources(2, *GRID.shape)
    formed, back = operator(layers), operator.adjoint(field, (6, 5))
    assert back.shape == layers.shape
    left, right = (formed.conj() * field).sum(), (layers.conj() * back).sum()
    assert (left - right).abs() < 1e-12 * formed.norm() * field.norm()
    small = kind(Grid((2, 3), 4e-6), WAVE, (0.3e-3, 1e-3), cone=cone)
    assert torch.autograd.gradgradcheck(lambda x: small(x).abs().square(), sources(2, 1, 2).requires_grad_())


@pytest.mark.parametrize("kind", BOTH)
def test_planes_without_light_contribute_nothing(kind):
    operator = kind(GRID, WAVE, (1e-3, 2e-3))
    dark = operator(torch.zeros(2, 5, 7, dtype=torch.complex64))
    assert dark.dtype == torch.complex64 and not dark.any()
    one = torch.zeros(2, 5, 7, dtype=torch.complex128)
    one[1, 2, 3] = torch.tensor(2j)  # on the axis
    only = kind(GRID, WAVE, (2e-3,))(torch.full((1, 1, 1), 2j, dtype=torch.complex128))
    assert relative(operator(one), only) < 1e-13


@pytest.mark.parametrize("kind", [*BOTH, AxialHologram])
def test_what_is_dark_changes_nothing_where_it_cannot_be_asked_for(kind, monkeypatch):
    """On a GPU, planes, rows and columns without light are computed like the others."""
    layers = sources(3, 13, 20)
    layers[1], layers[2, :4], layers[0, :, 15:] = 0, 0, 0
    operator = kind(GRID, WAVE, (0.3e-3, 0.34e-3, 0.35e-3), cone="taper")
    wanted = operator(layers)
    monkeypatch.setattr(checks, "readable", lambda *tensors: False)
    assert relative(operator(layers), wanted) < 1e-14


@pytest.mark.parametrize("kind", [*BOTH, AxialHologram])
def test_a_compiled_hologram_takes_layers_of_several_sizes(kind):
    torch.compiler.reset()
    operator = kind(Grid((3, 5), GRID.pitch), WAVE, (0.3e-3, 0.34e-3), cone="taper")
    compiled = torch.compile(operator, fullgraph=True, backend="eager")
    for shape in ((4, 5), (6, 3), (4, 5)):
        layers = sources(2, *shape)
        assert relative(compiled(layers), operator(layers)) < 1e-14


def test_full_waves_alias_where_the_cone_is_narrower_than_the_window():
    """The three definitions, at half the cone that the window has and beyond it (thesis Sec. 5.6.1)."""
    grid = Grid(128, 3.74e-6)
    layers = sources(1, 128, 128)
    for depth, low, high in ((2.8e-3, 0.3, 1.0), (7e-3, 0.0, 1e-12)):  # K / (V + H) = 0.5, 1.25
        full = ConvolutionHologram(grid, 636e-9, [depth], cone="full")(layers)
        box = ConvolutionHologram(grid, 636e-9, [depth], cone="box")(layers)
        assert low <= relative(full, box) <= high


def test_lengths_are_those_of_the_cone_and_no_more():
    grid = Grid(512, 3.74e-6)
    near = ConvolutionHologram(grid, 636e-9, [1e-3], stride=2).padded((256, 256))
    far = ConvolutionHologram(grid, 636e-9, [1.0], stride=2).padded((256, 256))
    assert near == (540, 540)  # 511 between the farthest pair, 22 of the cone
    assert far == (1024, 1024) and far[0] <= 2 * 512


@pytest.mark.parametrize("cone", ["full", "box", "disc", "taper", "band"])
def test_the_length_is_the_largest_that_a_plane_needs(cone):
    """Depths in any order, of which some are tapered in frequency, and some are so far that their wave is whole."""
    grid, depths = Grid((96, 64), (3.74e-6, 4e-6)), [4e-3, 0.3e-3, 31e-3, 9e-3, 8e-3, 1e-3, 120e-3, 16e-3]
    for count in range(1, len(depths) + 1):
        alone = [ConvolutionHologram(grid, 520e-9, [each], cone=cone).padded((40, 48)) for each in depths[:count]]
        largest = tuple(max(lengths) for lengths in zip(*alone, strict=True))
        assert ConvolutionHologram(grid, 520e-9, depths[:count], cone=cone).padded((40, 48)) == largest


def test_direct_counts_its_pairs():
    grid, depths = Grid((9, 8), 4e-6), (20e-6, 5e-3)
    layers = sources(2, 3, 4)
    layers[1, 0] = 0
    operator = DirectHologram(grid, WAVE, depths, stride=2)
    counted = 0
    for plane, depth in zip(layers.numpy(), depths, strict=True):
        for i, sy in enumerate(holograms.positions(3, 2) * 4e-6):
            for j, sx in enumerate(holograms.positions(4, 2) * 4e-6):
                dy, dx = (holograms.positions(n) * 4e-6 - s for n, s in ((9, sy), (8, sx)))
                field = holograms.wave(dy[:, None], dx[None], (4e-6, 4e-6), WAVE, depth, "box")
                counted += int((field != 0).sum()) * (plane[i, j] != 0)
    assert operator.pairs(layers) == counted
    assert DirectHologram(grid, WAVE, depths, stride=2, cone="full").pairs(layers) == (12 + 8) * 72


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"depths": []}, ValueError, "at least one distance"),
        ({"depths": [1e-3, 0.0]}, ValueError, "depth of a plane must be above zero in metres, got 0.0"),
        ({"depths": [-1e-3]}, ValueError, "depth of a plane must be above zero"),
        ({"depths": [float("nan")]}, ValueError, "depth of a plane must be finite"),
        ({"wavelength": 0.0}, ValueError, "wavelength must be above zero"),
        ({"stride": 0}, ValueError, "stride must be at least 1"),
    ],
)
def test_impossible_arguments_are_named(kind, change, error, message):
    arguments = {"grid": GRID, "wavelength": WAVE, "depths": [1e-3], **change}
    with pytest.raises(error, match=message):
        kind(**arguments)


@pytest.mark.parametrize("kind", BOTH)
def test_wrong_layers_are_named(kind):
    operator = kind(GRID, WAVE, [1e-3, 2e-3])
    with pytest.raises(TypeError, match=r"complex tensor \(..., D, h, w\), got torch.float32"):
        operator(torch.zeros(2, 4, 4))
    with pytest.raises(ValueError, match=r"D = 2 depths, got \(3, 4, 4\)"):
        operator(torch.zeros(3, 4, 4, dtype=torch.complex64))
    with pytest.raises(ValueError, match=r"got \(2, 0, 4\)"):
        operator(torch.zeros(2, 0, 4, dtype=torch.complex64))


@pytest.mark.parametrize("kind", BOTH)
def test_a_pitch_below_half_a_wavelength_carries_every_direction(kind):
    grid = Grid((9, 7), 0.2e-6)
    layers = sources(1, 5, 5)
    wanted = holograms.direct(layers.numpy(), grid.shape, grid.pitch, WAVE, [2e-6], "full")
    assert relative(kind(grid, WAVE, [2e-6], cone="box")(layers), wanted) < 1e-12


@pytest.mark.parametrize("depths", [(1e-3, 1.3e-3), (40e-3, 41e-3)], ids=["near", "far"])
def test_a_sharp_band_is_the_wave_of_its_spectrum(depths):
    grid, layers = Grid((64, 48), 3.74e-6), sources(2, 24, 20)
    operator = ConvolutionHologram(grid, WAVE, depths, cone="band", stride=2)
    wanted = holograms.direct(layers.numpy(), grid.shape, grid.pitch, WAVE, depths, "band", stride=2)
    # 2 s^2 / sqrt(N) = 8e-4 with s = 0.07 and N of 160.
    assert relative(operator(layers), wanted) < 1e-3


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize("cone", ["taper", "band"])
def test_a_limited_spectrum_is_refused_where_it_has_no_meaning(kind, cone):
    with pytest.raises(ValueError, match=f"cone='{cone}' needs a pitch of at least 0.9 wavelengths, 4.68e-07 m, got"):
        kind(Grid(8, 0.4e-6), WAVE, [1e-3], cone=cone)


def test_sums_over_frequencies_that_never_end_are_refused():
    with pytest.raises(ValueError, match="depth 50 m is too far .* use a nearer plane"):
        DirectHologram(Grid(8, 1e-6), WAVE, [50.0], cone="band")(sources(1, 4, 4))


@pytest.mark.parametrize("kind", [*BOTH, AxialHologram])
def test_unknown_cones_and_several_wavelengths_are_named(kind):
    with pytest.raises(ValueError, match="cone must be one of 'full', 'box', 'disc', 'taper', 'band', got 'sphere'"):
        kind(GRID, WAVE, [1e-3], cone="sphere")
    with pytest.raises(ValueError, match="one length in metres, got 2: make one hologram per colour"):
        kind(GRID, [WAVE, 636e-9], [1e-3])
