"""Simulated participants of the perception study, whose equal-efficiency scales are known.

Their spread was fitted to what the thesis prints: F = 7.02 for 5 deg at 10 deg in Table 2.2, and how often a scale is
undefined. A perception time is the expected median as a screen records it, half a frame late.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from holotorch.experiments.perception.analysis.config import SimulationSettings, TargetTimeSettings
from holotorch.experiments.perception.analysis.curves import Responses
from holotorch.experiments.perception.study.design import THESIS_CONDITIONS

_INNER = 40.0  # degrees; within, only the target times are measured
_LATE = 1.5  # seconds, of a lapse at most


def inner_seconds(size_deg: float, eccentricity_deg: float) -> float:
    """How much longer than a 5 deg pattern at 10 deg one within 40 deg takes, in seconds.

    From the distances between the lines of Table 2.2 at 55 deg, at 122 ms per factor e of the size: 27 ms less per
    factor e, and 0.3 ms more per degree.
    """
    return 3e-4 * (eccentricity_deg - 10) - 0.027 * math.log(size_deg / 5)


def true_line(settings: SimulationSettings, target: TargetTimeSettings) -> tuple[float, float]:
    """(alpha, beta) of the participants' median scale for a target time; exact, as medians pass through exp."""
    if target.seconds is not None:
        factor = math.exp((target.seconds - settings.seconds) / settings.slope)
    else:
        size, angle = target.size_deg, target.eccentricity_deg
        assert size is not None and angle is not None  # as the settings have checked
        if angle < _INNER:
            factor = math.exp(inner_seconds(size, angle) / settings.slope)
        else:
            factor = size / (settings.alpha * angle + settings.beta)
    return settings.alpha * factor, settings.beta * factor


def simulate(
    settings: SimulationSettings,
    generator: np.random.Generator,
    conditions: Sequence[tuple[float, float]] = THESIS_CONDITIONS,
    *,
    targets: int = 10,
    distractions: int = 4,
) -> Responses:
    """Answers of ``settings.participants`` simulated participants.

    A participant takes T = T0 + a ln(S / S(E)) from 40 deg on, S(E) being their scale for the time T0 of a 5 deg
    pattern at 10 deg. The logarithm of S(E) is Gaussian around that of alpha E + beta, so the line is that of medians.

    Args:
        settings: The truth and the noise.
        generator: Source of all randomness.
        conditions: (eccentricity, size) in degrees.
        targets: Trials to answer per condition.
        distractions: Trials not to answer per condition.
    """
    people = settings.participants
    where = np.array(conditions, dtype=float).reshape(-1, 2)
    angles = np.unique(where[:, 0])
    slope = settings.slope * np.exp(settings.slope_spread * generator.standard_normal(people))
    base = settings.seconds + settings.time_spread * generator.standard_normal(people)
    shift = settings.scale_spread * generator.standard_normal((people, 1))
    shift = shift + settings.local_spread * generator.standard_normal((people, len(angles)))
    times = np.empty((people, len(where)))
    for k, (angle, size) in enumerate(where):
        if angle < _INNER:
            # In proportion to the slope: so the scale for each target time changes by the same factor for everyone.
            times[:, k] = base + slope / settings.slope * inner_seconds(size, angle)
        else:
            middle = math.log(settings.alpha * angle + settings.beta)
            times[:, k] = base + slope * (math.log(size) - middle - shift[:, np.searchsorted(angles, angle)])
    repeats = targets + distractions
    shape = (people, len(where), repeats)
    reaction = times[..., None] + _trials(settings, generator, shape, targets)
    reaction = reaction + np.where(generator.random(shape) < settings.lapse, _LATE * generator.random(shape), 0)
    # Patterns appear at the start of a frame, and the button is looked at once per frame.
    reaction = np.ceil(np.maximum(reaction, 0) / settings.frame) * settings.frame
    target = np.broadcast_to(np.arange(repeats) < targets, shape)
    chance = generator.random(shape)
    responded = np.where(target, chance >= settings.miss, chance < settings.false_alarm)
    reaction[~responded] = np.nan
    return Responses(
        np.repeat(np.arange(1, people + 1), len(where) * repeats),
        np.tile(np.repeat(where[:, 0], repeats), people),
        np.tile(np.repeat(where[:, 1], repeats), people),
        target.ravel(),
        reaction.ravel(),
        np.full(math.prod(shape), settings.frame),
        simulated=True,
    )


def _trials(
    settings: SimulationSettings, generator: np.random.Generator, shape: tuple[int, ...], answers: int
) -> "np.ndarray[tuple[int, ...], np.dtype[np.float64]]":
    """Gaussian plus exponential; the median of so many ``answers``, recorded with the frames, has the mean 0."""
    gaussian = settings.trial * settings.gaussian
    scale = math.sqrt(settings.trial**2 - gaussian**2)
    noise = gaussian * generator.standard_normal(shape) + scale * generator.exponential(size=shape)
    return noise - _centre(gaussian, scale, answers) - settings.frame / 2


@lru_cache
def _centre(gaussian: float, scale: float, answers: int) -> float:
    """Mean of the median of so many answers: above that of the distribution, which is skewed (12 ms for ten)."""
    if not gaussian and not scale:
        return 0.0
    t = np.linspace(-8 * gaussian, 8 * gaussian + 40 * scale, 20001)
    below = np.array([_distribution(value, gaussian, scale) for value in t])
    lower, upper = (answers + 1) // 2, answers // 2 + 1  # the places in order that a median is of
    late = [
        sum(math.comb(answers, j) * below**j * (1 - below) ** (answers - j) for j in range(place, answers + 1))
        for place in (lower, upper)
    ]
    share = (late[0] + late[1]) / 2  # of medians up to t
    return float((np.diff(share) * (t[1:] + t[:-1]) / 2).sum())


def _distribution(t: float, gaussian: float, scale: float) -> float:
    """P(Z + X <= t) of a Gaussian plus an exponential."""
    if not gaussian:
        return -math.expm1(-max(t, 0) / scale)
    if not scale:
        return _phi(t / gaussian)
    z, ratio = t / gaussian, gaussian / scale
    late = math.exp(min(-t / scale + ratio**2 / 2, 700)) * _phi(z - ratio)
    return max(_phi(z) - late, 0.0)


def _phi(z: float) -> float:
    return math.erfc(-z / math.sqrt(2)) / 2
