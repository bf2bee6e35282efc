"""Which propagator, with how much padding: the cheapest whose predicted error is within the tolerance."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch

from holotorch.core import checks
from holotorch.core.fourier import good_length
from holotorch.core.grid import Grid
from holotorch.core.plan import Plan
from holotorch.optics.predict import AxisContent, rms_beyond_fresnel

FINEST = 0.9  # wavelengths of pitch below which the cropped kernel no longer separates
_PADS = (1.0, 1.03125, 1.0625, 1.125, 1.25, 1.5)
_WIDE_PADS = (2.0, 3.0, 4.0, 6.0, 8.0)
CROP_PAD = 2.25  # of CroppedKernel
_CROP_PADS = (2.0, CROP_PAD)


@dataclass(frozen=True)
class Candidate:
    """One way to propagate; its error is computed when first asked for.

    Attributes:
        method: Name.
        sampled: Per axis (y, x), whether its transfer function is sampled, or its taps cropped.
        padded: Samples of the transforms.
        paraxial: Whether the factor beyond Fresnel is left out.
        predict: Gives the expected relative L2 error.
        flops: Arithmetic of one call.
        memory: Bytes.
    """

    method: str
    sampled: tuple[bool, bool]
    padded: tuple[int, int]
    paraxial: bool
    predict: Callable[[], float]
    flops: float
    memory: int

    @cached_property
    def error(self) -> float:
        """Expected relative L2 error."""
        return self.predict()


def plan_propagation(
    grid: Grid,
    wavelength: float | Sequence[float],
    distance: float | Sequence[float],
    *,
    tolerance: float = 1e-3,
    band: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
    dtype: torch.dtype = torch.complex64,
    memory_limit: int | None = None,
) -> Plan:
    """Choose how to propagate a field over ``distance`` on its own grid.

    Args:
        grid: Sampling of the field.
        wavelength: In metres; of several, the plan serves all.
        distance: In metres, of either sign; likewise.
        tolerance: Largest relative L2 error of the result that is wanted.
        band: Highest frequencies (y, x) of the content in cycles per metre; up to the grid's own by default. The
            prediction is the expectation for noise that fills this band and the window; smoother content does better.
        margin: Widths (y, x) in metres over which the content fades smoothly to nothing at both ends of each axis. By
            default it is cut hard by the window, and the edges diffract.
        dtype: complex64 or complex128, of the field.
        memory_limit: Refuse a plan that needs more bytes than this per channel.

    Raises:
        ValueError: Impossible numbers, or more memory than ``memory_limit``; the message says how to tile.
    """
    return plan_from(
        candidates(grid, wavelength, distance, band=band, margin=margin, dtype=dtype), grid, tolerance, memory_limit
    )


def plan_from(found: list[Candidate], grid: Grid, tolerance: float, memory_limit: int | None = None) -> Plan:
    """The plan for the best of ``found``."""
    best, second = choose(found, checks.positive("tolerance", tolerance))
    adequate = best.error <= tolerance
    size = f"{best.padded[0]} x {best.padded[1]} samples"
    if memory_limit is not None and best.memory > memory_limit:
        raise ValueError(
            f"{best.method} on {size} needs {best.memory / 1e9:.3g} GB per channel, more than the "
            f"{memory_limit / 1e9:.3g} GB allowed; propagate tiles of the source, each padded to the whole window, and "
            "add their results, or use a coarser grid"
        )
    verdict = "the cheapest adequate" if adequate else "the most accurate, though not adequate,"
    reason = (
        f"{best.method} on {size} is {verdict} of {len(found)} ways: predicted error {best.error:.1e} for a tolerance "
        f"of {tolerance:.1e}"
    )
    pad = best.padded[0] / grid.shape[0], best.padded[1] / grid.shape[1]
    return Plan(
        best.method, pad, best.padded, best.error, best.memory, best.flops, reason, _lost(best, second), adequate
    )


def choose(found: list[Candidate], tolerance: float) -> tuple[Candidate, Candidate | None]:
    """The cheapest adequate candidate, or the most accurate if none is, and the one that came next.

    Cheap ones are asked for their error first, and none after the first that is adequate.
    """
    ranked = sorted(found, key=lambda way: (way.flops, not way.paraxial))
    for i, way in enumerate(ranked):
        if way.error <= tolerance:
            rival = ranked[i - 1] if i else ranked[1] if len(ranked) > 1 else None
            return way, rival
    ranked.sort(key=lambda way: way.error)
    return ranked[0], ranked[1] if len(ranked) > 1 else None


def candidates(
    grid: Grid,
    wavelength: float | Sequence[float],
    distance: float | Sequence[float],
    *,
    band: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
    dtype: torch.dtype = torch.complex64,
) -> list[Candidate]:
    """Every way with its predicted error and cost; for several wavelengths and distances the worst of them."""
    waves = checks.wavelengths(wavelength)
    distances = [checks.finite("distance", z, "metres") for z in _listed(distance)]
    bands = _bands(grid, band)
    for rim in margin:
        if checks.finite("margin", rim, "metres") < 0:
            raise ValueError(f"margin must be at least 0 metres, got {rim!r}")
    if dtype not in (torch.complex64, torch.complex128):
        raise TypeError(f"dtype must be complex64 or complex128, got {dtype}")
    longest, far = max(waves), max(abs(z) for z in distances)
    ways = [_identity(grid, longest, far, bands)]
    if far == 0:
        return ways
    axes = [
        AxisContent(size, pitch, limit, longest, far, rim)
        for size, pitch, limit, rim in zip(grid.shape, grid.pitch, bands, margin, strict=True)
    ]
    if axes[0] == axes[1]:
        axes[1] = axes[0]  # what it has computed serves both
    lengths = [_lengths(axis, _PADS) for axis in axes]
    pairs = zip(*lengths, strict=False) if axes[0] == axes[1] else itertools.product(*lengths)
    ways += [_sampled(axes, pair, dtype) for pair in pairs]
    if min(grid.pitch) < FINEST * longest:
        wide = zip(*(_lengths(axis, _WIDE_PADS) for axis in axes), strict=False)
        return ways + [_sampled(axes, pair, dtype) for pair in wide]
    for mask in ((False, False),) if axes[0] == axes[1] else ((False, False), (True, False), (False, True)):
        ways += [_cropped(axes, mask, room, dtype) for room in (None, *_CROP_PADS)]
    return ways


def _lengths(axis: AxisContent, pads: tuple[float, ...]) -> list[int]:
    lengths = (axis.size if pad == 1 else good_length(math.ceil(axis.size * pad)) for pad in pads)
    return list(dict.fromkeys(lengths))


def _sampled(axes: list[AxisContent], padded: tuple[int, ...], dtype: torch.dtype) -> Candidate:
    """The exact transfer function, sampled on both axes."""

    def predict() -> float:
        energies = [axis.wrapped(length) for axis, length in zip(axes, padded, strict=True)]
        return math.hypot(math.sqrt(sum(energies)), _rounding(axes, (True, True), dtype))

    return _way("angular spectrum", (True, True), (padded[0], padded[1]), False, predict, dtype)


def _cropped(axes: list[AxisContent], mask: tuple[bool, bool], room: float | None, dtype: torch.dtype) -> Candidate:
    """Cropped taps where ``mask`` is False, elsewhere a transfer function sampled at the largest padding below 2.

    ``room`` None is paraxial; a number is the padding in which the factor beyond Fresnel finds its room.
    """
    lengths = [
        _lengths(axis, _PADS)[-1]
        if keep
        else good_length(2 * axis.size - 1 if room is None else crop_length(axis, room))
        for axis, keep in zip(axes, mask, strict=True)
    ]

    def predict() -> float:
        energies = [_rounding(axes, mask, dtype) ** 2, 0.0]
        if room is None:
            energies[1] = max(rms_beyond_fresnel(axes) ** 2, sum(axis.paraxial() for axis in axes))
        for axis, other, length, keep in zip(axes, axes[::-1], lengths, mask, strict=True):
            if keep:
                energies.append(axis.wrapped(length))
            elif room is not None and other is axis and len(energies) > 2:
                energies.append(energies[-1])
            elif room is not None:
                # The cross frequency of rms size stands for the whole of the other axis.
                energies.append(axis.cropped(length, other.band / math.sqrt(3)))
        return math.sqrt(sum(energies))

    method = ("Fresnel" if room is None else "cropped kernel") + (", one axis sampled" if any(mask) else "")
    return _way(method, mask, (lengths[0], lengths[1]), room is None, predict, dtype)


def _rounding(axes: list[AxisContent], sampled: tuple[bool, bool], dtype: torch.dtype) -> float:
    """Rounding of the transforms, relative to what is left of the light in the window.

    A sampled transfer function keeps all light on the padded grid, and rounds against it; cropped taps keep what lands.
    """
    left = math.prod(axis.captured for axis, keep in zip(axes, sampled, strict=True) if keep)
    return 3 * torch.finfo(dtype).eps / math.sqrt(max(left, 1e-12))


def crop_length(axis: AxisContent, room: float = CROP_PAD, offset: float = 0.0) -> int:
    """Samples of a transform that holds the taps, and twice what the factor beyond Fresnel adds to their reach."""
    # Light steeper than what lands in the window need not be followed; sqrt(2) for the corner of the band.
    reach = 2 * axis.size * axis.pitch + abs(offset)
    sine = min(math.sqrt(2) * axis.wavelength * axis.nyquist, reach / math.hypot(reach, axis.distance), 0.99)
    shift = axis.distance * (sine / math.sqrt(1 - sine * sine) - sine) if room > 2 else 0.0
    return math.ceil(room * axis.size + 2 * shift / axis.pitch) - 1


def _listed(values: float | Sequence[float]) -> list[float]:
    return list(values) if isinstance(values, Sequence) else [values]


def _bands(grid: Grid, band: tuple[float, float] | None) -> list[float]:
    nyquist = [0.5 / pitch for pitch in grid.pitch]
    if band is None:
        return nyquist
    return [min(checks.positive("band", b, "cycles per metre"), n) for b, n in zip(band, nyquist, strict=True)]


def _identity(grid: Grid, longest: float, far: float, bands: list[float]) -> Candidate:
    # rms over the band of the phase pi lambda z f^2, which is the whole effect but for the carrier.
    square = sum(b**4 / 5 for b in bands) + 2 * bands[0] ** 2 * bands[1] ** 2 / 9
    phase = min(math.pi * longest * far * math.sqrt(square), 2.0)
    return Candidate("identity", (True, True), grid.shape, False, lambda: phase, float(math.prod(grid.shape)), 0)


def _way(
    method: str,
    sampled: tuple[bool, bool],
    padded: tuple[int, int],
    paraxial: bool,
    predict: Callable[[], float],
    dtype: torch.dtype,
) -> Candidate:
    samples = math.prod(padded)
    flops = 10 * samples * math.log2(max(2, samples)) + 6 * samples
    return Candidate(method, sampled, padded, paraxial, predict, flops, 4 * samples * dtype.itemsize)


def _lost(best: Candidate, second: Candidate | None) -> str:
    if second is None:
        return "no other way was considered"
    name = f"{second.method} on {second.padded[0]} x {second.padded[1]} samples"
    if second.flops > best.flops:
        return f"{name} lost by its cost, {second.flops / max(best.flops, 1):.2f} times as much arithmetic"
    return f"{name} lost by its predicted error of {second.error:.1e}"
