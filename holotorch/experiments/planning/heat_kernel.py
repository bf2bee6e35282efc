"""What a measured heat kernel tells of its own errors: its noise, and the heat beyond its table."""

import math
from collections.abc import Collection, Sequence

import torch
from torch import Tensor

NOISY = 2e-4  # noise of a kernel above which it is stated; a thousandth costs little (correct_my_chip.md)
_WARM = 0.02  # mean rise along a side, relative to the centre, above which heat is missing
_MISSING = 0.01  # heat beyond the table, relative to that within, above which it is said
_FAINT = 1e-3  # rise beyond the table, relative to the centre, below which it is left out
_WIDEST = 401  # taps of a table that is continued, at most
_LEAST = 1e-6  # rise of a tap, relative to the centre, whose logarithm is taken for a smaller one


def opposite_noise(kernel: Tensor) -> float:
    """Noise of the taps of a kernel [h, w], relative to its centre, if heat spreads equally to opposite sides.

    It is the larger one of that in all taps and that in the outermost ring.
    """
    differences = (kernel - kernel.flip((0, 1))).square() / 2
    parts = [part.mean().sqrt().item() for part in (differences, differences[_ring(kernel, 0)])]
    return max(parts) / kernel.max().item()


def even(kernel: Tensor) -> Tensor:
    """The kernel [h, w] with the mean of opposite taps in both of them."""
    return (kernel + kernel.flip((0, 1))) / 2


def warm_ring(kernel: Tensor) -> float:
    """Largest mean rise along a side of a kernel [h, w], relative to its centre; 0 for a single tap."""
    middle = kernel[kernel.shape[0] // 2, kernel.shape[1] // 2]
    sides = [side.mean() for side in (kernel[0], kernel[-1], kernel[:, 0], kernel[:, -1]) if kernel.numel() > len(side)]
    return float(max(sides, default=0.0 * middle) / middle)


def is_cut_off(kernel: Tensor) -> bool:
    """Whether much heat spreads beyond the table of a measured kernel."""
    return warm_ring(kernel) > _WARM or heat_beyond(kernel) > _MISSING


def heat_beyond(kernel: Tensor) -> float:
    """Heat beyond the table of a kernel [h, w], relative to that within, if it falls on as in :func:`continued`.

    0 where that is unknown.
    """
    whole = continued(kernel / kernel.max(), (_WIDEST, _WIDEST))
    return 0.0 if whole is None else float(whole.sum() / kernel.double().sum() * kernel.max()) - 1


def cut_off_note(kernel: Tensor) -> list[str]:
    """A note on a measured kernel whose table ends where it is still warm; empty for another."""
    if not is_cut_off(kernel):
        return []
    beyond = heat_beyond(kernel)
    about = f", some {beyond:.1%} of that within," if beyond > _MISSING else ""
    return [
        f"the measured kernel is cut off where the rise is still {warm_ring(kernel):.1%} of that of its centre "
        f"(mean of the warmest side): the heat beyond{about} is not in the model; give more rows and columns, or "
        "subtract what is not heat"
    ]


def response_note(given: Collection[str], section: str, wavelengths: Sequence[float]) -> list[str]:
    """A note on a phase per kelvin whose wavelength is assumed to be 630 nm, which the run does not have.

    ``given`` are the keys of the ``section`` that the configuration states.
    """
    if "rad_per_K" not in given or "rad_per_K_at" in given or any(abs(each - 630e-9) < 1e-9 for each in wavelengths):
        return []
    own = f"{wavelengths[0] * 1e9:.4g}nm"
    return [
        f"{section}.rad_per_K is taken to be that at 630 nm, which is none of the wavelengths here: say where it was "
        f"measured, such as {section}.rad_per_K_at={own}, or limits and temperatures are those of another chip"
    ]


def continued(kernel: Tensor, shape: tuple[int, ...]) -> Tensor | None:
    """A measured kernel with the heat beyond its table, which falls on as it does towards the table's sides.

    ``kernel`` [h, w] has 1 at its centre; the result [H, W], float64, is at most as large as ``shape``, the pixels
    (y, x) of the array. The rise beyond the table is exp(a - r / length), with r the distance from the centre in pixels
    and a and length fitted to the two outermost rings; it goes on to a thousandth of the centre. A guess, which only
    tells how much the missing heat may matter. None for a kernel that does not fall towards its sides.
    """
    kernel = kernel.detach().cpu().double()
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in kernel.shape)
    distance, rings = torch.hypot(y[:, None], x), _ring(kernel, 0) | _ring(kernel, 1)
    if not min(kernel.shape) > 4:
        return None
    fitted = torch.stack([torch.ones_like(distance[rings]), -distance[rings]], 1)
    start, fall = torch.linalg.lstsq(fitted, kernel[rings].clamp(min=_LEAST).log()[:, None]).solution[:, 0].tolist()
    if not fall > 0:
        return None
    radius = math.ceil((start - math.log(_FAINT)) / fall)
    sides = [
        max(n, min(2 * radius + 1, 2 * ((most - 1) // 2) + 1)) for n, most in zip(kernel.shape, shape, strict=True)
    ]
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in sides)
    whole = torch.exp(start - fall * torch.hypot(y[:, None], x))
    top, left = ((side - n) // 2 for side, n in zip(sides, kernel.shape, strict=True))
    whole[top : top + kernel.shape[0], left : left + kernel.shape[1]] = kernel
    return whole


def _ring(kernel: Tensor, depth: int) -> Tensor:
    """The taps of a kernel [h, w] that lie ``depth`` rows or columns within its sides, bool [h, w]."""
    height, width = kernel.shape
    ring = torch.zeros_like(kernel, dtype=torch.bool)
    ring[depth : height - depth, depth : width - depth] = True
    ring[depth + 1 : height - depth - 1, depth + 1 : width - depth - 1] = False
    return ring
