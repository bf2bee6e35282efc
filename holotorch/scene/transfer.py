"""TransferFunction: colour and opacity as functions of a scalar."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks

Numbers = Tensor | Sequence[float]


class TransferFunction(nn.Module):
    """Piecewise-linear colour and opacity over the values of a volume; constant beyond the first and last position.

    ``colours`` and ``opacities`` are parameters without gradient; ``transfer.requires_grad_()`` makes them learnable
    (samplers then also evaluate transparent regions, which they skip otherwise). Values outside [0, 1] count as 0 or 1
    and have gradient 0; call :meth:`clip_` after each optimiser step, so that no value stays outside.

    Args:
        positions: Values of the volume, rising, shape [K], K >= 2.
        colours: Red, green, blue in [0, 1], shape [K, 3]: radiance of an opaque point.
        opacities: In [0, 1], shape [K]: fraction of the light that is absorbed along ``unit_distance``.
        unit_distance: As a fraction of the longest side of the volume, so that the picture does not depend on the size
            at which the volume is placed. 1 / 256 is a voxel of a cube of 256 voxels.

    Raises:
        TypeError: Not numbers.
        ValueError: Shapes that do not match, positions that do not rise, numbers outside [0, 1] or not finite.
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
        position, colour, opacity = (
            _table(name, values)
            for name, values in (("positions", positions), ("colours", colours), ("opacities", opacities))
        )
        count = position.numel()
        if position.ndim != 1 or count < 2:
            raise ValueError(f"positions must be a list of at least 2 values, got shape {tuple(position.shape)}")
        if tuple(colour.shape) != (count, 3):
            raise ValueError(f"colours must be (K, 3) = {(count, 3)}, one per position, got {tuple(colour.shape)}")
        if tuple(opacity.shape) != (count,):
            raise ValueError(f"opacities must be (K,) = {(count,)}, one per position, got {tuple(opacity.shape)}")
        for name, values in (("colours", colour), ("opacities", opacity)):
            if values.detach().min() < 0 or values.detach().max() > 1:
                ends = values.detach().aminmax()
                raise ValueError(f"{name} must lie in [0, 1], got {ends.min.item():g} to {ends.max.item():g}")
        falls = (position.diff() <= 0).nonzero()
        if falls.numel():
            k = int(falls[0])
            raise ValueError(f"positions must rise, got {position[k].item():g} before {position[k + 1].item():g}")
        self.unit_distance = checks.positive("unit_distance", unit_distance, "widths of the volume")
        self.register_buffer("positions", position)
        self.colours = nn.Parameter(colour, requires_grad=False)
        self.opacities = nn.Parameter(opacity, requires_grad=False)

    def forward(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Colour [3, ...] and opacity [...] per unit distance for ``values`` [...].

        The result has the higher precision of the values and the table. It is differentiable in the values, too; at a
        position the derivative is that of the interval above it.
        """
        dtype = self.colours.dtype
        if values.is_floating_point():
            dtype = torch.promote_types(dtype, values.dtype)
        values, positions = values.to(dtype), self.positions.to(dtype)
        interval = torch.bucketize(values.detach(), positions[1:-1], right=True, out_int32=True)
        table = torch.cat([self.colours.T, self.opacities[None]]).clamp(0, 1).to(dtype)
        flat = interval.reshape(-1)
        fraction = ((values - positions[:-1][interval]) * (1 / positions.diff())[interval]).clamp(0, 1)
        start, step = (part.index_select(1, flat).reshape(4, *values.shape) for part in (table[:, :-1], table.diff()))
        result = torch.addcmul(start, step, fraction)
        return result[:3], result[3]

    def visible(self, low: Tensor, high: Tensor) -> Tensor:
        """Whether any value between ``low`` and ``high`` [...] is not fully transparent, bool [...].

        True everywhere while the opacities are learnable, since transparent values then have a gradient.
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
        """Two numbers: values up to the first and from the second on are fully transparent."""
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
    try:
        table = torch.as_tensor(values)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be numbers, got {values!r}: {error}") from None
    if table.is_complex() or table.dtype == torch.bool:
        raise TypeError(f"{name} must be real numbers, got {table.dtype}")
    table = table if table.dtype == torch.float64 else table.to(torch.float32)
    checks.all_finite(name, table)
    return table.detach().clone()
