"""Parts of an eye's pupil: those that are corrected besides the whole pupil, and those that no method is given."""

import math
from collections.abc import Iterator, Sequence

import torch
from torch.quasirandom import SobolEngine

from holotorch.optics import View

SIDES = ((0.0, 1.0), (0.0, -1.0))  # (y, x) towards what is covered of the left and right halves, which are held back
_RADII = 0.15, 0.6  # of the smaller circles, in radii of the pupil
_HELD = 0.5  # radius of the circles that are held back, and distance of their centres from that of the pupil
_DIAGONALS = math.pi / 4, 5 * math.pi / 4  # directions of these centres, from the x axis
APART = 0.15  # least distance of the centre of a corrected circle from these centres, in radii of the pupil
TURNED_DEG = 15  # least angle between a corrected edge and those of the left and right halves


def halves(foci: Sequence[float], radius: float) -> list[View]:
    """The left and the right half of the pupil at each focus."""
    return [View(focus, radius, covered=side) for focus in foci for side in SIDES]


def held_parts(foci: Sequence[float], radius: float) -> list[View]:
    """Two circles of half the pupil's radius at each focus, opposite to each other."""
    return [View(focus, _HELD * radius, (radius * y, radius * x)) for focus in foci for y, x in _held_centres()]


def corrected_parts(foci: Sequence[float], radius: float, count: int, seed: int) -> list[View]:
    """Parts of the pupil with random foci between the first and the last, in turn circles and pupils that an edge cuts.

    A circle has 0.15 to 0.6 of the pupil's radius, anywhere within the pupil. An edge, as of an eye box, an eyelid or
    the rim of a lens, covers half of the pupil, in any direction. What is held back is left out: centres of circles
    within 0.15 radii of those of :func:`held_parts`, and edges within 15 degrees of those of :func:`halves`. Sizes,
    directions and foci are those of scrambled Sobol sequences, so that few parts cover all of them. Directions are
    denser towards the gaps, as the nodes of Chebyshev are towards the ends of an interval: there they hold a fit that
    must go on beyond them.
    """
    circles, edges = _circles(foci, radius, seed), _edges(foci, radius, seed + 1)
    return [next(edges if k % 2 else circles) for k in range(count)]


def _held_centres() -> list[tuple[float, float]]:
    return [(_HELD * math.sin(angle), _HELD * math.cos(angle)) for angle in _DIAGONALS]


def _circles(foci: Sequence[float], radius: float, seed: int) -> Iterator[View]:
    for size, distance, angle, focus in _sobol(4, seed):
        small = _RADII[0] + (_RADII[1] - _RADII[0]) * size
        r, a = (1 - small) * math.sqrt(distance), 2 * math.pi * angle
        y, x = r * math.sin(a), r * math.cos(a)
        if min(math.dist((y, x), each) for each in _held_centres()) >= APART:
            yield View(_between(foci, focus), radius * small, (radius * y, radius * x))


def _edges(foci: Sequence[float], radius: float, seed: int) -> Iterator[View]:
    for turn, focus in _sobol(2, seed):
        side, within = divmod(2 * turn, 1)
        denser = (1 - math.cos(math.pi * within)) / 2  # towards both ends
        angle = math.radians(180 * side + TURNED_DEG + (180 - 2 * TURNED_DEG) * denser)
        yield View(_between(foci, focus), radius, covered=(math.sin(angle), math.cos(angle)))


def _between(foci: Sequence[float], fraction: float) -> float:
    return foci[0] + fraction * (foci[-1] - foci[0])


def _sobol(dimension: int, seed: int) -> Iterator[list[float]]:
    engine = SobolEngine(dimension, scramble=True, seed=seed)
    while True:
        yield engine.draw(1, dtype=torch.float64)[0].tolist()
