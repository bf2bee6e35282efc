"""Which way to a hologram: the cheapest whose predicted error is within the tolerance, with its cost."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.hologram.axial import AxialHologram
from holotorch.hologram.cone import Cone, check_scene, cone_samples
from holotorch.hologram.convolution import ConvolutionHologram
from holotorch.optics.candidates import FINEST

_ROUNDING = {torch.complex64: 5e-7, torch.complex128: 1e-12}
# Arithmetic of a wave's sample in float64, measured against that of a transform; of passing over an array once.
_WAVE, _PASS = 150.0, 12.0
_FEW_SAMPLES = 4  # a cone of fewer pixels across is no wave any more


@dataclass(frozen=True)
class HologramPlan:
    """The cheapest adequate way found, and the one that came next.

    Attributes:
        method: "convolution" or "axial nodes".
        cone: Definition of the waves, see ``holotorch.hologram.cone``.
        near: Whether the cone is narrower than the window somewhere, so that definitions differ.
        transforms: Of the sources, one per plane or per node.
        size: Samples (y, x) of the whole spectrum.
        predicted_error: Expected relative L2 error for sources like noise, against that definition.
        memory_bytes: Largest extra memory of one colour.
        flops: Arithmetic of one colour, transforms and passes over arrays.
        reason: One sentence that says why this one.
        runner_up: One sentence on the other.
        notes: Where the scene comes near a border of validity.
        adequate: Whether ``predicted_error`` is within the tolerance.
        operator: The module that does it.
    """

    method: str
    cone: Cone
    near: bool
    transforms: int
    size: tuple[int, int]
    predicted_error: float
    memory_bytes: int
    flops: float
    reason: str
    runner_up: str
    notes: tuple[str, ...]
    adequate: bool
    operator: nn.Module


def plan_hologram(
    grid: Grid,
    wavelength: float,
    depths: Sequence[float],
    shape: tuple[int, int],
    *,
    stride: int = 1,
    tolerance: float = 1e-3,
    cone: Cone | None = None,
    dtype: torch.dtype = torch.complex64,
    memory_limit: int | None = None,
) -> HologramPlan:
    """Choose how to form the hologram of layers of ``shape`` (h, w), the lit part of the scene.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Of the planes, in metres, above 0.
        shape: Sources of a plane; only those that are lit need be counted.
        stride: Pixels between neighbouring sources.
        tolerance: Relative L2 error that is wanted.
        cone: Definition of the waves. By default a soft rim, "taper", which costs least and rings least; far away,
            where the cone is wider than the window, all are the same.
        dtype: complex64 or complex128.
        memory_limit: In bytes.

    Raises:
        ValueError: Impossible arguments, no way within the tolerance, or none within the memory limit.
    """
    wavelength, listed, stride = check_scene(grid, wavelength, depths, stride)
    tolerance = checks.positive("tolerance", tolerance)
    if dtype not in _ROUNDING:
        raise TypeError(f"dtype must be torch.complex64 or torch.complex128, got {dtype}")
    found = []
    if cone != "band" or min(grid.pitch) >= FINEST * wavelength:
        exact = ConvolutionHologram(grid, wavelength, listed, cone=cone or "taper", stride=stride)
        found.append(_convolution(exact, shape, dtype))
    if cone in (None, "taper", "band") or not _near(grid, wavelength, listed, shape, stride):
        limited: Cone = "band" if cone == "band" else "taper"
        axial = AxialHologram(grid, wavelength, listed, cone=limited, stride=stride, tolerance=tolerance)
        found.append(_axial(axial, shape, dtype))
    adequate = [way for way in found if way["predicted_error"] <= tolerance]
    if not adequate:
        best = min(found, key=lambda way: way["predicted_error"])
        raise ValueError(
            f"no way reaches a tolerance of {tolerance:.1e} for cone={best['cone']!r}: {best['method']} comes to "
            f"{best['predicted_error']:.1e}; use cone='taper' or a larger tolerance"
        )
    ordered = sorted(adequate, key=lambda way: way["flops"])
    if memory_limit is not None:
        fitting = [way for way in ordered if way["memory_bytes"] <= memory_limit]
        if not fitting:
            least = min(way["memory_bytes"] for way in ordered)
            raise ValueError(
                f"the hologram needs {least / 1e9:.2f} GB and {memory_limit / 1e9:.2f} GB are allowed; use fewer "
                "pixels or a larger tolerance"
            )
        ordered = fitting
    best, others = ordered[0], [way for way in found if way is not ordered[0]]
    runner_up = "there is no other way to this definition"
    if others:
        other = others[0]
        why = f"{other['flops'] / best['flops']:.1f} times the work" if other in adequate else "not accurate enough"
        runner_up = f"{other['method']}: {other['transforms']} transforms, {other['predicted_error']:.0e}, {why}"
    near = _near(grid, wavelength, listed, shape, stride)
    return HologramPlan(
        **best, near=near, runner_up=runner_up, notes=_notes(grid, wavelength, listed, near), adequate=True
    )


def _near(grid: Grid, wavelength: float, depths: Sequence[float], shape: tuple[int, int], stride: int) -> bool:
    half = cone_samples(grid, wavelength, min(depths))
    return any(
        wide < (count * stride + pixels) / 2 for wide, count, pixels in zip(half, shape, grid.shape, strict=True)
    )


def _transform(samples: float) -> float:
    return 5 * samples * math.log2(max(samples, 2))


def _convolution(operator: ConvolutionHologram, shape: tuple[int, int], dtype: torch.dtype) -> dict:
    size, count = operator.padded(shape), len(operator.depths)
    samples, sources = math.prod(size), math.prod(size) / operator.stride**2
    waves = 0.0
    for depth in operator.depths:
        cone = cone_samples(operator.grid, operator.wavelength, depth)
        waves += math.prod(min(wide, length / 2) for wide, length in zip(cone, size, strict=True))
    flops = count * (_transform(sources) + _transform(samples) / 2 + 3 * _PASS * samples) + _WAVE * waves
    bytes_ = dtype.itemsize
    largest = math.prod(
        min(wide, length / 2) + 1
        for wide, length in zip(
            cone_samples(operator.grid, operator.wavelength, max(operator.depths)), size, strict=True
        )
    )
    return {
        "method": "convolution",
        "cone": operator.cone,
        "transforms": count,
        "size": size,
        "predicted_error": _limited_error(operator, size) if operator.cone == "band" else _ROUNDING[dtype],
        "memory_bytes": round(bytes_ * (3.3 * samples + sources) + 80 * largest),
        "flops": flops + _transform(samples),
        "reason": f"{count} planes, each with a transform of its sources and half of one for its wave; exact",
        "operator": operator,
    }


def _limited_error(operator: ConvolutionHologram, size: tuple[int, int]) -> float:
    """Of a convolution with the band's own wave, as ``CroppedKernel`` derives it, for noise."""
    sine = operator.wavelength / (2 * min(operator.grid.pitch))
    return 2 * sine**2 / math.sqrt(min(size) / 2)


