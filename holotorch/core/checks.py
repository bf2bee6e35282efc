"""Argument checks with uniform messages: the expected value, the given value, and what to change."""

import contextlib
import math
import numbers
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from holotorch.core import memory
from holotorch.core.quantities import OFFSET, WAVELENGTH, Quantity

_UNASKED = 64 << 20  # bytes up to which the available memory is not read, which takes 0.1 ms
_TURNED = 0.01  # rad: phase error above which rounding is reported, 1 % of a field


class SamplingWarning(UserWarning):
    """A grid is too coarse or too small for its light; the message names a sufficient sampling."""


class PrecisionWarning(UserWarning):
    """A number has fewer digits than the phase of light needs; the message names a sufficient type."""


def positive(name: str, value: float, unit: str = "") -> float:
    """Return ``value`` as float, or raise ValueError unless it is finite and above zero."""
    number = finite(name, value, unit)
    if number <= 0:
        raise ValueError(f"{name} must be above zero{_in(unit)}, got {value!r}")
    return number


def nonnegative(name: str, value: float, unit: str = "") -> float:
    """Return ``value`` as float, or raise ValueError unless it is finite and at least zero."""
    number = finite(name, value, unit)
    if number < 0:
        raise ValueError(f"{name} must be at least zero{_in(unit)}, got {value!r}")
    return number


def finite(name: str, value: float, unit: str = "") -> float:
    """Return ``value`` as float, or raise TypeError for what is no number and ValueError for NaN and infinity."""
    number = _number(name, value, unit)
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite{_in(unit)}, got {value!r}")
    return number


def quantity(kind: Quantity, value: float, name: str = "") -> float:
    """Return a physical quantity as float, or raise unless it can be meant: see :mod:`holotorch.core.quantities`.

    Args:
        kind: Which quantity, with its unit and range.
        value: A number, or a tensor of one element that carries no gradient.
        name: Of the argument; that of the quantity by default.

    Raises:
        TypeError: No number.
        ValueError: NaN, or outside the range; the message names the unit, and the prefix that was forgotten.
    """
    name = name or kind.name
    number = _number(name, value, kind.words)
    problem = kind.problem(number)
    if problem:
        raise ValueError(f"{name} {problem}")
    return number


def meant(kind: Quantity, value: Tensor | float, name: str = "") -> None:
    """Raise as :func:`quantity` for a number and as :func:`quantities` for a tensor, which may be learned.

    Tensors that are compiled or mapped over hold no values yet, and those on another device are not waited for.
    """
    if not isinstance(value, Tensor):
        quantity(kind, value, name)
    elif value.device.type == "cpu" and not torch.compiler.is_compiling():
        with contextlib.suppress(RuntimeError):  # of vmap and of fake tensors, where a value would decide
            quantities(kind, value, name)


def precise(wavelength: Tensor | float, distance: Tensor | float) -> None:
    """PrecisionWarning where the rounding of a tensor below float64 turns the phase of exp(ikz) by 0.01 rad or more."""
    coarse = {
        name: value.dtype
        for name, value in (("wavelength", wavelength), ("distance", distance))
        if isinstance(value, Tensor) and value.is_floating_point() and value.dtype != torch.float64
    }
    given = [value for value in (wavelength, distance) if isinstance(value, Tensor)]
    if not coarse or torch.compiler.is_compiling() or any(value.device.type != "cpu" for value in given):
        return
    rounding = sum(torch.finfo(dtype).eps / 2 for dtype in coarse.values())
    with contextlib.suppress(RuntimeError):
        cycles = torch.as_tensor(distance).detach().double() / torch.as_tensor(wavelength).detach().double()
        turned = 2 * math.pi * rounding * float(cycles.abs().max()) if cycles.numel() else 0.0
        if turned >= _TURNED:
            which = " and ".join(f"{name} is {str(dtype).removeprefix('torch.')}" for name, dtype in coarse.items())
            warnings.warn(
                f"{which}, whose rounding turns the phase of exp(ikz) by up to {turned:.2g} rad here; pass float64",
                PrecisionWarning,
                stacklevel=3,
            )


def quantities(kind: Quantity, values: Tensor, name: str = "") -> None:
    """Raise ValueError for an element of ``values``, of any shape and with or without gradient, as :func:`quantity`."""
    size = values.detach().abs() if kind.negative else values.detach()
    if bool(((size >= kind.low) & (size <= kind.high)).all()):
        return  # most calls end here, without a loop over all elements
    for value in values.detach().reshape(-1).tolist():
        problem = kind.problem(value)
        if problem:
            raise ValueError(f"{name or kind.name} {problem}")


