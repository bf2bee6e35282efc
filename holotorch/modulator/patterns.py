"""Frames of grey levels that calibrate a panel, and the look-up table from what they give."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks

_STROKES = 96  # first guesses of the fit: full strokes between a quarter and eight turns of half a circle,
_BENDS = 13  # each with phases rising as powers of the level between 0.4 and 2.5
_KNOTS = 17


def uniform(shape: tuple[int, int], level: int, *, bits: int = 8) -> Tensor:
    """One grey level everywhere, uint8 (uint16 above 8 bits) [H, W]."""
    return _frame(torch.full(_shape(shape), _level("level", level, bits), dtype=torch.int32), bits)


def grey_sweep(shape: tuple[int, int], levels: Sequence[int], *, bits: int = 8) -> Tensor:
    """Uniform frames, one for each level, uint8 or uint16 [L, H, W]; a view that needs the memory of L pixels."""
    shades = torch.tensor([_level("level", level, bits) for level in levels], dtype=torch.int32)
    return _frame(shades, bits)[:, None, None].expand(-1, *_shape(shape))


def grating(
    shape: tuple[int, int], period: float, level: int, *, reference: int = 0, angle: float = 0.0, bits: int = 8
) -> Tensor:
    """Binary grating: half of each period shows ``reference``, the other half ``level``.

    Args:
        shape: (H, W) of the panel.
        period: In pixels, at least 2; even ones make equal halves along the axes, and the even orders vanish.
        level: Grey level of the second half.
        reference: Of the first half, which begins at pixel (0, 0).
        angle: Direction in rad in which the stripes follow each other, from +x (right) towards +y (down).
        bits: Of the panel.

    Returns:
        uint8 or uint16 [H, W]. Its first order has (2 / pi)^2 sin^2(phase difference / 2) of the light.
    """
    if not checks.finite("period", period, "pixels") >= 2:
        raise ValueError(f"period must be at least 2 pixels, got {period!r}")
    turn = checks.finite("angle", angle, "rad")
    y, x = _coordinates(shape)
    # Rounded, so that cos(pi / 2) = 6e-17 does not push the borders of stripes to and fro.
    along = (x * math.cos(turn) + y * math.sin(turn)) * (2 / period)
    second = (along + 1e-9).floor().long() % 2 == 1
    return _two(second, reference, level, bits)


def grating_sweep(
    shape: tuple[int, int],
    levels: Sequence[int],
    *,
    period: float = 8,
    reference: int = 0,
    angle: float = 0.0,
    bits: int = 8,
) -> Tensor:
    """Gratings between ``reference`` and each of ``levels``, [L, H, W]: their first orders are :func:`fit_lut`'s."""
    frames = [grating(shape, period, level, reference=reference, angle=angle, bits=bits) for level in levels]
    return torch.stack(frames) if frames else torch.empty(0, *_shape(shape), dtype=torch.uint8)


