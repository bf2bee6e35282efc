"""ThermalCrosstalk: the spreading of heat between the pixels of a phased array."""

import inspect
import itertools
import math
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn import functional

from holotorch.core import checks
from holotorch.core.fourier import convolve
from holotorch.core.learning import PreciseModule, without_graph
from holotorch.core.precision import at_least_single
from holotorch.core.quantities import SIGMA_PX

_SMALLEST_TAP = 1e-12  # smaller taps are set to 0: products with them may be denormal numbers, which are slow
_ROOM = 1.5  # largest sigma for which a learnable kernel has enough taps, relative to the given one
_METRES = 1e-3  # pixels; a smaller sigma spreads no heat and is likely in metres
LOST_HEAT = 0.1  # share of heat outside a given number of taps that is too much; the thesis loses 8.7 % at sigma 2.5
_TAPS_OF_FFT = 40  # taps per pixel, over both axes, above which FFTs are faster on a CPU (scripts/bench.py crosstalk)


class ThermalCrosstalk(PreciseModule):
    """Convolution of heater phases (or temperatures) [..., H, W] with the heat kernel exp(-d^2 / sigma^2).

    The kernel at a distance of d pixels is the temperature rise there, relative to the rise of a pixel that is heated
    alone. Sigma is sqrt 2 times the standard deviation of the Gaussian. The centre tap is 1 and the kernel is not
    normalised, since the heat from all neighbours adds to that of the pixel. The array is padded with zeros. The
    operator is linear and real; dtype and device follow the input, but half precision, which cannot hold a phase, is
    computed and returned in float32.

    Args:
        sigma_px: Sigma in pixels, 0 to 100; 0 means no crosstalk. The thesis's chip has 0.66. An ``nn.Parameter`` is
            learned.
        size: Odd number of taps per axis. By default, the kernel has all taps of at least 1e-6, if sigma is learned
            those of 1.5 times the given sigma. The thesis always uses 7, which loses 2.3 % of the heat at sigma 2.0
            (see :attr:`lost_heat`).
        learnable: Make sigma a Parameter. It is in ``state_dict`` in any case, as ``sigma``.

    Raises:
        ValueError: ``sigma_px`` outside its range, or 0 if it is to be learned, or with a gradient but no Parameter;
            ``size`` even or below 1; in a call: an array smaller than the given ``size``.

    Warns:
        SamplingWarning: ``size`` taps lose more than 10 % of the heat, or ``sigma_px`` is above 0 but below 0.001,
            which is likely a length in metres.

    Source: thesis Eqs. 4.2-4.4.
    """

    sigma: Tensor | None
    patch: Tensor | None
    taps: Tensor

    def __init__(self, sigma_px: float | Tensor, size: int | None = None, *, learnable: bool = False):
        super().__init__()
        without_graph("sigma_px", sigma_px)
        sigma = checks.quantity(SIGMA_PX, sigma_px.detach() if isinstance(sigma_px, Tensor) else sigma_px)
        if size is not None and checks.whole("crosstalk size", size, 1) % 2 == 0:
            raise ValueError(f"crosstalk size must be an odd number of taps of at least 1, got {size!r}")
        self.size_is_given = size is not None
        given = sigma_px if isinstance(sigma_px, nn.Parameter) else sigma
        self.learned = self.record("sigma", given, learnable=learnable)
        if self.learned and sigma == 0:
            raise ValueError(
                "a learned sigma must be above 0, where the kernel depends on it, got 0; start at 0.3, say"
            )
        self.radius = _needed_radius(sigma * (_ROOM if self.learned else 1)) if size is None else size // 2
        self.patch = None
        self._keep_taps()
        if 0 < sigma < _METRES:
            warnings.warn(
                f"sigma_px={sigma:g} lets no heat reach a neighbour; it is in pixels: divide a length by the pitch",
                checks.SamplingWarning,
                stacklevel=2,
            )
        if size is not None and self.lost_heat > LOST_HEAT:
            enough = 2 * _needed_radius(sigma) + 1
            warnings.warn(
                f"{size} taps lose {self.lost_heat:.0%} of the heat of sigma_px={sigma:g}; size={enough} or size=None "
                "keeps all of it",
                checks.SamplingWarning,
                stacklevel=2,
            )

    @classmethod
    def from_patch(cls, patch: Tensor, *, learnable: bool = False) -> "ThermalCrosstalk":
        """Build from a measured response: the temperature rises [h, w] around one heated pixel in the centre.

        h and w are odd. The rises have any unit, since they are divided by that of the centre; they need not be
        symmetric. They are kept as ``patch``, and with ``learnable`` become a Parameter, whose learning rate then does
        not depend on their unit; only ratios to its centre count. An ``nn.Parameter`` is learned as it is. Raises
        ValueError for even sizes, NaN, negative rises, a centre that is not the warmest, or a patch with a gradient
        that is no Parameter.
        """
        if isinstance(patch, str | Path):
            table = "torch.from_numpy(numpy.loadtxt(file, delimiter=','))"
            raise TypeError(f"patch must be a tensor, got the name of a file; of a table in CSV give {table}")
        checks.real("patch", patch)
        checks.all_finite("patch", patch.detach())
        if patch.ndim != 2 or patch.shape[0] % 2 == 0 or patch.shape[1] % 2 == 0:
            raise ValueError(f"patch must have two odd sizes (h, w) around the heated pixel, got {tuple(patch.shape)}")
        centre = patch[patch.shape[0] // 2, patch.shape[1] // 2]
        if patch.min() < 0 or centre <= 0 or centre < patch.max():
            raise ValueError(
                f"patch must hold rises >= 0 with the heated centre the warmest, got centre {centre.item():g}, "
                f"minimum {patch.min().item():g}, maximum {patch.max().item():g}"
            )
        self = cls(0.0)
        del self.sigma, self.patch
        self.sigma, self.size_is_given = None, True
        given = patch if isinstance(patch, nn.Parameter) else patch / centre
        self.learned = self.record("patch", given, learnable=learnable)
        self._keep_taps()
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
        """The two-dimensional kernel, float64 [h, w], with centre tap 1, with the gradients of what is learned."""
        return _kernel(self._present_taps())

    @property
    def sigma_px(self) -> float:
        """The present sigma in pixels; NaN for a measured patch."""
        return math.nan if self.sigma is None else self.sigma.item()

    @property
    def total(self) -> float:
        """Sum of the kernel, which is the ratio of phase to heater phase in a uniformly heated, infinite array."""
        return self.kernel.sum().item()

    @property
    def lost_heat(self) -> float:
        """Share of the Gaussian's heat that lies outside the taps; NaN for a measured patch."""
        sigma = self.sigma_px
        if math.isnan(sigma):
            return math.nan
        offsets = torch.arange(_needed_radius(sigma) + 5, dtype=torch.float64)
        column = _gaussian(offsets, torch.tensor(sigma, dtype=torch.float64))
        return max(0.0, 1 - self.total / (2 * column.sum().item() - 1) ** 2)

    def forward(self, phase: Tensor) -> Tensor:
        """Spread ``phase``, real [..., H, W]; the result has the same shape and unit."""
        return self._spread(phase, self._present_taps())

    def adjoint(self, phase: Tensor) -> Tensor:
        """Apply the transpose, which is the correlation with the kernel."""
        return self._spread(phase, _flipped(self._present_taps()))

    def extra_repr(self) -> str:
        """Main parameters, for ``print(module)``."""
        sigma = "measured" if self.sigma is None else "meta" if self.sigma.is_meta else f"{self.sigma_px:g}"
        return f"sigma_px={sigma}, taps={self._shape()}{', learned' * self.learned}"

    def _shape(self) -> tuple[int, int]:
        taps = 2 * self.radius + 1
        return (taps, taps) if self.patch is None else (self.patch.shape[0], self.patch.shape[1])

    def _computed_taps(self) -> Tensor:
        """Taps of the column [n] of a Gaussian, or the measured kernel [h, w], float64."""
        if self.patch is not None:
            return self.patch / self.patch[self.patch.shape[0] // 2, self.patch.shape[1] // 2]
        assert self.sigma is not None
        offsets = torch.arange(-self.radius, self.radius + 1, dtype=torch.float64, device=self.sigma.device)
        return _gaussian(offsets, self.sigma)

    def _keep_taps(self) -> None:
        """Keep the taps of a kernel that is not learned; those of a learned one are computed in every call."""
        self.keep("taps", None if self.learned else self._computed_taps())

    def _present_taps(self) -> Tensor:
        """Taps [n] of the column and of the row of a Gaussian, or the measured kernel [h, w]."""
        return self._computed_taps() if self.learned else self.taps

    def _spread(self, phase: Tensor, taps: Tensor) -> Tensor:
        checks.real("phase", phase)
        if phase.ndim < 2:
            raise ValueError(f"phase must end in (H, W), got {tuple(phase.shape)}")
        size = self._shape()
        if self.size_is_given and (size[0] > phase.shape[-2] or size[1] > phase.shape[-1]):
            raise ValueError(
                f"crosstalk kernel of {size[0]} x {size[1]} px is larger than the array of {phase.shape[-2]} x "
                f"{phase.shape[-1]} px, the last two axes of {tuple(phase.shape)}; give a smaller size or a larger grid"
            )
        phase = at_least_single(phase)
        if taps.numel() * (2 if taps.ndim == 1 else 1) > _TAPS_OF_FFT:
            return convolve(phase, _kernel(taps).to(phase))
        add = _shifted_sum if torch.compiler.is_compiling() else _ShiftAndAdd.apply
        return add(phase, taps.to(phase.device))

    def _load_from_state_dict(self, *args, **kwargs):
        super()._load_from_state_dict(*args, **kwargs)
        self._keep_taps()


def _kernel(taps: Tensor) -> Tensor:
    """The kernel [h, w] of taps [h, w], or of taps [n] along both axes."""
    return taps[:, None] * taps if taps.ndim == 1 else taps


def _flipped(taps: Tensor) -> Tensor:
    return taps.flip(tuple(range(taps.ndim)))


def _shifted_sum(image: Tensor, taps: Tensor) -> Tensor:
    """Convolution of ``image`` [..., H, W] with ``taps`` as a sum of shifted copies, one per tap.

    Taps [h, w] are the kernel; taps [n] are its column and its row.
    """
    readable = checks.readable(image)  # numbers are faster than tensors
    if taps.ndim == 1:
        if not readable:
            return _shifted_sum(_shifted_sum(image, taps[:, None]), taps[None])
        numbers = taps.tolist()
        return _summed_along(_summed_along(image, numbers, -2), numbers, -1)
    rows, columns = taps.shape
    if readable and min(rows, columns) == 1:
        return _summed_along(image, taps.flatten().tolist(), -2 if columns == 1 else -1)
    height, width = image.shape[-2:]
    padded = _padded(image, taps.shape)
    values = taps.tolist() if readable else [row.unbind() for row in taps.to(image).unbind()]
    result = torch.zeros_like(image)
    for i, j in itertools.product(range(rows), range(columns)):
        tap, y, x = values[i][j], rows - 1 - i, columns - 1 - j
        if isinstance(tap, Tensor):
            result = result.addcmul(padded[..., y : y + height, x : x + width], tap)
        elif tap:
            result.add_(padded[..., y : y + height, x : x + width], alpha=tap)
    return result


def _summed_along(image: Tensor, taps: list[float], axis: int) -> Tensor:
    """:func:`_shifted_sum` along one axis: parts of arrays are added, which needs no padding."""
    size, middle = image.shape[axis], len(taps) // 2
    result = image * taps[middle]
    for k, tap in enumerate(taps):
        moved = abs(k - middle)
        if tap and 0 < moved < size:
            to, source = (moved, 0) if k > middle else (0, moved)
            result.narrow(axis, to, size - moved).add_(image.narrow(axis, source, size - moved), alpha=tap)
    return result


def _padded(image: Tensor, size: torch.Size) -> Tensor:
    rows, columns = size
    return functional.pad(image, (columns // 2, columns // 2, rows // 2, rows // 2))


class _ShiftAndAdd(torch.autograd.Function):
    """:func:`_shifted_sum` with derivatives that keep only the image.

    On a CPU, the backward pass of conv2d with one channel takes about ten times as long (``scripts/bench.py
    crosstalk``). torch.compile, which accepts no function with a forward-mode derivative, uses the plain sum.
    """

    @staticmethod
    def forward(image: Tensor, taps: Tensor) -> Tensor:
        return _shifted_sum(image, taps)

    @staticmethod
    def vmap(info, in_dims, *args):
        image, taps = args
        images = image.expand(info.batch_size, *image.shape) if in_dims[0] is None else image.movedim(in_dims[0], 0)
        if in_dims[1] is None:
            return _ShiftAndAdd.apply(images, taps), 0
        pairs = zip(images, taps.movedim(in_dims[1], 0), strict=True)
        return torch.stack([_ShiftAndAdd.apply(*pair) for pair in pairs]), 0  # type: ignore[list-item]

    @staticmethod
    def setup_context(ctx, inputs, output):
        image, taps = inputs
        # The image is kept where the derivative with respect to the taps needs it, and freed elsewhere.
        ctx.save_for_backward(image if taps.requires_grad else None, taps)
        forward_mode = getattr(forward_ad, "_current_level", 0) >= 0  # as forward_ad itself asks
        ctx.save_for_forward(image if forward_mode else None, taps)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        image, taps = ctx.saved_tensors
        (gradient,) = gradients
        of_image = _ShiftAndAdd.apply(gradient, _flipped(taps)) if ctx.needs_input_grad[0] else None
        of_taps = _correlated(gradient, image, taps) if ctx.needs_input_grad[1] else None
        return of_image, of_taps

    @staticmethod
    def jvp(ctx, *tangents: Tensor):
        image, taps = ctx.saved_tensors
        of_image, of_taps = tangents
        parts = [] if of_image is None else [_ShiftAndAdd.apply(of_image, taps)]
        if of_taps is not None and taps.ndim == 2:
            parts.append(_ShiftAndAdd.apply(image, of_taps))
        elif of_taps is not None:
            for column, row in ((of_taps, taps), (taps, of_taps)):
                parts.append(_ShiftAndAdd.apply(_ShiftAndAdd.apply(image, column[:, None]), row[None]))
        return sum(parts[1:], parts[0])


# ``apply`` asks for it in every call, and working it out anew takes a fifth of the time of a small array.
setattr(_ShiftAndAdd.forward, "__signature__", inspect.signature(_ShiftAndAdd.forward))  # noqa: B010


def _correlated(gradient: Tensor, image: Tensor, taps: Tensor) -> Tensor:
    """Derivative with respect to ``taps`` for a ``gradient`` with respect to the convolution."""
    if taps.ndim == 1:
        column, row = taps[:, None], taps[None]
        of_column = _correlated(_ShiftAndAdd.apply(gradient, row.flip(1)), image, column)
        return of_column.flatten() + _correlated(gradient, _ShiftAndAdd.apply(image, column), row).flatten()
    rows, columns = taps.shape
    height, width = image.shape[-2:]
    padded = _padded(image, taps.shape)
    sums = [
        (padded[..., y : y + height, x : x + width] * gradient).sum()
        for y, x in itertools.product(reversed(range(rows)), reversed(range(columns)))
    ]
    return torch.stack(sums).reshape(taps.shape).double()


def _gaussian(offsets: Tensor, sigma: Tensor) -> Tensor:
    """One-dimensional kernel at whole numbers of pixels from its centre; differentiable in a sigma above 0."""
    exponent = -(offsets / torch.where(sigma > 0, sigma, 1)).square()
    lit = (offsets == 0) | ((exponent >= math.log(_SMALLEST_TAP)) & (sigma > 0))
    return torch.where(lit, torch.exp(exponent), 0.0)


def _needed_radius(sigma: float) -> int:
    """Largest offset in pixels whose tap is at least 1e-6."""
    return max(0, math.ceil(sigma * math.sqrt(-math.log(1e-6))) - 1)
