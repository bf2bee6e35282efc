"""Every method of propagation, with its predicted error and its cost.

The factor beyond Fresnel is the exact transfer function divided by Fresnel's, both without the factor exp(ikz). The
taps of a method are the samples of its impulse response.
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

ZOOMED = "angular spectrum, zoomed"  # method that reads the result on another grid by chirp-z transforms
_PADS = (1.0, 1.03125, 1.0625, 1.125, 1.25, 1.5)  # padding factors of a sampled transfer function that are tried
_WIDE_PADS = (2.0, 3.0, 4.0, 6.0, 8.0)  # further padding factors for steep, tilted or displaced light
_CROP_PADS = (2.0, CROP_PAD)  # values of ``pad`` in crop_length that are tried
_TAILS = (0.125, 0.5, 1.5)  # values of ``tails`` in resampled_padding that are tried
_PRODUCT_SPEED = 4.0  # operations of a dense product in the time of one operation of an FFT

Axes = tuple[AxisContent, AxisContent]  # (y, x) at one distance


@dataclass(frozen=True)
class Method:
    """One method of propagation.

    Attributes:
        method: Name of the method.
        sampled: Per axis (y, x), True if the transfer function is sampled in frequency; False if the impulse response
            is sampled in space and cropped to the displacements between source and window.
        padded: Samples (y, x) of the transforms.
        paraxial: Whether the factor beyond Fresnel is neglected.
    """

    method: str
    sampled: tuple[bool, bool]
    padded: tuple[int, int]
    paraxial: bool


@dataclass(frozen=True)
class Candidate(Method):
    """A method with its cost and its error, which is computed at the first access.

    Attributes:
        scenes: Light of both axes at each distance that bounds the error, at the longest wavelength.
        predict: Computes the expected relative L2 error of one of the ``scenes``.
        flops: Floating-point operations of one call.
        memory: Largest extra memory of one call, in bytes.
        cost: ``flops``, with the operations of dense products divided by their relative speed.
    """

    scenes: list[Axes]
    predict: Callable[[Axes], float]
    flops: float
    memory: int
    cost: float

    @property
    def label(self) -> str:
        """Method and samples, for messages."""
        return f"{self.method} on {self.padded[0]} x {self.padded[1]} samples"

    @cached_property
    def error(self) -> float:
        """Expected relative L2 error, the largest one of the scenes."""
        return max(map(self.predict, self.scenes))

    @property
    def plain(self) -> Method:
        """The method alone."""
        return Method(self.method, self.sampled, self.padded, self.paraxial)

    def captured(self) -> float:
        """Product over both axes of :attr:`AxisContent.captured`, the smallest one of the scenes."""
        return min(math.prod(axis.captured for axis in axes) for axes in self.scenes)


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
    longest = max(wavelengths)
    scenes = [_axes(planes, longest, distance, content) for distance in _extremes(planes, distances)]
    options = [_identity(scenes)] if planes.straight else []
    if planes.straight and not any(distances):
        return options
    wide, tilted = min(planes.grid.pitch) < FINEST * longest, any(planes.tilt)
    if not planes.same_pitch:
        dense = [] if wide else [_resampled(planes, scenes, dtype, tails) for tails in (None, *_TAILS)]
        pairs = zip(*(_lengths(axis, _PADS + _WIDE_PADS) for axis in scenes[0]), strict=False)
        return dense + [_zoomed(planes, scenes, pair, dtype) for pair in pairs]
    symmetric = scenes[0][0] is scenes[0][1]
    pads = _PADS + (_WIDE_PADS if wide or tilted or planes.out != planes.grid else ())
    lengths = [_lengths(axis, pads) for axis in scenes[0]]
    pairs = zip(*lengths, strict=False) if symmetric or wide or tilted else itertools.product(*lengths)
    options += [_sampled(scenes, pair, dtype) for pair in pairs]
    if wide:
        return options
    mixed = [] if symmetric or tilted or planes.out != planes.grid else [(True, False), (False, True)]
    crop_pads = [*_CROP_PADS, 3.0, 4.0] if tilted else [None, *_CROP_PADS]
    return options + [
        _cropped(scenes, sampled, crop_pad, dtype) for sampled in [(False, False), *mixed] for crop_pad in crop_pads
    ]


def _extremes(planes: PlanePair, distances: Sequence[float]) -> list[float]:
    """Distances that bound the error: the longest one, or both ends of the range if ``planes`` is not straight."""
    if planes.straight:
        return [max(map(abs, distances)) or 1e-12]
    return list(dict.fromkeys(z or 1e-12 for z in (min(distances), max(distances))))


def _axes(planes: PlanePair, wavelength: float, distance: float, content: FieldContent) -> Axes:
    """Light of both axes for the prediction of errors in a window of the source's pitch."""
    same_pitch = planes.same_pitch
    if not same_pitch:
        # The window covers the result and one sample more on each side. Its samples are a quarter of a pitch off those
        # of the source. Other positions would underestimate the error: on the source's samples the tails of the content
        # are zero, and half-way between them the contributions of the two ends of the band cancel.
        height, width = (
            math.ceil(extent / pitch) + 2 for extent, pitch in zip(planes.out.extent, planes.grid.pitch, strict=True)
        )
        planes = PlanePair(planes.grid, Grid((height, width), planes.grid.pitch), planes.offset, planes.tilt)
    geometry = (torch.tensor(value, dtype=torch.float64) for value in (distance, planes.tilt))
    positions = [position.item() for position in shifts(planes, *geometry)]
    # Light that travels backward is the conjugate of light that travels forward with the opposite tilt.
    backward = distance < 0
    signals = [signal.conj() if backward else signal for signal in content.signals or ()]
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
            positions[axis] if same_pitch else round(positions[axis]) + 0.25,
            (sines[axis], sines[1 - axis]),
            signals[axis] if signals else None,
        )
        for axis in (0, 1)
    )
    # Equal axes share one object, so that its cached results are computed once.
    return (y, y) if y == x and content.signals is None else (y, x)


