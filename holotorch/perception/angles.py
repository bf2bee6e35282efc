"""Checks of angles and sizes in one voice, and tensors of them."""

from typing import Any

import torch
from torch import Tensor


def as_tensor(name: str, value: Any, unit: str = "degrees") -> Tensor:
    """A number, a list or a tensor as a floating tensor; numbers are float64, tensors keep dtype, device and graph.

    Raises:
        TypeError: It is no real number and no tensor of them.
        ValueError: It is empty, or NaN or infinite somewhere.
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
    """Angles from the fixation point, 0 to 180 deg. ValueError outside: a side of the field is no sign here."""
    tensor = as_tensor(name, value)
    bad = (tensor < 0) | (tensor > 180)
    if bad.any():
        cure = "it is an angle from the fixation point, without a side; take the absolute value"
        raise ValueError(f"{name} must be within 0 to 180 degrees, got {first(tensor, bad):g}; {cure}")
    return tensor


def size(value: Any, name: str = "size_deg") -> Tensor:
    """Sizes of patterns above zero and at most 360 deg, or ValueError."""
    tensor = as_tensor(name, value)
    bad = (tensor <= 0) | (tensor > 360)
    if bad.any():
        raise ValueError(f"{name} must be above zero and at most 360 degrees, got {first(tensor, bad):g}")
    return tensor


def first(tensor: Tensor, where: Tensor) -> float:
    """The first element of ``tensor`` at which ``where`` holds, as a number."""
    return tensor.detach()[where].flatten()[0].item()
