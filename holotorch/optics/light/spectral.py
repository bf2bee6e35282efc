"""Images under a spectrum: few wavelengths are propagated, and images at nearby wavelengths are derived from them.

In the Fresnel model and without the carrier, a fixed hologram H under light of wavelength lambda produces at distance z
the field U with FT[U](f) = exp(-i pi lambda z f^2) FT[H](f). Only the product of wavelength and distance enters, so a
change of wavelength acts like a change of depth:

    FT[U'](f) = exp(-i pi (lambda' - lambda) z f^2) FT[U](f).

The field on the retina is the part of U exp(i pi A x^2 / (lambda B)) that the pupil transmits, where A and B are
elements of the ray transfer matrix (:mod:`holotorch.optics.viewing.imaging`). Divided by this parabolic phase, it is U
as limited by the pupil, and the equation above gives the field at the neighbouring wavelength by two transforms. An
error remains, because the result has the pupil of the propagated wavelength. The true pupil transmits fixed directions
and therefore cuts off a fraction 2 |lambda' - lambda| / lambda more, or less, of the light at its edge. This error
limits the difference in wavelength between neighbours; speckle, which changes about every nanometre, does not.
"""

import math
import warnings
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity
from holotorch.core.fourier import centred_fft2, centred_ifft2
from holotorch.core.grid import Grid
from holotorch.core.precision import double
from holotorch.optics.free_space.kernels import cycles_phasor
from holotorch.optics.light.incoherent import incoherent_sum
from holotorch.optics.light.wavelength_sampling import error_free, least_count, pupil_exceeds_band, select_wavelengths
from holotorch.optics.viewing.display import Display, number
from holotorch.optics.viewing.elementwise import propagate_elements
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.imaging import propagate_collapsed
from holotorch.optics.viewing.retina import TOLERANCE, scene_error


def neighbours(
    image: Tensor,
    grid: Grid,
    wavelength: float,
    others: Sequence[float],
    display: Display,
    eye: Eye,
    *,
    elements: bool = False,
) -> Iterator[Tensor]:
    """Fields on the retina at wavelengths near that of ``image``, which was propagated there.

    Args:
        image: Field on the retina, complex [..., H, W], from :func:`propagate_collapsed` or
            :func:`propagate_elements` for the plane in focus.
        grid: Sampling of ``image``.
        wavelength: Wavelength of ``image`` in metres.
        others: Wavelengths of the results in metres.
        display: The display with which ``image`` was computed.
        eye: The eye with which ``image`` was computed. Its aberrations and colour error are applied at each wavelength.
        elements: Whether ``image`` comes from :func:`propagate_elements`, which keeps the curvature of the phase.

    Yields:
        Complex [..., H, W] for each of ``others``, one in memory at a time. Near the edges, light from outside ``grid``
        is missing, and light that leaves ``grid`` wraps around; :func:`spectral_image` therefore adds a margin.

    Raises ValueError for an eye with aberrations or colour error whose pupil transmits more than the band of ``grid``.
    """
    centre = checks.wavelengths(wavelength)[0]
    if pupil_exceeds_band(grid, centre, display, eye):
        raise ValueError(
            "the aberrations of this eye cannot be replaced by those at another wavelength, since its pupil transmits "
            "more than the band of the grid; propagate every wavelength, or use a smaller pupil or a finer grid"
        )
    plane = display.focus_plane(eye.accommodation)
    first, second, _, _ = display.matrix(plane)
    curvature = first / second + (eye.axial_length / second**2 if elements else 0.0)
    y, x = grid.coordinates(image.device)
    fy, fx = (torch.fft.fftshift(frequencies) for frequencies in grid.frequencies(image.device))

    def parabola(values: Tensor, rate, rows: Tensor, columns: Tensor) -> Tensor:
        rate = double(rate, values.device)
        by_row, by_column = cycles_phasor(rate * rows.square()), cycles_phasor(rate * columns.square())
        return values * by_row.to(values.dtype) * by_column.to(values.dtype)

    def with_errors(values: Tensor, length: float, sign: int) -> Tensor:
        # Applies the errors of the eye in the plane of its pupil, or removes them with a sign of -1.
        path = eye.path(fy * (length * second), fx * (length * second), length)
        return centred_ifft2(centred_fft2(values) * cycles_phasor(path * (sign / length)).to(values.dtype))

    rate = first / second / 2
    if error_free(eye):
        spectrum = centred_fft2(parabola(image, -curvature / (2 * centre), y, x))
    else:
        lit = parabola(image, (rate - curvature / 2) / centre, y, x)
        spectrum = centred_fft2(parabola(with_errors(lit, centre, -1), -rate / centre, y, x))
    for other in checks.wavelengths(list(others)):
        field = centred_ifft2(parabola(spectrum, -plane * (other - centre) / 2, fy, fx))
        yield field if error_free(eye) else with_errors(parabola(field, rate / other, y, x), other, 1)


