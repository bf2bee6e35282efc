"""Coarse lines on frames that are drawn by distance from a line."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from holotorch.tracking.detection import coarse
from holotorch.tracking.detection.coarse import Segment, find_segments
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.pose.status import Refusal, Status
from holotorch.tracking.simulation.world import synthetic_camera

SIZE = (360, 640)
TABLE = ColourTable(synthetic_camera(), THESIS)


def drawn(
    middle, angle, length=240.0, width=6.0, ground: Any = 120, order=(0, 1, 2), noise=0.0, seed=8, size=SIZE
) -> torch.Tensor:
    """Frame of three bands in a row around ``middle``, the first of them at the beginning."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    t = (x - middle[0]) * math.cos(angle) + (y - middle[1]) * math.sin(angle)
    u = -(x - middle[0]) * math.sin(angle) + (y - middle[1]) * math.cos(angle)
    cover = np.clip(width / 2 + 0.5 - np.abs(u), 0, 1) * np.clip(length / 2 + 0.5 - np.abs(t), 0, 1)
    band = np.clip((t + length / 2) * 3 / length, 0, 2).astype(int)
    colour = np.array([THESIS.colours[i] for i in order], float)[band]
    frame = ground + cover[..., None] * (colour - ground) + noise * rng.normal(size=(*size, 3))
    return torch.from_numpy(np.clip(np.round(frame), 0, 255).astype(np.uint8)).permute(2, 0, 1).contiguous()


def places(segment: Segment, middle, angle) -> NDArray[np.complex128]:
    """Of the segment's ends, along the line from ``middle`` and beside it."""
    return (np.array([segment.start, segment.end]) - complex(*middle)) * np.exp(-1j * angle)


def missed(segment: Segment, middle, angle) -> float:
    """How far the segment's ends lie beside the line, in pixels."""
    return float(np.abs(places(segment, middle, angle).imag).max())


@pytest.mark.parametrize("degrees", range(0, 360, 15))
def test_lines_are_found_in_all_directions(degrees):
    """Every second pixel of a tube 6 px wide: within 2 px, as the search that follows needs."""
    angle, middle = math.radians(degrees), (300.0 + degrees / 10, 170.0)
    found = find_segments(drawn(middle, angle, noise=2.5), TABLE)
    assert 1 <= len(found) <= 3
    assert missed(found[0], middle, angle) < 2
    # It reaches over the bands, to a tile or two.
    along = places(found[0], middle, angle).real
    assert abs(along.min() + 120) < 48 and abs(along.max() - 120) < 48


@pytest.mark.parametrize("width", [3.5, 10, 16])
def test_thin_and_thick_tubes_are_found(width):
    found = find_segments(drawn((320, 180), 0.5, width=width, noise=2.5), TABLE)
    assert missed(found[0], (320, 180), 0.5) < 2


@pytest.mark.parametrize("ground", [0, 20, 235])
def test_dark_and_bright_surroundings(ground):
    found = find_segments(drawn((320, 180), 2.2, ground=ground, noise=2.5), TABLE)
    assert missed(found[0], (320, 180), 2.2) < 2


def refused(frame: torch.Tensor) -> Status:
    with pytest.raises(Refusal) as caught:
        find_segments(frame, TABLE)
    return caught.value.status


def test_frames_without_colour_have_no_lines():
    zeros = torch.zeros(3, *SIZE, dtype=torch.uint8)
    grey = (128 + 12 * torch.randn(1, *SIZE)).clamp(0, 255).to(torch.uint8).expand(3, -1, -1)
    cloths = [zeros + torch.tensor(colour, dtype=torch.uint8)[:, None, None] for colour in THESIS.colours]
    for frame in (zeros, zeros + 255, grey, *cloths):
        assert refused(frame) is Status.NO_CATHETER


def test_noise_and_clutter_give_few_lines():
    rng = torch.Generator().manual_seed(9)
    noise = torch.randint(0, 256, (3, *SIZE), dtype=torch.uint8, generator=rng)
    assert len(find_segments(noise, TABLE)) <= 3
    clutter = torch.full((3, *SIZE), 120, dtype=torch.uint8)
    for i in range(300):
        x, y = (int(torch.randint(0, side - 12, (1,), generator=rng)) for side in SIZE[::-1])
        clutter[:, y : y + 4, x : x + 12] = torch.tensor(THESIS.colours[i % 3], dtype=torch.uint8)[:, None, None]
    assert len(find_segments(clutter, TABLE)) <= 3


def test_the_tube_comes_first_among_sheets_of_its_colours():
    frame = drawn((320, 180), 0.35, noise=2.5)
    for i, colour in enumerate(THESIS.colours):
        frame[:, 20 + 110 * i : 90 + 110 * i, 20:110] = torch.tensor(colour, dtype=torch.uint8)[:, None, None]
    assert missed(find_segments(frame, TABLE)[0], (320, 180), 0.35) < 2


def test_the_right_order_comes_before_the_wrong_one():
    right, wrong = drawn((320, 90), 0.0), drawn((320, 270), 0.0, order=(1, 0, 2))
    both = torch.where(torch.arange(SIZE[0])[:, None] < 180, right, wrong)
    assert missed(find_segments(both, TABLE)[0], (320, 90), 0.0) < 2


@pytest.mark.parametrize("band", range(3))
def test_one_colour_alone_is_no_line_but_a_band(band):
    assert refused(drawn((320, 180), 0.4, order=(band, band, band))) is Status.BANDS_MISSING