def _lengths(axis: AxisContent, pads: tuple[float, ...]) -> list[int]:
    """Different lengths of transforms for the padding factors ``pads``, in increasing order."""
    largest = max(axis.size, axis.window)
    lengths = (largest if pad == 1 else good_length(math.ceil(largest * pad)) for pad in pads)
    return list(dict.fromkeys(lengths))


def _identity(scenes: list[Axes]) -> Candidate:
    """The unchanged field, times exp(ikz)."""

    def predict(axes: Axes) -> float:
        y, x = axes
        if y.distance <= 1e-12:
            return 0.0
        # Rms over the content of the phase pi lambda z f^2, the only change inside the window.
        square = y.moment(4) + x.moment(4) + 2 * y.moment(2) * x.moment(2)
        phase = min(math.pi * y.wavelength * y.distance * math.sqrt(square), 2.0)
        if phase > 0.1:  # large enough to exclude this method without the error at the edges
            return phase
        return max(phase, sum(math.sqrt(axis.unchanged()) for axis in axes))

    size = (scenes[0][0].size, scenes[0][1].size)
    flops = float(math.prod(size))
    return Candidate("identity", (True, True), size, False, scenes, predict, flops, 0, flops)


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

    sampled, costs = (True, True), _fft_costs(padded, dtype)
    return Candidate("angular spectrum", sampled, (padded[0], padded[1]), False, scenes, predict, *costs)


def _cropped(scenes: list[Axes], sampled: tuple[bool, bool], crop_pad: float | None, dtype: torch.dtype) -> Candidate:
    """Cropped taps on the axes where ``sampled`` is False.

    On the other axes the transfer function is sampled at the largest one of ``_PADS``. ``crop_pad`` is the padding
    (``pad`` in ``crop_length``) of the taps times the factor beyond Fresnel; if it is None, this factor is neglected.
    """

    def length(axis: int) -> int:
        first = scenes[0][axis]
        if sampled[axis]:
            return _lengths(first, _PADS)[-1]
        least = first.size + first.window - 1
        if crop_pad is not None:
            least = max(
                crop_length(x.size, x.window, x.pitch, x.wavelength, x.distance, x.shift, crop_pad)
                for x in (axes[axis] for axes in scenes)
            )
        return good_length(least, odd=any(first.tilt))

    lengths = length(0), length(1)

    def predict(axes: Axes) -> float:
        if any(axes[0].tilt):
            # A measured field may have its light at frequencies where both axes have errors. The sum of the errors of
            # the two axes is then too small and is scaled up.
            mixing = 1 if axes[0].measured is None else 1 + sum(sine != 0 for sine in axes[0].tilt)
            taps = mixing * math.sqrt(_tilted_taps(axes, lengths, paraxial=False))
            return math.hypot(_rounding(axes, sampled, dtype), taps)
        energies = [_rounding(axes, sampled, dtype) ** 2, _paraxial(axes) if crop_pad is None else 0.0]
        for axis, other, padded, keep in zip(axes, axes[::-1], lengths, sampled, strict=True):
            if keep:
                energies.append(axis.wrapped(padded))
            elif crop_pad is not None and other is axis and len(energies) > 2:
                energies.append(energies[-1])
            elif crop_pad is not None:
                # The rms frequency of the other axis represents all of its content.
                energies.append(axis.cropped(padded, math.sqrt(other.moment(2))))
        return math.sqrt(sum(energies))

    method = ("Fresnel" if crop_pad is None else "cropped kernel") + (", one axis sampled" if any(sampled) else "")
    return Candidate(method, sampled, lengths, crop_pad is None, scenes, predict, *_fft_costs(lengths, dtype))


