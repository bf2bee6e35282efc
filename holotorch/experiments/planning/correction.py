"""Errors of the parts of a correction, as plans of kind ``pec`` and ``joint`` predict them.

All errors are relative L2 errors of the intensity that the heater phases form, at its best scale.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from holotorch.experiments.config.errors import ConfigError
from holotorch.io.heat_kernels import load_heat_kernel
from holotorch.modulator import ThermalCrosstalk

HEAT, PROPAGATION, STOPPING = "heat", "propagation", "stopping"  # parts that share the tolerance of a run
NO_STEP = "not measured: the solver accepts no further step from there"
# Residual of a corrected picture against its target. Runs of 64 px at sigma 0.66 to 2 px left 0.01 to 0.6.
_RESIDUAL = 0.3
# Error of single precision in the intensity of phases of some rad; 2e-7 to 3e-6 in the same runs.
_ROUNDING = {torch.float32: 3e-6, torch.float64: 1e-14}
_FINEST = 1e-7  # relative change of a loss that float32 can still resolve
_NOISE = 0.05  # negative rise, relative to the warmest, up to which it may be noise of the measurement
_MARGIN = 4  # taps on each side of the complete kernel, in addition to all taps of at least 1e-6


@dataclass(frozen=True)
class HeaterPhases:
    """Heater phases that a plan expects of the solver, in rad, and the pixels (y, x) of the array."""

    mean: float
    deviation: float
    shape: tuple[int, int]


def measured_crosstalk(path: str, shape: Sequence[int], key: str) -> ThermalCrosstalk:
    """The spreading of the heat by a measured kernel from a file, on an array of ``shape`` pixels (y, x).

    ConfigError, with the ``key`` of the configuration that names the file, for one that cannot be used.
    """
    try:
        rises = load_heat_kernel(path)
    except ValueError as error:
        raise ConfigError([f"{key}: {error}"]) from error
    try:
        crosstalk = ThermalCrosstalk.from_patch(rises)
    except ValueError as error:
        named = str(error).replace("patch", path, 1)
        raise ConfigError([f"{key}: {named}{_cure(rises)}"]) from error
    if rivals := _rivals(rises):
        raise ConfigError([f"{key}: {path}: {rivals}"])
    if any(taps > side for taps, side in zip(crosstalk.kernel.shape, shape, strict=True)):
        size = f"{crosstalk.kernel.shape[0]} x {crosstalk.kernel.shape[1]}"
        raise ConfigError([f"{key}: {size} taps are more than the {tuple(shape)} px of the array"])
    return crosstalk


def _cure(rises: Tensor) -> str:
    """What to change in a table of rises [h, w] that is refused, as the end of a message; empty if it is not known."""
    if not rises.numel() or not bool(rises.isfinite().all()):
        return ""
    if bool((rises < 0).any()):
        below = rises[rises < 0]
        negative = f"; rises are negative ({below.min():g} ... {below.max():g})"
        if -below.min() > _NOISE * rises.max():
            return f"{negative}: subtract the ambient temperature"
        return (
            f"{negative}, as noise is: average more measurements, keep only the rows and columns around the heated "
            "pixel in which the rise is well above the noise, and set what is still below 0 to 0"
        )
    row, column = divmod(int(rises.argmax()), rises.shape[1])
    down, across = min(row, rises.shape[0] - 1 - row), min(column, rises.shape[1] - 1 - column)
    if (2 * down + 1, 2 * across + 1) == tuple(rises.shape):
        return ""
    place = f"; the warmest pixel is in row {row + 1}, column {column + 1} of the file"
    if all(side == 1 or kept > 0 for side, kept in zip(rises.shape, (down, across), strict=True)):
        kept = f"rows {row - down + 1} to {row + down + 1} and columns {column - across + 1} to {column + across + 1}"
        return f"{place}: keep {kept}"
    even = [name for name, side in zip(("a row", "a column"), rises.shape, strict=True) if side % 2 == 0]
    if not even:
        return f"{place}: it needs neighbours on all sides"
    size, lines = " x ".join(map(str, rises.shape)), " and ".join(even)
    return f"; {size}: add or drop {lines} so that the heated pixel is in the middle"


def _rivals(rises: Tensor) -> str:
    """What is wrong with a table of rises [h, w] in which others are as warm as the middle; empty if none is."""
    centre = rises[rises.shape[0] // 2, rises.shape[1] // 2]
    warm = rises >= centre
    warm[rises.shape[0] // 2, rises.shape[1] // 2] = False
    if not bool(warm.any()):
        return ""
    rows = ", ".join(str(row + 1) for row in warm.any(1).nonzero().flatten().tolist())
    others = f"in rows {rows} of the file, {int(warm.sum())} pixels are" if "," in rows else f"pixels of row {rows} are"
    return f"{others} as warm as the heated pixel in the middle ({centre.item()}): is this a kernel?"


def complete_kernel(sigma_px: float) -> ThermalCrosstalk:
    """The heat kernel with all taps that change a picture in double precision."""
    return ThermalCrosstalk(sigma_px, 2 * (ThermalCrosstalk(sigma_px).radius + _MARGIN) + 1)


def spread_completely(sigma_px: float, phase: Tensor) -> Tensor:
    """Heater phases [..., H, W] after the heat has spread by the complete kernel, which may be wider than the array."""
    crosstalk, (height, width) = complete_kernel(sigma_px).to(phase.device), phase.shape[-2:]
    room = max(0, crosstalk.radius - (min(height, width) - 1) // 2)
    return crosstalk(functional.pad(phase, [room] * 4))[..., room : room + height, room : room + width]


def needed_taps(sigma_px: float, taps: int) -> int | None:
    """``taps`` for :class:`ThermalCrosstalk`; None if its default has no more taps."""
    return taps if taps < 2 * ThermalCrosstalk(sigma_px).radius + 1 else None


def cropping_error(sigma_px: float, taps: int, heaters: HeaterPhases) -> float:
    """Error of a heat kernel with ``taps`` per axis.

    The dropped taps K change the phase by sum K times the mean heater phase, which only matters near the edges, where
    half of the neighbours are missing, and by a random sum of the deviations. An rms phase error e in rad causes a
    relative error of about e in the intensity.
    """
    crosstalk = complete_kernel(sigma_px)
    dropped, kept = crosstalk.kernel.clone(), taps // 2
    middle = slice(max(0, crosstalk.radius - kept), crosstalk.radius + kept + 1)
    dropped[middle, middle] = 0
    edge = min(1.0, crosstalk.radius * sum(1 / side for side in heaters.shape))  # half a kernel deep, on both sides
    common = heaters.mean * dropped.sum().item() / 2 * math.sqrt(edge)
    return math.hypot(common, heaters.deviation * dropped.square().sum().sqrt().item())


def cropped_taps(sigma_px: float, share: float, heaters: HeaterPhases) -> int:
    """Smallest odd number of taps per axis whose error is within ``share``; all taps of 1e-6 if none is."""
    few, most = 0, ThermalCrosstalk(sigma_px).radius  # taps on each side; the error falls with their number
    while few < most:
        middle = (few + most) // 2
        if cropping_error(sigma_px, 2 * middle + 1, heaters) <= share:
            most = middle
        else:
            few = middle + 1
    return 2 * most + 1


def stopping_error(tolerance: float, patience: int) -> float:
    """Error of a solver that stops after ``patience`` relative changes of the loss below ``tolerance``.

    It is the part of the residual that as many further steps would remove at the same rate.
    """
    return _RESIDUAL * math.sqrt(patience * tolerance)


def stopping_tolerance(share: float, patience: int) -> float:
    """Inverse of :func:`stopping_error`."""
    return (share / _RESIDUAL) ** 2 / patience


def solver_precision(tolerance: float) -> torch.dtype:
    """Precision of a solver that stops at relative changes of the loss below ``tolerance``, unless that is 0."""
    return torch.float64 if 0 < tolerance < _FINEST else torch.float32


def rounding_error(dtype: torch.dtype) -> float:
    """Error of a propagation in a precision, of phases of some rad."""
    return _ROUNDING[dtype]


def scaled_error(image: Tensor, exact: Tensor) -> float:
    """Relative L2 error of an intensity at its best scale; 0 if both are 0."""
    image, exact = image.double(), exact.double()
    square, norm = image.square().sum().item(), exact.norm().item()
    scale = (image * exact).sum().item() / square if square else 0.0
    return (scale * image - exact).norm().item() / norm if norm else 0.0