def spectral_image(
    field: Tensor,
    grid: Grid,
    wavelengths: Sequence[float] | Tensor,
    weights: Sequence[float] | Tensor,
    display: Display,
    eye: Eye,
    *,
    count: int | None = None,
    tolerance: float | None = None,
    reach: float | None = None,
    elements: bool = False,
    paraxial: bool = False,
    recompute: bool = False,
) -> Tensor:
    """Image of one hologram on the retina under light of many wavelengths, few of which are propagated.

    Args:
        field: Field of the hologram, complex [..., H, W], the same for all wavelengths.
        grid: Sampling of the hologram.
        wavelengths: [K] in metres, increasing, such as those of ``Spectrum.every`` or ``Spectrum.samples``.
        weights: Weights of the wavelengths, at least 0, [K] or [S, K] for S spectra; a tensor may require gradients.
        display: Positions of hologram, eyepiece and eye.
        eye: Pupil, retina and accommodation; the image is that of the plane in focus.
        count: Number of wavelengths to propagate, with equal shares of the power; the others are :func:`neighbours`.
        tolerance: In place of ``count``: accepted error of deriving images instead of propagating each wavelength
            (:func:`neighbour_error`), relative to the mean image.
        reach: Half width in metres of the scene, used with ``tolerance``; that of the hologram by default.
        elements: Use :func:`propagate_elements` instead of :func:`propagate_collapsed`.
        paraxial: Passed to the propagation function.
        recompute: As in :func:`incoherent_sum`, for each propagated wavelength.

    Returns:
        Intensity [..., H, W] or [S, ..., H, W], real, on the coordinates of the plane in focus like ``retinal_image``.

    Raises:
        ValueError: Neither or both of count and tolerance, wavelengths that do not increase, or invalid weights; the
            errors of :func:`neighbours` and of the propagation to the retina.

    Warns SamplingWarning if the expected error of :func:`propagate_collapsed` exceeds 0.1, the default of ``Retina``.
    """
    checks.field("field", field, grid.shape)
    if (count is None) == (tolerance is None):
        raise ValueError(f"give either count or tolerance, got {count!r} and {tolerance!r}")
    given = checks.wavelengths(torch.as_tensor(wavelengths, dtype=torch.float64).tolist())
    lengths = torch.tensor(given, dtype=torch.float64)
    shares = torch.as_tensor(weights, dtype=torch.float64)
    if shares.ndim not in (1, 2) or len(lengths) != shares.shape[-1] or bool((lengths.diff() <= 0).any()):
        got = f"{len(lengths)} wavelengths, weights {tuple(shares.shape)}"
        raise ValueError(f"wavelengths must increase, with one weight each, got {got}")
    if not bool((shares >= 0).all()) or not 0 < shares.sum() < math.inf:
        raise ValueError(f"weights must be at least 0, finite and not all 0, got {shares.tolist()}")
    power = shares.detach().reshape(-1, len(lengths)).sum(0)
    if tolerance is not None:
        count = least_count(lengths, power, tolerance, grid, display, eye, reach=reach)
    nodes, nearest = select_wavelengths(lengths, power, count or 0)
    propagate = propagate_elements if elements else propagate_collapsed
    if not elements:
        _warn_of_collapse(grid, lengths, display, eye, reach, paraxial)
    largest = (lengths - lengths[nodes][nearest]).abs().max().item()
    margin = derived_margin(grid, largest, display, eye)
    wide = Grid((grid.shape[0] + 2 * margin[0], grid.shape[1] + 2 * margin[1]), grid.pitch)
    padded = torch.nn.functional.pad(field, (margin[1], margin[1], margin[0], margin[0]))

    def weighted(image: Tensor, k: int) -> Tensor:
        weight = shares[..., k].to(image.device, image.real.dtype)
        return intensity(image) * weight.reshape(*weight.shape, *(1,) * image.ndim)

    def image_near(node: int) -> Tensor:
        centre = lengths[nodes[node]].item()
        image = propagate(padded[..., None, :, :], wide, [centre], display, eye, paraxial=paraxial)[..., 0, :, :]
        others = [k for k, owner in enumerate(nearest) if owner == node and k != nodes[node]]
        near = lengths[others].tolist()
        images = neighbours(image, wide, centre, near, display, eye, elements=elements) if others else ()
        parts = (weighted(other, k) for k, other in zip(others, images, strict=True))
        return sum(parts, start=weighted(image, nodes[node]))

    total = incoherent_sum(image_near, list(range(len(nodes))), [1.0] * len(nodes), recompute=recompute)
    return total[..., margin[0] : margin[0] + grid.shape[0], margin[1] : margin[1] + grid.shape[1]]


def _warn_of_collapse(
    grid: Grid, lengths: Tensor, display: Display, eye: Eye, reach: float | None, paraxial: bool
) -> None:
    """SamplingWarning, in the name of the caller's caller, if the collapse is less accurate than ``Retina`` allows."""
    middle = lengths[len(lengths) // 2].item()
    error = scene_error(grid, middle, display, eye, reach=reach, paraxial=paraxial)
    if error > TOLERANCE:
        warnings.warn(
            f"spectral_image: the error of propagate_collapsed is about {error:.2g} of the intensity; elements=True "
            "is more accurate and slower, and a smaller reach describes a smaller scene",
            checks.SamplingWarning,
            stacklevel=3,
        )


def derived_margin(grid: Grid, change: float, display: Display, eye: Eye) -> tuple[int, int]:
    """Samples (y, x) by which a change of the wavelength in metres moves the steepest light sideways."""
    plane = abs(number(display.focus_plane(eye.accommodation)))
    y, x = (math.ceil(plane * change / (2 * p**2)) * (n > 1) for n, p in zip(grid.shape, grid.pitch, strict=True))
    return y, x
