"""What light a plan has to serve: described by its user, or measured from a field."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.quantities import OFFSET, SPREAD

_MIXTURES = 24


@dataclass(frozen=True)
class FieldContent:
    """Band and rim of the light on a grid, and signals that stand for it if they were measured.

    Attributes:
        band: Highest frequencies (y, x), in cycles per metre.
        margin: Widths (y, x) in metres over which the content fades smoothly to nothing at the ends of each axis.
        signals: Per axis (y, x) complex128 [K, samples], or None where tones that fill the band are to be taken.
    """

    band: tuple[float, float]
    margin: tuple[float, float]
    signals: tuple[Tensor, Tensor] | None = None


def described(
    grid: Grid,
    wavelength: float,
    distance: float,
    *,
    band: tuple[float, float] | None = None,
    spread: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
) -> FieldContent:
    """Content by its ``band``, or by its ``spread``: how far (y, x) in metres it travels sideways over the distance."""
    for rim in margin:
        if checks.quantity(OFFSET, rim, "margin") < 0:
            raise ValueError(f"margin must be at least 0 metres, got {rim!r}")
    nyquist = [0.5 / pitch for pitch in grid.pitch]
    if band is not None and spread is not None:
        raise ValueError("describe the content by band= or by spread=, not by both")
    limits = [math.inf, math.inf]
    if band is not None:
        limits = [checks.positive("band", limit, "cycles per metre") for limit in band]
    elif spread is not None:
        reaches = [checks.quantity(SPREAD, reach) for reach in spread]
        if distance:
            limits = [reach / math.hypot(reach, distance) / wavelength for reach in reaches]
    y, x = (min(limit, top) for limit, top in zip(limits, nyquist, strict=True))
    return FieldContent((y, x), margin)


def measured(field: Tensor, grid: Grid) -> FieldContent:
    """Content of ``field``, complex [..., H, W]: each axis by random mixtures of the field's lines along it.

    The energy that any filter of one axis lets through is, in expectation, the same for the mixtures as for the field,
    whatever it is: beams, hard edges, noise. 24 of them estimate it to about a factor of 1.2, for two products with a
    thin matrix. The same seed every time: a plan does not depend on chance.
    """
    lines = field.detach().reshape(-1, *grid.shape)
    generator = torch.Generator().manual_seed(0)
    mixed = []
    for lined in (lines, lines.transpose(-1, -2)):
        weights = torch.randn(len(lines), lined.shape[-1], _MIXTURES, dtype=torch.complex64, generator=generator)
        mixture = torch.einsum("bnl,blk->kn", lined, weights.to(field.device, field.dtype))
        mixed.append(mixture.to("cpu", torch.complex128))
    scale = max(signals.abs().max().item() for signals in mixed) or 1.0
    nyquist = 0.5 / grid.pitch[0], 0.5 / grid.pitch[1]
    return FieldContent(nyquist, (0.0, 0.0), (mixed[0] / scale, mixed[1] / scale))
