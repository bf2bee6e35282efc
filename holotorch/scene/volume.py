"""Volume: a scalar field sampled on a regular grid in a box."""

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import VOXEL

Triple = tuple[float, float, float]
IDENTITY: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_SLAB = 1 << 22  # number of samples processed at once; temporary memory is then tens of megabytes


@dataclass(eq=False)
class Volume:
    """Samples of a scalar field (voxels) on a regular grid in a box, with axes in the order (z, y, x).

    Attributes:
        values: Real tensor [D, H, W]. It keeps the type in the file, for instance uint8, and may be memory-mapped.
        spacing: Distance between samples along (z, y, x), in ``unit``.
        unit: "m", or "relative" if only the proportions of the volume are known.
        origin: Position (z, y, x) of sample [0, 0, 0] in the coordinates of the file, in ``unit``.
        orientation: Three unit vectors, along the axes z, y and x of ``values``, each with components (z, y, x) in the
            coordinates of the file.
        frame: Where x, y and z of the file point, a letter for each: to a patient's L(eft) or R(ight), A (front) or P
            (back), S (head) or I (feet), such as "LPS"; "xyz" if that has no names; empty if the file states no
            directions.

    Raises:
        TypeError: ``values`` is not a real tensor, or a spacing is not a number.
        ValueError: ``values`` without three axes or without voxels, a spacing that is not finite and positive, an
            unknown unit, or axes that are not at right angles.
    """

    values: Tensor
    spacing: Triple
    unit: str
    origin: Triple = (0.0, 0.0, 0.0)
    orientation: tuple[Triple, Triple, Triple] = IDENTITY
    frame: str = ""

    def __post_init__(self) -> None:
        values = self.values
        if not isinstance(values, Tensor):
            raise TypeError(f"volume values must be a torch.Tensor, got {type(values).__name__}; use torch.from_numpy")
        if values.is_complex() or values.dtype in (torch.bool, torch.uint64):
            raise TypeError(
                f"volume values must be real numbers, got {values.dtype}; convert them, for instance to float32"
            )
        if values.ndim != 3:
            raise ValueError(f"volume values must have three axes (z, y, x), got shape {tuple(values.shape)}")
        if not values.numel():
            raise ValueError(f"volume must hold at least one voxel, got shape {tuple(values.shape)}")
        if self.unit not in ("m", "relative"):
            raise ValueError(
                f"volume unit must be 'm' or 'relative', got {self.unit!r}; convert other lengths to metres"
            )
        self.spacing = _triple("volume spacing", self.spacing)
        for step in self.spacing:
            if self.unit == "m":
                checks.quantity(VOXEL, step)
            else:
                checks.positive("volume spacing", step, self.unit)
        self.origin = _triple("volume origin", self.origin)
        self.orientation = _right_angled(self.orientation)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of samples (D, H, W)."""
        depth, height, width = self.values.shape
        return depth, height, width

    @property
    def extent(self) -> Triple:
        """Size (z, y, x) in ``unit``, which is the number of samples times the spacing."""
        (depth, height, width), (z, y, x) = self.shape, self.spacing
        return depth * z, height * y, width * x

    @property
    def left_handed(self) -> bool:
        """Whether the axes x, y, z of the voxels form a left-handed frame in the coordinates of the file."""
        return torch.linalg.det(torch.tensor(self.orientation, dtype=torch.float64)).item() < 0

    def mirrored(self) -> "Volume":
        """A copy with the voxels in reverse order along x; origin and orientation still say where they are."""
        z, y, (a, b, c) = self.orientation
        last = (self.shape[2] - 1) * self.spacing[2]
        origin = self.origin[0] + last * a, self.origin[1] + last * b, self.origin[2] + last * c
        values = reversed_along(self.values, (2,))
        return Volume(values, self.spacing, self.unit, origin, (z, y, (-a, -b, -c)), self.frame)

    def value_range(self) -> tuple[float, float]:
        """Smallest and largest value; ValueError if a value is NaN or infinite."""
        ends = torch.stack([torch.stack(slab.aminmax()).to(torch.float64) for _, slab in self._slabs()])
        least, most = ends[:, 0].min().item(), ends[:, 1].max().item()
        if not (abs(least) < float("inf") and abs(most) < float("inf")):
            self.check_finite()
        return least, most

    def check_finite(self) -> None:
        """Raise ValueError if voxels are NaN or infinite, stating the position of the first one and their number."""
        if not self.values.is_floating_point():
            return
        first, count = "", 0
        for start, slab in self._slabs():
            bad = ~torch.isfinite(slab)
            bad_voxels = int(bad.sum())
            if bad_voxels and not count:
                # argmax finds the first bad voxel; nonzero would allocate memory for the indices of all.
                index = bad.flatten().to(torch.uint8).argmax()
                z, y, x = (int(i) for i in torch.unravel_index(index, slab.shape))
                first = f"voxel (z, y, x) = ({start + z}, {y}, {x}) is {slab[z, y, x].item()}"
            count += bad_voxels
        if count:
            raise ValueError(
                f"volume must be finite, but {first} ({count} of {self.values.numel()} in all); repair it first, for "
                "instance with values.nan_to_num(nan=0, posinf=0, neginf=0)"
            )

    def bricks(self, size: int = 16) -> Tensor:
        """Smallest and largest value of every brick, [2, ceil(D / size), ceil(H / size), ceil(W / size)].

        A brick is a block of samples. Along each axis brick b holds the samples from b * size to (b + 1) * size, both
        included. Linear interpolation in the brick therefore gives no value outside these two. The dtype is that of
        the values, or int64 for unsigned integers of 16 and 32 bits.

        Raises:
            ValueError: A voxel is NaN or infinite.
        """
        size = checks.whole("brick size", size, 1)
        ends = torch.stack([self._reduced(size, torch.amin), self._reduced(size, torch.amax)])
        if ends.is_floating_point() and not torch.isfinite(ends).all():
            self.check_finite()
        return ends

    def _reduced(self, size: int, reduce: Callable[..., Tensor]) -> Tensor:
        result = self.values.detach()
        for axis, count in enumerate(self.shape):
            windows = ((start, min(size + 1, count - start)) for start in range(0, count, size))
            parts = [reduce(_comparable(result.narrow(axis, start, length)), dim=axis) for start, length in windows]
            result = torch.stack(parts, axis)
        return result

    def _slabs(self) -> Iterator[tuple[int, Tensor]]:
        values = self.values.detach()
        step = max(1, _SLAB // (values.shape[1] * values.shape[2]))
        for start in range(0, values.shape[0], step):
            yield start, _comparable(values[start : start + step])


def reversed_along(values: Tensor, axes: Sequence[int]) -> Tensor:
    """A copy with the order reversed along ``axes``, also of unsigned integers, which torch does not flip."""
    signed = {torch.uint16: torch.int16, torch.uint32: torch.int32}.get(values.dtype, values.dtype)
    return values.view(signed).flip(tuple(axes)).view(values.dtype)


def _comparable(values: Tensor) -> Tensor:
    """``values``, converted to int64 if torch cannot compare their type."""
    return values.to(torch.int64) if values.dtype in (torch.uint16, torch.uint32) else values


def _triple(name: str, values: Sequence[float]) -> Triple:
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != 3:
        raise TypeError(f"{name} must be three numbers (z, y, x), got {values!r}")
    z, y, x = (checks.finite(name, value) for value in values)
    return z, y, x


def _right_angled(rows: Sequence[Sequence[float]]) -> tuple[Triple, Triple, Triple]:
    if not isinstance(rows, Sequence) or len(rows) != 3:
        raise TypeError(f"volume orientation must be three rows (z, y, x) of direction cosines, got {rows!r}")
    z, y, x = (_triple("row of the volume's orientation", row) for row in rows)
    products = [sum(map(operator.mul, a, b)) - (a is b) for a in (z, y, x) for b in (z, y, x)]
    # The tolerance of 1e-3 allows for direction cosines that a file states with only three digits.
    if max(map(abs, products)) > 1e-3:
        raise ValueError(
            f"volume axes must be unit vectors at right angles, got {(z, y, x)}; resample a sheared volume (a tilted "
            "gantry, for instance) first"
        )
    return z, y, x