def _axial(operator: AxialHologram, shape: tuple[int, int], dtype: torch.dtype) -> dict:
    design = operator.design(shape)
    samples, sources = math.prod(design.size), math.prod(design.size) / operator.stride**2
    nodes, planes = design.nodes.count, len(operator.depths)
    spread = 8 * design.nodes.width * planes * math.prod(shape)
    flops = nodes * (_transform(sources) + _PASS * samples) + spread + _transform(samples) + _WAVE * samples / 2
    slab = math.prod(shape) * (8 + 2 * (8 + design.nodes.width)) * dtype.itemsize
    what = "planes as their own nodes" if design.nodes.width == 1 else f"{planes} planes on {nodes} nodes"
    return {
        "method": "axial nodes",
        "cone": operator.cone,
        "transforms": nodes,
        "size": design.size,
        "predicted_error": max(design.predicted_error, _ROUNDING[dtype] * math.sqrt(nodes) / 2),
        "memory_bytes": round(dtype.itemsize * (3 * samples + 2 * sources) + slab),
        "flops": flops,
        "reason": f"{what}, one small transform each and one large one in all",
        "operator": operator,
    }


def _notes(grid: Grid, wavelength: float, depths: Sequence[float], near: bool) -> tuple[str, ...]:
    notes = []
    across = 2 * min(cone_samples(grid, wavelength, min(depths)))
    if across < _FEW_SAMPLES:
        notes.append(
            f"the nearest plane's light covers {across:.2g} pixels: closer than that a point is a pixel, not a wave"
        )
    if near:
        notes.append(
            "the cone of light is narrower than the window: definitions of its rim differ by several percent, and "
            "sources see part of the hologram only"
        )
    if min(grid.pitch) <= wavelength / 2:
        notes.append("the pitch is at or below half a wavelength: light leaves in every direction")
    return tuple(notes)
