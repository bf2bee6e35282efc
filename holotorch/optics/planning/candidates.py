"""Every way to propagate, with its predicted error and its cost."""

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

_PADS = (1.0, 1.03125, 1.0625, 1.125, 1.25, 1.5)
_WIDE_PADS = (2.0, 3.0, 4.0, 6.0, 8.0)
_CROP_PADS = (2.0, CROP_PAD)
_TAILS = (0.125, 0.5, 1.5)  # of resampled_padding
_PRODUCT_SPEED = 4.0  # arithmetic of a dense product that takes the time of 1 in an FFT


@dataclass(frozen=True)
class Candidate:
    """One way to propagate; its error is computed when first asked for.

    Attributes:
        method: Name.
        sampled: Per axis (y, x), whether its transfer function is sampled, or its taps cropped.
        padded: Samples of the transforms.
        paraxial: Whether the factor beyond Fresnel is left out.
        predict: Gives the expected relative L2 error.
        captured: Gives the share of the energy of the content that is expected to land in the window, of several
            wavelengths and distances the least.
        flops: Arithmetic of one call.
        memory: Bytes.
        cost: What candidates are ranked by: ``flops``, those of dense products counted at their speed.
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
    """Every method for ``planes``; its error is the largest one over the wavelengths and distances."""
    if dtype not in (torch.complex64, torch.complex128):
        raise TypeError(f"dtype must be complex64 or complex128, got {dtype}")
    longest, far = max(wavelengths), max(distances, key=abs)
    scenes = [_axes(planes, longest, distance, content) for distance in _extremes(planes, distances)]
    ways = [_identity(scenes)] if planes.straight else []
    if far == 0 and planes.straight:
        return ways
    wide = min(planes.grid.pitch) < FINEST * longest
    if not planes.same_pitch:
        dense = [] if wide else [_resampled(planes, scenes, dtype, tails) for tails in (None, *_TAILS)]
        pairs = zip(*(_lengths(axis, _PADS + _WIDE_PADS) for axis in scenes[0]), strict=False)
        return dense + [_zoomed(planes, scenes, pair, dtype) for pair in pairs]
    alike = scenes[0][0] is scenes[0][1]
    tilted = any(planes.tilt)
    pads = _PADS + (_WIDE_PADS if wide or tilted or planes.out != planes.grid else ())
    lengths = [_lengths(axis, pads) for axis in scenes[0]]
    pairs = zip(*lengths, strict=False) if alike or wide or tilted else itertools.product(*lengths)
    ways += [_sampled(scenes, pair, dtype) for pair in pairs]
    if wide:
        return ways
    masks = (
        [(False, False)]
        if alike or tilted or planes.out != planes.grid
        else [(False, False), (True, False), (False, True)]
    )
    rooms = [*_CROP_PADS, 3.0, 4.0] if tilted else [None, *_CROP_PADS]
    return ways + [_cropped(scenes, mask, room, dtype) for mask in masks for room in rooms]


def _extremes(planes: PlanePair, distances: Sequence[float]) -> list[float]:
    """Distances that stand for all: the farthest, and where the result is aside both ends of their range."""
    if planes.straight:
        return [max(map(abs, distances)) or 1e-12]
    return list(dict.fromkeys(z or 1e-12 for z in (min(distances), max(distances))))


def _axes(planes: PlanePair, wavelength: float, distance: float, content: FieldContent) -> Axes:
    asked = planes
    if not planes.same_pitch:
        # The window of the result in samples of the source, a sample more on each side, and between them: the tails of
        # the content vanish on samples, and the ends of its band half-way cancel.
        height, width = (
            math.ceil(extent / pitch) + 2 for extent, pitch in zip(planes.out.extent, planes.grid.pitch, strict=True)
        )
        planes = PlanePair(planes.grid, Grid((height, width), planes.grid.pitch), planes.offset, planes.tilt)
    places = shifts(planes, torch.tensor(distance, dtype=torch.float64), torch.tensor(planes.tilt, dtype=torch.float64))
    # Light that travels back is the conjugate of light that travels on in the mirrored direction.
    back = distance < 0
    signals = [each.conj() if back else each for each in content.signals or ()]
    sines = [-sine if back else sine for sine in planes.tilt]
    y, x = (
        AxisContent(
            planes.grid.shape[axis],
            planes.grid.pitch[axis],
            content.band[axis],
            wavelength,
            abs(distance),
            content.margin[axis],
            planes.out.shape[axis],
            places[axis].item() if planes == asked else round(places[axis].item()) + 0.25,
            (sines[axis], sines[1 - axis]),
            signals[axis] if signals else None,
        )
        for axis in (0, 1)
    )
    # What one axis has computed serves an equal other one.
    return (y, y) if y == x and content.signals is None else (y, x)


def _lengths(axis: AxisContent, pads: tuple[float, ...]) -> list[int]:
    largest = max(axis.size, axis.window)
    lengths = (largest if pad == 1 else good_length(math.ceil(largest * pad)) for pad in pads)
    return list(dict.fromkeys(lengths))


def _identity(scenes: list[Axes]) -> Candidate:
    """The field as it is, times the carrier."""
    axes = y, x = max(scenes, key=lambda axes: axes[0].distance)

    def predict() -> float:
        if y.distance <= 1e-12:
            return 0.0
        # rms over the content of the phase pi lambda z f^2, which is the whole effect inside the window.
        square = y.moment(4) + x.moment(4) + 2 * y.moment(2) * x.moment(2)
        phase = min(math.pi * y.wavelength * y.distance * math.sqrt(square), 2.0)
        if phase > 0.1:  # much too far to stand still, whatever the edges do
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

    return _way("angular spectrum", (True, True), (padded[0], padded[1]), False, scenes, predict, dtype)


def _cropped(scenes: list[Axes], mask: tuple[bool, bool], room: float | None, dtype: torch.dtype) -> Candidate:
    """Cropped taps where ``mask`` is False, elsewhere a transfer function sampled at the largest padding below 2.

    ``room`` None is paraxial; a number is the padding in which the factor beyond Fresnel finds its room.
    """

    def length(axis: int) -> int:
        own = [axes[axis] for axes in scenes]
        if mask[axis]:
            return _lengths(own[0], _PADS)[-1]
        return good_length(
            own[0].size + own[0].window - 1 if room is None else max(_crop_length(each, room) for each in own),
            odd=any(own[0].tilt),
        )

    lengths = length(0), length(1)

    def predict(axes: Axes) -> float:
        if any(axes[0].tilt):
            # A measured field has its light in few places, where what both axes crop together may weigh more.
            mixing = 1 if axes[0].measured is None else 1 + sum(sine != 0 for sine in axes[0].tilt)
            taps = mixing * math.sqrt(_tilted_taps(axes, lengths, paraxial=False))
            return math.hypot(_rounding(axes, mask, dtype), taps)
        energies = [_rounding(axes, mask, dtype) ** 2, 0.0]
        if room is None:
            energies[1] = max(rms_beyond_fresnel(list(axes)) ** 2, sum(axis.paraxial() for axis in axes))
        for axis, other, padded, keep in zip(axes, axes[::-1], lengths, mask, strict=True):
            if keep:
                energies.append(axis.wrapped(padded))
            elif room is not None and other is axis and len(energies) > 2:
                energies.append(energies[-1])
            elif room is not None:
                # The cross frequency of rms size stands for the whole of the other axis.
                energies.append(axis.cropped(padded, math.sqrt(other.moment(2))))
        return math.sqrt(sum(energies))

    method = ("Fresnel" if room is None else "cropped kernel") + (", one axis sampled" if any(mask) else "")
    return _way(method, mask, lengths, room is None, scenes, predict, dtype)


def _resampled(planes: PlanePair, scenes: list[Axes], dtype: torch.dtype, tails: float | None) -> Candidate:
    """Dense taps between any two grids; the factor beyond Fresnel applied first, with room for its ``tails``.

    None leaves that factor out.
    """
    height, width = planes.grid.shape
    wavelength, far = scenes[0][0].wavelength, max(axes[0].distance for axes in scenes)
    padded = planes.grid.shape if tails is None else resampled_padding(planes, wavelength, far, tails)
    rims = (padded[0] - height) // 2, (padded[1] - width) // 2
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

    tall, broad = height + 2 * rims[0], width + 2 * rims[1]
    products = 8.0 * planes.out.shape[0] * broad * (tall + planes.out.shape[1])
    transforms = 0.0 if paraxial else _transforms(math.prod(padded))
    memory = dtype.itemsize * (
        planes.out.shape[0] * (tall + broad)
        + planes.out.shape[1] * broad
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
    """The sampled transfer function, and the result summed from its spectrum at the points of the other grid."""
    way = _sampled(scenes, padded, dtype)
    lines = 0.0
    for size, count, number in zip(padded, planes.out.shape, (planes.out.shape[1], padded[0]), strict=True):
        length = good_length(size + count - 1)
        lines += 10 * number * length * math.log2(length)
    flops = way.flops / 2 + lines
    memory = way.memory + 2 * dtype.itemsize * max(padded[0], planes.out.shape[0]) * (padded[1] + planes.out.shape[1])
    return replace(way, method="angular spectrum, zoomed", flops=flops, cost=flops, memory=memory)


def _crop_length(axis: AxisContent, room: float) -> int:
    return crop_length(axis.size, axis.window, axis.pitch, axis.wavelength, axis.distance, axis.shift, room)


def _rounding(axes: Axes, sampled: tuple[bool, bool], dtype: torch.dtype) -> float:
    """Rounding of the transforms, relative to what is left of the light in the window.

    A sampled transfer function keeps all light on the padded grid, and rounds against it; cropped taps keep what lands.
    """
    left = math.prod(axis.captured for axis, keep in zip(axes, sampled, strict=True) if keep)
    return 3 * torch.finfo(dtype).eps / math.sqrt(max(left, 1e-12))


def _transforms(samples: int) -> float:
    return 10 * samples * math.log2(max(2, samples)) + 6 * samples


def _way(
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
