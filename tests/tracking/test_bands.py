"""Bands on labels: the best cuts against all cuts, and what is seen of flipped, hidden and drowned bands."""

import itertools

import numpy as np
import pytest
import torch

from holotorch.tracking.bands import find_axis, find_stretches, order_scores
from holotorch.tracking.catheter import THESIS, Catheter
from holotorch.tracking.colours import ColourTable
from holotorch.tracking.world import synthetic_camera

CAMERA = synthetic_camera()
TABLE = ColourTable(CAMERA, THESIS)
RED, GREEN, BLUE = THESIS.colours
FOUR = ColourTable(CAMERA, Catheter((0.01, 0.03, 0.05, 0.07, 0.09), (RED, BLUE, RED, GREEN), 1e-3, 0.2))


def worth(labels: np.ndarray, bands, cuts) -> np.ndarray:
    """Of cuts [..., N + 1], by the written rule: agreement 1, other colours -1, none -0.6; around them -0.25."""
    share = np.stack([(labels == c + 1).mean(-1) for c in range(labels.max() + 1)])
    others = share.sum(0)
    sums = lambda gain: np.concatenate([[0], np.cumsum(gain)])  # noqa: E731
    around = sums(-0.25 * others)
    total = around[cuts[..., 0]] + around[-1] - around[cuts[..., -1]]
    for j, band in enumerate(bands):
        gain = sums(2 * share[band] - others - 0.6 * (1 - others))
        total = total + gain[cuts[..., j + 1]] - gain[cuts[..., j]]
    return total - around[-1]


def all_cuts(length: int, count: int) -> np.ndarray:
    return np.array(list(itertools.combinations_with_replacement(range(length + 1), count)))


@pytest.mark.parametrize("table", [TABLE, FOUR], ids=["three", "four"])
def test_the_best_order_is_the_best_of_all(table):
    """Float32 sums of 11 rows: 1e-5."""
    rng = np.random.default_rng(5)
    cuts = all_cuts(11, len(table.bands) + 1)
    labels = rng.integers(0, 4, (30, 11, 2))
    # Every other one is a catheter in parts.
    for i in range(0, 30, 2):
        ends = np.sort(rng.integers(0, 12, len(table.bands) + 1))
        for j, band in enumerate(table.bands):
            labels[i, ends[j] : ends[j + 1]] = band + 1
        if i % 4:
            labels[i] = labels[i, ::-1]
    found = order_scores(torch.from_numpy(labels.astype(np.uint8)), table)
    wanted = [max(worth(row, table.bands, cuts).max(), worth(row[::-1], table.bands, cuts).max()) for row in labels]
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-5, rtol=0)
    assert max(wanted) > 5


def strip(lengths, bands=(0, 1, 2), before=12, after=12, rows=3) -> torch.Tensor:
    """Labels [T, rows] of bands in a row, nothing around them."""
    parts = [torch.zeros(before), *(torch.full((n,), b + 1.0) for n, b in zip(lengths, bands, strict=True))]
    return torch.cat([*parts, torch.zeros(after)]).to(torch.uint8)[:, None].repeat(1, rows)


def stretches(labels, table=TABLE, drape=None, middle=0.0):
    drape = torch.zeros(len(labels), dtype=torch.bool) if drape is None else drape
    return find_stretches(labels, drape, table, middle)


def test_clean_bands_are_found_where_they_are():
    found = stretches(strip((20, 25, 30)), middle=50.0)
    assert found is not None and found.known == 4 and not found.flipped
    assert found.edges.tolist() == [11.5 - 50, 31.5 - 50, 56.5 - 50, 86.5 - 50]
    assert found.shown.tolist() == [20, 25, 30] and found.whole.tolist() == [20, 25, 30]
    assert found.doubtful == (True, False, False, True)


def test_flipped_bands_keep_the_order_of_the_catheter():
    labels = strip((20, 25, 30)).flip(0)
    found = stretches(labels)
    assert found is not None and found.flipped and found.known == 4
    # Edge 0 is the first of the catheter: red to nothing, at 75 + 12 pixels in this direction.
    assert found.edges.tolist() == [86.5, 66.5, 41.5, 11.5]
    assert found.whole.tolist() == [20, 25, 30]


def test_noisy_bands_are_cut_where_all_cuts_say():
    rng = np.random.default_rng(6)
    cuts = all_cuts(70, 4)
    for _ in range(4):
        lengths = rng.integers(12, 20, 3)
        labels = strip(lengths, before=8, after=62 - int(lengths.sum())).numpy().astype(int)
        wrong = rng.random(labels.shape) < 0.08
        labels[wrong] = rng.integers(0, 4, wrong.sum())
        found = stretches(torch.from_numpy(labels.astype(np.uint8)))
        best = cuts[worth(labels, (0, 1, 2), cuts).argmax()]
        assert found is not None and not found.flipped and found.known >= 3
        seen = found.edges.isfinite().numpy()
        assert (found.edges.numpy() == best - 0.5)[seen].all()


def test_a_finger_within_a_band_leaves_it_one():
    labels = strip((30, 30, 30))
    labels[52:62] = 0
    found = stretches(labels)
    assert found is not None and found.known == 4 and found.edges.tolist() == [11.5, 41.5, 71.5, 101.5]
    assert found.shown.tolist() == [30, 20, 30] and found.whole.tolist() == [30, 30, 30]


