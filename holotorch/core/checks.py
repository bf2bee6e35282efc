"""Argument checks. Their messages name the expected value, the given value, and often what to change."""

import contextlib
import math
import numbers
import re
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from holotorch.core import memory
from holotorch.core.quantities import OFFSET, WAVELENGTH, Quantity

_SMALL = 64 << 20  # bytes: smaller requests skip the check, since reading the available memory takes 0.1 ms
_PHASE_ERROR = 0.01  # rad: a rounding error of the phase this large causes a warning; it changes a field by 1 %
_LENGTH = re.compile(r"\s*([-+]?\d+(?:\.\d*)?)\s*([nuµμmc])m\s*")  # a number and its unit
_EXPONENTS = {"n": -9, "u": -6, "µ": -6, "μ": -6, "m": -3, "c": -2}


class SamplingWarning(UserWarning):
    """A grid is too coarse or too small for the light on it; the message names a sufficient sampling."""


class PrecisionWarning(UserWarning):
    """The dtype of a wavelength or distance is too coarse for the phase k z; the message names a sufficient dtype."""


class CostWarning(UserWarning):
    """A result is many times as expensive as one with a somewhat larger error; the message says how to accept it."""


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
    """Return ``value`` as float, or raise TypeError unless it is a number and ValueError for NaN and infinity."""
    number = _number(name, value, unit)
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite{_in(unit)}, got {value!r}")
    return number


def quantity(kind: Quantity, value: float | Tensor, name: str = "") -> float:
    """Return a physical quantity as float, or raise unless it is plausible.

    Args:
        kind: The quantity, with its unit and plausible range.
        value: A number, or a tensor of one element that does not require gradients.
        name: Name of the argument; by default that of the quantity.

    Raises:
        TypeError: The value is not a number.
        ValueError: NaN, or a value outside the range. The message names the unit and, for lengths, the SI prefix that
            was probably forgotten.
    """
    name = name or kind.name
    number = _number(name, value, kind.words)
    problem = kind.problem(number)
    if problem:
        raise ValueError(f"{name} {problem}")
    return number


def readable(*tensors: Tensor) -> bool:
    """Whether the elements of ``tensors`` can be read at no cost, so that it pays to ask for them and to do less.

    They must have values, see :func:`have_values`, on the CPU: reading from a GPU waits for all that it has to do.
    """
    return have_values(*tensors) and all(tensor.device.type == "cpu" for tensor in tensors)


def have_values(*tensors: Tensor) -> bool:
    """Whether the elements of ``tensors`` can be read at all.

    There are none under ``torch.compile`` and ``torch.export``, on the meta device, and in fake tensors and other
    subclasses.
    """
    if torch.compiler.is_compiling():
        return False
    return all(type(tensor) in (Tensor, nn.Parameter) and not tensor.is_meta for tensor in tensors)


def plausible(kind: Quantity, value: Tensor | float, name: str = "") -> None:
    """Check a number as :func:`quantity` does, and a tensor, which may require gradients, as :func:`quantities` does.

    Tensors that are not :func:`readable`, and those under ``vmap``, which have no values, are not checked.
    """
    if not isinstance(value, Tensor):
        quantity(kind, value, name)
    elif readable(value):
        with contextlib.suppress(RuntimeError):  # vmapped tensors have no values
            quantities(kind, value, name)


def precise(wavelength: Tensor | float, distance: Tensor | float) -> None:
    """Warn if the rounding of a tensor that is not float64 can change the phase of exp(ikz) by 0.01 rad or more."""
    given = {"wavelength": wavelength, "distance": distance}
    tensors = {name: value for name, value in given.items() if isinstance(value, Tensor)}
    coarse = {name: t.dtype for name, t in tensors.items() if t.is_floating_point() and t.dtype != torch.float64}
    if not coarse or not readable(*tensors.values()):
        return
    rounding = sum(torch.finfo(dtype).eps / 2 for dtype in coarse.values())
    with contextlib.suppress(RuntimeError):
        cycles = torch.as_tensor(distance).detach().double() / torch.as_tensor(wavelength).detach().double()
        error = 2 * math.pi * rounding * float(cycles.abs().max()) if cycles.numel() else 0.0
        if error >= _PHASE_ERROR:
            which = " and ".join(f"{name} is {str(dtype).removeprefix('torch.')}" for name, dtype in coarse.items())
            warnings.warn(
                f"{which}, whose rounding turns the phase of exp(ikz) by up to {error:.2g} rad here; pass float64",
                PrecisionWarning,
                stacklevel=3,
            )


def quantities(kind: Quantity, values: Tensor, name: str = "") -> None:
    """Raise ValueError, as :func:`quantity` does, for the first implausible element of ``values``, of any shape."""
    if values.numel() > 1:  # without a loop over all elements
        size = values.detach().abs() if kind.negative else values.detach()
        if bool(((size >= kind.low) & (size <= kind.high)).all()):
            return
    for value in values.detach().reshape(-1).tolist():
        problem = kind.problem(value)
        if problem:
            raise ValueError(f"{name or kind.name} {problem}")


