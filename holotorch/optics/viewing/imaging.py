"""Collapsed propagation to the retina: eyepiece, eye and the space between them as one filter of the image.

Derivation. Let (A, B, C, D) be the paraxial ray matrix from an object plane, field U(x), to the pupil of the eye, as in
``Display.matrix``. By Collins's integral the field on the pupil is

    V(xi) = e^{ikL} / (i lambda B) integral U(x) exp(i pi (A x^2 - 2 x xi + D xi^2) / (lambda B)) dx

(two axes at once). The eye multiplies it by its pupil function P and by exp(-i pi xi^2 / (lambda f_eye)) with
1 / f_eye = 1 / s + 1 / d_r, and Fresnel's integral over d_r leads to the retina:

    R(u) = e^{ikd_r} / (i lambda d_r) exp(i pi u^2 / (lambda d_r)) integral P V
           exp(i pi xi^2 (1 / d_r - 1 / f_eye) / lambda) exp(-2 pi i u xi / (lambda d_r)) dxi.

On the pupil the parabolas add up to D / B + 1 / d_r - 1 / f_eye = D / B - 1 / s: the defocus. It vanishes for the plane
in focus, since B / D = d_eye + s0 / (1 - s0 / f) = d_eye + s1, the distance at which its image is seen. With
xi = lambda B f the two integrals are a Fourier transform and an inverse one,

    g(x) = IFT[ P(lambda B f) exp(i pi lambda B (D - B / s) f^2) FT[ U(x) exp(i pi A x^2 / (lambda B)) ](f) ],
    |R(u)| = |B / d_r| |g(-u B / d_r)|,

so the retina shows |g| scaled by -d_r / B, and sum |g|^2 pitch^2 is the power that arrives. The defocus phase has no B
in a denominator and moves light by (D - B / s) xi in the object plane.
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
from holotorch.core.fourier import centred_fft2, centred_ifft2, good_length
from holotorch.core.grid import Grid
from holotorch.optics.free_space.kernels import (
    angular_spectrum_kernel,
    carrier,
    fresnel_kernel,
    turns_phasor,
    window_taper,
)
from holotorch.optics.free_space.zoomed import chirps, zoomed
from holotorch.optics.viewing.display import Display, Length, inverse, number
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.rays import fringe

_ROOM = 1.02  # of every limit, for what edges spread beyond the rays
_FINEST = 64.0
_SPOTS = 16  # of a point behind a hard pupil kept around the window: its tails carry light in and out


@dataclass(frozen=True)
class CollapseSampling:
    """Sizes (y, x) of the collapse on one grid.

    Attributes:
        oversampling: How much finer than the hologram the object plane is sampled.
        padded: Samples of the transform that leads to the object plane, at the hologram's pitch.
        window: The object plane at the hologram's pitch, with room for defocus and the tails of spots.
        fine: The same window, oversampled.
    """

    oversampling: tuple[float, float]
    padded: tuple[int, int]
    window: tuple[int, int]
    fine: tuple[int, int]

    @property
    def flops(self) -> float:
        """Arithmetic of one image of one wavelength, 5 n log2 n for each transform."""
        (py, px), (fy, fx) = self.padded, self.fine
        # The chirp-z transform takes two of length padded + fine per line, rows first.
        zoom = sum(10 * lines * n * math.log2(n) for lines, n in ((py, px + fx), (fx, py + fy)))
        return _fft(py * px) + zoom + _fft(fy * fx) + _fft(math.prod(self.window))

    def memory_bytes(self, passed: float, itemsize: int = 8, batch: int = 1) -> int:
        """Largest extra memory of images of one wavelength.

        Within 10 % of what was measured from 1 GB to 8 GB; below, up to 0.2 GB less than was measured.

        Args:
            passed: Samples of the spectrum that the pupil takes (:func:`pupil_bands`), at least those of ``window``.
            itemsize: Bytes of a sample: 8 for complex64, 16 for complex128.
            batch: Fields at once.
        """
        kernel = 110 * math.prod(self.padded)  # of the propagation to the object plane, while it is built
        lines = 4.2 * itemsize * batch * self.fine[1] * (self.fine[0] + self.padded[0])  # of the chirp-z transform
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
) -> Tensor:
    """Field on the retina, referred back to the object plane: the g(x) of this module's derivation.

    Args:
        field: Of the hologram, complex [..., C, H, W].
        grid: Its sampling.
        wavelengths: In metres, one per channel.
        display: Positions of hologram, eyepiece and eye.
        eye: Pupil, retina, accommodation. Its radius, accommodation and axial length and the display's lengths may
            carry gradients.
        plane: Distance in metres from the hologram of the object plane, to which light is propagated first; by default
            the one in focus. It sets the scale of the result.
        sampling: Of the object plane; by default :func:`collapse_sampling`.
        paraxial: Fresnel's model throughout. Otherwise propagation to the eyepiece is exact, and the pupil takes over
            the phase that Fresnel leaves out behind it for points on the axis, -k / 8 sum d_i u_i^4 over the slopes u_i
            of the ray through xi: spherical aberration. The part that depends on the position beside the axis (mostly
            a shift) is left out.

    Returns:
        Complex [..., C, H, W] on ``grid``, upright: the retina shows it :func:`retinal_scale` times as large, turned
        upside down, and the sum of its intensity times the pitches is the power on the retina. The phase misses the
        curvature and carrier that the intensity does not show.

    Raises:
        ValueError: The pupil is an image of the object plane (B = 0), or needs oversampling beyond 64.
        MemoryError: It would take more memory than is available; said before anything is allocated.

    Warns:
        SamplingWarning: ``sampling`` is coarser than :func:`collapse_sampling`.

    It leaves out the edge of the eyepiece (``plan_retina`` says whether it blocks light that the pupil would accept),
    the phase that Fresnel leaves out behind the eyepiece for points beside the axis, and light that leaves the window
    of ``grid`` before the object plane.
    Departs from Algorithm 6, which samples every lens phase at the pitch of the hologram, where they alias.
    """
    channel_wavelengths = checks.wavelengths(wavelengths)
    checks.field("field", field, (len(channel_wavelengths), *grid.shape))
    plane = display.object_plane(plane, eye.accommodation)
    least = collapse_sampling(grid, channel_wavelengths, display, eye, plane)
    sizes = sampling or least
    if any(have < want * (1 - 1e-9) for have, want in zip(sizes.oversampling, least.oversampling, strict=True)):
        warnings.warn(
            f"an object plane sampled {max(sizes.oversampling):.3g} times as fine as the hologram aliases into the "
            f"pupil; {max(least.oversampling):.3g} times would do",
            SamplingWarning,
            stacklevel=2,
        )
    passed = max(
        math.prod(pupil_bands(grid, wavelength, display, eye, plane)) for wavelength in channel_wavelengths
    ) * math.prod(sizes.window)
    size, batch = field.dtype.itemsize, field.numel() // max(1, math.prod(field.shape[-3:]))
    checks.affordable(
        sizes.memory_bytes(passed, size, batch) + size * field.numel(),
        f"propagate_collapsed() on an object plane of {sizes.fine[0]} x {sizes.fine[1]} samples, "
        f"{max(sizes.oversampling):.3g} times as fine as the hologram's {grid.shape[0]} x {grid.shape[1]},",
        "crop the hologram, pass fewer fields at once, use a smaller pupil, or put the plane farther from the pupil",
        field.device,
    )
    images = [
        _image(field[..., c, :, :], grid, wavelength, display, eye, plane, sizes, paraxial)
        for c, wavelength in enumerate(channel_wavelengths)
    ]
    return torch.stack(images, -3)


def retinal_scale(display: Display, eye: Eye, plane: Length | None = None) -> Length:
    """Metres on the retina per metre in the object plane, -d_r / B: negative, since the image is upside down."""
    plane = display.object_plane(plane, eye.accommodation)
    return -eye.axial_length / display.matrix(plane)[1]


def pupil_bands(grid: Grid, wavelength: float, display: Display, eye: Eye, plane: Length) -> tuple[int, int]:
    """How many bands of the hologram's pitch (y, x), 1 / pitch each, the pupil takes from the object plane; odd."""
    # A pupil may take more than one band: light beside the axis that comes in at a slant.
    taken = (number(eye.pupil_radius) + 8 * eye.softness) / (wavelength * abs(number(display.matrix(plane)[1])))
    y, x = (2 * math.ceil(max(0.0, pitch * taken * _ROOM - 0.5)) + 1 for pitch in grid.pitch)
    return y, x


