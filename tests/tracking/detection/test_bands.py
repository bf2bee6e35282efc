"""Bands on labels: the best cuts against all cuts, and what is seen of flipped, hidden and drowned bands."""

import itertools

import numpy as np
import pytest
import torch

from holotorch.tracking.detection.bands import find_stretches, order_scores
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.simulation.world import synthetic_camera

CAMERA = synthetic_camera()
TABLE = ColourTable(CAMERA, THESIS)
RED, GREEN, BLUE = THESIS.colours
FOUR = ColourTable(CAMERA, Catheter((0.01, 0.03, 0.05, 0.07, 0.09), (RED, BLUE, RED, GREEN), 1e-3, 0.2))


def worth(labels: np.ndarray, bands, cuts) -> np.ndarray:
    """Of cuts [K, N + 1]: [K, N], by the written rule: agreement 1, others -1, none -0.6; around them -0.25."""
    share = np.stack([(labels == c + 1).mean(-1) for c in range(labels.max() + 1)])
    others = share.sum(0)
    sums = lambda gain: np.concatenate([[0], np.cumsum(gain)])  # noqa: E731
    around = sums(-0.25 * others)
    gains = [sums(2 * share[band] - others - 0.6 * (1 - others)) - around for band in bands]
    return np.stack([gain[b] - gain[a] for gain, a, b in zip(gains, cuts.T, cuts.T[1:], strict=False)], -1)


def balanced(labels: np.ndarray, bands, cuts) -> np.ndarray:
    """Scores of all best cuts, in which a band counts for twice the second best at most."""
    each = worth(labels, bands, cuts)
    one = each[np.isclose(each.sum(-1), each.sum(-1).max(), atol=1e-6)]
    return np.minimum(one, 2 * np.maximum(np.sort(one, -1)[:, -2:-1], 0)).sum(-1)


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
    found = order_scores(labels.astype(np.uint8), table)
    for score, row in zip(found.tolist(), labels, strict=True):
        one, other = (balanced(way, table.bands, cuts) for way in (row, row[::-1]))
        assert np.abs(np.maximum(one[:, None], other) - score).min() < 1e-5
    assert found.max() > 4


def strip(lengths, bands=(0, 1, 2), before=12, after=12, rows=3) -> np.ndarray:
    """Labels [T, rows] of bands in a row, nothing around them."""
    values = [0, *(band + 1 for band in bands), 0]
    return np.repeat(values, [before, *lengths, after]).astype(np.uint8)[:, None].repeat(rows, 1)


def stretches(labels, table=TABLE, drape=None, middle=0.0, through=None, onward=False):
    nowhere = np.zeros(len(labels), dtype=bool)
    drape, through = (nowhere if given is None else given for given in (drape, through))
    return find_stretches(labels, drape, through, table, middle, onward=onward)


def seen(found) -> list[bool]:
    assert found is not None
    return np.isfinite(found.edges).tolist()


def test_clean_bands_are_found_where_they_are():
    found = stretches(strip((20, 25, 30)), middle=50.0)
    assert found is not None and found.known == 4 and not found.flipped
    assert found.edges.tolist() == [11.5 - 50, 31.5 - 50, 56.5 - 50, 86.5 - 50]
    assert found.shown == (20, 25, 30) and found.whole == (20, 25, 30)
    assert found.doubtful == (True, False, False, True)


def test_flipped_bands_keep_the_order_of_the_catheter():
    labels = strip((20, 25, 30))[::-1]
    found = stretches(labels)
    assert found is not None and found.flipped and found.known == 4
    # Edge 0 is the first of the catheter: red to nothing, at 75 + 12 pixels in this direction.
    assert found.edges.tolist() == [86.5, 66.5, 41.5, 11.5]
    assert found.whole == (20, 25, 30)


def test_noisy_bands_are_cut_where_all_cuts_say():
    rng = np.random.default_rng(6)
    cuts = all_cuts(70, 4)
    for _ in range(4):
        lengths = rng.integers(12, 20, 3)
        labels = strip(lengths, before=8, after=62 - int(lengths.sum())).astype(int)
        wrong = rng.random(labels.shape) < 0.08
        labels[wrong] = rng.integers(0, 4, wrong.sum())
        found = stretches(labels.astype(np.uint8))
        best = cuts[worth(labels, (0, 1, 2), cuts).sum(-1).argmax()]
        assert found is not None and not found.flipped and found.known >= 3
        known = np.isfinite(found.edges)
        assert (found.edges == best - 0.5)[known].all()


