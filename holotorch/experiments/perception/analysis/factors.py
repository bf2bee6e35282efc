"""Effects of the contrast and the motion of a pattern on its perception time, with the participant as the unit."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import stats

from holotorch.experiments.perception.analysis.curves import Times
from holotorch.experiments.perception.analysis.statistics import LEAST, Array
from holotorch.perception.factors import contrast_term, motion_term


@dataclass(frozen=True)
class Effect:
    """Mean over participants of a difference of times or a coefficient of the model, in seconds, with a t interval.

    ``interval`` is NaN if fewer than ``LEAST`` participants have a value.
    """

    name: str
    seconds: float
    interval: tuple[float, float]
    participants: int

    def row(self) -> dict[str, Any]:
        """The row of factors.csv."""
        low, high = (value if math.isfinite(value) else None for value in self.interval)
        return {"effect": self.name, "seconds": self.seconds, "low": low, "high": high, "people": self.participants}

    def in_words(self) -> str:
        """The effect in milliseconds."""
        low, high = (1e3 * value for value in self.interval)
        return f"{self.name} {1e3 * self.seconds:+.1f} [{low:.1f}, {high:.1f}] ms"


def level_effects(times: Times, confidence: float) -> list[Effect]:
    """Time that each contrast and speed adds to the time of the reference, without a model.

    A participant's value is the mean difference over all pairs of eccentricity and size with a time in both.
    """
    seconds = times.all_seconds
    effects = []
    for k, (contrast, speed) in enumerate(times.variants[1:], 1):
        difference = (seconds[..., k] - seconds[..., 0]).reshape(len(seconds), -1)
        measured = np.isfinite(difference)
        sums = np.where(measured, difference, 0).sum(1)
        values = np.divide(sums, measured.sum(1), out=np.full(len(sums), np.nan), where=measured.any(1))
        effects.append(_effect(f"contrast {contrast:g} at {speed:g} deg/s", values, confidence))
    return effects


def model_effects(times: Times, middle_deg: float, confidence: float) -> list[Effect]:
    """Coefficients of the model of contrast and motion that is fitted to the times of each participant.

    T = T(E, S) + (k + k' e) (1 / C - 1) - (m + m' e) g(V, E), with an unknown T for each pair of eccentricity and size,
    the terms of contrast C and speed V of ``holotorch.perception.factors``, and e the eccentricity from ``middle_deg``
    in units of 10 deg. k' and m' tell whether the effects change with the eccentricity; the laws do not need them. The
    fit is by least squares, and the intervals are t intervals of the mean over participants.

    Answers faster than ``cleaning.fastest`` are left out, which lengthens the shortest times and makes the effects
    appear smaller for participants with times near it: by 7 to 9 % at the default noise of simulated participants.

    Returns:
        k and k' if there are several contrasts, and m and m' if there are several speeds. Participants whose times do
        not determine all of them are left out.
    """
    contrast, speed = np.array(times.variants).T.copy()
    from_middle = (times.eccentricities - middle_deg)[:, None, None] / 10
    shape = times.all_seconds.shape[1:]  # [E, S, W]
    names: list[str] = []
    terms: list[Array] = []
    where = torch.from_numpy(times.eccentricities)[:, None, None]
    size = contrast_term(contrast).numpy(), -motion_term(speed, where).numpy()
    for word, values, term in (("contrast", contrast, size[0]), ("motion", speed, size[1])):
        if len(np.unique(values)) > 1:
            names += [word, f"{word} per 10 deg of eccentricity"]
            terms += [np.broadcast_to(term, shape), np.broadcast_to(term * from_middle, shape)]
    if not terms:
        return []
    fits = np.stack([_fit(person, np.stack(terms, -1)) for person in times.all_seconds])
    return [_effect(name, fits[:, k], confidence) for k, name in enumerate(names)]


def _fit(seconds: Array, terms: Array) -> Array:
    """Coefficients [K] of terms [E, S, W, K] in the times [E, S, W] of one participant; NaN if they are not determined.

    The mean of every pair of eccentricity and size is subtracted, which eliminates T(E, S).
    """
    measured = np.isfinite(seconds)
    number = np.maximum(measured.sum(-1, keepdims=True), 1)
    y = np.where(measured, seconds, 0)
    y = np.where(measured, y - y.sum(-1, keepdims=True) / number, 0).ravel()
    x = np.where(measured[..., None], terms, 0)
    x = np.where(measured[..., None], x - x.sum(-2, keepdims=True) / number[..., None], 0).reshape(len(y), -1)
    scale = np.linalg.norm(x, axis=0)
    if not scale.all() or np.linalg.matrix_rank(x / scale, tol=1e-6) < x.shape[1]:
        return np.full(x.shape[1], np.nan)
    return np.linalg.lstsq(x, y)[0]


def _effect(name: str, values: Array, confidence: float) -> Effect:
    values = values[np.isfinite(values)]
    people = len(values)
    mean = float(values.mean()) if people else math.nan
    if people < LEAST:
        return Effect(name, mean, (math.nan, math.nan), people)
    half = float(stats.t.isf((1 - confidence) / 2, people - 1) * values.std(ddof=1) / math.sqrt(people))
    return Effect(name, mean, (mean - half, mean + half), people)
