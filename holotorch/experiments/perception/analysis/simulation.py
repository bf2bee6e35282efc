"""Simulated participants of the perception study, whose equal-efficiency scales are known.

The times of the settings are expected medians of recorded times. Recorded times are on average half a frame longer than
the actual times, because they are rounded up to whole frames.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import product

import numpy as np
from scipy import special, stats

from holotorch.experiments.perception.analysis.config import SimulationSettings, TargetTimeSettings
from holotorch.experiments.perception.analysis.curves import Responses
from holotorch.experiments.perception.analysis.statistics import Array
from holotorch.experiments.perception.study.design import AS_IN_THESIS, THESIS_CONDITIONS
from holotorch.perception.factors import contrast_term, motion_term

_INNER = 40.0  # degrees; patterns nearer to the fixation point have no scale and only serve as targets
MIDDLE_DEG = 55.0  # eccentricity at which the settings give the effects of contrast and motion
_LATE = 1.5  # seconds; longest delay of a lapse


def inner_seconds(size_deg: float, eccentricity_deg: float) -> float:
    """Perception time of a pattern within 40 deg minus that of a 5 deg pattern at 10 deg, in seconds.

    The time falls by 27 ms when the size grows by a factor of e, and rises by 0.3 ms per degree of eccentricity. Both
    numbers are derived from the distances between the lines of Table 2.2 at 55 deg, converted to times with a slope of
    122 ms per factor of e in size.
    """
    return 3e-4 * (eccentricity_deg - 10) - 0.027 * math.log(size_deg / 5)


def true_line(settings: SimulationSettings, target: TargetTimeSettings) -> tuple[float, float]:
    """(alpha, beta) of the participants' median scale for a target time.

    The result is exact, because the median of exp(x) is exp of the median of x.
    """
    if target.seconds is not None:
        factor = math.exp((target.seconds - settings.seconds) / settings.slope)
    else:
        size, angle = target.size_deg, target.eccentricity_deg
        assert size is not None and angle is not None  # checked by TargetTimeSettings
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

    At 40 deg and beyond, a participant's time is T = T0 + a ln(S / S(E)), where S(E) is the participant's scale for the
    time T0 of a 5 deg pattern at 10 deg. ln S(E) is Gaussian around ln(alpha E + beta), so that alpha E + beta is the
    median scale.

    Args:
        settings: True scales and noise.
        generator: Source of all randomness.
        conditions: (eccentricity, size) in degrees.
        targets: Trials per condition with the target pattern.
        distractions: Trials per condition with the other pattern, which should not be answered.
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
            # Proportional to the slope, so that another target time scales the S(E) of all participants equally.
            times[:, k] = base + slope / settings.slope * inner_seconds(size, angle)
        else:
            middle = math.log(settings.alpha * angle + settings.beta)
            times[:, k] = base + slope * (math.log(size) - middle - shift[:, np.searchsorted(angles, angle)])
    times, where, variants = _with_factors(settings, generator, times, where)
    repeats = targets + distractions
    shape = (people, len(where), repeats)
    gaussian = settings.trial * settings.gaussian
    scale = math.sqrt(settings.trial**2 - gaussian**2)
    noise = gaussian * generator.standard_normal(shape) + scale * generator.exponential(size=shape)
    # The offset makes the expected median of the answers, after rounding up to frames, equal to the participant's time.
    noise = noise - _mean_of_medians(gaussian, scale, targets) - settings.frame / 2
    lapses = np.where(generator.random(shape) < settings.lapse, _LATE * generator.random(shape), 0)
    reaction = times[..., None] + noise + lapses
    # Patterns appear at the start of a frame, and the button is read once per frame.
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
        contrast=np.tile(np.repeat(variants[:, 0], repeats), people),
        speed_deg_s=np.tile(np.repeat(variants[:, 1], repeats), people),
    )


def _with_factors(
    settings: SimulationSettings, generator: np.random.Generator, times: Array, where: Array
) -> tuple[Array, Array, Array]:
    """Times [P, N W], (eccentricity, size) [N W, 2] and (contrast, speed) [N W, 2] of N conditions in W variants.

    ``times`` [P, N] are those of black patterns at rest at the conditions ``where`` [N, 2]. No random number is drawn
    if there are no other variants.
    """
    variants = np.array(list(product(settings.contrasts, settings.speeds_deg_s)))
    conditions = len(where)
    times, where = times.repeat(len(variants), 1), where.repeat(len(variants), 0)
    variants = np.tile(variants, (conditions, 1))
    if (variants == AS_IN_THESIS).all():
        return times, where, variants
    k, m = 1 + settings.factor_spread * generator.standard_normal((2, len(times), 1))
    from_middle = (where[:, 0] - MIDDLE_DEG) / 10
    k = settings.contrast * k + settings.contrast_growth * from_middle
    m = settings.motion * m + settings.motion_growth * from_middle
    c, g = contrast_term(variants[:, 0].copy()).numpy(), motion_term(variants[:, 1].copy(), where[:, 0].copy()).numpy()
    change = k * c - m * g
    return times + change, where, variants


@lru_cache
def _mean_of_medians(gaussian: float, scale: float, answers: int) -> float:
    """Mean of the median of ``answers`` samples of the noise; it exceeds the distribution's median, which is skewed.

    The noise is a Gaussian of standard deviation ``gaussian`` plus an exponential of mean ``scale``. The cumulative
    distribution of the k-th of n ordered samples at t is I_p(k, n - k + 1), with p = P(noise <= t) and I the
    regularised incomplete beta function.
    """
    if not gaussian and not scale:
        return 0.0
    t = np.linspace(-8 * gaussian, 8 * gaussian + 40 * scale, 20001)
    if gaussian and scale:
        noise = stats.exponnorm(scale / gaussian, scale=gaussian)
    else:
        noise = stats.norm(scale=gaussian) if gaussian else stats.expon(scale=scale)
    below = noise.cdf(t)
    middle = ((answers + 1) // 2, answers // 2 + 1)  # ranks of the one or two samples that define the median
    first, second = (special.betainc(rank, answers - rank + 1, below) for rank in middle)
    cumulative = (first + second) / 2
    return float((np.diff(cumulative) * (t[1:] + t[:-1]) / 2).sum())
