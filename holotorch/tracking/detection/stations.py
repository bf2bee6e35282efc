"""The mid-line of the tube's image and its width, from many stations across the bands."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from holotorch.tracking.camera.lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.axis_fit import AxisFit, fit_axis
from holotorch.tracking.detection.bands import Stretches
from holotorch.tracking.detection.fits import median
from holotorch.tracking.pose.status import Refusal, Status

_LEVEL_SD = 2.5 / 255  # of a pixel's level; fits correct it by what they leave
_ONE_SIDED = 0.15  # contrast to one side over that to the other
_NARROWEST = 2.4  # pixels: below it no pixel shows one band alone
_STATIONS, _FEWEST = 8, 6
_SAMPLES = 16  # for each station: along the tube neighbours differ in nothing but noise
_MOST = 700  # samples across, of all stations together: wide tubes take fewer stations
THIRD = 0.35  # how well a width is known of which nothing is known, as a share of it
_SLOW = 0.2  # of the width: a standard deviation that says that it may not have been reached yet
_LINEAR = 0.1  # of a width: of what it is freed by one step of a fit, not by a new one, errs by the square of that
_OTHER = 1.5  # pixels from its width at which a tube is surely wider or narrower
_SHARP = 0.9  # pixels of blur, to begin with
_SETTLED = 3.0  # pixels: a middle that moves farther in the last of a fit's steps is none
_LINE_FLOOR = 0.002  # of the width: what gloss and shadow, which repeat along the tube, may move its middle


@dataclass(frozen=True, eq=False)
class Axis:
    """Mid-line of the tube's image and its width.

    Attributes:
        line: On the plane z = 1; the bands lie around t = 0.
        width, taper: Of the strip at t = 0 in pixels, and its change per pixel.
        width_sd: Standard deviation of the width.
        offset_sd, slope_sd: Of the line, in pixels and pixels per pixel, at ``centre``.
        centre: Where the two are independent, t in pixels.
        fit: What it was made of, on the line it was looked for along.
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
        """Of the sides, standard deviation in pixels."""
        return float(self.fit.unknown[4])

    def width_at(self, t: float | np.ndarray) -> np.ndarray:
        """Pixels."""
        return self.width + self.taper * np.asarray(t)


@dataclass(frozen=True, eq=False)
class Stations:
    """What is seen across the bands at stations along ``line``, as :func:`fit_axis` takes it; ``extent`` in pixels."""

    line: Line
    extent: float
    signal: np.ndarray
    weight: np.ndarray
    t: np.ndarray
    band: np.ndarray
    level: np.ndarray
    bright: np.ndarray

    def rough_width(self) -> float:
        """Of the tube in pixels: where the signal is nearer to what it is at most than to what is beside."""
        left, right = self.signal[:, :2].mean(1), self.signal[:, -2:].mean(1)
        middle = self.signal.shape[1] // 2
        away = np.abs(self.signal - np.repeat(np.stack([left, right], 1), [middle, middle + 1], 1))
        return median((2 * away > away.max(1, keepdims=True)).sum(1))

    def show(self, width: float, blur: float) -> bool:
        """Whether they reach beyond the sides of a tube so wide."""
        return self.signal.shape[1] > 2 * (0.6 * width + 3 + 2 * blur)