def test_a_finger_within_a_band_leaves_it_one():
    labels = strip((30, 30, 30))
    labels[52:62] = 0
    found = stretches(labels)
    assert found is not None and found.known == 4 and found.edges.tolist() == [11.5, 41.5, 71.5, 101.5]
    assert found.shown == (30, 20, 30) and found.whole == (30, 30, 30)


@pytest.mark.parametrize("edge", [1, 2])
def test_a_finger_over_an_edge_hides_it_alone(edge):
    labels = strip((30, 30, 30))
    at = 12 + 30 * edge
    labels[at - 8 : at + 8] = 0
    found = stretches(labels)
    assert seen(found) == [i != edge for i in range(4)]


def test_the_end_of_the_labels_is_no_edge():
    assert seen(stretches(strip((30, 30, 30), after=0))) == [True, True, True, False]
    assert seen(stretches(strip((30, 30, 30), before=0))) == [False, True, True, True]


def test_an_outer_edge_beyond_which_another_band_lies_is_none():
    """Blue beyond the first band: something of that colour lies there, and where the red ends is its doing."""
    labels = strip((30, 30, 30), before=40)
    labels[:40] = 3
    found = stretches(labels)
    assert seen(found) == [False, True, True, True]


def test_a_drowned_band_still_shows_the_edge_to_it():
    """On a drape of the last band's colour, labels say nothing of where it ends, but that the middle band ends."""
    labels = strip((30, 30, 30))
    labels[72:] = 3
    drape = np.zeros(len(labels), dtype=bool)
    drape[72:] = True
    found = stretches(labels, drape=drape)
    assert found is not None and seen(found) == [True, True, True, False]
    assert found.edges[:3].tolist() == [11.5, 41.5, 71.5]
    assert found.doubtful[2]  # its far side is like the surroundings


def test_the_wrong_order_and_nothing_are_no_bands():
    assert stretches(np.zeros((100, 3), dtype=np.uint8)) is None
    one = stretches(strip((30,), (1,)))
    assert one is None or one.known < 3
    for wrong in ((1, 0, 2), (0, 2, 1)):
        found = stretches(strip((30, 30, 30), wrong))
        assert found is None or found.known < 4
    score = order_scores(np.stack([strip((30, 30, 30)), strip((30, 30, 30), (1, 0, 2))]), TABLE)
    assert score[0] > 1.4 * score[1]
    assert float(score[0]) == pytest.approx(90 * 1.25, abs=1e-3)  # 1 for each pixel, and 0.25 for none outside


def test_repeated_colours_are_told_by_their_order():
    labels = strip((20, 18, 25, 22), FOUR.bands)
    for turned in (labels, labels[::-1]):
        found = stretches(turned, FOUR)
        assert found is not None and found.known == 5 and found.flipped == (turned is not labels)
        assert found.whole == (20, 18, 25, 22)


def check_slow(labels: np.ndarray, cuts: np.ndarray, flipped: bool) -> None:
    found = stretches(labels[::-1] if flipped else labels)
    assert found is not None and found.known == 4 and found.flipped == flipped
    wanted = len(labels) - cuts - 0.5 if flipped else cuts - 0.5
    assert np.abs(found.edges - wanted).max() <= 10


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("bands", list(itertools.permutations(range(3))))
def test_long_bands_of_a_tube_that_moved_along_itself_keep_their_edges(bands, flipped):
    """Light mixed evenly over 20 px around each edge, as labels of it have it: an edge is known to half of them."""
    table = ColourTable(CAMERA, Catheter(THESIS.edges, tuple(THESIS.colours[i] for i in bands), 1e-3, 0.35))
    cuts = 60 + 90 * np.arange(4)
    levels = np.array([(120, 120, 120), *(THESIS.colours[i] for i in bands), (120, 120, 120)], dtype=np.uint8)
    light = CAMERA.linear(torch.from_numpy(levels)).numpy().astype(float)
    share = ((np.arange(390) + 0.5 - cuts[:, None]) / 20 + 0.5).clip(0, 1)
    mixed = light[0] + share.T @ np.diff(light, axis=0)
    labels = table.labels(np.round(CAMERA.levels(torch.from_numpy(mixed)).numpy()).astype(np.uint8)[:, None])[:, 0]
    assert (labels[cuts[1] - 10 : cuts[2] + 10] != np.repeat([1, 2, 3], [10, 90, 10])).sum() > 5
    check_slow(labels[:, None].repeat(3, 1), cuts, flipped)