def checkerboard(shape: tuple[int, int], side: int, level: int, *, reference: int = 0, bits: int = 8) -> Tensor:
    """Squares of ``side`` pixels that show ``reference`` (the first) and ``level`` in turn, [H, W]."""
    checks.whole("side", side, 1)
    y, x = _coordinates(shape)
    return _two((y.long() // side + x.long() // side) % 2 == 1, reference, level, bits)


def orientation_chart(shape: tuple[int, int], *, bits: int = 8) -> Tensor:
    """Four quadrants of four greys and a letter F, [H, W]: no flip, turn or transposition leaves it as it is.

    Rising from 1/4 of the top level over upper left, upper right, lower left to the top itself at the lower right; the
    F of level 0 stands upright in the middle and takes a third of the height. At least 16 x 16 pixels.
    """
    height, width = _shape(shape)
    if min(height, width) < 16:
        raise ValueError(f"an orientation chart needs at least 16 x 16 pixels, got {height} x {width}")
    y, x = _coordinates(shape)
    quadrant = (y >= height // 2) * 2 + (x >= width // 2) * 1
    frame = ((2**bits - 1) * (quadrant + 1)) // 4
    size = min(height, width) / 3
    v, u = (y - height / 2) / size + 0.5, (x - width / 2) / size + 0.3  # 0 .. 1 over the letter, 0.6 of it wide
    inside = (v >= 0) & (v < 1) & (u >= 0) & (u < 0.6)
    letter = inside & ((u < 0.16) | (v < 0.16) | ((v >= 0.4) & (v < 0.56) & (u < 0.46)))
    return _frame(torch.where(letter, 0, frame), bits)


def circles(shape: tuple[int, int], radii: Sequence[float], level: int, *, width: float = 2.0, bits: int = 8) -> Tensor:
    """Rings about the optical axis (pixel n // 2) and a cross of a pixel's width through it, [H, W], else level 0.

    Args:
        shape: (H, W) of the panel.
        radii: Of the middle of each ring, in pixels.
        level: Of the rings and the cross.
        width: Of the rings, in pixels.
        bits: Of the panel.
    """
    y, x = _coordinates(shape)
    y, x = y - shape[0] // 2, x - shape[1] // 2
    distance = (y.square() + x.square()).sqrt()
    half = checks.positive("width", width, "pixels") / 2
    marked = (y == 0) | (x == 0)
    for radius in radii:
        marked = marked | ((distance - checks.positive("radius", radius, "pixels")).abs() <= half)
    return _two(marked, 0, level, bits)


@dataclass(frozen=True)
class LUTFit:
    """Result of :func:`fit_lut`.

    Attributes:
        lut: Phase in rad of every level against level 0, float64 [2^bits], strictly rising.
        peak: Intensity at a phase of pi, in the measurement's unit, without the background.
        background: Intensity at no phase.
        rms: Of measured minus fitted intensity, relative to ``peak``.
    """

    lut: Tensor
    peak: float
    background: float
    rms: float


def fit_lut(levels: Sequence[int], first_order_intensity: Sequence[float] | Tensor, *, bits: int = 8) -> LUTFit:
    """Phase of every level from the first-order intensity of gratings between level 0 and each of ``levels``.

    The model is background + peak sin^2(phase / 2) with a phase that rises from 0, as a smooth curve through 17 knots,
    least squares. First guesses cover strokes from half a turn to four turns.

    Args:
        levels: Grey levels of the sweep, rising, from 0 to the top one; at least 24 of them.
        first_order_intensity: One value each, any unit.
        bits: Of the panel.

    Raises:
        ValueError: Too few levels, not from 0 to the top, NaN, or no maximum within the sweep: the peak is not known
            for a stroke below half a turn.

    Intensity does not say the sign of a phase: it is taken to rise. Near a phase of 0, pi, 2 pi, ... sin^2 is flat and
    a single value says little: that is why a smooth curve is fitted instead of inverting value by value.
    """
    top = 2 ** checks.whole("bits", bits, 1) - 1
    at = [_level("level", level, bits) for level in levels]
    measured = torch.as_tensor(first_order_intensity).detach().to("cpu", torch.float64)
    checks.all_finite("first_order_intensity", measured)
    if measured.shape != (len(at),) or len(at) < 24 or at[0] != 0 or at[-1] != top or sorted(set(at)) != at:
        raise ValueError(
            f"a sweep needs at least 24 rising levels from 0 to {top} with one intensity each, got {len(at)} levels "
            f"from {at[0] if at else 'none'} to {at[-1] if at else 'none'} and intensities {tuple(measured.shape)}"
        )
    spread = (measured.max() - measured.min()).item()
    if spread <= 0:
        raise ValueError("the first order does not change with the level: no phase can be found in it")
    unit = (measured - measured.min()) / spread
    place = torch.tensor(at, dtype=torch.float64) / top
    knots = _refined(place, unit, _first_guess(place, unit))
    phase = _curve(knots, place)
    if knots.sum() < 1.05 * math.pi:
        raise ValueError(
            f"the stroke comes out as {knots.sum().item():.3g} rad: the first order has no clear maximum within the "
            "sweep, so its peak, and with it the phase, is unknown; raise the voltage, or take a shorter wavelength"
        )
    background, peak, error = _linear_part(phase, unit)
    everywhere = torch.arange(top + 1, dtype=torch.float64) / top
    return LUTFit(
        _curve(knots, everywhere),
        peak.item() * spread,
        background.item() * spread + measured.min().item(),
        math.sqrt(error.item() / len(at)) / abs(peak.item()),
    )


def _first_guess(place: Tensor, unit: Tensor) -> Tensor:
    """Increments between the knots of the best power law."""
    strokes = torch.linspace(math.pi / 2, 8 * math.pi, _STROKES, dtype=torch.float64)
    bends = torch.logspace(math.log10(0.4), math.log10(2.5), _BENDS, dtype=torch.float64)
    phases = strokes[:, None, None] * place ** bends[:, None]
    error = _linear_part(phases, unit)[2]
    best = int(error.argmin())
    stroke, bend = strokes[best // _BENDS], bends[best % _BENDS]
    at = torch.linspace(0, 1, _KNOTS, dtype=torch.float64)
    return torch.diff(stroke * at**bend).clamp(min=1e-3 * stroke)


def _refined(place: Tensor, unit: Tensor, increments: Tensor) -> Tensor:
    """Least squares over the logarithms of the increments, which keeps them above zero."""
    logs = increments.log().requires_grad_()
    solver = torch.optim.LBFGS([logs], max_iter=300, tolerance_grad=1e-10, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        solver.zero_grad()
        # A weak pull towards equal neighbours: flat parts of sin^2 leave the knots there free otherwise.
        value = _linear_part(_curve(logs.exp(), place), unit)[2] / len(unit) + 1e-4 * torch.diff(logs).square().mean()
        value.backward()
        return value

    solver.step(loss)  # type: ignore[arg-type]
    return logs.detach().exp()


def _curve(increments: Tensor, place: Tensor) -> Tensor:
    """Phase at ``place`` in [0, 1]: a cubic through the knots whose slopes keep it rising (harmonic means)."""
    values = torch.cat([increments.new_zeros(1), increments.cumsum(0)])
    inner = 2 / (1 / increments[1:] + 1 / increments[:-1])
    slopes = torch.cat([increments[:1], inner, increments[-1:]])
    scaled = place * len(increments)
    row = scaled.floor().long().clamp(0, len(increments) - 1)
    t = scaled - row
    return (
        values[row] * (1 + 2 * t) * (1 - t).square()
        + slopes[row] * t * (1 - t).square()
        + values[row + 1] * t.square() * (3 - 2 * t)
        + slopes[row + 1] * t.square() * (t - 1)
    )


def _linear_part(phase: Tensor, unit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Best background and peak [...] for phases [..., L], and the sum of squares that remains."""
    shape = torch.sin(phase / 2).square()
    mean, wanted = shape.mean(-1, keepdim=True), unit.mean()
    deviation = shape - mean
    peak = (deviation * (unit - wanted)).sum(-1) / deviation.square().sum(-1).clamp(min=1e-12)
    peak = peak.clamp(min=0)
    background = wanted - peak * mean[..., 0]
    return background, peak, (unit - background[..., None] - peak[..., None] * shape).square().sum(-1)


def _coordinates(shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    height, width = _shape(shape)
    return torch.arange(height, dtype=torch.float64)[:, None], torch.arange(width, dtype=torch.float64)[None, :]


def _shape(shape: tuple[int, int]) -> tuple[int, int]:
    if len(shape) != 2:
        raise ValueError(f"shape must be (H, W), got {shape!r}")
    return checks.whole("height", shape[0], 1), checks.whole("width", shape[1], 1)


def _level(name: str, level: int, bits: int) -> int:
    if checks.whole("bits", bits, 1) > 16:
        raise ValueError(f"bits must be at most 16, got {bits}")
    if checks.whole(name, level, 0) >= 2**bits:
        raise ValueError(f"{name} must be at most {2**bits - 1} for {bits} bits, got {level}")
    return level


def _two(second: Tensor, reference: int, level: int, bits: int) -> Tensor:
    low, high = _level("reference", reference, bits), _level("level", level, bits)
    return _frame(torch.where(second, high, low), bits)


def _frame(levels: Tensor, bits: int) -> Tensor:
    return levels.to(torch.uint8 if bits <= 8 else torch.uint16)
