"""DVRSampler at its borders: the same volume in other ways, what it skips, special volumes, phases, mistakes."""

import math
import warnings

import numpy as np
import pytest
import torch
from host_reads import HostReads

from holotorch import Grid
from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.scene.phases import point_phases, random_phase
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume

GRID = Grid((24, 35), (0.5e-4, 0.4e-4))
WIDTH, CENTRE = 1e-3, 0.02
DEPTHS = [CENTRE + WIDTH * ((k + 0.5) / 12 - 0.5) for k in range(12)]
# Half-way, but for the outermost slabs, which take in whatever is turned out of the middle.
CUTS = [0.019, *((a + b) / 2 for a, b in zip(DEPTHS, DEPTHS[1:], strict=False)), 0.021]
COLOURS = [[0.1, 0.2, 0.9], [0.5, 0.9, 0.1], [1.0, 0.3, 0.2]]
TURN = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]], dtype=torch.float64)


def transfer(opacities=(0.1, 0.2, 0.5), positions=(0.0, 0.5, 1.0), unit=0.1) -> TransferFunction:
    parts = [torch.tensor(part, dtype=torch.float64) for part in (positions, COLOURS, opacities)]
    return TransferFunction(*parts, unit_distance=unit)


def sampler(table=None, **options) -> DVRSampler:
    chosen = {"rays": GRID, "depths": DEPTHS, "width": WIDTH, "early": 0.0, **options}
    return DVRSampler(table or transfer(), chosen.pop("rays"), chosen.pop("depths"), **chosen)


def noise(*shape: int) -> Volume:
    return Volume(torch.rand(*shape, dtype=torch.float64), (1.0, 1.0, 1.0), "relative")


def sparse() -> Volume:
    """Mostly nothing: a few blobs, some of them touching the faces, in bricks of 16."""
    values = torch.zeros(40, 50, 37, dtype=torch.float64)
    values[0:4, 3:9, 30:37] = torch.rand(4, 6, 7, dtype=torch.float64)
    values[20:22, 16, 5] = 0.9
    values[33:40, 41:50, 10:12] = torch.rand(7, 9, 2, dtype=torch.float64)
    return Volume(values, (1.0, 1.0, 1.0), "relative")


GEOMETRIES = {
    "parallel": {},
    "from an eye": {"eye": -0.01},
    "turned": {"rotation": TURN, "boundaries": CUTS},
}


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_without_values_nothing_is_asked_and_the_result_is_the_same(geometry, monkeypatch):
    """As under torch.compile: no ray is taken out of the march, also none that has ended."""
    volume, chosen = sparse(), torch.rand(GRID.shape) > 0.2
    rendering = sampler(transfer((0.0, 0.2, 1.0), unit=0.02), early=0.1, **GEOMETRIES[geometry])
    rendering.checks_slabs = False
    wanted = *rendering.render(volume, chosen), rendering(volume).stack(), rendering.depth_map(volume)
    with monkeypatch.context() as patch, HostReads() as reads:
        patch.setattr(checks, "have_values", lambda *tensors: False)
        got = *rendering.render(volume, chosen), rendering(volume).stack(), rendering.depth_map(volume)
    assert reads.count == 0
    for one, other in zip(got, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-15)
    there = Volume(volume.values.to("meta"), volume.spacing, volume.unit)
    picture, _ = rendering.to("meta").render(there)
    assert picture.is_meta and picture.shape == (3, *GRID.shape)


def test_eye_far_away_sees_what_parallel_rays_see():
    volume, near = noise(6, 7, 8), sampler()
    far = sampler(eye=-1e4)
    # Rays spread by 1e-3 / 1e4 over the depth, up to 4e-7 voxels between which values differ by up to 1.
    torch.testing.assert_close(far.render(volume), near.render(volume), rtol=0, atol=4e-7)
    radiance = [made(volume).stack().abs().square() for made in (far, near)]
    # Onto the grid: 17 rays times 1e-7 of the difference of neighbours.
    torch.testing.assert_close(*radiance, rtol=0, atol=2e-6)


