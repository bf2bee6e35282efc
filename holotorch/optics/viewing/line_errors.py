"""Errors of both methods to the retina, measured on single lines of a field.

Many causes add up to the error of a method: light that wraps around in a transform or leaves its window, because the
spots of a hard pupil have long tails; samples across the edges of pupil and eyepiece; oblique paths that the collapse
approximates. Each acts along y and along x. Light that varies along one axis only, such as that of one row of a
hologram, has all of them, and costs so little that a method can simply be compared with element-by-element propagation
of far more samples. The errors of the two axes differ in sign and place, and their squares add up.

A line sees the pupil as a slit, whose spots have pi / 4 of the energy of those of a disc in their tails: the transfer
functions fall from their peaks with slopes of this ratio.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.fourier import fft2, good_length, ifft2, multiplied
from holotorch.core.grid import Grid
from holotorch.optics.free_space.kernels import angular_spectrum_kernel
from holotorch.optics.viewing.display import Display, number
from holotorch.optics.viewing.elementwise import ElementSampling, least_oversampling, propagate_elements
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.imaging import CollapseSampling, propagate_collapsed
from holotorch.optics.viewing.rays import samples_for_all_light

Sampling = CollapseSampling | ElementSampling
Lines = tuple[Tensor | None, Tensor | None]  # complex128 [L, n] along y and x; None for an axis of one sample

_LINES = 16  # per axis, fewer if their transforms together have more samples than _SAMPLES
_SAMPLES = 2**20
_LONGEST = 2**22  # samples of the transform of one line: two seconds for each wavelength, focus and axis
_NOISE = 1024  # samples of noise per axis, for which fewer lines suffice if they are long; errors vary by about 10 %
_FINER = 1.5  # samples of the reference for each that element-by-element propagation needs
_WIDER = 2.0  # width of the reference's window relative to that of element-by-element propagation
# Softness of edges on the elements, in samples. Where a hard edge lies between samples matters at the two ends of a
# slit, while it averages out around a disc.
_SOFTNESS = 0.5


def noise_lines(grid: Grid) -> Lines:
    """Lines of complex white noise, which fills the window and the band of ``grid``; the seed is fixed."""
    return _both_axes(grid, lambda size, pitch: _noise(size))


def scene_lines(grid: Grid, wavelength: float, plane: float, half_width: float) -> Lines:
    """Lines of a hologram of white noise in the plane ``plane`` within ``half_width`` of the axis, in metres."""

    def light(size: int, pitch: float) -> Tensor:
        points = 2 * math.floor(half_width / pitch) + 1
        enough = samples_for_all_light(points, size, pitch, wavelength, plane)
        padded = Grid((1, good_length(math.ceil(max(enough, points, size)))), pitch)
        _check_length(padded.shape[1])
        kernel = angular_spectrum_kernel(padded, wavelength, -plane, band_limit=False)
        spectrum = multiplied(fft2(_affordable(_noise(points), padded.shape[1])[:, None], padded.shape), kernel)
        return ifft2(spectrum, (1, size), (0, (points // 2 - size // 2) % padded.shape[1]))[:, 0]

    return _both_axes(grid, light)


def field_lines(field: Tensor) -> Lines:
    """Columns and rows of ``field`` [..., H, W], those at equal steps of the energy that they hold together."""
    stack = field.detach().to("cpu", torch.complex128).reshape(-1, *field.shape[-2:])
    lines = []
    for fields in (stack.transpose(-1, -2), stack):
        candidates = fields.reshape(-1, fields.shape[-1])
        energy = intensity(candidates).sum(-1).cumsum(0)
        steps = (torch.arange(_LINES, dtype=torch.float64) + 0.5) / _LINES * energy[-1]
        chosen = torch.searchsorted(energy, steps).clamp(max=len(candidates) - 1)
        lines.append(candidates[chosen] if candidates.shape[-1] > 1 else None)
    return lines[0], lines[1]


def line_errors(
    lines: Sequence[Lines],
    grid: Grid,
    wavelengths: Sequence[float],
    display: Display,
    eye: Eye,
    plane: float,
    samplings: Sequence[Sampling],
    *,
    paraxial: bool = False,
    dtype: torch.dtype = torch.complex128,
) -> list[float]:
    """Relative L2 error of the intensity of all channels together, for each method with its sizes in ``samplings``.

    ``lines`` are those of the hologram for each wavelength, and ``dtype`` is the type of the fields of the methods. The
    other arguments are those of ``propagate_collapsed``. See the text of this module. ValueError if the light of a line
    spreads over too many samples.
    """
    display, eye = _without_gradients(display), _without_gradients(eye)
    least = least_oversampling(grid, wavelengths, display, eye, plane=plane)
    total, squares = 0.0, torch.zeros(len(samplings), dtype=torch.float64)
    for channel, wavelength in zip(lines, wavelengths, strict=True):
        parts, known = [], {}
        for axis, light in enumerate(channel):
            if light is None:
                continue
            sizes = tuple(_of_axis(sampling, axis) for sampling in samplings)
            key = id(light), grid.pitch[axis], sizes  # equal axes have equal errors
            if key not in known:
                line, finer = Grid((1, light.shape[1]), grid.pitch[axis]), _finer(least, axis)
                _check_length(finer.fine[1])
                light = _affordable(light, finer.fine[1])
                steps = [_pupil_step(sampling, line, wavelength, display, plane) for sampling in sizes]
                setup = line, wavelength, display, _between_samples(eye, max(steps)), plane, paraxial
                exact = _image(light, finer, *setup)
                images = [_image(light.to(dtype), sampling, *setup) for sampling in sizes]
                squares_of = [(image - exact).square().sum() for image in images]
                known[key] = exact.square().sum() / len(light), torch.stack(squares_of) / len(light)
            parts.append(known[key])
        energy = sum(exact for exact, _ in parts) / len(parts)
        squares += energy * sum(error / exact.clamp_min(1e-300) for exact, error in parts)
        total += energy
    return (squares / max(total, 1e-300)).sqrt().tolist()


def _image(
    light: Tensor,
    sampling: Sampling,
    line: Grid,
    wavelength: float,
    display: Display,
    eye: Eye,
    plane: float,
    paraxial: bool,
) -> Tensor:
    """Intensity on the retina of lines [L, n] by the method of ``sampling``, float64."""
    setup = light[:, None, None], line, wavelength, display
    with warnings.catch_warnings(action="ignore", category=SamplingWarning):  # for a pupil a fraction of a sample wider
        if isinstance(sampling, CollapseSampling):
            field = propagate_collapsed(*setup, eye, plane=plane, sampling=sampling, paraxial=paraxial)
        else:
            eye = replace(eye, softness=max(eye.softness, _SOFTNESS * line.pitch[1] / sampling.oversampling[1]))
            field = propagate_elements(*setup, eye, plane=plane, sampling=sampling, paraxial=paraxial)
    return intensity(field).double()


def _pupil_step(sampling: Sampling, line: Grid, wavelength: float, display: Display, plane: float) -> float:
    """Distance in metres between samples of the pupil in the collapse, 0 for elements."""
    if isinstance(sampling, ElementSampling):
        return 0.0
    return wavelength * abs(number(display.matrix(plane)[1])) / (sampling.window[1] * line.pitch[1])


def _between_samples(eye: Eye, step: float) -> Eye:
    """The eye with the edge of its pupil half-way between samples, where their number does not change the brightness.

    Of a disc, whose edge lies anywhere between samples, the changes average out.
    """
    return replace(eye, pupil_radius=(math.floor(eye.pupil_radius / step) + 0.5) * step) if step else eye


def _of_axis(sampling: Sampling, axis: int) -> Sampling:
    """The sampling of a line along ``axis``."""
    sizes = {key: (type(value[axis])(1), value[axis]) for key, value in vars(sampling).items()}
    return replace(sampling, **sizes)


def _finer(sampling: ElementSampling, axis: int) -> ElementSampling:
    """The sampling of the reference for a line along ``axis``."""
    padded, fine = _WIDER * sampling.padded[axis], _FINER * _WIDER * sampling.fine[axis]
    return ElementSampling(
        (1.0, _FINER * sampling.oversampling[axis]),
        (1, good_length(math.ceil(padded))),
        (1, good_length(math.ceil(fine))),
    )


def _check_length(samples: int) -> None:
    """ValueError if the transform of a line takes too long."""
    if samples > _LONGEST:
        raise ValueError(
            f"the light of a row of the hologram spreads over {samples:.2g} samples, expected {_LONGEST:.2g} at most; "
            "bring eyepiece and eye nearer to the hologram, or use a coarser pitch"
        )


def _affordable(lines: Tensor, samples: int) -> Tensor:
    """As many of ``lines`` [L, n], at equal steps, as there is time for with transforms of ``samples``; at least 1."""
    return lines[:: math.ceil(len(lines) / max(1, min(len(lines), _SAMPLES // samples)))]


def _without_gradients(lengths: Any) -> Any:
    """A display or an eye with all its tensors as numbers."""
    return replace(lengths, **{key: number(v) if isinstance(v, Tensor) else v for key, v in vars(lengths).items()})


def _both_axes(grid: Grid, light: Callable[[int, float], Tensor]) -> Lines:
    """``light(size, pitch)`` for both axes, one tensor for equal axes."""
    y, x = zip(grid.shape, grid.pitch, strict=True)
    row = light(*x) if x[0] > 1 else None
    return (row if y == x else light(*y) if y[0] > 1 else None), row


def _noise(count: int) -> Tensor:
    """Lines of complex white noise, complex128 [L, count]."""
    lines = min(max(_NOISE // count, _LINES // 4), _LINES)
    return torch.randn(lines, count, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
