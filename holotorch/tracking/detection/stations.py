"""Axis and width of the tube's image, from several cross-sections of the bands, called stations."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.axis_fit import AxisFit, fit_axis
from holotorch.tracking.detection.bands import Stretches
from holotorch.tracking.detection.fits import median
from holotorch.tracking.pose.status import Refusal, Status


@dataclass(frozen=True)
class StationPlan:
    """Number of cross-sections of the tube, called stations, and of their samples."""

    most: int = 8  # stations of a tube of ordinary width
    fewest: int = 6  # stations of a wide tube
    samples: int = 16  # neighbouring lines across the tube that are averaged for one station to reduce noise
    most_across: int = 700  # samples across the tube in all stations together; it limits the stations of wide tubes


@dataclass(frozen=True)
class AxisLimits:
    """Limits for refusing the fit of an axis, and an error floor; determined on synthetic frames."""

    one_sided: float = 0.15  # least ratio of the contrasts of the tube to its two sides, smaller over larger
    narrowest: float = 2.4  # least width in pixels; in a narrower tube no pixel shows the colour of one band alone
    moving: float = 3.0  # largest change of the middle in the last step of a converged fit, in pixels
    floor: float = 0.002  # error of the axis in widths, from gloss and shadow that are constant along the tube


@dataclass(frozen=True)
class WidthFit:
    """Limits of the measurement of a tube's width independently of a pose."""

    slow: float = 0.2  # relative deviation of a width above which the fit may not have converged and is continued
    linear: float = 0.1  # relative change of a width up to which one linear step replaces a fit
    other_px: float = 1.5  # difference in pixels from which on the tube is surely wider or narrower than expected
    blur_px: float = 0.9  # initial standard deviation of the blur in pixels: that of a focused camera


STATION_PLAN, _LIMITS, _WIDTH = StationPlan(), AxisLimits(), WidthFit()
THIRD = 0.35  # relative deviation of the prior for an unknown width
_LEVEL_SD = 2.5 / 255  # assumed standard deviation of a pixel's level; fits rescale it by their residuals


@dataclass(frozen=True, eq=False)
class Axis:
    """Axis of the tube's image, and the width of that image.

    Attributes:
        line: Line of the axis on the plane z = 1, with the bands around t = 0.
        width, taper: Width at t = 0 in pixels, and its change per pixel.
        width_sd: Standard deviation of the width in pixels.
        offset_sd, slope_sd: Standard deviations of the axis at ``centre``, in pixels and pixels per pixel.
        centre: Position t in pixels at which the errors of offset and slope are uncorrelated.
        fit: Fit to the stations that gave this axis, relative to the line of the stations.
    """

    line: Line
    width: float
    taper: float
    width_sd: float
    offset_sd: float
    slope_sd: float
    centre: float
    fit: AxisFit

    @property
    def blur(self) -> float:
        """Blur of the tube's sides, standard deviation in pixels."""
        return float(self.fit.unknown[4])

    def width_at(self, t: float | np.ndarray) -> np.ndarray:
        """Width in pixels at positions ``t``."""
        return self.width + self.taper * np.asarray(t)


@dataclass(frozen=True, eq=False)
class Stations:
    """Samples across the bands at stations along ``line``, as :func:`fit_axis` takes them.

    ``extent`` is the distance in pixels from the first to the last sampled position. ``light`` [3, S, U] are the
    samples in linear light, each the mean of ``samples`` neighbouring ones.
    """

    line: Line
    extent: float
    light: np.ndarray
    samples: int
    signal: np.ndarray
    weight: np.ndarray
    t: np.ndarray
    band: np.ndarray
    level: np.ndarray
    bright: np.ndarray

    def rough_width(self) -> float:
        """Width of the tube in pixels: median number of samples with over half of the largest contrast."""
        left, right = self.signal[:, :2].mean(1), self.signal[:, -2:].mean(1)
        middle = self.signal.shape[1] // 2
        away = np.abs(self.signal - np.repeat(np.stack([left, right], 1), [middle, middle + 1], 1))
        return median((2 * away > away.max(1, keepdims=True)).sum(1))

    def show(self, width: float, blur: float) -> bool:
        """Whether the samples extend beyond the blurred sides of a tube; ``width`` and ``blur`` in pixels."""
        return self.signal.shape[1] > 2 * (0.6 * width + 3 + 2 * blur)


