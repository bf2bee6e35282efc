"""FieldContent: the light that a plan must serve, as its user describes it or as measured from a field."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import OFFSET, SPREAD

_MIXTURES = 24  # random mixtures per axis; they estimate an energy to about a factor of 1.2


@dataclass(frozen=True)
class FieldContent:
    """Band and edges of the light on a grid, and signals that represent the light if it was measured.

    Attributes:
        band: Highest frequencies (y, x), in cycles per metre.
        margin: Widths (y, x) in metres over which the content fades smoothly to zero at both ends of each axis.
        signals: Per axis (y, x) complex128 [K, samples]; None if tones that fill the band represent the content.
    """

    band: tuple[float, float]
    margin: tuple[float, float] = (0.0, 0.0)
    signals: tuple[Tensor, Tensor] | None = None


def field_content(
    grid: Grid,
    wavelengths: Sequence[float],
    distances: Sequence[float],
    *,
    band: tuple[float, float] | None = None,
    spread: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
    field: Tensor | None = None,
) -> FieldContent:
    """Content measured from ``field``, or without one described by ``band`` or ``spread``, and ``margin``.

    ``spread`` is the distance (y, x) in metres that the light travels sideways over the longest of ``distances``.
    Without ``band`` and ``spread`` the content fills the band of the grid.
    """
    for width in margin:
        if checks.quantity(OFFSET, width, "margin") < 0:
            raise ValueError(f"margin must be at least 0 metres, got {width!r}")
    nyquist = 0.5 / grid.pitch[0], 0.5 / grid.pitch[1]
    if band is not None and spread is not None:
        raise ValueError("describe the content by band= or by spread=, not by both")
    limits = [math.inf, math.inf]
    if band is not None:
        limits = [checks.positive("band", limit, "cycles per metre") for limit in band]
    elif spread is not None:
        widths, distance = [checks.quantity(SPREAD, width) for width in spread], max(map(abs, distances))
        if distance:
            limits = [width / math.hypot(width, distance) / max(wavelengths) for width in widths]
    if field is not None:
        checks.field("field", field, grid.shape)
        return FieldContent(nyquist, signals=_mixtures(field, grid))
    return FieldContent((min(limits[0], nyquist[0]), min(limits[1], nyquist[1])), margin)


def _mixtures(field: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Random mixtures of the lines of ``field``, complex [..., H, W], along each axis (y, x), largest value 1.

    The energy that a filter of one axis passes has the same expectation for the mixtures as for the field, whatever
    the field holds: beams, hard edges or noise. The seed is fixed, so that equal fields get equal plans.
    """
    lines = field.detach().reshape(-1, *grid.shape)
    generator = torch.Generator().manual_seed(0)
    mixed = []
    for stack in (lines, lines.transpose(-1, -2)):
        weights = torch.randn(len(lines), stack.shape[-1], _MIXTURES, dtype=torch.complex64, generator=generator)
        mixture = torch.einsum("bnl,blk->kn", stack, weights.to(field.device, field.dtype))
        mixed.append(mixture.to("cpu", torch.complex128))
    scale = max(signals.abs().max().item() for signals in mixed) or 1.0
    return mixed[0] / scale, mixed[1] / scale
