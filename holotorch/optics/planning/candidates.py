"""Every method of propagation, with its predicted error and its cost.

The factor beyond Fresnel is the exact transfer function divided by Fresnel's. The taps of a method are the samples of
its impulse response.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from holotorch.core.fourier import good_length
from holotorch.core.grid import Grid
from holotorch.optics.free_space.padding import CROP_PAD, FINEST, crop_length, resampled_padding
from holotorch.optics.free_space.plane_pair import PlanePair, shifts
from holotorch.optics.planning.content import FieldContent
from holotorch.optics.planning.predict import AxisContent, rms_beyond_fresnel

# Padding factors of a sampled transfer function that are tried, and those tried for steep, tilted or displaced light.
_PADS = (1.0, 1.03125, 1.0625, 1.125, 1.25, 1.5)
_WIDE_PADS = (2.0, 3.0, 4.0, 6.0, 8.0)
_CROP_PADS = (2.0, CROP_PAD)  # values of ``pad`` in crop_length
_TAILS = (0.125, 0.5, 1.5)  # values of ``tails`` in resampled_padding
_PRODUCT_SPEED = 4.0  # operations of a dense product in the time of one operation of an FFT


@dataclass(frozen=True)
class Candidate:
    """One method of propagation; its error is computed at the first access.

    Attributes:
        method: Name of the method.
        sampled: Per axis (y, x), True if the transfer function is sampled in frequency; False if the impulse response
            is sampled in space and cropped to the displacements between source and window.
        padded: Samples (y, x) of the transforms.
        paraxial: Whether the factor beyond Fresnel is neglected.
        predict: Computes the expected relative L2 error.
        captured: Computes the fraction of the energy that is expected to arrive in the window; the smallest one of
            several wavelengths and distances.
        flops: Floating-point operations of one call.
        memory: Largest extra memory of one call, in bytes.
        cost: Rank of the candidate: ``flops``, with dense products weighted by their speed.
    """

    method: str
    sampled: tuple[bool, bool]
    padded: tuple[int, int]
    paraxial: bool
    predict: Callable[[], float]
    captured: Callable[[], float]
    flops: float
    memory: int
    cost: float

    @cached_property
    def error(self) -> float:
        """Expected relative L2 error."""
        return self.predict()


Axes = tuple[AxisContent, AxisContent]


def candidates(
    planes: PlanePair,
    wavelengths: Sequence[float],
    distances: Sequence[float],
    content: FieldContent,
    dtype: torch.dtype = torch.complex64,
) -> list[Candidate]:
    """Every method for ``planes``; the error of each is the largest one over the wavelengths and distances."""
    if dtype not in (torch.complex64, torch.complex128):
        raise TypeError(f"dtype must be complex64 or complex128, got {dtype}")
    longest, farthest = max(wavelengths), max(distances, key=abs)
    scenes = [_axes(planes, longest, distance, content) for distance in _extremes(planes, distances)]
    options = [_identity(scenes)] if planes.straight else []
    if farthest == 0 and planes.straight:
        return options
    wide = min(planes.grid.pitch) < FINEST * longest
    if not planes.same_pitch:
        dense = [] if wide else [_resampled(planes, scenes, dtype, tails) for tails in (None, *_TAILS)]
        pairs = zip(*(_lengths(axis, _PADS + _WIDE_PADS) for axis in scenes[0]), strict=False)
        return dense + [_zoomed(planes, scenes, pair, dtype) for pair in pairs]
    symmetric = scenes[0][0] is scenes[0][1]
    tilted = any(planes.tilt)
    pads = _PADS + (_WIDE_PADS if wide or tilted or planes.out != planes.grid else ())
    lengths = [_lengths(axis, pads) for axis in scenes[0]]
    pairs = zip(*lengths, strict=False) if symmetric or wide or tilted else itertools.product(*lengths)
    options += [_sampled(scenes, pair, dtype) for pair in pairs]
    if wide:
        return options
    sampled_axes = (
        [(False, False)]
        if symmetric or tilted or planes.out != planes.grid
        else [(False, False), (True, False), (False, True)]
    )
    crop_pads = [*_CROP_PADS, 3.0, 4.0] if tilted else [None, *_CROP_PADS]
    return options + [
        _cropped(scenes, sampled_axis, crop_pad, dtype) for sampled_axis in sampled_axes for crop_pad in crop_pads
    ]


def _extremes(planes: PlanePair, distances: Sequence[float]) -> list[float]:
    """Distances that bound the error: the longest one, or both ends of the range if the result is displaced."""
    if planes.straight:
        return [max(map(abs, distances)) or 1e-12]
    return list(dict.fromkeys(z or 1e-12 for z in (min(distances), max(distances))))


def _axes(planes: PlanePair, wavelength: float, distance: float, content: FieldContent) -> Axes:
    requested = planes
    if not planes.same_pitch:
        # The error is predicted for a window of the source's pitch that covers the result, one sample more on each
        # side. Its samples are a quarter of a pitch off those of the source. Other positions would underestimate the
        # error: on the source's samples the tails of the content are zero, and half-way between them the
        # contributions of the two ends of the band cancel.
        height, width = (
            math.ceil(extent / pitch) + 2 for extent, pitch in zip(planes.out.extent, planes.grid.pitch, strict=True)
        )
        planes = PlanePair(planes.grid, Grid((height, width), planes.grid.pitch), planes.offset, planes.tilt)
    positions = shifts(
        planes, torch.tensor(distance, dtype=torch.float64), torch.tensor(planes.tilt, dtype=torch.float64)
    )
    # Light that travels backward is the conjugate of light that travels forward in the mirrored direction.
    backward = distance < 0
    signals = [each.conj() if backward else each for each in content.signals or ()]
    sines = [-sine if backward else sine for sine in planes.tilt]
    y, x = (
        AxisContent(
            planes.grid.shape[axis],
            planes.grid.pitch[axis],
            content.band[axis],
            wavelength,
            abs(distance),
            content.margin[axis],
            planes.out.shape[axis],
            positions[axis].item() if planes == requested else round(positions[axis].item()) + 0.25,
            (sines[axis], sines[1 - axis]),
            signals[axis] if signals else None,
        )
        for axis in (0, 1)
    )
    # Equal axes share one object, so that cached results are computed once.
    return (y, y) if y == x and content.signals is None else (y, x)


def _lengths(axis: AxisContent, pads: tuple[float, ...]) -> list[int]:
    largest = max(axis.size, axis.window)
    lengths = (largest if pad == 1 else good_length(math.ceil(largest * pad)) for pad in pads)
    return list(dict.fromkeys(lengths))


def _identity(scenes: list[Axes]) -> Candidate:
    """The unchanged field, times the carrier."""
    axes = y, x = max(scenes, key=lambda axes: axes[0].distance)

    def predict() -> float:
        if y.distance <= 1e-12:
            return 0.0
        # Rms over the content of the phase pi lambda z f^2, the only change inside the window.
        square = y.moment(4) + x.moment(4) + 2 * y.moment(2) * x.moment(2)
        phase = min(math.pi * y.wavelength * y.distance * math.sqrt(square), 2.0)
        if phase > 0.1:  # large enough to exclude this method without looking at the edges
            return phase
        return max(phase, sum(math.sqrt(axis.standing()) for axis in axes))

    size = (y.size, x.size)
    work = float(math.prod(size))
    return Candidate("identity", (True, True), size, False, predict, lambda: 1.0, work, 0, work)


def _sampled(scenes: list[Axes], padded: tuple[int, ...], dtype: torch.dtype) -> Candidate:
    """The exact transfer function, sampled on both axes."""
    tilted = any(scenes[0][0].tilt)
    wide = not tilted and any(axis.pitch < FINEST * axis.wavelength for axis in scenes[0])

    def predict(axes: Axes) -> float:
        energies = [
            axis.wrapped_slices(length, other, limited=wide) if tilted or wide else axis.wrapped(length)
            for axis, other, length in zip(axes, axes[::-1], padded, strict=True)
        ]
        return math.hypot(math.sqrt(sum(energies)), _rounding(axes, (True, True), dtype))

    return _fft_candidate("angular spectrum", (True, True), (padded[0], padded[1]), False, scenes, predict, dtype)


def _cropped(
    scenes: list[Axes], sampled_axis: tuple[bool, bool], crop_pad: float | None, dtype: torch.dtype
) -> Candidate:
    """Cropped taps on the axes where ``sampled_axis`` is False.

    On the other axes the transfer function is sampled at the largest padding below 2. ``crop_pad`` is the padding for
    the taps and the factor beyond Fresnel; if it is None, this factor is neglected.
    """

    def length(axis: int) -> int:
        along = [axes[axis] for axes in scenes]
        if sampled_axis[axis]:
            return _lengths(along[0], _PADS)[-1]
        return good_length(
            along[0].size + along[0].window - 1
            if crop_pad is None
            else max(_crop_length(each, crop_pad) for each in along),
            odd=any(along[0].tilt),
        )

    lengths = length(0), length(1)

    def predict(axes: Axes) -> float:
        if any(axes[0].tilt):
            # A measured field may have its light where both axes crop it. The sum of the errors of the two axes is then
            # too small, so it is scaled up.
            mixing = 1 if axes[0].measured is None else 1 + sum(sine != 0 for sine in axes[0].tilt)
            taps = mixing * math.sqrt(_tilted_taps(axes, lengths, paraxial=False))
            return math.hypot(_rounding(axes, sampled_axis, dtype), taps)
        energies = [_rounding(axes, sampled_axis, dtype) ** 2, 0.0]
        if crop_pad is None:
            energies[1] = max(rms_beyond_fresnel(list(axes)) ** 2, sum(axis.paraxial() for axis in axes))
        for axis, other, padded, keep in zip(axes, axes[::-1], lengths, sampled_axis, strict=True):
            if keep:
                energies.append(axis.wrapped(padded))
            elif crop_pad is not None and other is axis and len(energies) > 2:
                energies.append(energies[-1])
            elif crop_pad is not None:
                # The rms frequency of the other axis represents all of its content.
                energies.append(axis.cropped(padded, math.sqrt(other.moment(2))))
        return math.sqrt(sum(energies))

    method = ("Fresnel" if crop_pad is None else "cropped kernel") + (", one axis sampled" if any(sampled_axis) else "")
    return _fft_candidate(method, sampled_axis, lengths, crop_pad is None, scenes, predict, dtype)


def _resampled(planes: PlanePair, scenes: list[Axes], dtype: torch.dtype, tails: float | None) -> Candidate:
    """Fresnel propagation between two grids of any pitch, as dense matrix products.

    The factor beyond Fresnel is applied first, by FFT on a grid padded for its ``tails`` (``resampled_padding``). If
    ``tails`` is None, this factor is neglected.
    """
    height, width = planes.grid.shape
    wavelength, farthest = scenes[0][0].wavelength, max(axes[0].distance for axes in scenes)
    padded = planes.grid.shape if tails is None else resampled_padding(planes, wavelength, farthest, tails)
    edges = (padded[0] - height) // 2, (padded[1] - width) // 2
    paraxial, tilted = tails is None, any(planes.tilt)

    def predict(axes: Axes) -> float:
        error = _rounding(axes, (False, False), dtype) ** 2
        pairs = list(zip(axes, axes[::-1], padded, strict=True))
        if tilted and paraxial:
            return math.sqrt(error + _tilted_taps(axes, padded, paraxial=True))
        if tilted:
            return math.sqrt(error + sum(axis.resampled_slices(length, other) for axis, other, length in pairs))
        if paraxial:
            return math.sqrt(error + max(rms_beyond_fresnel(list(axes)) ** 2, sum(axis.paraxial() for axis in axes)))
        for axis, other, length in pairs:
            error += axis.resampled(length, math.sqrt(other.moment(2)))
        return math.sqrt(error)

    padded_height, padded_width = height + 2 * edges[0], width + 2 * edges[1]
    products = 8.0 * planes.out.shape[0] * padded_width * (padded_height + planes.out.shape[1])
    transforms = 0.0 if paraxial else _transforms(math.prod(padded))
    memory = dtype.itemsize * (
        planes.out.shape[0] * (padded_height + padded_width)
        + planes.out.shape[1] * padded_width
        + 3 * math.prod(padded)
        + math.prod(planes.out.shape)
    )
    method = "resampled Fresnel" if paraxial else "resampled kernel"
    return Candidate(
        method,
        (False, False),
        padded,
        paraxial,
        lambda: max(predict(axes) for axes in scenes),
        lambda: _captured(scenes),
        products + transforms,
        memory,
        products / _PRODUCT_SPEED + transforms,
    )


def _zoomed(planes: PlanePair, scenes: list[Axes], padded: tuple[int, ...], dtype: torch.dtype) -> Candidate:
    """The sampled transfer function; a chirp-z transform evaluates the result at the points of the other grid."""
    candidate = _sampled(scenes, padded, dtype)
    lines = 0.0
    for size, count, number in zip(padded, planes.out.shape, (planes.out.shape[1], padded[0]), strict=True):
        length = good_length(size + count - 1)
        lines += 10 * number * length * math.log2(length)
    flops = candidate.flops / 2 + lines
    memory = candidate.memory + 2 * dtype.itemsize * max(padded[0], planes.out.shape[0]) * (
        padded[1] + planes.out.shape[1]
    )
    return replace(candidate, method="angular spectrum, zoomed", flops=flops, cost=flops, memory=memory)


def _crop_length(axis: AxisContent, crop_pad: float) -> int:
    return crop_length(axis.size, axis.window, axis.pitch, axis.wavelength, axis.distance, axis.shift, crop_pad)


def _rounding(axes: Axes, sampled: tuple[bool, bool], dtype: torch.dtype) -> float:
    """Rounding error of the transforms, relative to the light that arrives in the window.

    A sampled transfer function keeps all light on the padded grid, and its rounding is relative to all of it; cropped
    taps keep only the light that arrives.
    """
    left = math.prod(axis.captured for axis, keep in zip(axes, sampled, strict=True) if keep)
    return 3 * torch.finfo(dtype).eps / math.sqrt(max(left, 1e-12))


def _transforms(samples: int) -> float:
    return 10 * samples * math.log2(max(2, samples)) + 6 * samples


def _fft_candidate(
    method: str,
    sampled: tuple[bool, bool],
    padded: tuple[int, int],
    paraxial: bool,
    scenes: list[Axes],
    predict: Callable[[Axes], float],
    dtype: torch.dtype,
) -> Candidate:
    samples = math.prod(padded)
    flops = _transforms(samples)
    memory = 4 * samples * dtype.itemsize
    return Candidate(
        method,
        sampled,
        padded,
        paraxial,
        lambda: max(predict(axes) for axes in scenes),
        lambda: _captured(scenes),
        flops,
        memory,
        flops,
    )


def _tilted_taps(axes: Axes, lengths: tuple[int, ...], *, paraxial: bool) -> float:
    return sum(
        axis.tilted_taps(length, other, paraxial=paraxial)
        for axis, other, length in zip(axes, axes[::-1], lengths, strict=True)
    )


def _captured(scenes: list[Axes]) -> float:
    return min(math.prod(axis.captured for axis in axes) for axes in scenes)
