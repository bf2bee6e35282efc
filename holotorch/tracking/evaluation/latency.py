"""Latency of a tracker relative to a reference that tracks the same motion, Sec. 3.5.4 of the thesis."""

import math
from typing import NamedTuple

import scipy.signal
import torch
from torch import Tensor

from holotorch.core import checks

_LEAST = 0.8  # least correlation of two curves that show the same motion
_DROP = 0.05  # least difference between the largest and the smallest correlation within the search
_SAMPLES = 20  # least number of samples of a track


class Latency(NamedTuple):
    """Result of :func:`latency`.

    Attributes:
        seconds: Lag of the track behind the reference; negative if the track leads.
        sd: Standard deviation of ``seconds``, if the difference of the curves is white noise.
        correlation: Correlation at the peak, at most 1.
        width: Half-width of the peak in seconds, at half of the height of the parabola.
        overlap: Duration in seconds that both tracks cover.
    """

    seconds: float
    sd: float
    correlation: float
    width: float
    overlap: float


def latency(times: Tensor, tips: Tensor, reference_times: Tensor, reference: Tensor, longest: float = 0.5) -> Latency:
    """Lag of a track behind a reference, by cross-correlation of the distances from their first positions.

    The distances do not depend on the coordinate frames of the tracks. Hold the tool still at first, then move it fast
    and not periodically. Both curves are interpolated linearly to a common clock, except across longer gaps. A parabola
    through the maximum of their normalised correlation gives the lag.

    Args:
        times: [n] times of the frames in seconds, increasing, on the clock of ``reference_times``.
        tips: [n, 3] in metres; NaN where refused.
        reference_times: [m] times of the reference in seconds, increasing.
        reference: [m, 3] tips in metres, in any frame; NaN where there is none.
        longest: Largest lag in seconds, of either sign, that is searched.

    Raises:
        TypeError, ValueError: Wrong shapes, times that do not increase, tracks that are too short or do not overlap,
            curves that do not show the same motion, or a peak that is flat, at the end of the search, or ambiguous.
    """
    checks.positive("longest", longest, "seconds")
    curves = _curve("track", times, tips), _curve("reference", reference_times, reference)
    start, end = max(float(t[0]) for t, _ in curves), min(float(t[-1]) for t, _ in curves)
    if end - start <= 2 * longest:
        raise ValueError(
            f"the tracks share {max(0.0, end - start):.3g} s; a search to {longest:g} s needs more than "
            f"{2 * longest:g} s: record longer, or check that both have one clock"
        )
    fewest = min(int(((t >= start) & (t <= end)).sum()) for t, _ in curves)
    if fewest < _SAMPLES:
        raise ValueError(f"a track has {fewest} samples in the {end - start:.3g} s shared, fewer than {_SAMPLES}")
    step = min(float(t.diff().median()) for t, _ in curves) / 4
    count = int((end - start) / step) + 1
    if count > 1_000_000:
        raise ValueError(f"{end - start:.3g} s at steps of {step:.3g} s are too many samples; are times in seconds?")
    clock = start + step * torch.arange(count, dtype=torch.float64)
    most = math.ceil(longest / step)
    track, other = (_resample(curve, clock) for curve in curves)
    scores = _correlation(track, other, most)
    return _peak(scores, step, most, fewest, end - start)


