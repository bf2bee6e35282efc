"""ThermalCrosstalk: the spreading of heat between the pixels of a phased array."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from holotorch.core import checks
from holotorch.core.quantities import SIGMA_PX

_SMALLEST_TAP = 1e-12  # smaller taps are set to 0: products with them may be denormal numbers, which are slow


class ThermalCrosstalk(nn.Module):
    """Convolution of heater phases (or temperatures) [..., H, W] with the heat kernel exp(-d^2 / sigma^2).

    The kernel at a distance of d pixels is the temperature rise there, relative to the rise of a pixel that is heated
    alone. Sigma is sqrt 2 times the standard deviation of the Gaussian. The centre tap is 1 and the kernel is not
    normalised, since the heat from all neighbours adds to that of the pixel. The array is padded with zeros. The
    operator is linear and real; dtype and device follow the input.

    Args:
        sigma_px: Sigma in pixels, 0 to 100; 0 means no crosstalk. The thesis's chip has 0.66.
        size: Odd number of taps per axis. By default, the kernel has all taps of at least 1e-6. The thesis always uses
            7, which loses 2.3 % of the heat at sigma 2.0 (see :attr:`lost_heat`).

    Raises:
        ValueError: ``sigma_px`` outside its range, ``size`` even or below 1; in a call: an array smaller than the given
            ``size``.

    Source: thesis Eqs. 4.2-4.4.
    """

    def __init__(self, sigma_px: float, size: int | None = None):
        super().__init__()
        sigma = checks.quantity(SIGMA_PX, sigma_px)
        if size is not None and checks.whole("crosstalk size", size, 1) % 2 == 0:
            raise ValueError(f"crosstalk size must be an odd number of taps of at least 1, got {size!r}")
        radius = _needed_radius(sigma) if size is None else size // 2
        column = torch.tensor([[_tap(offset, sigma)] for offset in range(-radius, radius + 1)], dtype=torch.float64)
        self._set_factors(column, column.T)
        self.sigma_px, self.size_is_given = sigma, size is not None

    @classmethod
    def from_patch(cls, patch: Tensor) -> "ThermalCrosstalk":
        """Build from a measured response: the temperature rises [h, w] around one heated pixel in the centre.

        h and w are odd. The rises have any unit, since they are divided by that of the centre; they need not be
        symmetric. Raises ValueError for even sizes, NaN, negative rises or a centre that is not the warmest.
        """
        checks.real("patch", patch)
        checks.all_finite("patch", patch)
        if patch.ndim != 2 or patch.shape[0] % 2 == 0 or patch.shape[1] % 2 == 0:
            raise ValueError(f"patch must have two odd sizes (h, w) around the heated pixel, got {tuple(patch.shape)}")
        centre = patch[patch.shape[0] // 2, patch.shape[1] // 2]
        if patch.min() < 0 or centre <= 0 or centre < patch.max():
            raise ValueError(
                f"patch must hold rises >= 0 with the heated centre the warmest, got centre {centre.item():g}, "
                f"minimum {patch.min().item():g}, maximum {patch.max().item():g}"
            )
        self = cls(0.0)
        self._set_factors(patch.detach().to("cpu", torch.float64) / centre.item())
        self.sigma_px, self.size_is_given = math.nan, True
        return self

    @classmethod
    def fitted(cls, patch: Tensor, size: int | None = None) -> "ThermalCrosstalk":
        """Build from the Gaussian that fits a measured response best, as in Sec. 4.3.2 of the thesis.

        ``patch`` is as in :meth:`from_patch`, but larger than one pixel; ``size`` is as in the constructor. The fit is
        by least squares in the rises and not in their logarithms, which would amplify the noise of cold pixels. Raises
        ValueError as ``from_patch``, and for a patch that is nowhere below its centre.
        """
        measured = cls.from_patch(patch).kernel
        y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in measured.shape)
        square = y[:, None] ** 2 + x**2
        if not (measured[square > 0] < 1).any():
            raise ValueError("patch must fall off from its centre to be fitted")
        low, high = 1e-2, SIGMA_PX.high**2
        # Bisection: the derivative of the squared error with respect to s = sigma^2 changes sign once.
        for _ in range(60):
            middle = math.sqrt(low * high)
            model = torch.exp(-square / middle)
            # The derivative of sum (exp(-d^2 / s) - k)^2 for the measured kernel k, up to a positive factor.
            if ((model - measured) * model * square).sum() > 0:
                high = middle
            else:
                low = middle
        return cls(math.sqrt(low), size)

    @property
    def kernel(self) -> Tensor:
        """The two-dimensional kernel, float64 [h, w], with a centre tap of 1."""
        return math.prod(torch.tensor(factor, dtype=torch.float64) for factor in self._factors)  # type: ignore[return-value]

    @property
    def total(self) -> float:
        """Sum of the kernel: ratio of phase to heater phase in a uniformly heated, infinite array."""
        return self.kernel.sum().item()

    @property
    def lost_heat(self) -> float:
        """Share of the Gaussian's heat that lies outside the taps; NaN for a measured patch."""
        if math.isnan(self.sigma_px):
            return math.nan
        radius = _needed_radius(self.sigma_px) + 4
        whole = sum(_tap(offset, self.sigma_px) for offset in range(-radius, radius + 1)) ** 2
        return max(0.0, 1 - self.total / whole)

    def forward(self, phase: Tensor) -> Tensor:
        """Spread ``phase``, real [..., H, W]; the result has the same shape and unit."""
        return self._apply_factors(phase, self._factors)

    def adjoint(self, phase: Tensor) -> Tensor:
        """Apply the transpose, which is the correlation with the kernel."""
        return self._apply_factors(phase, tuple(map(_flipped, reversed(self._factors))))

    def extra_repr(self) -> str:
        """Main parameters, for ``print(module)``."""
        return f"sigma_px={self.sigma_px:g}, taps={tuple(self.kernel.shape)}"

    def _set_factors(self, *factors: Tensor) -> None:
        # Taps are Python floats, not tensors, so that they have full precision for every dtype and device.
        self._factors = tuple(tuple(map(tuple, factor.tolist())) for factor in factors)

    def _apply_factors(self, phase: Tensor, factors: tuple) -> Tensor:
        checks.real("phase", phase)
        if phase.ndim < 2:
            raise ValueError(f"phase must end in (H, W), got {tuple(phase.shape)}")
        size = max(len(factor) for factor in factors), max(len(factor[0]) for factor in factors)
        if self.size_is_given and (size[0] > phase.shape[-2] or size[1] > phase.shape[-1]):
            raise ValueError(
                f"crosstalk kernel of {size[0]} x {size[1]} px is larger than the array of {phase.shape[-2]} x "
                f"{phase.shape[-1]} px; give a smaller size or a larger grid"
            )
        for factor in factors:
            phase = _ShiftAndAdd.apply(phase, factor)
        return phase