def test_perspective_sources_lie_on_their_rays():
    """A thread along one ray from the eye stays in place in the picture, and moves outwards from plane to plane."""
    eye, depths = 0.0175, [0.0196, 0.0204]
    made = sampler(transfer((0.0, 0.0, 0.9)), eye=eye, depths=depths, boundaries=[0.0195, 0.02, 0.0205])
    y, x = torch.meshgrid(*[(torch.arange(80, dtype=torch.float64) - 39.5) * WIDTH / 80] * 2, indexing="ij")
    z = (torch.arange(80, dtype=torch.float64) - 39.5) * WIDTH / 80 + CENTRE
    scale = (z - eye) / (depths[0] - eye)
    target = torch.tensor([1.5e-4, -2.0e-4])
    apart = (y - target[0] * scale[:, None, None]).square() + (x - target[1] * scale[:, None, None]).square()
    volume = Volume(torch.exp(-apart / (2 * 4e-5**2)), (1.0, 1.0, 1.0), "relative")
    down, across = GRID.coordinates()
    for depth, plane in zip(depths, made(volume).amplitudes(), strict=True):
        power = plane.square().sum(0)
        centre = torch.stack([(power * down).sum(), (power * across).sum()]) / power.sum()
        # The spot is symmetric but for the slope of the thread within half a slab: 1 % of 0.25 mm.
        torch.testing.assert_close(centre.float(), target * (depth - eye) / (depths[0] - eye), rtol=0.01, atol=1e-6)


@pytest.mark.parametrize("axes", [(0, 1), (0, 2), (1, 2)])
def test_right_angles_are_permutations(axes):
    volume = Volume(torch.rand(5, 6, 7, dtype=torch.float64), (1.0, 1.3, 0.7), "relative")
    rotation = torch.eye(3, dtype=torch.float64)
    i, j = axes
    angle = torch.tensor(math.pi / 2, dtype=torch.float64)  # its cosine is 6e-17
    rotation[i, i] = rotation[j, j] = angle.cos()
    rotation[i, j], rotation[j, i] = -angle.sin(), angle.sin()
    # offset_i = -own_j, offset_j = own_i.
    values = volume.values.transpose(i, j).flip(i)
    order = [0, 1, 2]
    order[i], order[j] = j, i
    z, y, x = (volume.spacing[k] for k in order)
    same = Volume(values, (z, y, x), "relative")
    turned, straight = (sampler(boundaries=CUTS, rotation=r).render(v) for r, v in ((rotation, volume), (None, same)))
    torch.testing.assert_close(turned, straight, rtol=0, atol=1e-12)


def test_point_and_slice_readers_agree():
    """Turned by next to nothing, the volume is looked up point by point instead of slice by slice."""
    angle = 1e-9
    rotation = torch.eye(3, dtype=torch.float64)
    rotation[1, 2], rotation[2, 1] = -angle, angle
    for volume in (noise(9, 11, 10), sparse()):
        turned, straight = (sampler(rotation=r).render(volume) for r in (rotation, None))
        # Shifts of up to 1e-9 of a side of 50 voxels with values up to 1 apart.
        torch.testing.assert_close(turned, straight, rtol=0, atol=2e-6)


@pytest.mark.filterwarnings("ignore:slabs are up to")  # on purpose, for speed
@pytest.mark.parametrize("name", GEOMETRIES)
def test_skipping_changes_nothing(name):
    table = transfer((0.0, 0.1, 0.9), unit=0.01)
    made, volume = sampler(table, **GEOMETRIES[name]), sparse()
    fast = *made.render(volume), made.depth_map(volume), made(volume).stack().abs()
    table.requires_grad_()  # nothing is skipped then
    slow = *made.render(volume), made.depth_map(volume), made(volume).stack().abs()
    assert fast[1].max() > 0.5 and (fast[1] == 0).float().mean() > 0.3
    torch.testing.assert_close(fast, tuple(part.detach() for part in slow), rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_early_end_loses_no_more_than_promised(name):
    volume = noise(9, 9, 9)
    table = transfer(unit=0.02)
    (image, opacity), (ended, sum_) = (sampler(table, early=e, **GEOMETRIES[name]).render(volume) for e in (0.0, 1e-2))
    lost = opacity - sum_
    assert lost.min() >= -1e-15 and 1e-4 < lost.max() <= 1e-2
    assert (image - ended).abs().max() <= 1e-2


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.uint16])
def test_integers_render_as_their_numbers(name, dtype):
    values = torch.randint(0, 200, (10, 18, 33), dtype=torch.int32)
    made = sampler(transfer((0.0, 0.1, 0.4), (60.0, 90.0, 200.0)), **GEOMETRIES[name])
    whole, real = (made.render(Volume(values.to(d), (1.0, 1.0, 1.0), "relative")) for d in (dtype, torch.float64))
    torch.testing.assert_close(whole, real, rtol=0, atol=0)