def whole(name: str, value: int, least: int) -> int:
    """Return ``value`` as int, or raise TypeError unless it is an integer and ValueError if it is below ``least``."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be a whole number, got {type(value).__name__} {value!r}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value!r}")
    return int(value)


def port(value: int, least: int = 0) -> int:
    """Return a port of TCP or UDP as int, or raise as :func:`whole`, also above 65535; ``least`` 0 picks a free one."""
    if whole("port", value, least) > 65535:
        raise ValueError(f"port must be at most 65535, got {value!r}")
    return int(value)


def pair(name: str, values: Sequence[float], unit: str = "") -> tuple[float, float]:
    """Return two finite numbers (y, x) as floats, or raise TypeError for what is no pair of numbers."""
    items = values if isinstance(values, Sequence) and not isinstance(values, str) else ()
    if len(items) != 2:
        raise TypeError(f"{name} must be two numbers (y, x){_in(unit)}, got {values!r}")
    return finite(name, items[0], unit), finite(name, items[1], unit)


def offset(values: Sequence[float]) -> tuple[float, float]:
    """Return a position (y, x) in metres on a plane as floats, or raise as :func:`pair` and :func:`quantity`."""
    y, x = pair("offset", values, "metres")
    return quantity(OFFSET, y), quantity(OFFSET, x)


def wavelengths(values: float | Sequence[float]) -> tuple[float, ...]:
    """Return wavelengths in metres as a tuple, one per channel; a single number means one channel."""
    items: list[Any] = [values] if _scalar(values) else list(values)  # type: ignore[arg-type]
    if not items:
        raise ValueError("wavelengths must hold at least one value in metres, got none")
    return tuple(quantity(WAVELENGTH, item) for item in items)


def field(name: str, value: Tensor, shape: tuple[int, ...], *, complex_valued: bool = True) -> None:
    """Raise unless ``value`` is a tensor of the wanted kind whose last axes are ``shape``.

    Raises:
        TypeError: It is no tensor, or real where complex is needed, or the other way round.
        ValueError: Its trailing axes differ from ``shape``, which is (C, H, W) or (H, W).
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
    axes = "(C, H, W)" if len(shape) == 3 else "(H, W)"
    if tuple(value.shape[-len(shape) :]) != shape:
        raise ValueError(f"{name} must end in {axes} = {shape}, got {tuple(value.shape)}")
    real(name, value) if not complex_valued else _complex(name, value)


def real(name: str, value: Tensor) -> None:
    """Raise TypeError unless ``value`` is a real floating-point tensor."""
    if not isinstance(value, Tensor) or not value.is_floating_point():
        raise TypeError(f"{name} must be a real floating-point tensor, got {getattr(value, 'dtype', type(value))}")


def all_finite(name: str, value: Tensor) -> None:
    """Raise ValueError naming the first NaN or infinite element, if any."""
    bad = ~torch.isfinite(value)
    if bad.any():
        index = tuple(int(i) for i in bad.nonzero()[0])
        count = int(bad.sum())
        raise ValueError(f"{name} must be finite, but element {index} is {value[index].item()} ({count} in all)")


def affordable(needed: float, what: str, cure: str, device: torch.device | str = "cpu") -> None:
    """Raise MemoryError before an operation that needs more memory than is available.

    Args:
        needed: Largest extra memory of the operation, in bytes.
        what: What needs it, with the sizes that decide it.
        cure: What to change, as an imperative.
        device: Where it is allocated.
    """
    if needed <= _UNASKED or torch.compiler.is_compiling():
        return
    available = memory.available_memory(device)
    if available is not None and needed > available:
        raise MemoryError(
            f"{what} needs about {needed / 1e9:.3g} GB of memory and {available / 1e9:.3g} GB are available; {cure}"
        )


def _number(name: str, value: Any, unit: str) -> float:
    if isinstance(value, Tensor) and value.requires_grad:
        raise TypeError(f"{name} is fixed in a module and cannot carry a gradient; use the kernel function instead")
    try:
        if isinstance(value, bool | str):
            raise TypeError
        return float(value)
    except OverflowError:  # an integer beyond all floats
        return math.inf if int(value) > 0 else -math.inf
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a number{_in(unit)}, got {type(value).__name__} {value!r}") from None


def weights(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return weights as they are, or raise unless they broadcast to ``shape`` = (C, ...) and leave something of each C.

    Raises:
        ValueError: NaN, infinity, a weight below zero, another shape, or a channel in which all are zero: whatever is
            compared there is equal.
    """
    all_finite(name, value)
    behind = shape[len(shape) - value.ndim :]
    fits = value.ndim <= len(shape) and all(n in (1, whole) for n, whole in zip(value.shape, behind, strict=True))
    if not fits or (value.numel() and value.min() < 0):
        raise ValueError(f"{name} must be >= 0 and broadcast to the target {shape}, got {tuple(value.shape)}")
    empty = ~value.expand(shape).flatten(1).any(1)
    if bool(empty.any()):
        raise ValueError(f"{name} is zero everywhere in channel {int(empty.nonzero()[0])}: nothing is left to compare")
    return value


def _complex(name: str, value: Tensor) -> None:
    if not value.is_complex():
        raise TypeError(f"{name} must be complex (complex64 or complex128), got {value.dtype}; use torch.complex")


def _scalar(value: Any) -> bool:
    return isinstance(value, str | numbers.Real) or (isinstance(value, Tensor) and value.ndim == 0)


def _in(unit: str) -> str:
    return f" in {unit}" if unit else ""
