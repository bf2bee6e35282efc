"""Latency of a tracker relative to a reference that tracks the same motion of a tool, Sec. 3.5.4."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.core import checks

_LEAST = 0.8  # least correlation of two curves that show the same motion
_DROP = 0.05  # least range of the correlation within the search; with less, the peak is flat
_RIVAL = 0.02  # difference of correlation up to which a second peak makes the lag ambiguous
_SAMPLES = 20  # least number of samples of a track
_GAP = 2.5  # longest gap, in sampling intervals, that is interpolated
_CLOCK = 4  # samples of the common clock per sampling interval of the faster track
_LONGEST_CLOCK = 1_000_000  # most samples of the common clock; more indicate times in another unit


class Latency(NamedTuple):
    """Result of :func:`latency`.

    Attributes:
        seconds: Lag of the track behind the reference; negative where it leads.
        sd: Standard deviation of ``seconds``, if the difference of the curves is white noise.
        correlation: Correlation at the peak, at most 1.
        width: Width of the peak in seconds: the shift at which its parabola has lost half of its height.
        overlap: Duration in seconds that both tracks cover.
    """

    seconds: float
    sd: float
    correlation: float
    width: float
    overlap: float


def latency(times: Tensor, tips: Tensor, reference_times: Tensor, reference: Tensor, longest: float = 0.5) -> Latency:
    """Lag of a track behind a reference, by cross-correlation of the distances from their first positions.

    Distances do not depend on the coordinate frames of the two tracks. Hold the tool still at first, then move it fast
    and without a steady rhythm. Both curves are interpolated linearly to a common clock, except across refusals. A
    parabola through the maximum of their normalised correlation gives the lag.

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
    own = _curve("track", times, tips)
    other = _curve("reference", reference_times, reference)
    start, end = max(float(own[0][0]), float(other[0][0])), min(float(own[0][-1]), float(other[0][-1]))
    if end - start <= 2 * longest:
        raise ValueError(
            f"the tracks share {max(0.0, end - start):.3g} s; a search to {longest:g} s needs more than "
            f"{2 * longest:g} s: record longer, or check that both have one clock"
        )
    fewest = min(int(((t >= start) & (t <= end)).sum()) for t, _ in (own, other))
    if fewest < _SAMPLES:
        raise ValueError(f"a track has {fewest} samples in the {end - start:.3g} s shared, fewer than {_SAMPLES}")
    step = min(float(t.diff().median()) for t, _ in (own, other)) / _CLOCK
    count = int((end - start) / step) + 1
    if count > _LONGEST_CLOCK:
        raise ValueError(f"{end - start:.3g} s at steps of {step:.3g} s are too many samples; are times in seconds?")
    clock = start + step * torch.arange(count, dtype=torch.float64)
    most = math.ceil(longest / step)
    scores = _correlation(_resampled(own, clock), _resampled(other, clock), most)
    return _peak(scores, step, most, fewest, end - start)


def _peak(scores: Tensor, step: float, most: int, samples: int, overlap: float) -> Latency:
    best = int(scores.nan_to_num(-2.0).argmax())
    top = float(scores[best])
    if not top >= _LEAST:
        raise ValueError(f"the curves do not show the same motion: correlation {top:.3g}, expected {_LEAST} or more")
    if best in (0, 2 * most) or not bool(scores[best - 1 : best + 2].isfinite().all()):
        raise ValueError(f"the correlation still rises at {(best - most) * step:.3g} s; search for a longer lag")
    if top - float(scores[scores.isfinite()].min()) < _DROP:
        raise ValueError(f"the peak is flat: the correlation stays above {top - _DROP:.3g}; move faster, and stop")
    before, after = float(scores[best - 1]), float(scores[best + 1])
    bend = 2 * top - before - after  # above zero at a peak
    width = step * math.sqrt(top / bend)
    inner = scores[1:-1]
    rivals = (inner > scores[:-2]) & (inner > scores[2:]) & (inner > top - _RIVAL)
    lags = (torch.arange(1, 2 * most) - best) * step
    rivals &= lags.abs() > width / 2  # closer maxima are noise on the peak itself
    if bool(rivals.any()):
        rival = (int(rivals.nonzero()[0]) + 1 - most) * step
        raise ValueError(
            f"lags of {(best - most) * step:.3g} s and {rival:.3g} s fit alike: move without a steady rhythm, or "
            "search for a shorter lag"
        )
    shift = (after - before) / (2 * bend)
    top += bend * shift * shift / 2
    sd = width * math.sqrt(max(0.0, 1 - top * top) / (top * top * samples))
    return Latency((best - most + shift) * step, sd, min(top, 1.0), width, overlap)


def _curve(name: str, times: Tensor, tips: Tensor) -> tuple[Tensor, Tensor]:
    """Times [n] and distances [n] from the first tip, of the samples with a pose."""
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


def _resampled(curve: tuple[Tensor, Tensor], clock: Tensor) -> Tensor:
    """The curve interpolated linearly to the times of the clock; NaN in its gaps."""
    times, values = curve
    after = torch.searchsorted(times, clock).clamp(1, len(times) - 1)
    interval = times[after] - times[after - 1]
    share = ((clock - times[after - 1]) / interval).clamp(0, 1)
    value = values[after - 1] + share * (values[after] - values[after - 1])
    return torch.where(interval > _GAP * times.diff().median(), torch.nan, value)


def _correlation(track: Tensor, reference: Tensor, most: int) -> Tensor:
    """Pearson's r of track(t + lag) and reference(t) for lags -most to most, over the times at which both exist."""
    size = 1 << (len(track) + most - 1).bit_length()

    def sums(first: Tensor, second: Tensor) -> Tensor:  # over t of first(t + lag) second(t)
        product = torch.fft.rfft(first, size) * torch.fft.rfft(second, size).conj()
        whole = torch.fft.irfft(product, size)
        return torch.cat([whole[size - most :], whole[: most + 1]])

    known = [value.isfinite().double() for value in (track, reference)]
    # Subtract the means first, which avoids cancellation in the variances below.
    a, b = (
        torch.where(mask > 0, v - v[mask > 0].mean(), 0.0) for v, mask in zip((track, reference), known, strict=True)
    )
    number = sums(*known).round()
    mean_a, mean_b = sums(a, known[1]) / number, sums(known[0], b) / number
    vary_a = sums(a * a, known[1]) / number - mean_a.square()
    vary_b = sums(known[0], b * b) / number - mean_b.square()
    together = sums(a, b) / number - mean_a * mean_b
    enough = (number >= 0.5 * float(number.max())) & (vary_a > 0) & (vary_b > 0)
    return torch.where(enough, together / (vary_a * vary_b).sqrt(), torch.nan)