def collapse_sampling(
    grid: Grid, wavelengths: Sequence[float], display: Display, eye: Eye, plane: Length
) -> CollapseSampling:
    """Least sampling of the object plane that keeps aliases out of the pupil.

    There the field's frequencies, up to F = 1 / (2 pitch) + |A| x / (lambda |B|) at the end x of the window, may alias
    as long as they do not come back into the pupil's, f <= r / (lambda |B|): 1 / fine pitch >= F + f suffices.
    """
    first, second, _, back = (number(value) for value in display.matrix(plane))
    radius, distance = number(eye.pupil_radius) + 8 * eye.softness, number(plane)
    blur = abs(back - second * number(inverse(eye.accommodation))) * radius
    factors, padded, window, fine = [], [], [], []
    for size, pitch in zip(grid.shape, grid.pitch, strict=True):
        if size == 1:
            for each in (factors, padded, window, fine):
                each.append(1)
            continue
        # An even number more, so that the axis stays on sample n // 2 of both.
        spot = max(wavelengths) * abs(second) / (2 * radius)
        wide = size + 2 * math.ceil((blur + _SPOTS * spot) / pitch)
        factor = 1.0
        for wavelength in wavelengths:
            if abs(second) <= 1e-9 * (abs(distance) + number(display.eye_distance)):
                raise ValueError("the pupil is an image of this object plane (B = 0); give another plane")
            taken = radius / (wavelength * abs(second))
            if taken > _ROOM / (2 * pitch):
                # Light of the object beyond the pitch's band, which the hologram does not hold on the axis.
                factor = max(factor, 2 * pitch * taken)
            highest = 1 / (2 * pitch) + abs(first) * wide * pitch / 2 / (wavelength * abs(second))
            factor = max(factor, _ROOM * pitch * (highest + taken))
        if factor > _FINEST:
            raise ValueError(f"the collapse would need {factor:.3g} times the hologram's sampling; give another plane")
        factors.append(factor)
        window.append(wide)
        fine.append(good_length(math.ceil(factor * wide)))
        padded.append(max(_padding(size, wide, pitch, wavelength, distance) for wavelength in wavelengths))
    pairs = [(each[0], each[1]) for each in (factors, padded, window, fine)]
    return CollapseSampling(pairs[0], pairs[1], pairs[2], pairs[3])  # type: ignore[arg-type]