def test_single_precision_is_the_default_and_close():
    values = torch.randint(0, 255, (12, 12, 12), dtype=torch.uint8)
    volume = Volume(values, (1.0, 1.0, 1.0), "relative")
    for options in GEOMETRIES.values():
        double = transfer((0.0, 0.1, 0.4), (0.0, 90.0, 255.0))
        single = TransferFunction([0.0, 90.0, 255.0], COLOURS, [0.0, 0.1, 0.4], unit_distance=0.1)
        found, wanted = (sampler(t, **options).render(volume)[0] for t in (single, double))
        assert found.dtype == torch.float32
        # Values are rounded by 255 x 6e-8, over 12 steps; paths of 1e-4 m by rounding depths of 5e-4 m.
        torch.testing.assert_close(found.double(), wanted, rtol=0, atol=2e-5)


def test_empty_volume_is_exactly_dark():
    for options in GEOMETRIES.values():
        made = sampler(transfer((0.0, 0.1, 0.9)), **options)
        volume = Volume(torch.zeros(20, 20, 20, dtype=torch.float64), (1.0, 1.0, 1.0), "relative")
        for result in (*made.render(volume), made.depth_map(volume), made(volume).stack().abs()):
            assert result.eq(0).all()


@pytest.mark.parametrize("name", GEOMETRIES)
def test_one_voxel(name):
    """A cube of one value: paths are those through its box, whatever the planes."""
    made = sampler(transfer((0.3, 0.3, 0.3)), **GEOMETRIES[name])
    _, opacity = made.render(Volume(torch.full((1, 1, 1), 0.4, dtype=torch.float64), (2e-3, 2e-3, 2e-3), "m"))
    if name == "parallel":
        y, x = GRID.coordinates()
        inside = (y.abs() <= WIDTH / 2 * (1 + 1e-9)) & (x.abs() <= WIDTH / 2 * (1 + 1e-9))
        torch.testing.assert_close(opacity, inside.double() * (1 - 0.7**10), rtol=0, atol=1e-12)
    slant = 1 / 0.8 if name == "turned" else 1.0
    assert opacity[12, 17].item() == pytest.approx(1 - 0.7 ** (10 * slant), abs=1e-12)


def test_volume_wider_than_the_grid_is_cut():
    volume, small = noise(8, 8, 8), Grid((6, 9), GRID.pitch)
    image, opacity = sampler().render(volume)
    part, beside = sampler(rays=small).render(volume)
    # Samples n // 2 of both grids are on the axis.
    torch.testing.assert_close(part, image[:, 12 - 3 : 12 + 3, 17 - 4 : 17 + 5], rtol=0, atol=0)
    torch.testing.assert_close(beside, opacity[12 - 3 : 12 + 3, 17 - 4 : 17 + 5], rtol=0, atol=0)


def test_volume_beside_all_planes_is_dark_and_a_cut_one_is_announced():
    assert sampler(distance=0.5, boundaries=CUTS).render(noise(3, 3, 3))[1].eq(0).all()
    with pytest.warns(SamplingWarning, match="50% of that depth is cut off; add planes"):
        sampler(depths=DEPTHS[:6], distance=CENTRE).render(noise(3, 3, 3))


def test_chosen_rays_only():
    chosen = torch.rand(*GRID.shape) > 0.7
    volume, made = noise(5, 5, 5), sampler()
    (image, opacity), (part, beside) = made.render(volume), made.render(volume, chosen)
    torch.testing.assert_close(part, image * chosen, rtol=0, atol=0)
    torch.testing.assert_close(beside, opacity * chosen, rtol=0, atol=0)


def test_depth_map_of_a_sheet_is_its_depth():
    values = torch.zeros(12, 4, 4, dtype=torch.float64)
    values[7] = 1
    made = sampler(transfer((0.0, 0.0, 0.9)))
    depth = made.depth_map(Volume(values, (1.0, 3.0, 3.0), "relative"))
    inside = depth > 0
    assert inside.any() and not inside.all()
    torch.testing.assert_close(depth[inside], torch.full_like(depth[inside], DEPTHS[7]), rtol=1e-12, atol=0)


