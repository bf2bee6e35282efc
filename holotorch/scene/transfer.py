"""TransferFunction: colour and opacity as functions of the value of a volume."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.learning import fixed

Numbers = Tensor | Sequence[float]


class TransferFunction(nn.Module):
    """Piecewise-linear colour and opacity over the values of a volume; constant beyond the first and last position.

    ``colours`` and ``opacities`` are parameters without gradient; ``transfer.requires_grad_()`` makes them learnable.
    Samplers then also evaluate transparent regions, which they otherwise skip. Parameters outside [0, 1] are clipped
    when used and have gradient 0; call :meth:`clip_` after each optimiser step, so that none remains outside.

    Args:
        positions: Values of the volume, rising, shape [K], K >= 2.
        colours: Red, green, blue in [0, 1] at the positions, shape [K, 3]: radiance of an opaque medium. More than
            three channels, such as one for each wavelength, are allowed.
        opacities: Opacity in [0, 1] at the positions, shape [K]: fraction of the light that is absorbed along
            ``unit_distance``.
        unit_distance: Distance as a fraction of the longest side of the volume, so that the picture does not depend on
            the size of the volume in the scene. 1 / 256 is the edge of a voxel in a cube of 256^3 voxels.

    Raises:
        TypeError: An argument does not consist of real numbers.
        ValueError: Shapes that do not match, positions that do not rise, colours or opacities outside [0, 1], or a
            number that is not finite.
    """

    positions: Tensor

    def __init__(
        self,
        positions: Numbers,
        colours: Numbers | Sequence[Sequence[float]],
        opacities: Numbers,
        *,
        unit_distance: float,
    ):
        super().__init__()
        position, colour = _table("positions", positions), _table("colours", colours)
        opacity, count = _table("opacities", opacities), position.numel()
        if position.ndim != 1 or count < 2:
            raise ValueError(f"positions must be a list of at least 2 values, got shape {tuple(position.shape)}")
        for name, axes, values, shape in (
            ("colours", "(K, 3)", colour, (count, max(3, colour.shape[-1]) if colour.ndim == 2 else 3)),
            ("opacities", "(K,)", opacity, (count,)),
        ):
            if tuple(values.shape) != shape:
                raise ValueError(f"{name} must be {axes} = {shape}, one per position, got {tuple(values.shape)}")
            least, most = values.min().item(), values.max().item()
            if least < 0 or most > 1:
                raise ValueError(f"{name} must lie in [0, 1], got {least:g} to {most:g}")
        falls = (position.diff() <= 0).nonzero()
        if falls.numel():
            k = int(falls[0])
            raise ValueError(f"positions must rise, got {position[k].item():g} before {position[k + 1].item():g}")
        self.unit_distance = checks.positive("unit_distance", unit_distance, "widths of the volume")
        self.register_buffer("positions", position)
        self.colours = nn.Parameter(colour, requires_grad=False)
        self.opacities = nn.Parameter(opacity, requires_grad=False)

    @property
    def visible_from(self) -> float:
        """Largest value below which all values are transparent; -inf if there is none, inf if nothing is visible."""
        visible = self.opacities.gt(0).nonzero()
        if not len(visible):
            return math.inf
        first = int(visible[0])
        return float(self.positions[first - 1]) if first else -math.inf

    def forward(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Colour [C, ...] of C = 3 or more channels, and opacity [...] per unit distance, for ``values`` [...].

        The dtype is the more precise one of values and colours. The result is also differentiable in the values; at one
        of ``positions`` the derivative is that of the interval above it.
        """
        dtype = self.colours.dtype
        if values.is_floating_point():
            dtype = torch.promote_types(dtype, values.dtype)
        values, positions = values.to(dtype), self.positions.to(dtype)
        interval = torch.bucketize(values.detach(), positions[1:-1], right=True, out_int32=True)
        table = torch.cat([self.colours.T, self.opacities[None]]).clamp(0, 1).to(dtype)
        flat = interval.reshape(-1)
        fraction = ((values - positions[:-1][interval]) * (1 / positions.diff())[interval]).clamp(0, 1)
        start, step = (
            part.index_select(1, flat).reshape(len(table), *values.shape) for part in (table[:, :-1], table.diff())
        )
        result = torch.addcmul(start, step, fraction)
        return result[:-1], result[-1]

    def visible(self, low: Tensor, high: Tensor) -> Tensor:
        """Whether any value from ``low`` [...] to ``high`` [...] has an opacity above 0, bool [...].

        True everywhere if the opacities are learnable, since values of opacity 0 then have a gradient.
        """
        if self.opacities.requires_grad:
            return torch.ones_like(low, dtype=torch.bool)
        opacities = self.opacities.detach()
        opaque = torch.cat([opacities.new_zeros(1), (opacities > 0).cumsum(0)])
        low, high = (end.to(self.positions.dtype).contiguous() for end in (low, high))
        between = (
            opaque[torch.bucketize(high, self.positions)] > opaque[torch.bucketize(low, self.positions, right=True)]
        )
        return between | (self.forward(low)[1] > 0) | (self.forward(high)[1] > 0)

    def support(self) -> tuple[float, float]:
        """Smallest interval of values outside which the opacity is 0; all values if the opacities are learnable."""
        if self.opacities.requires_grad:
            return -math.inf, math.inf
        visible = (self.opacities.detach() > 0).nonzero().flatten().tolist()
        if not visible:
            return math.inf, -math.inf
        positions = [-math.inf, *self.positions.tolist(), math.inf]
        return positions[visible[0]], positions[visible[-1] + 2]

    @torch.no_grad()
    def clip_(self) -> None:
        """Clip colours and opacities to [0, 1]."""
        self.colours.clamp_(0, 1)
        self.opacities.clamp_(0, 1)


def _table(name: str, values: Numbers | Sequence[Sequence[float]]) -> Tensor:
    """Copy of ``values`` as a tensor of finite numbers, float64 if ``values`` are, else float32."""
    try:
        table = torch.as_tensor(values)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be numbers, got {values!r}: {error}") from None
    if table.is_complex() or table.dtype == torch.bool:
        raise TypeError(f"{name} must be real numbers, got {table.dtype}")
    fixed(name, values, "transfer.requires_grad_() makes colours and opacities learnable")
    table = table if table.dtype == torch.float64 else table.to(torch.float32)
    checks.all_finite(name, table)
    return table.detach().clone()