def look_across(sampler: Sampler, lens: Lens, line: Line, stretches: Stretches, width: float, blur: float) -> Stations:
    """Stations within the bands that are seen, of a tube some ``width`` pixels wide.

    A Refusal (BANDS_MISSING, TOO_NARROW) where no band is seen whole, or too little of them.
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
    wanted = min(_STATIONS, max(_FEWEST, _MOST // len(u)))
    length = sum(b - a for a, b in spans)
    samples = min(_SAMPLES, max(1, int(length / wanted)))
    each = [max(1, round(wanted * (b - a) / length)) for a, b in spans]
    if samples < 2 and sum(each) > length:
        raise Refusal(Status.TOO_NARROW, "the bands are a few pixels long")
    parts = [
        a + (np.arange(count * samples) + 0.5).reshape(count, samples) * ((b - a) / (count * samples))
        for (a, b), count in zip(spans, each, strict=True)
    ]
    band, t = np.repeat(np.arange(len(parts)), each), np.concatenate(parts)
    light = sampler(line.pixels(lens, t.ravel(), u)).reshape(3, *t.shape, len(u)).sum(2) / np.float32(samples)
    signal, weight, *levels = _contrast(light, u, width, band, samples)
    return Stations(line, float(t.max() - t.min()), signal, weight, t.mean(-1), band, *levels)


def measure_axis(
    stations: Stations, width: tuple[float, float], known: float, blur: float, before: Axis | None = None
) -> Axis:
    """Mid-line and width; ``width`` and ``known`` as for ``fit_axis``, which begins at what was found ``before``.

    A Refusal (NO_AXIS, TOO_NARROW) where sides are unclear, one-sided or bent, or too near each other.
    """
    given = stations.signal, stations.weight, stations.t, stations.band, stations.level, stations.bright
    fit = fit_axis(*given, width, blur, known, before.fit.unknown if before else None)
    axis = _axis(stations, fit)
    lost = not np.isfinite(fit.covariance).all() or fit.moving > _SETTLED
    if lost or not 0 < axis.width < 2 * width[0] + 3:
        raise Refusal(Status.NO_AXIS, "the bands have no clear sides")
    if min(fit.contrast) < _ONE_SIDED:
        raise Refusal(Status.NO_AXIS, "the bands' colours go on beside the line: too wide for the catheter")
    if 2 * np.count_nonzero(fit.weight > 0.2) < len(fit.weight):
        raise Refusal(Status.NO_AXIS, "the bands do not lie on one straight line: bent, or not a catheter")
    if axis.width + axis.width_sd < _NARROWEST:
        raise Refusal(Status.TOO_NARROW, f"the catheter is {axis.width:.1f} px wide; {_NARROWEST:g} px are needed")
    return axis


def measure_width(
    look: Callable[[float, float], Stations], stations: Stations, axis: Axis, wide: tuple[float, float], known: float
) -> tuple[Stations, Axis, Axis]:
    """Stations, axis, and one more axis whose width is its own, to check with.

    ``axis`` is that of a tube ``wide`` (pixels at t = 0, and its taper per pixel, ``known`` to a share). Where the tube
    reaches beyond the stations, ``look`` (at a width and a blur in pixels) sees it anew: by the axis before its width
    is measured, and once more by that width. Refusals are those of :func:`look_across` and :func:`measure_axis`.
    """
    narrow = not stations.show(axis.width, axis.blur)
    if narrow:
        stations = look(axis.width, axis.blur)
    rough = stations.rough_width()
    if known >= THIRD:
        axis = width = measure_axis(stations, wide, known, axis.blur) if narrow else axis
    elif abs(rough - wide[0]) >= max(_OTHER, 0.25 * wide[0]):
        width = measure_axis(stations, (rough, 0.0), THIRD, _SHARP)
    else:
        # Beginning with a width that is nearly right, gloss is not taken for it.
        width = _axis(stations, axis.fit.given(wide, THIRD, known))
        if narrow or abs(width.width - wide[0]) > _LINEAR * wide[0]:
            width = measure_axis(stations, wide, THIRD, axis.blur, axis)
    if stations.show(width.width, width.blur):
        axis = measure_axis(stations, wide, known, width.blur) if narrow and known < THIRD else axis
        return stations, axis, width
    stations = look(width.width, width.blur)
    other = abs(width.width - wide[0]) > 3 * width.width_sd
    axis = measure_axis(stations, wide, known, width.blur)
    own = (width.width, width.taper) if other else wide
    width = measure_axis(stations, own, THIRD, width.blur, None if other else axis)
    if width.width_sd > _SLOW * wide[0]:  # width against blur: a long valley, and steps are small
        width = measure_axis(stations, (width.width, width.taper), THIRD, width.blur)
    return stations, axis, width


def narrowed(stations: Stations, axis: Axis, width: tuple[float, float], known: float) -> Axis:
    """The axis, where its width (pixels at t = 0, and taper per pixel) comes to be known, to a share of it."""
    return _axis(stations, axis.fit.given(width, known))


def _axis(stations: Stations, fit: AxisFit) -> Axis:
    offset, slope, wide, taper = fit.sides.tolist()
    (variance, cross), (_, other) = fit.covariance[:2, :2].tolist()
    other = max(other, 1e-18)
    floor = _LINE_FLOOR * wide
    return Axis(
        stations.line.moved(offset, slope),
        wide,
        taper,
        math.sqrt(max(float(fit.covariance[2, 2]), 0.0)),
        math.hypot(math.sqrt(max(variance - cross * cross / other, 0.0)), floor),
        math.hypot(math.sqrt(other), 2 * floor / max(20.0, stations.extent)),
        -cross / other,
        fit,
    )


def _contrast(light: np.ndarray, u: np.ndarray, width: float, band: np.ndarray, samples: int):
    """Light [3, S, U] as one signal [S, U], its inverse variances, and each band's level in it [bands], and brightness.

    The signal is the mix of channels, one for each band, in which tube and surroundings differ most over the noise.
    """
    away = np.abs(u)
    where = np.empty((len(u), 2), dtype=np.float32)
    where[:, 0], where[:, 1] = away <= max(0.6, 0.3 * width), away >= 0.5 * width + 1.5
    parts = light @ (where / where.sum(0))  # [3, S, 2]
    member = (band[:, None] == np.arange(band[-1] + 1)).astype(np.float32)
    own, around = parts.transpose(2, 0, 1) @ (member / np.maximum(member.sum(0), 1))  # [3, bands] each
    mixes = (own - around) / (variance_of(own) + variance_of(around))
    mixes = mixes / np.maximum(np.sqrt((mixes * mixes).sum(0)), 1e-12)
    mix = mixes[:, band, None]  # [3, S, 1]
    signal = (light * mix).sum(0)
    variance = (mix * mix * variance_of(light)).sum(0) / samples
    level, bright = np.array([mixes * own, np.abs(mixes) * own], dtype=np.float64).sum(1)
    return signal, 1 / np.maximum(variance, 1e-30), level, bright


def variance_of(light: np.ndarray) -> np.ndarray:
    """Of light, from the noise of levels: the slope of the sRGB curve's inverse, which rises about as light^0.58."""
    # By logarithms, which NumPy has for vectors of the processor; its powers take ten times as long.
    return np.exp(np.log(np.maximum(light, 0.002)) * (2.8 / 2.4) + 2 * math.log(_LEVEL_SD * 2.4 / 1.055))