def test_phases():
    volume, generator = noise(5, 5, 5), torch.Generator().manual_seed(3)
    dark = sampler()(volume)
    per_ray = sampler(phase=lambda grid: random_phase(grid, generator=generator))(volume)
    assert per_ray.phase is not None and per_ray.phase.dtype == torch.float64
    for plane, amplitude in zip(per_ray.planes(), dark.amplitudes(), strict=True):
        torch.testing.assert_close(plane, amplitude * torch.exp(1j * per_ray.phase), rtol=1e-14, atol=0)
    per_point = sampler(phase=lambda grid: point_phases(grid, generator=generator))(volume)
    assert per_point.phase is None
    stack = per_point.stack()
    torch.testing.assert_close(stack, per_point.stack(), rtol=0, atol=0)
    torch.testing.assert_close(stack.abs(), dark.stack().abs(), rtol=1e-14, atol=0)
    angles = stack[:, 0][stack[:, 0].abs() > 0].angle()
    # 12 planes of 500 lit points: the mean of n random directions is 1 / sqrt(n) long.
    assert torch.polar(torch.ones_like(angles), angles).mean().abs() < 5 / math.sqrt(len(angles))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depths": []}, "at least one distance"),
        ({"depths": [0.02, 0.019, 0.0195]}, "rise or fall throughout"),
        ({"depths": [0.02, -0.01]}, "above zero in metres"),
        ({"width": 0.0}, "width must be above zero"),
        ({"early": 1.0}, r"transmittance in \[0, 1\)"),
        ({"rotation": torch.eye(2)}, r"\(3, 3\) tensor"),
        ({"rotation": -torch.eye(3)}, "determinant 1"),
        ({"rotation": torch.ones(3, 3)}, "orthonormal"),
        ({"boundaries": [0.019, 0.021]}, "one more than the 12 depths"),
        ({"boundaries": np.linspace(0.02, 0.021, 13).tolist()}, "plane 0 at .* must lie within its slab"),
    ],
)
def test_mistakes_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        sampler(**change)


def test_mistakes_that_need_the_volume():
    volume = noise(4, 4, 4)
    volume.values[1, 2, 3] = math.nan
    for options in GEOMETRIES.values():
        for render in (sampler(**options), sampler(**options).render):
            with pytest.raises(ValueError, match=r"voxel \(z, y, x\) = \(1, 2, 3\) is nan"):
                render(volume)
    with pytest.raises(ValueError, match="eye must be in front of all slabs"):
        sampler(eye=0.02)(noise(2, 2, 2))
    with pytest.raises(TypeError, match="volume must be a Volume, got Tensor"):
        sampler()(torch.rand(3, 3, 3))


