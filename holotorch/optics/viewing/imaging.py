"""Collapsed propagation to the retina: eyepiece, eye and the space between them act as one filter on the image.

Derivation. Let (A, B, C, D) be the paraxial ray matrix from an object plane with the field U(x) to the pupil of the
eye (``Display.matrix``), and L the length of that path. The eye accommodates to the distance s, has the axial length
d_r and stands d_eye behind the eyepiece, whose focal length is f_el. In front of the eyepiece are the object plane, at
the distance s0, and its virtual image, at s1 = s0 / (1 - s0 / f_el). By Collins's integral the field on the pupil is

    V(xi) = e^{ikL} / (i lambda B) integral U(x) exp(i pi (A x^2 - 2 x xi + D xi^2) / (lambda B)) dx,

where x and xi are two-dimensional. The eye multiplies V by its pupil function P and by exp(-i pi xi^2 / (lambda f_eye))
with 1 / f_eye = 1 / s + 1 / d_r. Fresnel's integral over d_r gives the field on the retina:

    R(u) = e^{ikd_r} / (i lambda d_r) exp(i pi u^2 / (lambda d_r)) integral P V
           exp(i pi xi^2 (1 / d_r - 1 / f_eye) / lambda) exp(-2 pi i u xi / (lambda d_r)) dxi.

The curvatures of the parabolic phases on the pupil add up to D / B + 1 / d_r - 1 / f_eye = D / B - 1 / s, the defocus.
The defocus vanishes for the plane in focus, where B / D = d_eye + s1, the distance from the virtual image to the eye,
equals s. With the spatial frequency f = xi / (lambda B), the integrals are a Fourier transform and its inverse:

    g(x) = IFT[ P(lambda B f) exp(i pi lambda B (D - B / s) f^2) FT[ U(x) exp(i pi A x^2 / (lambda B)) ](f) ],
    |R(u)| = |B / d_r| |g(-u B / d_r)|,

so the retina shows |g| scaled by -d_r / B, and sum |g|^2 pitch^2 is the power on the retina. The defocus phase moves
the light that crosses the pupil at xi by (D - B / s) xi in the object plane.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.deprecation import renamed
from holotorch.core.fourier import centred_fft2, centred_ifft2, fft2, good_length, ifft2, multiplied
from holotorch.core.grid import Grid
from holotorch.core.precision import double
from holotorch.optics.free_space.kernels import (
    angular_spectrum_kernel,
    carrier,
    cycles_phasor,
    fresnel_kernel,
    window_taper,
)
from holotorch.optics.free_space.zoomed import Chirp, chirps, zoomed
from holotorch.optics.viewing.display import Display, Length, inverse, number
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.rays import fringe_width, samples_for_all_light

_ROOM = 1.02  # factor on frequencies, for light that edges diffract beyond the geometric rays
_FINEST = 64.0  # largest oversampling
_SPOTS = 16  # margin around the window in spot sizes lambda |B| / (2 r), for the long tails of a hard pupil's spot


@dataclass(frozen=True)
class CollapseSampling:
    """Sizes (y, x) of the collapsed propagation from one grid.

    Attributes:
        oversampling: Pitch of the hologram divided by the pitch in the object plane.
        padded: Samples, at the hologram's pitch, of the transform for the propagation to the object plane.
        window: Samples of the object plane at the hologram's pitch, with a margin for defocus and the tails of spots.
        fine: Samples of the same window at the oversampled pitch.
    """

    oversampling: tuple[float, float]
    padded: tuple[int, int]
    window: tuple[int, int]
    fine: tuple[int, int]

    @property
    def plain(self) -> bool:
        """Whether the object plane has the samples of the hologram, within the period of the transform."""
        return self.fine == self.window and all(p >= w for p, w in zip(self.padded, self.window, strict=True))

    @property
    def flops(self) -> float:
        """Floating-point operations for one image of one wavelength, 5 n log2 n for each transform."""
        padded, window, fine = (fft_flops(math.prod(shape)) for shape in (self.padded, self.window, self.fine))
        return padded + (padded if self.plain else zoom_flops(self.padded, self.fine)) + fine + window

    def memory_bytes(self, passed: float, itemsize: int = 8, batch: int = 1) -> int:
        """Largest extra memory in bytes for ``batch`` images of one wavelength, with samples of ``itemsize`` bytes.

        ``passed`` is the number of samples of the spectrum that the pupil transmits, ``window`` times the number of
        :func:`pupil_bands`. The estimate is within 10 % of measurements from 1 GB to 8 GB; below 1 GB it is up to
        0.2 GB too small.
        """
        kernel = 110 * math.prod(self.padded)  # computing the transfer function to the object plane
        lines = 4.2 * itemsize * batch * self.fine[1] * (self.fine[0] + self.padded[0])  # chirp-z transform
        return math.ceil(max(kernel, lines, (88 + 1.5 * itemsize * batch) * passed))


def propagate_collapsed(
    field: Tensor,
    grid: Grid,
    wavelengths: float | Sequence[float],
    display: Display,
    eye: Eye,
    *,
    plane: Length | None = None,
    sampling: CollapseSampling | None = None,
    paraxial: bool = False,
    factors: "Sequence[CollapseFactors] | None" = None,
) -> Tensor:
    """Field on the retina, referred back to the object plane: the g(x) of this module's derivation.

    It neglects the edge of the eyepiece, the non-Fresnel phase behind the eyepiece for points beside the axis, and
    light that leaves the window of ``grid`` before the object plane. ``plan_retina`` predicts the error, which includes
    that of the sampling. Thesis Algorithm 6 instead samples every lens phase at the hologram's pitch, where it aliases.

    Args:
        field: Field of the hologram, complex [..., C, H, W].
        grid: Sampling of the hologram.
        wavelengths: In metres, one per channel.
        display: Positions of hologram, eyepiece and eye.
        eye: Pupil, retina and accommodation. All lengths of eye and display may require gradients.
        plane: Distance in metres from the hologram to the object plane, to which light is propagated first; by default
            the plane in focus. It sets the scale of the result.
        sampling: Sampling of the object plane; :func:`collapse_sampling` by default.
        paraxial: Use Fresnel's model for every distance. Otherwise propagation to the eyepiece is exact, and the pupil
            function includes the spherical aberration that Fresnel's model neglects behind the eyepiece for points on
            the axis: the phase -k / 8 sum_i d_i u_i^4, where d_i are the distances from eyepiece to eye and from eye to
            retina, and u_i the slopes over these distances of the ray through xi.
        factors: Results of :func:`collapse_factors` for these arguments, which are computed by default.

    Returns:
        Complex [..., C, H, W] on ``grid``, upright. A position times :func:`retinal_scale` (negative) is that on the
        retina. The sum of the intensity times both pitches is the power on the retina. The curvature and the factor
        exp(ikz), which do not affect the intensity, are omitted.

    Raises:
        ValueError: The pupil is an image of the object plane (B = 0), or the oversampling would exceed 64.
        MemoryError: The operation would need more memory than is available; raised before anything is allocated.

    Warns:
        SamplingWarning: ``sampling`` is coarser than :func:`collapse_sampling`.
    """
    channel_wavelengths = checks.wavelengths(wavelengths)
    checks.field("field", field, (len(channel_wavelengths), *grid.shape))
    plane = display.object_plane(plane, eye.accommodation)
    least = collapse_sampling(grid, channel_wavelengths, display, eye, plane)
    sizes = sampling or least
    warn_if_coarse(sizes.oversampling, least.oversampling, "an object plane", "aliases into the pupil")
    bands = max(math.prod(pupil_bands(grid, wavelength, display, eye, plane)) for wavelength in channel_wavelengths)
    size, batch = field.dtype.itemsize, field.numel() // max(1, math.prod(field.shape[-3:]))
    checks.affordable(
        sizes.memory_bytes(bands * math.prod(sizes.window), size, batch) + size * field.numel(),
        f"propagate_collapsed() on an object plane of {sizes.fine[0]} x {sizes.fine[1]} samples, "
        f"{max(sizes.oversampling):.3g} times as fine as the hologram's {grid.shape[0]} x {grid.shape[1]},",
        "crop the hologram, pass fewer fields at once, use a smaller pupil, or put the plane farther from the pupil",
        field.device,
    )
    factors = factors or collapse_factors(field, grid, channel_wavelengths, display, eye, plane, sizes, paraxial)
    images = [_image(field[..., c, :, :], grid, sizes, each) for c, each in enumerate(factors)]
    return torch.stack(images, -3)


def retinal_scale(display: Display, eye: Eye, plane: Length | None = None) -> Length:
    """Metres on the retina per metre in the object plane, -d_r / B: negative, since the image is upside down."""
    plane = display.object_plane(plane, eye.accommodation)
    return -eye.axial_length / display.matrix(plane)[1]


def pupil_bands(grid: Grid, wavelength: float, display: Display, eye: Eye, plane: Length) -> tuple[int, int]:
    """Odd numbers (y, x) of bands of width 1 / pitch that cover the frequencies which the pupil transmits.

    The frequencies are those of the field in the object plane times its parabolic phase, which shifts the light of
    points beside the axis beyond 1 / (2 pitch).
    """
    highest = (number(eye.pupil_radius) + 8 * eye.softness) / (wavelength * abs(number(display.matrix(plane)[1])))
    y, x = (2 * math.ceil(max(0.0, pitch * highest * _ROOM - 0.5)) + 1 for pitch in grid.pitch)
    return y, x


def collapse_sampling(
    grid: Grid, wavelengths: Sequence[float], display: Display, eye: Eye, plane: Length
) -> CollapseSampling:
    """Coarsest sampling of the object plane that keeps aliases out of the pupil.

    In the object plane the field times its parabolic phase (this module's derivation) has frequencies up to
    F = 1 / (2 pitch) + |A| x / (lambda |B|), where x is the edge of the window. They may alias as long as no alias
    falls into the pass-band |f| <= r / (lambda |B|) of a pupil with radius r. That holds if
    1 / (fine pitch) >= F + r / (lambda |B|).
    """
    first, second, _, back = (number(value) for value in display.matrix(plane))
    radius, distance = number(eye.pupil_radius) + 8 * eye.softness, number(plane)
    blur = abs(back - second * number(inverse(eye.accommodation))) * radius
    axes = []
    for size, pitch in zip(grid.shape, grid.pitch, strict=True):
        if size == 1:
            axes.append((1.0, 1, 1, 1))
            continue
        if abs(second) <= 1e-9 * (abs(distance) + number(display.eye_distance)):
            raise ValueError("the pupil is an image of this object plane (B = 0); give another plane")
        # An even number of samples is added, so that the axis stays on sample n // 2.
        spot = max(wavelengths) * abs(second) / (2 * radius)
        window = size + 2 * math.ceil((blur + _SPOTS * spot) / pitch)
        factor, padded = 1.0, size
        for wavelength in wavelengths:
            accepted = radius / (wavelength * abs(second))
            if accepted > _ROOM / (2 * pitch):
                # The pupil transmits frequencies above 1 / (2 pitch), which the sampling must resolve too.
                factor = max(factor, 2 * pitch * accepted)
            highest = 1 / (2 * pitch) + abs(first) * window * pitch / 2 / (wavelength * abs(second))
            factor = max(factor, _ROOM * pitch * (highest + accepted))
            # A transform of size + window samples and the margin wraps light, which a taper removes.
            tapered = size + window + fringe_width(wavelength, distance) / pitch
            all_light = samples_for_all_light(size, window, pitch, wavelength, distance)
            padded = max(padded, math.ceil(min(all_light, tapered)))
        if factor > _FINEST:
            raise ValueError(f"the collapse would need {factor:.3g} times the hologram's sampling; give another plane")
        axes.append((factor, padded, window, size))
    if all(factor == 1 for factor, *_ in axes):  # no oversampling: inverse FFTs take the place of chirp-z transforms
        windows = [_same_parity(window, size) for _, _, window, size in axes]
        lengths = [good_length(max(axis[1], window)) for axis, window in zip(axes, windows, strict=True)]
        return CollapseSampling((1.0, 1.0), _pair(lengths), _pair(windows), _pair(windows))
    sizes = [(f, good_length(padded), window, good_length(math.ceil(f * window))) for f, padded, window, _ in axes]
    return CollapseSampling(*zip(*sizes, strict=True))


def _same_parity(minimum: int, size: int) -> int:
    """Good length for an FFT, at least ``minimum``, that differs from ``size`` by an even number."""
    if size == 1:
        return 1
    return good_length(minimum, odd=True) if size % 2 else 2 * good_length(-(-minimum // 2))


def _pair(values: Sequence[int]) -> tuple[int, int]:
    return values[0], values[1]


@dataclass(frozen=True)
class CollapseFactors:
    """Factors of the collapsed propagation of one wavelength.

    Attributes:
        kernel: Transfer function to the object plane, complex [P, Q] in FFT order.
        zoom: Factors (y, x) of the chirp-z transform to the oversampled object plane; empty without oversampling.
        curvature: Parabolic phase of the object plane, a column [h, 1] and a row [1, w].
        pupil: Transmission of pupil, defocus and aberrations, complex [n, m], at frequencies within the pupil.
        bands: Number of bands (y, x) of width 1 / pitch among these frequencies.
    """

    kernel: Tensor
    zoom: list[Chirp]
    curvature: tuple[Tensor, Tensor]
    pupil: Tensor
    bands: tuple[int, int]


def collapse_factors(
    like: Tensor,
    grid: Grid,
    wavelengths: Sequence[float],
    display: Display,
    eye: Eye,
    plane: Length,
    sizes: CollapseSampling,
    paraxial: bool,
) -> list[CollapseFactors]:
    """Factors of :func:`propagate_collapsed` for each wavelength, on the device and in the dtype of ``like``."""
    return [_factors(like, grid, wavelength, display, eye, plane, sizes, paraxial) for wavelength in wavelengths]


def _factors(
    like: Tensor,
    grid: Grid,
    wavelength: float,
    display: Display,
    eye: Eye,
    plane: Length,
    sizes: CollapseSampling,
    paraxial: bool,
) -> CollapseFactors:
    """:func:`collapse_factors` for one wavelength."""
    device, dtype, there = like.device, like.dtype, double(plane, like.device)
    first, second, _, back = display.matrix(plane)
    padded, window, fine = Grid(sizes.padded, grid.pitch), Grid(sizes.window, grid.pitch), _fine(grid, sizes)
    if paraxial:
        kernel = fresnel_kernel(padded, wavelength, there)
    else:
        # Propagate exactly to the eyepiece, then back to the plane by Fresnel, because the ray matrix is paraxial.
        lens = double(display.lens_distance, device)
        kernel = angular_spectrum_kernel(padded, wavelength, lens, band_limit=False)
        kernel = kernel * fresnel_kernel(padded, wavelength, lens - there).conj()
    if all(p >= n + w or n == 1 for p, n, w in zip(sizes.padded, grid.shape, sizes.window, strict=True)):
        half_y, half_x = ((n + w) / 2 * p for n, w, p in zip(grid.shape, sizes.window, grid.pitch, strict=True))
        taper = window_taper(padded, wavelength, number(plane), (half_y, half_x), paraxial=paraxial)
        kernel = kernel * taper.to(device)
    kernel = (kernel * carrier(wavelength, there)).to(dtype)
    chirp_factors = [] if sizes.plain else chirps(grid, padded, fine, (0.0, 0.0), device)
    zoom = [(a.to(dtype), b.to(dtype), c.to(dtype)) for a, b, c in chirp_factors]
    rate = double(first / second, device) / (2 * wavelength)
    curvature = [cycles_phasor(rate * coordinate.square()).to(dtype) for coordinate in fine.coordinates(device)]
    bands = pupil_bands(grid, wavelength, display, eye, plane)
    # The positions (eta, xi) on the pupil of the frequencies of the spectrum. The window has the same width at both
    # pitches and therefore the same frequency step.
    eta, xi = (
        (torch.arange(n * m, dtype=torch.float64, device=device) - n * m // 2) / (n * p) * (wavelength * second)
        for n, m, p in zip(window.shape, bands, window.pitch, strict=True)
    )
    eta, xi = eta[:, None], xi[None, :]
    square = eta.square() + xi.square()
    cycles = (back / second - inverse(eye.accommodation)) / (2 * wavelength) * square
    if not paraxial:
        aberration = display.eye_distance * (back / second) ** 4 + 1 / eye.axial_length**3
        cycles = cycles - aberration / (8 * wavelength) * square.square()
    norm = math.sqrt(math.prod(window.shape) / math.prod(fine.shape))
    pupil = (eye.pupil_function(eta, xi, wavelength) * cycles_phasor(cycles) * norm).to(dtype)
    return CollapseFactors(kernel, zoom, (curvature[0], curvature[1]), pupil, bands)


def _fine(grid: Grid, sizes: CollapseSampling) -> Grid:
    """The window of the object plane at the oversampled pitch."""
    y, x = (p * n / m for p, n, m in zip(grid.pitch, sizes.window, sizes.fine, strict=True))
    return Grid(sizes.fine, (y, x))


def _image(field: Tensor, grid: Grid, sizes: CollapseSampling, factors: CollapseFactors) -> Tensor:
    """One wavelength of :func:`propagate_collapsed`, [..., H, W] to [..., H, W]."""
    if factors.zoom:
        light = zoomed(field, factors.kernel, factors.zoom)
    else:
        spectrum = multiplied(fft2(field, sizes.padded), factors.kernel)
        axes = zip(grid.shape, sizes.window, sizes.padded, strict=True)
        light = ifft2(spectrum, sizes.window, _pair([(n // 2 - w // 2) % p for n, w, p in axes]))
    light = light * (factors.curvature[0] * factors.curvature[1])
    rows, columns = factors.bands
    spectrum = _centred(centred_fft2(light), [n * m for n, m in zip(sizes.window, factors.bands, strict=True)])
    image = spectrum * factors.pupil
    # Sampling at the hologram's pitch adds up all bands of the spectrum.
    image = image.unflatten(-1, (columns, -1)).sum(-2).unflatten(-2, (rows, -1)).sum(-3)
    return _centred(centred_ifft2(image), grid.shape)


def _centred(values: Tensor, shape: Sequence[int]) -> Tensor:
    """``values`` [..., h, w] cropped or zero-padded to ``shape`` so that sample n // 2 of each axis stays at n // 2."""
    (h, w), (height, width) = values.shape[-2:], shape
    top, left = height // 2 - h // 2, width // 2 - w // 2
    return torch.nn.functional.pad(values, (left, width - w - left, top, height - h - top))


def fft_flops(count: int) -> float:
    """Floating-point operations of one FFT of ``count`` samples."""
    return 5 * count * math.log2(max(count, 2))


def zoom_flops(padded: tuple[int, int], fine: tuple[int, int]) -> float:
    """Floating-point operations of a chirp-z transform: two FFTs of padded + fine samples per line, rows first."""
    (py, px), (fy, fx) = padded, fine
    return sum(10 * lines * n * math.log2(n) for lines, n in ((py, px + fx), (fx, py + fy)))


def warn_if_coarse(sampling: Sequence[float], required: Sequence[float], sampled: str, aliases: str) -> None:
    """SamplingWarning in the name of the caller's caller if an oversampling (y, x) is below ``required``."""
    if any(given < needed * (1 - 1e-9) for given, needed in zip(sampling, required, strict=True)):
        warnings.warn(
            f"{sampled} sampled {max(sampling):.3g} times as fine as the hologram {aliases}; "
            f"{max(required):.3g} times would do",
            SamplingWarning,
            stacklevel=3,
        )


__getattr__ = renamed(__name__, {"imaged": "propagate_collapsed"})