def test_it_is_the_same_each_time():
    frame = drawn((320, 180), 0.4, noise=5.0)
    assert find_segments(frame, TABLE) == find_segments(frame, TABLE)


@pytest.mark.parametrize("size", [(360, 640), (361, 640), (360, 641), (359, 637), (25, 203), (203, 27)])
def test_memory_of_any_layout_gives_the_same_lines(size):
    """Planes, a camera's colours side by side, a part of a larger frame, every second column: all to the last bit."""
    middle = (size[1] / 2, size[0] / 2)
    frame = drawn(middle, math.pi / 2 if size[0] > size[1] else 0.0, 150.0, noise=5.0, size=size)
    wanted = find_segments(frame, TABLE)
    assert len(wanted) >= 1 and missed(wanted[0], middle, math.pi / 2 if size[0] > size[1] else 0.0) < 2
    camera = frame.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    part = torch.zeros(size[0] + 3, size[1] + 5, 3, dtype=torch.uint8)[1:-2, 3:-2].permute(2, 0, 1)
    four = torch.zeros(*size, 4, dtype=torch.uint8)[..., :3].permute(2, 0, 1)
    wide = torch.zeros(3, size[0], 2 * size[1], dtype=torch.uint8)[..., ::2]
    for other in (part, four, wide):
        other[:] = frame
    for other in (camera, part, four, wide):
        assert other.stride() != frame.stride() and find_segments(other, TABLE) == wanted


@pytest.mark.parametrize("border", [0.0, 638.0])
def test_lines_along_the_border_are_found(border):
    """Half of the tube is on the frame, and of that every second pixel."""
    found = find_segments(drawn((border, 180), math.pi / 2, width=8.0, noise=2.5), TABLE)
    assert missed(found[0], (border, 180), math.pi / 2) < 4


@pytest.mark.parametrize("size", [(60, 96), (61, 101), (49, 59)])
def test_tiles_are_those_of_a_count_one_by_one(size):
    """Lines and specks of three colours: count, middle and longest axis of each colour's pixels in tiles of 12."""
    rng = np.random.default_rng(sum(size))
    labels = np.where(rng.random(size) < 0.08, rng.integers(1, 4, size), 0).astype(np.uint8)
    along = np.arange(min(size))
    labels[along, along], labels[along // 2, along] = 1, 2
    labels[:36, :36] = 3  # too dense to be thin
    count: dict[tuple[int, int, int], int] = {}
    lines: dict[tuple[int, int, int], tuple[complex, NDArray, NDArray]] = {}
    for y, x in itertools.product(range(0, size[0], 12), range(0, size[1], 12)):
        part = labels[y : y + 12, x : x + 12]
        if np.count_nonzero(part) >= 6:
            for label in (1, 2, 3):
                down, right = (part == label).nonzero()
                count[y, x, label] = len(down)
                if len(down) >= 6:
                    values, vectors = np.linalg.eigh(np.cov(right, down, bias=True))
                    lines[y, x, label] = right.mean() + x + 1j * (down.mean() + y), vectors[:, 1], values
    thin = {
        key: value
        for key, value in lines.items()
        if sum(count.get((key[0] + dy, key[1] + dx, key[2]), 0) for dy in (-12, 0, 12) for dx in (-12, 0, 12))
        < 9 * 0.35 * 144
    }
    assert 0 < len(thin) < len(lines)
    found = coarse._tiles(labels, 3)
    assert found is not None and len(found.label) == len(thin) <= 40
    at = {(round(c.real, 4), round(c.imag, 4), label) for c, label in zip(found.centre, found.label + 1, strict=True)}
    assert at == {(round(c.real, 4), round(c.imag, 4), key[2]) for key, (c, _, _) in thin.items()}
    for label, n, centre, way in zip(found.label + 1, found.count, found.centre, found.along, strict=True):
        (y, x, _), (_, vector, values) = next(
            (key, value) for key, value in thin.items() if key[2] == label and abs(value[0] - centre) < 1e-4
        )
        assert n == count[y, x, label]
        if values[1] > 1.01 * values[0]:
            assert abs(way.real * vector[0] + way.imag * vector[1]) == pytest.approx(1, abs=1e-6)


def test_thin_objects_are_found_on_cloth_of_a_bands_hue():
    """Cloth in the hues of two bands hides them among its own labels; thin objects alone show all three."""
    cloth = np.zeros((*SIZE, 3))
    cloth[:, :320], cloth[:, 320:] = (150, 60, 60), (60, 80, 150)
    frame = drawn((320, 180), 0.35, ground=cloth, noise=2.5)
    assert refused(frame) in (Status.BANDS_MISSING, Status.NO_CATHETER)
    assert (
        missed(find_segments(frame, TABLE, thin=True)[0], (320, 180), 0.35) < 8
    )  # half of what the next step searches


def test_wide_patches_are_not_thin_and_lines_are():
    frame = torch.full((3, 200, 200), 120, dtype=torch.uint8)
    frame[:, 20:150, 20:110] = 30  # a sheet, with borders
    frame[:, :, 160:166] = 220
    thin = coarse._thin(frame)
    assert thin.shape == (100, 100) and bool(thin[20:70, 80:83].all())
    assert not thin[26:58, :60].any()  # far from the corners of the sheet
