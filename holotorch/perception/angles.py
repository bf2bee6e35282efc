"""Conversion of angles and sizes to tensors, with consistent checks and error messages."""

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
    bad = ~torch.isfinite(tensor)
    if bad.any():
        raise ValueError(f"{name} must be finite in {unit}, got {first(tensor, bad):g} ({int(bad.sum())} such values)")
    return tensor


def eccentricity(value: Any, name: str = "eccentricity_deg") -> Tensor:
    """Convert eccentricities to a tensor. ValueError outside 0 to 180 deg; they have no sign for left or right."""
    tensor = as_tensor(name, value)
    bad = (tensor < 0) | (tensor > 180)
    if bad.any():
        cure = "it is an angle from the fixation point without a sign for left or right; take the absolute value"
        raise ValueError(f"{name} must be within 0 to 180 degrees, got {first(tensor, bad):g}; {cure}")
    return tensor


def size(value: Any, name: str = "size_deg") -> Tensor:
    """Convert sizes of patterns to a tensor. ValueError for sizes that are not above 0 or exceed 360 deg."""
    tensor = as_tensor(name, value)
    bad = (tensor <= 0) | (tensor > 360)
    if bad.any():
        raise ValueError(f"{name} must be above zero and at most 360 degrees, got {first(tensor, bad):g}")
    return tensor


def first(tensor: Tensor, where: Tensor) -> float:
    """The first element of ``tensor`` at which the mask ``where`` is true, as a number."""
    return tensor.detach()[where].flatten()[0].item()