def whole(name: str, value: int, minimum: int) -> int:
    """Return ``value`` as int, or raise TypeError unless it is an integer and ValueError if it is below ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be a whole number, got {type(value).__name__} {value!r}")
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {value!r}")
    return int(value)


def port(value: int, minimum: int = 0) -> int:
    """Return the number of a TCP or UDP port as int, or raise unless it lies in ``minimum`` .. 65535."""
    if whole("port", value, minimum) > 65535:
        raise ValueError(f"port must be at most 65535, got {value!r}")
    return int(value)


def pair(name: str, values: Sequence[float], unit: str = "") -> tuple[float, float]:
    """Return ``values`` (y, x) as floats, or raise TypeError unless they are two numbers, ValueError unless finite."""
    items = values if isinstance(values, Sequence) and not isinstance(values, str) else ()
    if len(items) != 2:
        raise TypeError(f"{name} must be two numbers (y, x){_in(unit)}, got {values!r}")
    return finite(name, items[0], unit), finite(name, items[1], unit)


def offset(values: Sequence[float]) -> tuple[float, float]:
    """Return a position (y, x) in metres on a plane as floats, or raise as :func:`pair` and :func:`quantity`."""
    y, x = pair("offset", values, "metres")
    return quantity(OFFSET, y), quantity(OFFSET, x)


def wavelengths(values: float | Sequence[float] | Tensor) -> tuple[float, ...]:
    """Return wavelengths in metres as a tuple, one per channel, or raise; a single number stands for one channel."""
    single = isinstance(values, str | numbers.Real) or (isinstance(values, Tensor) and values.ndim == 0)
    items: list[Any] = [values] if single else list(values)  # type: ignore[arg-type]
    if not items:
        raise ValueError("wavelengths must hold at least one value in metres, got none")
    return tuple(quantity(WAVELENGTH, item) for item in items)


def tensor(name: str, value: Tensor, wanted: str = "a torch.Tensor") -> None:
    """Raise TypeError unless ``value`` is a tensor; the message names what makes one of an array or a list."""
    if not isinstance(value, Tensor):
        cure = {"ndarray": "; use torch.from_numpy(...)", "list": "; use torch.tensor(...)"}
        got = type(value).__name__
        raise TypeError(f"{name} must be {wanted}, got {got}{cure.get(got, '')}")


def field(name: str, value: Tensor, shape: tuple[int, ...], *, complex_valued: bool = True) -> None:
    """Raise TypeError unless ``value`` is a complex tensor, and ValueError unless its shape ends in ``shape``.

    ``shape`` is (C, H, W) or (H, W). With ``complex_valued=False`` the tensor must be real instead.
    """
    tensor(name, value)
    axes = "(C, H, W)" if len(shape) == 3 else "(H, W)"
    if tuple(value.shape[-len(shape) :]) != shape:
        raise ValueError(f"{name} must end in {axes} = {shape}, got {tuple(value.shape)}")
    if not complex_valued:
        real(name, value)
    elif not value.is_complex():
        cure = "of a real field give field + 0j, of amplitude and phase torch.polar(amplitude, phase)"
        raise TypeError(f"{name} must be complex (complex64 or complex128), got {value.dtype}; {cure}")


def real(name: str, value: Tensor) -> None:
    """Raise TypeError unless ``value`` is a real floating-point tensor."""
    wanted = "a real floating-point tensor"
    tensor(name, value, wanted)
    if not value.is_floating_point():
        cure = "" if value.is_complex() else f"; give {name}.float()" + " / 255" * (value.dtype == torch.uint8)
        raise TypeError(f"{name} must be {wanted}, got {value.dtype}{cure}")


def all_finite(name: str, value: Tensor) -> None:
    """Raise ValueError, naming the first NaN or infinite element, unless all elements are finite."""
    bad = ~torch.isfinite(value)
    if bad.any():
        index, count = tuple(bad.nonzero()[0].tolist()), int(bad.sum())
        raise ValueError(f"{name} must be finite, but element {index} is {value[index].item()} ({count} in all)")


def affordable(needed: float, what: str, cure: str, device: torch.device | str = "cpu") -> None:
    """Raise MemoryError if an operation would need more memory than is available.

    Args:
        needed: Largest extra memory of the operation, in bytes.
        what: The operation and its size, as the beginning of the message.
        cure: What to change, as an imperative, for the end of the message.
        device: Where the memory is allocated.
    """
    if needed <= _SMALL or torch.compiler.is_compiling():
        return
    available = memory.available_memory(device)
    if available is not None and needed > available:
        raise MemoryError(
            f"{what} needs about {needed / 1e9:.3g} GB of memory and {available / 1e9:.3g} GB are available; {cure}"
        )


def _number(name: str, value: Any, unit: str) -> float:
    if isinstance(value, Tensor) and value.requires_grad:
        raise TypeError(f"{name} is fixed here and cannot carry a gradient, which would be lost; give its detach()")
    try:
        if isinstance(value, bool | str):
            raise TypeError
        return float(value)
    except OverflowError:  # an integer too large for a float
        return math.inf if int(value) > 0 else -math.inf
    except (TypeError, ValueError):
        match = _LENGTH.fullmatch(value) if isinstance(value, str) and unit == "metres" else None
        cure = f"; give {match[1]}e{_EXPONENTS[match[2]]}" if match else ""
        raise TypeError(f"{name} must be a number{_in(unit)}, got {type(value).__name__} {value!r}{cure}") from None


def _in(unit: str) -> str:
    return f" in {unit}" if unit else ""