@pytest.mark.parametrize("other", [(0, 0), (0, 1), (1, 1), (3, 3), (2, 2), (3, 1), (0, 3)])
@pytest.mark.parametrize("flipped", [False, True])
def test_long_bands_keep_their_edges_whatever_the_mix_between_them_passes_for(other, flipped):
    """13 px of no colour, or of a wrong one: a mix of 20 px begins and ends in the colours of the two bands.

    Cuts lie anywhere on them. Beyond 11 px from a cut, most of 6 must be of the right colour.
    """
    labels = strip((90, 90, 90), before=60, after=60)
    cuts = 60 + 90 * np.arange(4)
    for cut in cuts[1:3]:
        labels[cut - 6 : cut], labels[cut : cut + 7] = other
    check_slow(labels, cuts, flipped)


def test_short_bands_whose_colours_change_slowly_have_no_edges():
    """Bands 30 px long of which 20 are mixed: what is left of a colour may be anything's."""
    labels = strip((30, 30, 30))
    for cut in 42 + 30 * np.arange(2):
        labels[cut - 10 : cut + 10] = 0
    found = stretches(labels)
    assert found is None or not np.isfinite(found.edges[1:3]).any()


@pytest.mark.parametrize("flipped", [False, True])
def test_cloth_that_shines_through_the_tube_hides_no_outer_edge(flipped):
    """Beyond the first band the tube shows the cloth behind it, in blue; in blue of its own it would be a band."""
    labels = strip((30, 30, 30), before=40, after=40)
    labels[:40] = 3
    through = np.zeros(len(labels), dtype=bool)
    through[:40] = True
    ways = (labels[::-1], through[::-1]) if flipped else (labels, through)
    assert seen(stretches(ways[0], through=ways[1])) == [True] * 4
    assert seen(stretches(ways[0])) == [False, True, True, True]
    # Where a part of it does not shine through, a thing lies there.
    through[5:] = False
    assert seen(stretches(ways[0], through=through[::-1] if flipped else through)) == [False, True, True, True]


def test_what_shines_through_beyond_the_last_band_is_the_same():
    labels = strip((30, 30, 30), before=40, after=40)
    labels[130:] = 1
    through = np.zeros(len(labels), dtype=bool)
    through[130:] = True
    found = stretches(labels, through=through)
    assert seen(found) == [True] * 4 and found is not None and found.edges[3] == 129.5
    assert seen(stretches(labels)) == [True, True, True, False]
    # Of the last band's own colour it ends nowhere.
    labels[130:] = 3
    assert seen(stretches(labels, through=through))[:3] == [True] * 3
    assert not seen(stretches(labels, through=through))[3]


def test_who_knows_where_the_tip_lies_does_not_turn_round():
    labels = strip((20, 25, 30))
    one, other = stretches(labels, onward=True), stretches(labels)
    assert one is not None and other is not None and not one.flipped
    assert one.edges.tolist() == other.edges.tolist() and one.whole == other.whole and one.doubtful == other.doubtful
    turned = stretches(labels[::-1], onward=True)
    assert turned is None or (not turned.flipped and turned.known < 3)


LIKE = ColourTable(CAMERA, Catheter((0.01, 0.03, 0.05, 0.07, 0.09), (RED, GREEN, RED, BLUE), 1e-3, 0.2))


@pytest.mark.parametrize("flipped", [False, True])
def test_what_reads_the_same_from_both_ends_says_nothing_of_the_tip(flipped):
    """Red, green, red, with the blue that follows hidden: who knows where the tip lies can use it, others cannot."""
    labels = strip((30, 30, 30, 30), LIKE.bands)
    labels[102:132] = 0
    given = labels[::-1] if flipped else labels
    assert stretches(given, LIKE) is None
    known = stretches(given, LIKE, onward=True)
    assert known is not None and not known.flipped
    # Turned round, the first band is the red that comes first on the way, as the catheter has it.
    assert seen(known)[:3] == [True] * 3 and known.edges[1] - known.edges[0] == 30


@pytest.mark.parametrize("flipped", [False, True])
def test_a_part_of_the_band_that_differs_tells_the_tip(flipped):
    """6 px of blue: as many as the colours beside an edge. Of 3, which specks of noise may be, there is no answer."""
    labels = strip((30, 30, 30, 30), LIKE.bands)
    labels[111:132] = 0
    found = stretches(labels[::-1] if flipped else labels, LIKE)
    assert found is not None and found.flipped == flipped
    labels[105:132] = 0
    assert stretches(labels[::-1] if flipped else labels, LIKE) is None
