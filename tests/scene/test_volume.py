import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from holotorch.scene import Volume
from holotorch.scene import volume as module

SIDE = ((1.0, 0.0, 0.0), (0.0, 0.6, 0.8), (0.0, -0.8, 0.6))
TYPES = [torch.uint8, torch.int8, torch.int16, torch.uint16, torch.int32, torch.uint32, torch.float16, torch.float64]


def filled(dtype=torch.float32, shape=(12, 17, 23)):
    values = np.random.default_rng(5).integers(0, 127, shape)
    return torch.from_numpy(values).to(dtype)


def test_shape_extent_and_provenance_are_kept():
    volume = Volume(filled(torch.uint8), (3e-3, 1e-3, 2e-3), "m", (0.1, 0.2, 0.3), SIDE)
    assert volume.shape == (12, 17, 23) and volume.values.dtype == torch.uint8
    assert volume.extent == pytest.approx((36e-3, 17e-3, 46e-3))
    assert volume.origin == (0.1, 0.2, 0.3) and volume.orientation == SIDE


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"values": np.zeros((2, 2, 2))}, TypeError, "must be a torch.Tensor, got ndarray; use torch.from_numpy"),
        (
            {"values": torch.zeros(2, 2, 2, dtype=torch.complex64)},
            TypeError,
            "must be real numbers, got torch.complex64",
        ),
        ({"values": torch.zeros(2, 2, 2, dtype=torch.bool)}, TypeError, "must be real numbers, got torch.bool"),
        ({"values": torch.zeros(2, 2, 2, 3)}, ValueError, r"three axes \(z, y, x\), got shape \(2, 2, 2, 3\)"),
        ({"values": torch.zeros(2, 0, 2)}, ValueError, "at least one voxel"),
        ({"spacing": (1.0, 0.0, 1.0)}, ValueError, "volume spacing must be above zero in relative, got 0.0"),
        ({"spacing": (1.0, float("nan"), 1.0)}, ValueError, "volume spacing must be finite"),
        ({"spacing": (1.0, 1.0)}, TypeError, r"must be three numbers \(z, y, x\)"),
        ({"spacing": 1.0}, TypeError, r"must be three numbers \(z, y, x\), got 1.0"),
        ({"unit": "mm"}, ValueError, "must be 'm' or 'relative', got 'mm'; convert other lengths to metres"),
        ({"origin": (0.0, float("inf"), 0.0)}, ValueError, "volume origin must be finite"),
        ({"orientation": ((1, 0, 0), (0, 1, 0.2), (0, 0, 1))}, ValueError, "right angles.*resample a sheared volume"),
        ({"orientation": ((2, 0, 0), (0, 1, 0), (0, 0, 1))}, ValueError, "unit vectors"),
        ({"orientation": ((1, 0, 0), (0, 1, 0))}, TypeError, "three rows"),
    ],
)
def test_refuses(change, error, message):
    arguments = {"values": torch.zeros(2, 3, 4), "spacing": (1.0, 1.0, 1.0), "unit": "relative"} | change
    with pytest.raises(error, match=message):
        Volume(**arguments)


@pytest.fixture(params=[1 << 22, 800])
def slabs(request, monkeypatch):
    monkeypatch.setattr(module, "_SLAB", request.param)


@pytest.mark.parametrize("dtype", TYPES)
def test_range_in_every_type(dtype, slabs):
    values = filled()
    values[7, 3, 2], values[2, 16, 22] = 127, -3 if dtype.is_signed else 0
    assert Volume(values.to(dtype), (1.0, 1.0, 1.0), "relative").value_range() == (-3 if dtype.is_signed else 0, 127)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("look", [Volume.check_finite, Volume.value_range, Volume.bricks])
def test_names_the_first_broken_voxel_and_their_number(bad, look, slabs):
    values = filled()
    values[5, 16, 3] = bad
    values[5, 16, 4] = values[11, 0, 0] = float("nan")
    with pytest.raises(
        ValueError, match=rf"\(z, y, x\) = \(5, 16, 3\) is {bad} \(3 of 4692 in all\); repair .*nan_to_num"
    ):
        look(Volume(values, (1.0, 1.0, 1.0), "relative"))


def test_sound_and_integer_volumes_pass(slabs):
    for dtype in TYPES:
        Volume(filled(dtype), (1.0, 1.0, 1.0), "relative").check_finite()


def test_the_search_looks_at_slabs(monkeypatch):
    """A mask of the whole would double the memory of a large volume."""
    seen, real = [], torch.isfinite
    monkeypatch.setattr(module, "_SLAB", 800)
    monkeypatch.setattr(torch, "isfinite", lambda values: (seen.append(values.numel()), real(values))[1])
    Volume(filled(), (1.0, 1.0, 1.0), "relative").check_finite()
    assert max(seen) <= 800 and sum(seen) == 12 * 17 * 23


@pytest.mark.parametrize("size", [1, 4, 8, 16, 40])
@pytest.mark.parametrize("dtype", TYPES)
def test_bricks_hold_their_samples_and_the_next(size, dtype):
    volume = Volume(filled(dtype), (1.0, 1.0, 1.0), "relative")
    low, high = volume.bricks(size).to(torch.float64).numpy()
    values = volume.values.to(torch.float64).numpy()
    assert low.shape == tuple(-(-n // size) for n in values.shape)
    for index in np.ndindex(low.shape):
        inside = values[tuple(slice(i * size, (i + 1) * size + 1) for i in index)]
        assert (low[index], high[index]) == (inside.min(), inside.max())


def test_bricks_bound_every_trilinear_sample():
    values = torch.rand(9, 17, 6, dtype=torch.float64)
    low, high = Volume(values, (1.0, 1.0, 1.0), "relative").bricks(4).numpy()
    # Random positions, those on samples and on the faces between bricks, and both ends.
    shape = np.array(values.shape)[:, None]
    places = np.random.default_rng(1).random((3, 4000)) * (shape - 1)
    places = np.concatenate([places, np.round(places), (shape - 1) * np.ones((1, 1)), np.zeros((3, 1))], axis=1)
    found = map_coordinates(values.numpy(), places, order=1)
    brick = tuple((places // 4).astype(int))
    # Interpolation is a convex mean of eight numbers below 1: a few roundings of 1.1e-16.
    assert (found >= low[brick] - 1e-15).all() and (found <= high[brick] + 1e-15).all()


def test_bricks_of_one_voxel_and_of_learnable_values():
    volume = Volume(torch.full((1, 1, 1), 3.0, requires_grad=True), (1.0, 1.0, 1.0), "relative")
    assert volume.bricks().tolist() == [[[[3.0]]], [[[3.0]]]] and not volume.bricks().requires_grad
    assert volume.value_range() == (3.0, 3.0) and volume.extent == (1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="brick size must be at least 1, got 0"):
        volume.bricks(0)


@pytest.mark.parametrize("dtype", TYPES)
def test_a_mirrored_volume_has_each_voxel_where_it_was(dtype):
    volume = Volume(filled(dtype), (3e-3, 1e-3, 2e-3), "m", (0.1, 0.2, 0.3), SIDE)
    mirrored = volume.mirrored()
    assert not volume.left_handed and mirrored.left_handed
    assert torch.equal(mirrored.values, torch.from_numpy(volume.values.numpy()[..., ::-1].copy()))
    for one, index in ((volume, 0), (mirrored, 22)):
        place = np.array(one.origin) + index * one.spacing[2] * np.array(one.orientation[2])
        np.testing.assert_allclose(place, volume.origin, atol=1e-12)
    assert torch.equal(mirrored.mirrored().values, volume.values)
