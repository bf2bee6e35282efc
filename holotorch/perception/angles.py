"""Conversion of angles and sizes to tensors, and checks of their ranges."""

from typing import Any

import torch
from torch import Tensor


def as_tensor(name: str, value: Any, unit: str = "degrees") -> Tensor:
    """Convert a number, list or tensor to a floating-point tensor.

    Numbers become float64; tensors keep their dtype, device and computation graph.

    Raises:
        TypeError: The value is neither a real number nor a list or tensor of real numbers.
        ValueError: The value is empty or contains NaN or infinity.
    """
    if isinstance(value, Tensor):
        if value.dtype == torch.bool or value.is_complex():
            raise TypeError(f"{name} must be real numbers in {unit}, got a tensor of {value.dtype}")
        tensor = value if value.is_floating_point() else value.double()
    else:
        if isinstance(value, bool | str | None):
            raise TypeError(f"{name} must be a number in {unit}, got {type(value).__name__} {value!r}")
        try:
            tensor = torch.as_tensor(value, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError):
            raise TypeError(f"{name} must be numbers in {unit}, got {type(value).__name__}") from None
    if tensor.numel() == 0:
        raise ValueError(f"{name} must hold at least one value in {unit}, got shape {tuple(tensor.shape)}")
    finite = torch.isfinite(tensor)
    require(finite, f"{name} must be finite in {unit}", tensor, f" ({int((~finite).sum())} such values)")
    return tensor


def eccentricity(value: Any, name: str = "eccentricity_deg") -> Tensor:
    """Convert eccentricities to a tensor. ValueError for an eccentricity outside 0 to 180 deg."""
    tensor = as_tensor(name, value)
    cure = "; it is an angle from the fixation point without a sign for left or right; take the absolute value"
    require(within(tensor, 0, 180), f"{name} must be within 0 to 180 degrees", tensor, cure)
    return tensor


def size(value: Any, name: str = "size_deg") -> Tensor:
    """Convert pattern sizes to a tensor. ValueError for a size that is not above 0 and at most 360 deg."""
    tensor = as_tensor(name, value)
    require((tensor > 0) & (tensor <= 360), f"{name} must be above zero and at most 360 degrees", tensor)
    return tensor


def within(values: Tensor, low: float, high: float, tolerance: float = 0.0) -> Tensor:
    """Whether each value v satisfies low - tolerance <= v <= high + tolerance; bool."""
    return (values >= low - tolerance) & (values <= high + tolerance)


def require(valid: Tensor, rule: str, values: Tensor, cure: str = "") -> None:
    """Raise ValueError unless all of ``valid`` is true. The message: ``rule``, the first invalid value, ``cure``."""
    if not valid.all():
        raise ValueError(f"{rule}, got {first(values, ~valid):g}{cure}")


def first(values: Tensor, where: Tensor) -> float:
    """The first of ``values`` at which the mask ``where`` is true, as a number."""
    return values.detach()[where].flatten()[0].item()
