"""TransferFunction: which colour and opacity a scalar gets."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks

Numbers = Tensor | Sequence[float]


class TransferFunction(nn.Module):
    """Piecewise-linear colour and opacity over the values of a volume; constant beyond the first and last position.

    ``colours`` and ``opacities`` are parameters without gradient: ``transfer.requires_grad_()`` makes them learnable
    (samplers then evaluate transparent places too, which they skip otherwise). Values outside [0, 1] count as 0 or 1
    and have gradient 0; :meth:`clip_` after a step of an optimiser puts them back, so that none is stuck there.

    Args:
        positions: In the volume's own values, rising, shape [K], K >= 2.
        colours: Red, green, blue in [0, 1], shape [K, 3]: what an opaque point radiates.
        opacities: In [0, 1], shape [K]: the part of the light that is held back along ``unit_distance``.
        unit_distance: As a fraction of the volume's width (its longest side), whatever the size at which it is placed:
            the same picture at 8 mm and at 30 cm. 1 / 256 is a voxel of a cube of 256 voxels.

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
        places, colour, opacity = (
            _table("positions", positions),
            _table("colours", colours),
            _table("opacities", opacities),
        )
        count = places.numel()
        if places.ndim != 1 or count < 2:
            raise ValueError(f"positions must be a list of at least 2 values, got shape {tuple(places.shape)}")
        if tuple(colour.shape) != (count, 3):
            raise ValueError(f"colours must be (K, 3) = {(count, 3)}, one per position, got {tuple(colour.shape)}")
        if tuple(opacity.shape) != (count,):
            raise ValueError(f"opacities must be (K,) = {(count,)}, one per position, got {tuple(opacity.shape)}")
        for name, values in (("colours", colour), ("opacities", opacity)):
            if values.detach().min() < 0 or values.detach().max() > 1:
                found = values.detach().aminmax()
                raise ValueError(f"{name} must lie in [0, 1], got {found.min.item():g} to {found.max.item():g}")
        falls = (places.diff() <= 0).nonzero()
        if falls.numel():
            k = int(falls[0])
            raise ValueError(f"positions must rise, got {places[k].item():g} before {places[k + 1].item():g}")
        self.unit_distance = checks.positive("unit_distance", unit_distance, "widths of the volume")
        self.register_buffer("positions", places)
        self.colours = nn.Parameter(colour, requires_grad=False)
        self.opacities = nn.Parameter(opacity, requires_grad=False)

    def forward(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Colour [3, ...] and opacity [...] per unit distance of ``values`` [...], in the wider of the two precisions.

        Colour and opacity share one search. Differentiable to the values too; at a position itself the slope is that of
        the interval above it.
        """
        dtype = self.colours.dtype
        if values.is_floating_point():
            dtype = torch.promote_types(dtype, values.dtype)
        values, places = values.to(dtype), self.positions.to(dtype)
        interval = torch.bucketize(values.detach(), places[1:-1], right=True, out_int32=True)
        table = torch.cat([self.colours.T, self.opacities[None]]).clamp(0, 1).to(dtype)
        flat = interval.reshape(-1)
        place = ((values - places[:-1][interval]) * (1 / places.diff())[interval]).clamp(0, 1)
        start, step = (part.index_select(1, flat).reshape(4, *values.shape) for part in (table[:, :-1], table.diff()))
        found = torch.addcmul(start, step, place)
        return found[:3], found[3]

    def visible(self, low: Tensor, high: Tensor) -> Tensor:
        """Whether any value between ``low`` and ``high`` [...] is not perfectly transparent, as bool [...].

        Everything is as long as the opacities are to be learned, for a transparent value has a gradient.
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
        """Values up to the first of these two numbers and from the second on are perfectly transparent."""
        if self.opacities.requires_grad:
            return -math.inf, math.inf
        seen = (self.opacities.detach() > 0).nonzero().flatten().tolist()
        if not seen:
            return math.inf, -math.inf
        places = [-math.inf, *self.positions.tolist(), math.inf]
        return places[seen[0]], places[seen[-1] + 2]

    @torch.no_grad()
    def clip_(self) -> None:
        """Put colours and opacities back into [0, 1]."""
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
