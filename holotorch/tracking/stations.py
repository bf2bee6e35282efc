"""The mid-line of the tube's image and its width, from many stations across the bands."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.tracking.bands import Stretches
from holotorch.tracking.camera import Camera
from holotorch.tracking.fits import AxisFit, fit_axis
from holotorch.tracking.status import Refusal, Status
from holotorch.tracking.strips import Line, Sampler

_LEVEL_SD = 2.5 / 255  # of a pixel's level; fits correct it by what they leave
_ONE_SIDED = 0.15  # contrast to one side over that to the other
_NARROWEST = 2.4  # pixels: below it no pixel shows one band alone
_STATIONS = 40
_SAMPLES = 4  # for each station
_LINE_FLOOR = 0.008  # of the width: what gloss and shadow, which repeat along the tube, may move its middle


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

    def width_at(self, t: float) -> float:
        """Pixels."""
        return self.width + self.taper * t


@dataclass(frozen=True, eq=False)
class Stations:
    """What is seen across the bands at stations along ``line``, as :func:`fit_axis` takes it; ``extent`` in pixels."""

    line: Line
    extent: float
    signal: Tensor
    weight: Tensor
    t: Tensor
    band: Tensor
    level: Tensor

    def show(self, width: float, blur: float) -> bool:
        """Whether they reach beyond the sides of a tube so wide."""
        return self.signal.shape[1] > 2 * (0.6 * width + 3 + 2 * blur)


def look_across(
    sampler: Sampler, camera: Camera, line: Line, stretches: Stretches, width: float, blur: float
) -> Stations:
    """Stations within the bands that are seen, of a tube some ``width`` pixels wide."""
    edges = stretches.edges.tolist()
    spans = [
        (a + 3, b - 3, j)
        for j, (a, b, shown, whole) in enumerate(
            zip(edges, edges[1:], stretches.shown.tolist(), stretches.whole.tolist(), strict=False)
        )
        if math.isfinite(a) and math.isfinite(b) and b - a > 10 and shown > 0.3 * whole
    ]
    if not spans:
        raise Refusal(Status.BANDS_MISSING, "no band is seen from one end to the other")
    device = sampler.frame.device
    every = max(1.0, sum(b - a for a, b, _ in spans) / (_SAMPLES * _STATIONS))
    # Several samples for each station: along the tube neighbours differ in nothing but noise.
    parts = [
        torch.arange(a, max(a, b - (_SAMPLES - 1) * every), _SAMPLES * every, dtype=torch.float64) for a, b, _ in spans
    ]
    band = torch.cat([torch.full((len(part),), k) for k, part in enumerate(parts)]).to(device)
    t = (torch.cat(parts)[:, None] + every * torch.arange(_SAMPLES)).to(device)
    if len(t) < 6:
        raise Refusal(Status.TOO_NARROW, "the bands are a few pixels long")
    half = math.ceil(0.6 * width + 4 + 2 * blur)
    u = torch.arange(2 * half + 1, dtype=torch.float64, device=device) - half
    light = sampler(line.pixels(camera, t.flatten(), u).unflatten(0, t.shape)).mean(2)
    signal, weight, level = _contrast(light, u, width, band, len(spans))
    return Stations(line, float(t.max() - t.min()), signal, weight, t.mean(-1), band, level)


def measure_axis(
    stations: Stations, width: tuple[float, float], known: float, blur: float, before: Axis | None = None
) -> Axis:
    """Mid-line and width; ``width`` and ``known`` as for ``fit_axis``, which begins at what was found ``before``."""
    given = stations.signal, stations.weight, stations.t, stations.band, stations.level
    fit = fit_axis(*given, width, blur, known, before.fit.unknown if before else None)
    offset, slope, wide, taper = fit.sides
    if not bool(torch.isfinite(fit.covariance).all()) or float(wide) > 2 * width[0] + 3:
        raise Refusal(Status.NO_AXIS, "the bands have no clear sides")
    if float(fit.contrast.min()) < _ONE_SIDED:
        raise Refusal(Status.NO_AXIS, "the bands' colours go on beside the line: too wide for the catheter")
    if float((fit.weight > 0.2).double().mean()) < 0.5:
        raise Refusal(Status.NO_AXIS, "the bands do not lie on one straight line: bent, or not a catheter")
    width_sd = float(fit.covariance[2, 2].clamp(min=0).sqrt())
    if float(wide) < _NARROWEST:
        raise Refusal(Status.TOO_NARROW, f"the catheter is {float(wide):.1f} px wide; {_NARROWEST:g} px are needed")
    variance, cross, other = fit.covariance[0, 0], fit.covariance[0, 1], fit.covariance[1, 1].clamp(min=1e-18)
    centre = -cross / other
    floor = _LINE_FLOOR * float(wide)
    extent = max(20.0, stations.extent)
    return Axis(
        stations.line.moved(offset, slope),
        float(wide),
        float(taper),
        width_sd,
        math.hypot(float((variance - cross * cross / other).clamp(min=0).sqrt()), floor),
        math.hypot(float(other.sqrt()), 2 * floor / extent),
        float(centre),
        fit,
    )


def _contrast(light: Tensor, u: Tensor, width: float, band: Tensor, bands: int) -> tuple[Tensor, Tensor, Tensor]:
    """Light [3, S, U] as one signal [S, U], its inverse variances, and each band's own level in it [bands].

    The signal is the mix of channels, one for each band, in which tube and surroundings differ most over the noise.
    """
    inner = (u.abs() <= max(0.6, 0.3 * width)).to(light.dtype)
    outer = (u.abs() >= 0.5 * width + 1.5).to(light.dtype)
    inside = (light * inner).sum(-1) / inner.sum()
    beside = (light * outer).sum(-1) / outer.sum()
    mean = torch.nn.functional.one_hot(band, bands).to(light.dtype)
    mean = mean / mean.sum(0)
    own, around = inside @ mean, beside @ mean  # [3, bands]
    mixes = (own - around) / (variance_of(own) + variance_of(around))
    mixes = mixes / mixes.norm(dim=0).clamp(min=1e-12)
    mix = mixes[:, band]  # [3, S]
    signal = (light * mix[..., None]).sum(0)
    variance = (mix.square()[..., None] * variance_of(light)).sum(0) / _SAMPLES
    return signal, 1 / variance.clamp(min=1e-30), (mixes * own).sum(0).to(torch.float64)


def variance_of(light: Tensor) -> Tensor:
    """Of light, from the noise of levels: the slope of the sRGB curve's inverse, which rises about as light^0.58."""
    return (_LEVEL_SD * 2.4 / 1.055) ** 2 * light.clamp(min=0.002) ** (2.8 / 2.4)
