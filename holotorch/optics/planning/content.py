"""FieldContent: description of the light for which a propagation is planned, given or measured from a field."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import OFFSET, SPREAD

_MIXTURES = 24  # random mixtures per axis; they estimate an energy within a factor of about 1.2


@dataclass(frozen=True)
class FieldContent:
    """Light on a grid, described by band and margin or represented by measured signals.

    Attributes:
        band: Highest frequencies (y, x), in cycles per metre.
        margin: Widths (y, x) in metres over which the light fades smoothly to zero at both ends of each axis.
        signals: Per axis (y, x) complex128 [K, samples], or None for tones that fill the band.
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
    """Content measured from ``field`` if given, else described by ``band`` or ``spread`` and by ``margin``.

    ``spread`` is the distance (y, x) in metres that the light travels sideways over the longest of ``distances``.
    Without ``band`` and ``spread`` the content fills the band of the grid.
    """
    for width in margin:
        if checks.quantity(OFFSET, width, "margin") < 0:
            raise ValueError(f"margin must be at least 0 metres, got {width!r}")
    if band is not None and spread is not None:
        raise ValueError("describe the content by band= or by spread=, not by both")
    nyquist = 0.5 / grid.pitch[0], 0.5 / grid.pitch[1]
    limits: Sequence[float] = nyquist
    if band is not None:
        limits = [checks.positive("band", limit, "cycles per metre") for limit in band]
    elif spread is not None:
        widths, distance = [checks.quantity(SPREAD, width) for width in spread], max(map(abs, distances))
        if distance:
            limits = [width / math.hypot(width, distance) / max(wavelengths) for width in widths]
    if field is not None:
        checks.field("field", field, grid.shape)
        return FieldContent(nyquist, signals=_mixtures(field, grid))
    y, x = map(min, limits, nyquist)
    return FieldContent((y, x), margin)


def _mixtures(field: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Random mixtures [K, samples] of the lines of ``field`` [..., H, W] along each axis (y, x), scaled to a peak of 1.

    The fraction of the energy that a filter along one axis transmits has the same expectation for the mixtures as for
    the field. The seed is fixed, so that equal fields get equal plans.
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