class _ShiftAndAdd(torch.autograd.Function):
    """Convolution as a sum of shifted copies of the image, one per tap.

    On a CPU, the backward pass of conv2d with one channel takes about ten times as long (``scripts/bench.py
    crosstalk``). There is no forward-mode derivative, since torch.compile does not accept a function with one.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(image: Tensor, taps: tuple[tuple[float, ...], ...]) -> Tensor:
        height, width = image.shape[-2:]
        rows, columns = len(taps), len(taps[0])
        padded = functional.pad(image, (columns // 2, columns // 2, rows // 2, rows // 2))
        result = torch.zeros_like(image)
        for i, row in enumerate(taps):
            for j, tap in enumerate(row):
                if tap:
                    y, x = rows - 1 - i, columns - 1 - j
                    result.add_(padded[..., y : y + height, x : x + width], alpha=tap)
        return result

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.taps = inputs[1]

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        return _ShiftAndAdd.apply(gradients[0], _flipped(ctx.taps)), None


def _flipped(taps: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    """Kernel of the transposed convolution: both axes reversed."""
    return tuple(row[::-1] for row in taps[::-1])


def _tap(offset: int, sigma: float) -> float:
    """One-dimensional kernel at a whole number of pixels from its centre."""
    if offset == 0 or sigma == 0:
        return float(offset == 0)
    tap = math.exp(-((offset / sigma) ** 2))
    return tap if tap >= _SMALLEST_TAP else 0.0


def _needed_radius(sigma: float) -> int:
    """Largest offset in pixels whose tap is at least 1e-6."""
    return max(0, math.ceil(sigma * math.sqrt(-math.log(1e-6))) - 1)