def look_across(
    sampler: Sampler,
    lens: Lens,
    line: Line,
    stretches: Stretches,
    width: float,
    blur: float,
    plan: StationPlan = STATION_PLAN,
) -> Stations:
    """Sample stations within the visible bands of a tube of about ``width`` pixels, with sides blurred by ``blur``.

    Raises:
        Refusal: BANDS_MISSING where no band is visible from end to end, TOO_NARROW where the bands are too short.
    """
    edges = stretches.edges.tolist()
    spans = [
        (a + 3, b - 3)
        for a, b, shown, whole in zip(edges, edges[1:], stretches.shown, stretches.whole, strict=False)
        if math.isfinite(a) and math.isfinite(b) and b - a > 10 and shown > 0.3 * whole
    ]
    if not spans:
        raise Refusal(Status.BANDS_MISSING, "no band is seen from one end to the other")
    half = math.ceil(0.6 * width + 4 + 2 * blur)
    u = np.arange(-half, half + 1.0)
    wanted = min(plan.most, max(plan.fewest, plan.most_across // len(u)))
    length = sum(b - a for a, b in spans)
    samples = min(plan.samples, max(1, int(length / wanted)))
    each = [max(1, round(wanted * (b - a) / length)) for a, b in spans]
    if samples < 2 and sum(each) > length:
        raise Refusal(Status.TOO_NARROW, "the bands are a few pixels long")
    parts = [
        a + (np.arange(count * samples) + 0.5).reshape(count, samples) * ((b - a) / (count * samples))
        for (a, b), count in zip(spans, each, strict=True)
    ]
    band, t = np.repeat(np.arange(len(parts)), each), np.concatenate(parts)
    light = sampler(line.pixels(lens, t.ravel(), u)).reshape(3, *t.shape, len(u)).sum(2) / np.float32(samples)
    signal, weight, *levels = best_contrast(light, width, band, samples)
    return Stations(line, float(t.max() - t.min()), light, samples, signal, weight, t.mean(-1), band, *levels)


def measure_axis(
    stations: Stations, width: tuple[float, float], known: float, blur: float, before: Axis | None = None
) -> Axis:
    """Axis and width from stations.

    ``width`` is the expected width at t = 0 in pixels and the taper per pixel, with the relative standard deviation
    ``known``; ``blur`` the initial standard deviation of the blur in pixels. The fit of ``before``, an earlier axis of
    the same stations, gives the other initial values.

    Raises:
        Refusal: NO_AXIS if the sides are unclear or bent, or on one side only; TOO_NARROW for a narrow tube.
    """
    given = stations.signal, stations.weight, stations.t, stations.band, stations.level, stations.bright
    fit = fit_axis(*given, width, blur, known, before.fit.unknown if before else None)
    axis = _axis(stations, fit)
    if not converged(fit) or not 0 < axis.width < 2 * width[0] + 3:
        raise Refusal(Status.NO_AXIS, "the bands have no clear sides")
    if min(fit.contrast) < _LIMITS.one_sided:
        raise Refusal(Status.NO_AXIS, "the bands' colours go on beside the line: too wide for the catheter")
    if 2 * np.count_nonzero(fit.weight > 0.2) < len(fit.weight):
        raise Refusal(Status.NO_AXIS, "the bands do not lie on one straight line: bent, or not a catheter")
    if axis.width + axis.width_sd < _LIMITS.narrowest:
        raise Refusal(
            Status.TOO_NARROW, f"the catheter is {axis.width:.1f} px wide; {_LIMITS.narrowest:g} px are needed"
        )
    return axis


def measure_width(
    look: Callable[[float, float], Stations], stations: Stations, axis: Axis, wide: tuple[float, float], known: float
) -> tuple[Stations, Axis, Axis]:
    """Stations, axis with the expected width, and a second axis with an independently measured width, for checks.

    ``axis`` is the fit to ``stations`` with the expected width ``wide`` (pixels at t = 0, taper per pixel) of relative
    standard deviation ``known``. ``look`` samples stations for a width and a blur in pixels; it is called before and
    after the measurement of the width if the tube extends beyond the stations.

    Raises:
        Refusal: As :func:`look_across` and :func:`measure_axis`.
    """
    narrow = not stations.show(axis.width, axis.blur)
    if narrow:
        stations = look(axis.width, axis.blur)
    rough = stations.rough_width()
    if known >= THIRD:
        axis = width = measure_axis(stations, wide, known, axis.blur) if narrow else axis
    elif abs(rough - wide[0]) >= max(_WIDTH.other_px, 0.25 * wide[0]):
        width = measure_axis(stations, (rough, 0.0), THIRD, _WIDTH.blur_px)
    else:
        # From a nearly correct initial width, the fit does not converge to the width of a highlight.
        width = _axis(stations, axis.fit.given(wide, THIRD, known))
        if narrow or abs(width.width - wide[0]) > _WIDTH.linear * wide[0]:
            width = measure_axis(stations, wide, THIRD, axis.blur, axis)
    if stations.show(width.width, width.blur):
        axis = measure_axis(stations, wide, known, width.blur) if narrow and known < THIRD else axis
        return stations, axis, width
    stations = look(width.width, width.blur)
    other = abs(width.width - wide[0]) > 3 * width.width_sd
    axis = measure_axis(stations, wide, known, width.blur)
    own = (width.width, width.taper) if other else wide
    width = measure_axis(stations, own, THIRD, width.blur, None if other else axis)
    if (
        width.width_sd > _WIDTH.slow * wide[0]
    ):  # width and blur are strongly correlated, so that the fit converges slowly
        width = measure_axis(stations, (width.width, width.taper), THIRD, width.blur)
    return stations, axis, width


def converged(fit: AxisFit) -> bool:
    """Whether the fit has a solution with errors."""
    return bool(np.isfinite(fit.covariance).all()) and fit.moving <= _LIMITS.moving


def narrowed(stations: Stations, axis: Axis, width: tuple[float, float], known: float) -> Axis:
    """``axis`` for a more precise ``width`` (pixels at t = 0, taper per pixel) of relative deviation ``known``."""
    return _axis(stations, axis.fit.given(width, known))


def _axis(stations: Stations, fit: AxisFit) -> Axis:
    offset, slope, wide, taper = fit.sides.tolist()
    width_sd = math.sqrt(max(float(fit.covariance[2, 2]), 0.0))
    axis = Axis(stations.line, wide, taper, width_sd, 0.0, 0.0, 0.0, fit)
    return moved(stations, axis, np.array([offset, slope]), fit.covariance[:2, :2])


def moved(stations: Stations, axis: Axis, middle: np.ndarray, covariance: np.ndarray) -> Axis:
    """``axis`` with another line and its errors: ``middle`` [2], offset in pixels and slope from the stations' line.

    Its ``centre`` is where the errors of offset and slope, of ``covariance`` [2, 2], are uncorrelated.
    """
    (variance, cross), (_, other) = covariance.tolist()
    other = max(other, 1e-18)
    floor = _LIMITS.floor * axis.width
    return replace(
        axis,
        line=stations.line.moved(*middle.tolist()),
        offset_sd=math.hypot(math.sqrt(max(variance - cross * cross / other, 0.0)), floor),
        slope_sd=math.hypot(math.sqrt(other), 2 * floor / max(20.0, stations.extent)),
        centre=-cross / other,
    )


def variance_of(light: np.ndarray) -> np.ndarray:
    """Variance of linear light from the noise of levels: proportional to the squared slope of the sRGB decoding."""
    # NumPy vectorises logarithms and exponentials; its powers take ten times as long.
    return np.exp(np.log(np.maximum(light, 0.002)) * (2.8 / 2.4) + 2 * math.log(_LEVEL_SD * 2.4 / 1.055))


def tube_and_background(count: int, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``count`` samples, bool [U] each, lie surely on a tube of ``width`` pixels and surely beside it."""
    away = np.abs(np.arange(count) - count // 2)
    return away <= max(0.6, 0.3 * width), away >= 0.5 * width + 1.5


def best_contrast(
    light: np.ndarray, width: float, band: np.ndarray, samples: int, variance: Callable = variance_of
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Signal [S, U] from light [C, S, U], its inverse variance, and two levels of each band [bands].

    In each band the signal is the linear combination of the channels that has the largest ratio of the contrast between
    tube and background to the noise, whose variance is a function of the light. The second level combines the
    channels with absolute weights. ``light`` holds means of ``samples`` samples of a tube of ``width`` pixels.
    """
    where = np.stack(tube_and_background(light.shape[-1], width), -1).astype(np.float32)
    parts = light @ (where / where.sum(0))  # [C, S, 2]
    member = (band[:, None] == np.arange(band[-1] + 1)).astype(np.float32)
    own, around = parts.transpose(2, 0, 1) @ (member / np.maximum(member.sum(0), 1))  # [C, bands] each
    mixes = (own - around) / (variance(own) + variance(around))
    mixes = mixes / np.maximum(np.sqrt((mixes * mixes).sum(0)), 1e-12)
    mix = mixes[:, band, None]  # [C, S, 1]
    signal = (light * mix).sum(0)
    noise = (mix * mix * variance(light)).sum(0) / samples
    level, bright = np.array([mixes * own, np.abs(mixes * own)], dtype=np.float64).sum(1)
    return signal, 1 / np.maximum(noise, 1e-30), level, bright