def _resampled(planes: PlanePair, scenes: list[Axes], dtype: torch.dtype, tails: float | None) -> Candidate:
    """Fresnel propagation between two grids of any pitch, as dense matrix products.

    The factor beyond Fresnel is applied first, by FFT on a grid padded for its ``tails`` (``resampled_padding``). If
    ``tails`` is None, this factor is neglected.
    """
    (height, width), (out_height, out_width) = planes.grid.shape, planes.out.shape
    wavelength, distance = scenes[0][0].wavelength, max(axes[0].distance for axes in scenes)
    padded = planes.grid.shape if tails is None else resampled_padding(planes, wavelength, distance, tails)
    paraxial, tilted = tails is None, any(planes.tilt)

    def predict(axes: Axes) -> float:
        energy = _rounding(axes, (False, False), dtype) ** 2
        pairs = list(zip(axes, axes[::-1], padded, strict=True))
        if tilted and paraxial:
            energy += _tilted_taps(axes, padded, paraxial=True)
        elif tilted:
            energy += sum(axis.resampled_slices(length, other) for axis, other, length in pairs)
        elif paraxial:
            energy += _paraxial(axes)
        else:
            for axis, other, length in pairs:
                energy += axis.resampled(length, math.sqrt(other.moment(2)))
        return math.sqrt(energy)

    # The products use the source and an equal margin on both sides of it.
    rows, columns = (n + 2 * ((p - n) // 2) for n, p in zip((height, width), padded, strict=True))
    products = 8.0 * out_height * columns * (rows + out_width)
    transforms = 0.0 if paraxial else _transforms(math.prod(padded))
    samples = out_height * (rows + columns + out_width) + out_width * columns + 3 * math.prod(padded)
    method, cost = "resampled Fresnel" if paraxial else "resampled kernel", products / _PRODUCT_SPEED + transforms
    flops, memory = products + transforms, dtype.itemsize * samples
    return Candidate(method, (False, False), padded, paraxial, scenes, predict, flops, memory, cost)


def _zoomed(planes: PlanePair, scenes: list[Axes], padded: tuple[int, ...], dtype: torch.dtype) -> Candidate:
    """The sampled transfer function; a chirp-z transform evaluates the result at the points of the other grid."""
    candidate = _sampled(scenes, padded, dtype)
    (rows, columns), (height, width) = padded, planes.out.shape
    transforms = (width, good_length(rows + height - 1)), (rows, good_length(columns + width - 1))  # lines, samples
    flops = candidate.flops / 2 + sum(10 * lines * n * math.log2(n) for lines, n in transforms)
    memory = candidate.memory + 2 * dtype.itemsize * max(rows, height) * (columns + width)
    return replace(candidate, method=ZOOMED, flops=flops, cost=flops, memory=memory)


def _rounding(axes: Axes, sampled: tuple[bool, bool], dtype: torch.dtype) -> float:
    """Rounding error of the transforms, relative to the light that arrives in the window.

    A sampled transfer function keeps all light on the padded grid, and its rounding error is relative to all light;
    cropped taps keep only the light that arrives.
    """
    arriving = math.prod(axis.captured for axis, keep in zip(axes, sampled, strict=True) if keep)
    return 3 * torch.finfo(dtype).eps / math.sqrt(max(arriving, 1e-12))


def _transforms(samples: int) -> float:
    """Floating-point operations of a transform, a product with a kernel and the inverse transform."""
    return 10 * samples * math.log2(max(2, samples)) + 6 * samples


def _fft_costs(padded: tuple[int, ...], dtype: torch.dtype) -> tuple[float, int, float]:
    """``flops``, ``memory`` and ``cost`` of a candidate that filters a padded field."""
    flops = _transforms(math.prod(padded))
    return flops, 4 * math.prod(padded) * dtype.itemsize, flops


def _paraxial(axes: Axes) -> float:
    """Energy of the error of neglecting the factor beyond Fresnel."""
    return max(rms_beyond_fresnel(axes) ** 2, sum(axis.paraxial() for axis in axes))


def _tilted_taps(axes: Axes, lengths: tuple[int, ...], *, paraxial: bool) -> float:
    """Sum over both axes of :meth:`AxisContent.tilted_taps` on transforms of ``lengths``."""
    return sum(
        axis.tilted_taps(length, other, paraxial=paraxial)
        for axis, other, length in zip(axes, axes[::-1], lengths, strict=True)
    )
