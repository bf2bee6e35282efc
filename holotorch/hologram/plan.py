"""Plan of a hologram: the cheapest method whose predicted error is within the tolerance, with its cost."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.hologram.axial import AxialHologram
from holotorch.hologram.cone import Cone, check_scene, cone_samples, is_plain
from holotorch.hologram.convolution import TAPER_ERROR, ConvolutionHologram
from holotorch.hologram.raster import span
from holotorch.optics.free_space.padding import FINEST

_ROUNDING = {torch.complex64: 5e-7, torch.complex128: 1e-12}  # relative rounding error of the sums
# Measured computing times, given as the number of floating-point operations of an FFT that takes equally long.
_WAVE = 150.0  # for one sample of a spherical wave in float64
_PASS = 12.0  # for one sample when an array is read and written once

EDGE_MATTERS = (
    "pixels bend light up to a largest angle only: the light of each point is a cone, which at this distance may fill "
    "only part of the hologram; how its edge is defined (hologram.cone) then changes the field by more than the "
    "tolerance, by up to tens of percent: state it where fields of other software are compared"
)


@dataclass(frozen=True)
class HologramPlan:
    """The cheapest adequate method and the next best one.

    Attributes:
        method: "convolution" or "axial nodes".
        cone: Definition of the waves, see ``holotorch.hologram.cone``.
        near: Whether a pixel lies near the edge of the cone of a source, or outside it. The choice of ``cone`` may then
            change the field by more than the tolerance.
        transforms: Number of FFTs of sources, one per plane or per node.
        size: Size (y, x) of the padded arrays in samples.
        predicted_error: Expected relative L2 error for random sources, against the wave that ``cone`` defines.
        memory_bytes: Peak of the memory that the computation allocates, in bytes.
        flops: Computing time, given as the number of floating-point operations of an FFT that takes equally long.
        reason: Short text that explains the choice.
        runner_up: Short text about the method that was not chosen.
        notes: Warnings where the scene is near a limit of validity.
        adequate: Whether ``predicted_error`` is within the tolerance.
        operator: The module that computes the hologram.
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
    """Choose the cheapest method for a hologram of planes with h x w sources each, within tolerance and memory limit.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Distances of the planes from the hologram in metres, above 0.
        shape: Number of sources (h, w) of a plane. Dark margins of the scene need not be included.
        stride: Distance between neighbouring sources in pixels.
        tolerance: Largest permitted relative L2 error of the field.
        cone: Definition of the waves; only methods that compute these are considered. The default is "taper", which is
            cheapest and rings least, or "box" for pitches below 0.9 wavelengths. If the plan's ``near`` is False, all
            definitions but "band" give the same field within the tolerance.
        dtype: dtype of the field, complex64 or complex128.
        memory_limit: Largest permitted ``memory_bytes`` of the plan; None for no limit.

    Raises:
        TypeError: ``dtype`` is not a complex type.
        ValueError: Invalid arguments, no method within the tolerance, or none within the memory limit.
    """
    wavelength, listed, stride = check_scene(grid, wavelength, depths, stride)
    tolerance = checks.positive("tolerance", tolerance)
    if dtype not in _ROUNDING:
        raise TypeError(f"dtype must be torch.complex64 or torch.complex128, got {dtype}")
    asked: Cone = cone or ("taper" if min(grid.pitch) >= FINEST * wavelength else "box")
    exact = ConvolutionHologram(grid, wavelength, listed, cone=asked, stride=stride)
    methods = [_convolution(exact, shape, dtype)]
    displacement, _ = span(grid, shape, stride)
    axial_cone = _axial_cone(grid, wavelength, min(listed), displacement, asked)
    if axial_cone:
        axial = AxialHologram(grid, wavelength, listed, cone=axial_cone, stride=stride, tolerance=tolerance)
        methods.append(_axial(axial, shape, dtype))
    adequate = [method for method in methods if method["predicted_error"] <= tolerance]
    if not adequate:
        best = min(methods, key=lambda method: method["predicted_error"])
        raise ValueError(
            f"no method reaches a tolerance of {tolerance:.1e} for cone={asked!r}: {best['method']} comes to "
            f"{best['predicted_error']:.1e}; use cone='taper' or a larger tolerance"
        )
    limit = math.inf if memory_limit is None else memory_limit
    fitting = [method for method in adequate if method["memory_bytes"] <= limit]
    if not fitting:
        least = min(method["memory_bytes"] for method in adequate)
        raise ValueError(
            f"the hologram needs {least / 1e9:.2f} GB and {limit / 1e9:.2f} GB are allowed; use fewer pixels or a "
            "larger tolerance"
        )
    best = min(fitting, key=lambda method: method["flops"])
    runner_up = "no other method computes this cone of light"
    for other in methods:
        if other is not best:
            ratio = other["flops"] / best["flops"]
            verdict = f"would take {ratio:.1f} times as long" if other in adequate else "is not accurate enough"
            runner_up = f"{other['method']} (error {other['predicted_error']:.0e}) {verdict}"
    near = not is_plain(grid, wavelength, min(listed), displacement, tolerance)
    notes = _notes(grid, wavelength, min(listed), near)
    return HologramPlan(**best, cone=asked, near=near, runner_up=runner_up, notes=notes, adequate=True)


