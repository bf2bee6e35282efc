"""Calibration of a panel: frames of grey levels to show, and the fit of its look-up table to measured intensities.

All frames are uint8 (uint16 above 8 bits). Their arguments are ``shape``, (H, W) of the panel in pixels, grey levels
from 0 to 2^bits - 1, and ``bits``, 1 to 16. Arguments outside these ranges raise ValueError.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.modulator.quantised import checked_bits


def uniform(shape: tuple[int, int], level: int, *, bits: int = 8) -> Tensor:
    """One grey level everywhere, [H, W]."""
    return _frame(torch.full(_shape(shape), _level("level", level, bits), dtype=torch.int32), bits)


def grey_sweep(shape: tuple[int, int], levels: Sequence[int], *, bits: int = 8) -> Tensor:
    """Uniform frames [L, H, W], one for each of L levels; an expanded view that takes the memory of L pixels."""
    shades = torch.tensor([_level("level", level, bits) for level in levels], dtype=torch.int32)
    return _frame(shades, bits)[:, None, None].expand(-1, *_shape(shape))


def grating(
    shape: tuple[int, int], period: float, level: int, *, reference: int = 0, angle: float = 0.0, bits: int = 8
) -> Tensor:
    """Binary grating [H, W]; its first order has (2 / pi)^2 sin^2(phase difference / 2) of the light.

    The first half of each period has the level ``reference``, the second half ``level``; the first period begins at
    pixel (0, 0). ``period`` is 2 pixels or more; an even one along x or y avoids even diffraction orders. ``angle`` is
    the direction of the grating vector in rad, from +x (right) towards +y (down).
    """
    if not checks.finite("period", period, "pixels") >= 2:
        raise ValueError(f"period must be at least 2 pixels, got {period!r}")
    angle = checks.finite("angle", angle, "rad")
    y, x = _coordinates(shape)
    half_periods = (x * math.cos(angle) + y * math.sin(angle)) * (2 / period)
    second = (half_periods + 1e-9).floor().long() % 2 == 1  # 1e-9 is above the rounding of cos(pi / 2) = 6e-17
    return _two_levels(second, reference, level, bits)


def grating_sweep(
    shape: tuple[int, int],
    levels: Sequence[int],
    *,
    period: float = 8,
    reference: int = 0,
    angle: float = 0.0,
    bits: int = 8,
) -> Tensor:
    """Gratings [L, H, W], one for each of L ``levels``, see :func:`grating`; for :func:`fit_lut`."""
    frames = [grating(shape, period, level, reference=reference, angle=angle, bits=bits) for level in levels]
    return torch.stack(frames) if frames else torch.empty(0, *_shape(shape), dtype=torch.uint8)


def checkerboard(shape: tuple[int, int], side: int, level: int, *, reference: int = 0, bits: int = 8) -> Tensor:
    """Checkerboard [H, W] of squares of ``side`` pixels with two grey levels; that at (0, 0) is ``reference``."""
    checks.whole("side", side, 1)
    y, x = _coordinates(shape)
    return _two_levels((y.long() // side + x.long() // side) % 2 == 1, reference, level, bits)


def orientation_chart(shape: tuple[int, int], *, bits: int = 8) -> Tensor:
    """Four grey quadrants and a letter F, [H, W]: every flip, quarter turn or transposition changes the picture.

    The quadrants have 1/4 (upper left), 1/2 (upper right), 3/4 (lower left) and 1/1 (lower right) of the largest level.
    The F in the middle has level 0 and a third of the height of the frame, which has at least 16 x 16 pixels.
    """
    height, width = _shape(shape)
    if min(height, width) < 16:
        raise ValueError(f"an orientation chart needs at least 16 x 16 pixels, got {height} x {width}")
    y, x = _coordinates(shape)
    quadrant = (y >= height // 2) * 2 + (x >= width // 2) * 1
    frame = ((2**bits - 1) * (quadrant + 1)) // 4
    size = min(height, width) / 3
    # Coordinates in units of the height of the letter, which occupies 0 <= v < 1 and 0 <= u < 0.6.
    v, u = (y - height / 2) / size + 0.5, (x - width / 2) / size + 0.3
    inside = (v >= 0) & (v < 1) & (u >= 0) & (u < 0.6)
    letter = inside & ((u < 0.16) | (v < 0.16) | ((v >= 0.4) & (v < 0.56) & (u < 0.46)))
    return _frame(torch.where(letter, 0, frame), bits)


def circles(shape: tuple[int, int], radii: Sequence[float], level: int, *, width: float = 2.0, bits: int = 8) -> Tensor:
    """Rings about the optical axis (pixel n // 2) and a cross through it, one pixel wide, on level 0, [H, W].

    ``radii`` are those of the centre lines of the rings and ``width`` is the width of each ring, in pixels.
    """
    y, x = _coordinates(shape)
    y, x = y - shape[0] // 2, x - shape[1] // 2
    distance = (y.square() + x.square()).sqrt()
    half = checks.positive("width", width, "pixels") / 2
    marked = (y == 0) | (x == 0)
    for radius in radii:
        marked = marked | ((distance - checks.positive("radius", radius, "pixels")).abs() <= half)
    return _two_levels(marked, 0, level, bits)


@dataclass(frozen=True)
class LUTFit:
    """Result of :func:`fit_lut`.

    Attributes:
        lut: Phase in rad of every level relative to level 0, float64 [2^bits], strictly rising.
        peak: Difference between the intensities at phases of pi and of 0, in the unit of the measurement.
        background: Intensity at a phase of 0, in the unit of the measurement.
        rms: Root mean square of measured minus fitted intensity, divided by ``peak``.
    """

    lut: Tensor
    peak: float
    background: float
    rms: float


def fit_lut(levels: Sequence[int], first_order_intensity: Sequence[float] | Tensor, *, bits: int = 8) -> LUTFit:
    """Phase of every level from the first-order intensity of gratings between level 0 and each of ``levels``.

    Fits the model background + peak sin^2(phase / 2) by least squares, where the phase is a smooth curve through 17
    knots that rises with the level; the intensity does not determine its sign. Near multiples of pi, sin^2 is flat, and
    a single intensity hardly determines the phase, so that all intensities are fitted together.

    Args:
        levels: At least 24 rising grey levels, from 0 to the largest one.
        first_order_intensity: One value per level, in any unit.
        bits: Bits of a grey level.

    Raises:
        ValueError: Levels other than described, NaN, equal intensities, or a phase range below about pi, for which the
            intensity has no maximum within the sweep and the peak is unknown.
    """
    top = 2 ** checked_bits(bits) - 1
    swept = [_level("level", level, bits) for level in levels]
    measured = torch.as_tensor(first_order_intensity).detach().to("cpu", torch.float64)
    checks.all_finite("first_order_intensity", measured)
    ends = (swept[0], swept[-1]) if swept else ("none", "none")
    if measured.shape != (len(swept),) or len(swept) < 24 or ends != (0, top) or sorted(set(swept)) != swept:
        raise ValueError(
            f"a sweep needs at least 24 rising levels from 0 to {top} with one intensity each, got {len(swept)} levels "
            f"from {ends[0]} to {ends[1]} and intensities {tuple(measured.shape)}"
        )
    spread = (measured.max() - measured.min()).item()
    if spread <= 0:
        raise ValueError("the first order does not change with the level: no phase can be found in it")
    unit = (measured - measured.min()) / spread
    x = torch.tensor(swept, dtype=torch.float64) / top
    increments = _fitted_increments(x, unit)
    if increments.sum() < 1.05 * math.pi:
        raise ValueError(
            f"the stroke comes out as {increments.sum().item():.3g} rad: the first order has no clear maximum within "
            "the sweep, so its peak, and with it the phase, is unknown; raise the voltage, or take a shorter wavelength"
        )
    background, peak, error = _linear_part(_curve(increments, x), unit)
    return LUTFit(
        _curve(increments, torch.arange(top + 1, dtype=torch.float64) / top),
        peak.item() * spread,
        background.item() * spread + measured.min().item(),
        math.sqrt(error.item() / len(swept)) / abs(peak.item()),
    )


def _fitted_increments(x: Tensor, unit: Tensor) -> Tensor:
    """Phase increments between knots that fit best, for levels ``x`` and intensities ``unit`` in [0, 1]."""
    # The start is the best of many power laws.
    strokes = torch.linspace(math.pi / 2, 8 * math.pi, 96, dtype=torch.float64)
    powers = torch.logspace(math.log10(0.4), math.log10(2.5), 13, dtype=torch.float64)
    curves = torch.cartesian_prod(strokes, powers)
    stroke, power = curves[_linear_part(curves[:, :1] * x ** curves[:, 1:], unit)[2].argmin()]
    knots = torch.linspace(0, 1, 17, dtype=torch.float64)
    start = torch.diff(stroke * knots**power).clamp(min=1e-3 * stroke)
    logs = start.log().requires_grad_()  # the unknowns are logarithms, which keeps the increments above zero
    solver = torch.optim.LBFGS([logs], max_iter=300, tolerance_grad=1e-10, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        solver.zero_grad()
        error = _linear_part(_curve(logs.exp(), x), unit)[2] / len(unit)
        # Smoothness determines the increments where sin^2 is flat and the intensity does not.
        value = error + 1e-4 * torch.diff(logs).square().mean()
        value.backward()
        return value

    solver.step(loss)  # type: ignore[arg-type]
    return logs.detach().exp()


def _curve(increments: Tensor, x: Tensor) -> Tensor:
    """Phase at ``x`` in [0, 1] by cubic Hermite interpolation, monotone since slopes are harmonic means."""
    values = torch.cat([increments.new_zeros(1), increments.cumsum(0)])
    inner = 2 / (1 / increments[1:] + 1 / increments[:-1])
    slopes = torch.cat([increments[:1], inner, increments[-1:]])
    scaled = x * len(increments)
    row = scaled.floor().long().clamp(0, len(increments) - 1)
    t = scaled - row
    start = values[row] * (1 + 2 * t) * (1 - t).square() + slopes[row] * t * (1 - t).square()
    return start + values[row + 1] * t.square() * (3 - 2 * t) + slopes[row + 1] * t.square() * (t - 1)


def _linear_part(phase: Tensor, unit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Least-squares background and peak [...] for phases [..., L], and the sum of squared residuals [...]."""
    model = torch.sin(phase / 2).square()
    mean, measured = model.mean(-1, keepdim=True), unit.mean()
    deviation = model - mean
    peak = (deviation * (unit - measured)).sum(-1) / deviation.square().sum(-1).clamp(min=1e-12)
    peak = peak.clamp(min=0)
    background = measured - peak * mean[..., 0]
    return background, peak, (unit - background[..., None] - peak[..., None] * model).square().sum(-1)


def _coordinates(shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    height, width = _shape(shape)
    return torch.arange(height, dtype=torch.float64)[:, None], torch.arange(width, dtype=torch.float64)[None, :]


def _shape(shape: tuple[int, int]) -> tuple[int, int]:
    if len(shape) != 2:
        raise ValueError(f"shape must be (H, W), got {shape!r}")
    return checks.whole("height", shape[0], 1), checks.whole("width", shape[1], 1)


def _level(name: str, level: int, bits: int) -> int:
    if checks.whole(name, level, 0) >= 2 ** checked_bits(bits):
        raise ValueError(f"{name} must be at most {2**bits - 1} for {bits} bits, got {level}")
    return level


def _two_levels(second: Tensor, reference: int, level: int, bits: int) -> Tensor:
    low, high = _level("reference", reference, bits), _level("level", level, bits)
    return _frame(torch.where(second, high, low), bits)


def _frame(levels: Tensor, bits: int) -> Tensor:
    return levels.to(torch.uint8 if bits <= 8 else torch.uint16)