@pytest.mark.parametrize("edge", [1, 2])
def test_a_finger_over_an_edge_hides_it_alone(edge):
    labels = strip((30, 30, 30))
    at = 12 + 30 * edge
    labels[at - 8 : at + 8] = 0
    found = stretches(labels)
    assert found is not None and not found.edges[edge].isfinite()
    assert found.known == 3 and found.edges.isfinite()[[0, 3]].all()


def test_the_end_of_the_labels_is_no_edge():
    found = stretches(strip((30, 30, 30), after=0))
    assert found is not None and found.edges.isfinite().tolist() == [True, True, True, False]
    found = stretches(strip((30, 30, 30), before=0))
    assert found is not None and found.edges.isfinite().tolist() == [False, True, True, True]


def test_an_outer_edge_beyond_which_another_band_lies_is_none():
    """Blue beyond the first band: something of that colour lies there, and where the red ends is its doing."""
    labels = strip((30, 30, 30), before=40)
    labels[:40] = 3
    found = stretches(labels)
    assert found is not None and not found.edges[0].isfinite() and found.edges[1:].isfinite().all()


def test_a_drowned_band_still_shows_the_edge_to_it():
    """On a drape of the last band's colour, labels say nothing of where it ends, but that the middle band ends."""
    labels = strip((30, 30, 30))
    labels[72:] = 3
    drape = torch.zeros(len(labels), dtype=torch.bool)
    drape[72:] = True
    found = stretches(labels, drape=drape)
    assert found is not None and found.edges.isfinite().tolist() == [True, True, True, False]
    assert found.edges[:3].tolist() == [11.5, 41.5, 71.5]
    assert found.doubtful[2]  # its far side is like the surroundings


def test_the_wrong_order_and_nothing_are_no_bands():
    assert stretches(torch.zeros(100, 3, dtype=torch.uint8)) is None
    one = stretches(strip((30,), (1,)))
    assert one is None or one.known < 3
    for wrong in ((1, 0, 2), (0, 2, 1)):
        found = stretches(strip((30, 30, 30), wrong))
        assert found is None or found.known < 4
    score = order_scores(torch.stack([strip((30, 30, 30)), strip((30, 30, 30), (1, 0, 2))]), TABLE)
    assert score[0] > 1.4 * score[1]
    assert float(score[0]) == pytest.approx(90 * 1.25, abs=1e-3)  # 1 for each pixel, and 0.25 for none outside


def test_repeated_colours_are_told_by_their_order():
    labels = strip((20, 18, 25, 22), FOUR.bands)
    for turned in (labels, labels.flip(0)):
        found = stretches(turned, FOUR)
        assert found is not None and found.known == 5 and found.flipped == (turned is not labels)
        assert found.whole.tolist() == [20, 18, 25, 22]


def fan(offset, slope, thick=5.0, length=201, half=20, coloured=1.0, seed=7):
    """Labels [T, U] of a tube u = offset + slope t, and u."""
    t, u = np.arange(length) - (length - 1) / 2, np.arange(2 * half + 1) - half
    lit = np.abs(u - offset - slope * t[:, None]) < thick / 2
    lit &= np.random.default_rng(seed).random(lit.shape) < coloured
    band = 1 + np.minimum(np.arange(length) * 3 // length, 2)
    return torch.from_numpy((lit * band[:, None]).astype(np.uint8)), torch.from_numpy(u.astype(float))


@pytest.mark.parametrize(("offset", "slope"), [(0.0, 0.0), (6.3, 0.04), (-9.0, -0.05), (3.0, 0.058)])
def test_the_axis_of_a_tube_is_found(offset, slope):
    """Whole pixels: each row's middle is off by up to half of one, and on average by little."""
    found = find_axis(*fan(offset, slope), 0.06)
    assert found is not None
    assert found[0] == pytest.approx(offset, abs=0.25) and found[1] == pytest.approx(slope, abs=0.004)


def test_the_axis_is_found_among_specks_and_gaps():
    labels, u = fan(4.0, 0.03, coloured=0.6)
    specks = torch.rand(labels.shape) < 0.02
    labels = torch.where(specks, 2, labels)
    labels[90:110] = 0
    found = find_axis(labels, u, 0.06)
    assert found is not None
    assert found[0] == pytest.approx(4.0, abs=0.5) and found[1] == pytest.approx(0.03, abs=0.008)


def test_rows_of_one_colour_are_no_tube():
    labels, u = fan(4.0, 0.03)
    labels[:60] = 1  # cloth
    found = find_axis(labels, u, 0.06)
    assert found is not None and found[0] == pytest.approx(4.0, abs=0.5)
    assert find_axis(torch.full_like(labels, 2), u, 0.06) is None


def test_without_colours_there_is_no_axis():
    labels, u = fan(0.0, 0.0)
    assert find_axis(torch.zeros_like(labels), u, 0.06) is None
    few = torch.zeros_like(labels)
    few[3, 4:10] = 1
    assert find_axis(few, u, 0.06) is None
    column = torch.zeros_like(labels)
    column[50, 2:22] = 1  # in one row only: no direction
    assert find_axis(column, u, 0.06) is None