def _padding(size: int, wide: int, pitch: float, wavelength: float, distance: float) -> int:
    """Length of a transform that wraps no light into the window: it holds all light, or is used with a taper."""
    sine = wavelength / (2 * pitch)
    spread = abs(distance) * sine / math.sqrt(1 - sine**2) if sine < 1 else math.inf
    need = min(
        (size + wide) / 2 + (spread + fringe(wavelength, distance)) / pitch,
        size + wide + fringe(wavelength, distance) / pitch,
    )
    return good_length(max(math.ceil(need), size))


def _image(
    field: Tensor,
    grid: Grid,
    wavelength: float,
    display: Display,
    eye: Eye,
    plane: Length,
    sizes: CollapseSampling,
    paraxial: bool,
) -> Tensor:
    first, second, _, back = display.matrix(plane)
    padded = Grid(sizes.padded, grid.pitch)
    window = Grid(sizes.window, grid.pitch)
    fy, fx = (p * n / m for p, n, m in zip(grid.pitch, sizes.window, sizes.fine, strict=True))
    fine = Grid(sizes.fine, (fy, fx))
    whole = all(p >= n + w or n == 1 for p, n, w in zip(sizes.padded, grid.shape, sizes.window, strict=True))
    if paraxial:
        kernel = fresnel_kernel(padded, wavelength, plane)
    else:
        # On to the eyepiece exactly, and back to the plane as the ray matrix has it.
        kernel = angular_spectrum_kernel(padded, wavelength, display.lens_distance, band_limit=False)
        kernel = kernel * fresnel_kernel(padded, wavelength, display.lens_distance - plane).conj()
    if whole:
        reach = [(n + w) / 2 * p for n, w, p in zip(grid.shape, sizes.window, grid.pitch, strict=True)]
        kernel = kernel * window_taper(padded, wavelength, number(plane), (reach[0], reach[1]), paraxial=paraxial)
    kernel = (kernel * carrier(wavelength, plane)).to(field.device, field.dtype)
    light = zoomed(field, kernel, chirps(grid, padded, fine, (0.0, 0.0), field.device))
    y, x = fine.coordinates(field.device)
    rate = torch.as_tensor(first / second, dtype=torch.float64, device=field.device) / (2 * wavelength)
    light = light * (turns_phasor(rate * y.square()) * turns_phasor(rate * x.square())).to(field.dtype)
    bands = pupil_bands(grid, wavelength, display, eye, plane)
    spectrum = _centred(centred_fft2(light), [n * m for n, m in zip(window.shape, bands, strict=True)])
    # The same window, so the same frequencies: those of its centred spectrum, and on.
    eta, xi = (
        (torch.arange(n * m, dtype=torch.float64, device=field.device) - n * m // 2) / (n * p) * (wavelength * second)
        for n, m, p in zip(window.shape, bands, window.pitch, strict=True)
    )
    eta, xi = eta[:, None], xi[None, :]
    square = eta.square() + xi.square()
    cycles = (back / second - inverse(eye.accommodation)) / (2 * wavelength) * square
    if not paraxial:
        legs = display.eye_distance * (back / second) ** 4 + 1 / eye.axial_length**3
        cycles = cycles - legs / (8 * wavelength) * square.square()
    passed = eye.pupil_function(eta, xi, wavelength) * turns_phasor(cycles)
    share = math.sqrt(math.prod(window.shape) / math.prod(fine.shape))
    image = spectrum * (passed * share).to(field.dtype)
    # Samples at the hologram's pitch have the sum of all bands for their spectrum.
    image = image.unflatten(-1, (bands[1], -1)).sum(-2).unflatten(-2, (bands[0], -1)).sum(-3)
    return _centred(centred_ifft2(image), grid.shape)


def _centred(values: Tensor, shape: Sequence[int]) -> Tensor:
    """The middle ``shape`` samples, or the values amid zeros; sample n // 2 stays the origin."""
    (h, w), (height, width) = values.shape[-2:], shape
    top, left = height // 2 - h // 2, width // 2 - w // 2
    return torch.nn.functional.pad(values, (left, width - w - left, top, height - h - top))


def _fft(count: int) -> float:
    return 5 * count * math.log2(max(count, 2))


__getattr__ = renamed(__name__, {"imaged": "propagate_collapsed"})