def _axial_cone(
    grid: Grid, wavelength: float, nearest: float, displacement: tuple[int, int], cone: Cone
) -> Cone | None:
    """Cone with which an ``AxialHologram`` computes the wave that ``cone`` defines, or None if it cannot."""
    if min(grid.pitch) < FINEST * wavelength:
        return None
    if cone in ("taper", "band"):
        return cone
    # If every pixel lies inside the box or disc of every source, no light is cut off, and the wave is that of "full".
    half_widths = cone_samples(grid, wavelength, nearest)
    y, x = (samples / half for samples, half in zip(displacement, half_widths, strict=True))
    return "full" if max(y, x) < 1 and (cone != "disc" or math.hypot(y, x) < 1) else None


def _transform(samples: float) -> float:
    """Floating-point operations of an FFT of ``samples`` complex samples."""
    return 5 * samples * math.log2(max(samples, 2))


def convolution_flops(operator: ConvolutionHologram, shape: tuple[int, int]) -> float:
    """Computing time of a convolution of layers of ``shape`` (h, w), as :attr:`HologramPlan.flops`."""
    size, count = operator.padded(shape), len(operator.depths)
    samples, sources = math.prod(size), math.prod(size) / operator.stride**2
    waves = _waves(operator, shape, size)
    flops = _transform(sources) + _transform(samples) / 2 + 3 * _PASS * samples + _WAVE * sum(waves) / len(waves)
    return count * flops + _transform(samples)


def _waves(operator: ConvolutionHologram, shape: tuple[int, int], size: tuple[int, int]) -> list[int]:
    """Number of samples of the spherical wave of each plane; of at most 1000 planes, the nearest and farthest included.

    ``size`` is that of the transforms.
    """
    depths, most = sorted(operator.depths), 1000
    if (last := len(depths) - 1) >= most:
        depths = [depths[last * k // (most - 1)] for k in range(most)]
    return [math.prod(operator.kernel_samples(depth, shape, size)) for depth in depths]


def _convolution(operator: ConvolutionHologram, shape: tuple[int, int], dtype: torch.dtype) -> dict:
    """Attributes of a :class:`HologramPlan` that depend on the method, for convolution."""
    size, count = operator.padded(shape), len(operator.depths)
    samples, sources = math.prod(size), math.prod(size) / operator.stride**2
    if operator.cone == "band":  # the error is derived in ``CroppedKernel``
        sine = operator.wavelength / (2 * min(operator.grid.pitch))
        error = 2 * sine**2 / math.sqrt(min(size) / 2)
    else:
        error = math.hypot(_ROUNDING[dtype], TAPER_ERROR if operator.cone == "taper" else 0)
    return {
        "method": "convolution",
        "transforms": count,
        "size": size,
        "predicted_error": error,
        "memory_bytes": round(dtype.itemsize * (3.3 * samples + sources) + 80 * max(_waves(operator, shape, size))),
        "flops": convolution_flops(operator, shape),
        "reason": f"{count} planes, each with a transform of its sources and half of one for its wave; exact",
        "operator": operator,
    }


def _axial(operator: AxialHologram, shape: tuple[int, int], dtype: torch.dtype) -> dict:
    """As :func:`_convolution`, for axial nodes."""
    design = operator.design(shape)
    samples, sources = math.prod(design.size), math.prod(design.size) / operator.stride**2
    nodes, planes = design.nodes.count, len(operator.depths)
    spread = 8 * design.nodes.width * planes * math.prod(shape)
    flops = nodes * (_transform(sources) + _PASS * samples) + spread + _transform(samples) + _WAVE * samples / 2
    slab = math.prod(shape) * (8 + 2 * (8 + design.nodes.width)) * dtype.itemsize
    spread_onto = "" if design.nodes.width == 1 else f" spread onto {nodes} nodes along the axis"
    return {
        "method": "axial nodes",
        "transforms": nodes,
        "size": design.size,
        "predicted_error": max(design.predicted_error, _ROUNDING[dtype] * math.sqrt(nodes) / 2),
        "memory_bytes": round(dtype.itemsize * (3 * samples + 2 * sources) + slab),
        "flops": flops,
        "reason": f"{planes} planes{spread_onto}, with one small transform each and a single large one",
        "operator": operator,
    }


def _notes(grid: Grid, wavelength: float, nearest: float, near: bool) -> tuple[str, ...]:
    notes = []
    across = 2 * min(cone_samples(grid, wavelength, nearest))
    if across < 4:  # a narrower cone has too few samples to represent a spherical wave
        notes.append(f"a point on the nearest plane lights {across:.2g} pixels, too few to sample its spherical wave")
    if near:
        notes.append(EDGE_MATTERS)
    if min(grid.pitch) <= wavelength / 2:
        notes.append("the pitch is at or below half a wavelength: light leaves in every direction")
    return tuple(notes)