def _peak(scores: Tensor, step: float, most: int, samples: int, overlap: float) -> Latency:
    """Latency at the highest of the correlations ``scores`` for lags of -most to most steps."""
    best = int(scores.nan_to_num(-2.0).argmax())
    top = float(scores[best])
    if not top >= _LEAST:
        raise ValueError(f"the curves do not show the same motion: correlation {top:.3g}, expected {_LEAST} or more")
    if best in (0, 2 * most) or not bool(scores[best - 1 : best + 2].isfinite().all()):
        raise ValueError(f"the correlation still rises at {(best - most) * step:.3g} s; search for a longer lag")
    if top - float(scores[scores.isfinite()].min()) < _DROP:
        raise ValueError(f"the peak is flat: the correlation stays above {top - _DROP:.3g}; move faster, and stop")
    before, after = float(scores[best - 1]), float(scores[best + 1])
    curvature = 2 * top - before - after  # above zero at a peak
    width = step * math.sqrt(top / curvature)
    # Other peaks of nearly the same height, except those that noise causes on the highest one.
    inner = scores[1:-1]
    others = (inner > scores[:-2]) & (inner > scores[2:]) & (inner > top - 0.02)
    others &= ((torch.arange(1, 2 * most) - best) * step).abs() > width / 2
    if bool(others.any()):
        rival = (int(others.nonzero()[0]) + 1 - most) * step
        raise ValueError(
            f"lags of {(best - most) * step:.3g} s and {rival:.3g} s fit alike: move without a steady rhythm, or "
            "search for a shorter lag"
        )
    shift = (after - before) / (2 * curvature)
    top += curvature * shift * shift / 2
    sd = width * math.sqrt(max(0.0, 1 - top * top) / (top * top * samples))
    return Latency((best - most + shift) * step, sd, min(top, 1.0), width, overlap)


def _curve(name: str, times: Tensor, tips: Tensor) -> tuple[Tensor, Tensor]:
    """Times [n] and distances [n] from the first tip, of the n samples with a pose."""
    for what, value in ((f"times of the {name}", times), (f"tips of the {name}", tips)):
        checks.real(what, value)
    if tips.ndim != 2 or tips.shape[1] != 3 or times.shape != tips.shape[:1]:
        raise ValueError(
            f"times and tips of the {name} must be of shape [n] and [n, 3], got {list(times.shape)} and "
            f"{list(tips.shape)}"
        )
    times, tips = times.detach().to("cpu", torch.float64), tips.detach().to("cpu", torch.float64)
    checks.all_finite(f"times of the {name}", times)
    if bool((times.diff() <= 0).any()):
        raise ValueError(f"times of the {name} must rise; sort them, and leave out what was recorded twice")
    known = tips.isfinite().all(-1)
    if int(known.sum()) < _SAMPLES:
        raise ValueError(f"the {name} has {int(known.sum())} answered samples, fewer than {_SAMPLES}")
    return times[known], (tips[known] - tips[known][0]).norm(dim=-1)


def _resample(curve: tuple[Tensor, Tensor], clock: Tensor) -> Tensor:
    """The curve interpolated linearly to the times of the clock; NaN in gaps above 2.5 sampling intervals."""
    times, values = curve
    after = torch.searchsorted(times, clock).clamp(1, len(times) - 1)
    interval = times[after] - times[after - 1]
    fraction = ((clock - times[after - 1]) / interval).clamp(0, 1)
    value = values[after - 1] + fraction * (values[after] - values[after - 1])
    return torch.where(interval > 2.5 * times.diff().median(), torch.nan, value)


def _correlation(track: Tensor, reference: Tensor, most: int) -> Tensor:
    """Pearson correlations [2 most + 1] of track(t + lag) and reference(t), for lags of -most to most steps.

    Each one is over the times at which both are finite, and NaN where these are fewer than half of the largest number.
    """

    def sums(first: Tensor, second: Tensor) -> Tensor:  # over t of first(t + lag) second(t)
        full = torch.from_numpy(scipy.signal.correlate(first.numpy(), second.numpy(), method="fft"))
        return full[len(second) - 1 - most : len(second) + most]

    known_a, known_b = track.isfinite().double(), reference.isfinite().double()
    # Subtracting the means first avoids cancellation in the variances below.
    a = torch.where(known_a > 0, track - track.nanmean(), 0.0)
    b = torch.where(known_b > 0, reference - reference.nanmean(), 0.0)
    number = sums(known_a, known_b).round()
    mean_a, mean_b = sums(a, known_b) / number, sums(known_a, b) / number
    variance_a = sums(a * a, known_b) / number - mean_a.square()
    variance_b = sums(known_a, b * b) / number - mean_b.square()
    covariance = sums(a, b) / number - mean_a * mean_b
    enough = (number >= 0.5 * float(number.max())) & (variance_a > 0) & (variance_b > 0)
    return torch.where(enough, covariance / (variance_a * variance_b).sqrt(), torch.nan)