@pytest.mark.parametrize("front", ["rising", "falling"])
@pytest.mark.parametrize("planes", [2, 5, 12])
def test_the_error_of_thick_slabs_is_predicted_and_warned_of(planes, front):
    """Against the emission-absorption integral in small steps along each of three lines of voxels."""
    voxels, width, unit = 48, 10e-3, 1 / 64
    z = (np.arange(voxels) + 0.5) / voxels
    lines = np.stack([0.5 + 0.45 * np.sin(rate * z) for rate in (5, 11, 17)])
    volume = Volume(torch.from_numpy(lines.T[:, None, :].repeat(3, 1).copy()), (1 / voxels, 0.1, 0.1), "relative")
    transfer = TransferFunction(
        torch.tensor([0.0, 1.0], dtype=torch.float64),
        torch.tensor([[1.0, 0.2, 0], [0, 0.6, 1]], dtype=torch.float64),
        torch.tensor([0.0, 0.1], dtype=torch.float64),
        unit_distance=unit,
    )
    ends = np.linspace(0.1 - width / 2, 0.1 + width / 2, planes + 1)[:: 1 if front == "rising" else -1]
    rays = Grid((3, 3), 0.1 * width)  # through the middles of the voxels
    arguments = {"width": width, "distance": 0.1, "early": 0.0, "boundaries": ends.tolist()}
    sampler = DVRSampler(transfer, rays, ((ends[1:] + ends[:-1]) / 2).tolist(), **arguments)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pictures = [sampler.render(volume)[0] for _ in range(2)]

    fine = (np.arange(20_000) + 0.5) / 20_000
    exact = []
    for line in lines if front == "rising" else lines[:, ::-1]:
        values = np.interp(fine * voxels - 0.5, np.arange(voxels), line)
        extinction = -np.log1p(-0.1 * values) / unit / len(fine)
        weights = np.exp(-np.concatenate([[0.0], extinction.cumsum()[:-1]])) * -np.expm1(-extinction)
        exact.append(np.stack([1 - values, 0.2 + 0.4 * values, values]) @ weights)
    wanted = torch.from_numpy(np.stack(exact, 1))[:, None, :].expand(3, 3, 3)
    error = ((pictures[0] - wanted).norm() / wanted.norm()).item()
    assert sampler.slab_error(volume) == pytest.approx(error, rel=0.5)
    assert len(caught) == (error > 0.25), error  # once, although it is rendered twice
    assert error > 1e-3


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("order", [1, -1], ids=["rising", "falling"])
def test_samples_within_a_slab_are_those_of_as_many_thinner_slabs(geometry, order):
    """Every thin slab as its own sample: the slow twin. Their light together is that of the plane."""
    options, volume, count = dict(GEOMETRIES[geometry]) | {"distance": CENTRE}, noise(20, 20, 20), 5
    if "eye" in options and order < 0:
        options["eye"] = 0.05
    half = 0.5 * WIDTH * (1.4 if "rotation" in options else 1.0)  # of the box around the volume
    thin = torch.linspace(CENTRE - half * order, CENTRE + half * order, 4 * count + 1, dtype=torch.float64)
    first = ((thin[0] + thin[1]) / 2).item()  # rays from an eye pass through the points of the grid on this plane

    def cut(ends: torch.Tensor, samples: int) -> DVRSampler:
        depths = [first, *((ends[1:] + ends[:-1]) / 2).tolist()[1:]]
        return sampler(depths=depths, **options | {"boundaries": ends.tolist(), "samples": samples})

    values = volume.values.requires_grad_()
    both = one, other = cut(thin[::count], count), cut(thin, 1)
    pictures = [each.render(volume) for each in both]
    torch.testing.assert_close(*pictures, rtol=1e-10, atol=1e-12)
    gradients = [torch.autograd.grad(picture.square().sum(), values)[0] for picture, _ in pictures]
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-11)
    if "eye" in options:
        return  # the light of each plane is interpolated onto its grid
    with torch.no_grad():
        planes, parts = (torch.stack(list(each(volume).amplitudes())).square() for each in both)
        torch.testing.assert_close(planes, parts.unflatten(0, (-1, count)).sum(1), rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(one.slab_layers(volume).towards((0.0, 0.0)), planes, rtol=1e-8, atol=1e-10)


def test_samples_bring_the_rendering_of_few_planes_near_that_of_many(recwarn):
    """The error falls with the square of their number, as it is predicted to, and the warning goes."""
    z = torch.linspace(0, 6, 96, dtype=torch.float64)
    volume = Volume((0.5 + 0.4 * z.sin())[:, None, None].expand(96, 4, 4).contiguous(), (1.0, 24.0, 24.0), "relative")
    geometry = {"rays": Grid(4, 1e-4), "distance": CENTRE, "depths": [0.0197, 0.0203]}
    wanted = sampler(**geometry, samples=400).render(volume)[0]
    errors = []
    for count in (1, 4, 16):
        one = sampler(**geometry, samples=count)
        errors.append(((one.render(volume)[0] - wanted).norm() / wanted.norm()).item())
        assert one.slab_error(volume) == pytest.approx(errors[-1], rel=0.2)
    assert errors[0] > 10 * errors[1] and errors[1] == pytest.approx(16 * errors[2], rel=0.3)
    assert len(recwarn) == (errors[0] > 0.25)


def test_opaque_slabs_of_many_samples_let_no_light_through():
    """In single precision, the sum of their weights may be above 1 by its rounding."""
    table = TransferFunction(torch.tensor([0.0, 1.0]), torch.ones(2, 3), torch.tensor([0.0, 1.0]), unit_distance=0.02)
    volume = Volume(torch.rand(24, 24, 24), (1.0, 1.0, 1.0), "relative")
    layers = sampler(table, depths=DEPTHS[::4], samples=13).slab_layers(volume)
    assert layers.opacity.max() == 1
    assert layers.towards((0.0, 0.0)).min() >= 0


@pytest.mark.parametrize("count", [0, -1, 1.5, "2"])
def test_a_number_of_samples_that_is_none(count):
    with pytest.raises((TypeError, ValueError), match="samples"):
        sampler(samples=count)


def test_the_error_of_very_many_slabs_follows_from_that_of_fewer():
    values = torch.linspace(0, math.pi, 64, dtype=torch.float64).sin() ** 2
    volume = Volume(values[:, None, None].expand(64, 4, 4).contiguous(), (1.0, 16.0, 16.0), "relative")

    def error(planes: int) -> float:
        depths = [CENTRE + WIDTH * ((k + 0.5) / planes - 0.5) for k in range(planes)]
        return sampler(rays=Grid(4, 1e-4), depths=depths).slab_error(volume)

    few = error(1000)  # none are joined
    assert few > 0
    for planes, joined in ((2000, 2), (16_000, 16)):
        assert error(planes) == pytest.approx(few / joined**2, rel=0.05)
