"""Propagation to the retina element by element, with the sampling that each element needs."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.deprecation import renamed
from holotorch.core.fourier import fft2, filter_spectrum, good_length
from holotorch.core.grid import Grid
from holotorch.optics.elements.lens import pupil
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, fresnel_kernel, turns_phasor
from holotorch.optics.free_space.zoomed import chirp, chirps, zoom, zoomed
from holotorch.optics.viewing.display import Display, Length, inverse, number
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.imaging import retinal_scale
from holotorch.optics.viewing.rays import Region, band, clipped, fringe, reach, refracted, steepest, travelled

_ROOM = 1.05  # factor on the slope of the steepest ray, for light that edges diffract beyond it


@dataclass(frozen=True)
class ElementSampling:
    """Sizes (y, x) of the element-by-element propagation from one grid.

    Attributes:
        oversampling: Pitch of the hologram divided by the pitch on eyepiece and eye.
        padded: Samples, at the hologram's pitch, of the transform for the propagation to the eyepiece.
        fine: Samples of eyepiece and eye at the hologram's pitch divided by ``oversampling``, enough for no light to
            wrap into their openings.
    """

    oversampling: tuple[float, float]
    padded: tuple[int, int]
    fine: tuple[int, int]

    @property
    def flops(self) -> float:
        """Floating-point operations for one image of one wavelength: six transforms, the first and last by chirp-z."""
        (py, px), (fy, fx) = self.padded, self.fine
        whole = 5 * fy * fx * math.log2(max(fy * fx, 2))
        zoom = sum(10 * lines * n * math.log2(n) for lines, n in ((py, px + fx), (fx, py + fy)))
        return 4 * whole + zoom

    def memory_bytes(self, itemsize: int = 8, batch: int = 1) -> int:
        """Largest extra memory in bytes for images of one wavelength, within 3 % of measurements at 1.4 to 2.4 GB.

        Args:
            itemsize: Bytes of a sample: 8 for complex64, 16 for complex128.
            batch: Number of fields processed together.
        """
        each = itemsize * batch
        return max(138 + each, 60 + 6 * each) * math.prod(self.fine)  # building a kernel; propagating behind the iris


def least_oversampling(
    grid: Grid, wavelengths: Sequence[float], display: Display, eye: Eye, *, plane: Length | None = None
) -> ElementSampling:
    """Coarsest sampling at which no lens phase, and no light behind a lens, aliases.

    The rays of the hologram start anywhere in its window with any slope within the band of its pitch. On each axis the
    polygon of these rays in position and slope is traced through the display. The largest slope s of a ray, or of a
    lens where rays cross it, requires a pitch of wavelength / (2 s), and the largest extent of the rays determines the
    window. 5 % is added to the slope, and Fresnel fringes to the window.
    """
    axes = [_axis(grid, axis, wavelengths, display, eye, plane) for axis in (0, 1)]
    oversampling, padded, fine = zip(*axes, strict=True)
    return ElementSampling(oversampling, padded, fine)


def propagate_elements(
    field: Tensor,
    grid: Grid,
    wavelengths: float | Sequence[float],
    display: Display,
    eye: Eye,
    *,
    plane: Length | None = None,
    sampling: ElementSampling | None = None,
    paraxial: bool = False,
) -> Tensor:
    """Propagate a hologram to the retina element by element (thesis Algorithm 6), scaled as ``propagate_collapsed``.

    This differs from Algorithm 6 in sampling only: there every step has the pitch of the hologram.

    Args:
        field: Field of the hologram, complex [..., C, H, W].
        grid: Sampling of the hologram.
        wavelengths: In metres, one per channel.
        display: Positions of hologram, eyepiece and eye, and the radius of the eyepiece.
        eye: Pupil, retina, accommodation.
        plane: Object plane in metres from the hologram, which only sets the scale; by default the one in focus.
        sampling: Sampling of the elements; :func:`least_oversampling` by default.
        paraxial: Use Fresnel's model of free space instead of the exact angular spectrum. Lenses have parabolic phases
            in both cases, as in the thesis.

    Returns:
        Complex [..., C, H, W]: sample x of ``grid`` holds the field at the point s x of the retina times abs(s), with
        s from :func:`retinal_scale`. The sum of the intensity times both pitches of the hologram is the power in this
        window of the retina.

    Raises:
        MemoryError: The operation would need more memory than is available; raised before anything is allocated.

    Warns:
        SamplingWarning: ``sampling`` is coarser than :func:`least_oversampling`.
    """
    channel_wavelengths = checks.wavelengths(wavelengths)
    checks.field("field", field, (len(channel_wavelengths), *grid.shape))
    least = least_oversampling(grid, channel_wavelengths, display, eye, plane=plane)
    sizes = sampling or least
    if any(
        given < least_factor * (1 - 1e-9)
        for given, least_factor in zip(sizes.oversampling, least.oversampling, strict=True)
    ):
        warnings.warn(
            f"elements sampled {max(sizes.oversampling):.3g} times as fine as the hologram alias in a lens; "
            f"{max(least.oversampling):.3g} times would do",
            SamplingWarning,
            stacklevel=2,
        )
    batch = field.numel() // max(1, math.prod(field.shape[-3:]))
    checks.affordable(
        sizes.memory_bytes(field.dtype.itemsize, batch) + field.dtype.itemsize * field.numel(),
        f"propagate_elements() on {sizes.fine[0]} x {sizes.fine[1]} samples, {max(sizes.oversampling):.3g} times as "
        f"fine as the hologram's {grid.shape[0]} x {grid.shape[1]},",
        "use propagate_collapsed(), crop the hologram, pass fewer fields at once, or use smaller lenses",
        field.device,
    )
    scale = retinal_scale(display, eye, plane)
    images = [
        _passed(field[..., c, :, :], grid, wavelength, display, eye, scale, sizes, paraxial)
        for c, wavelength in enumerate(channel_wavelengths)
    ]
    return torch.stack(images, -3)


def _axis(
    grid: Grid, axis: int, wavelengths: Sequence[float], display: Display, eye: Eye, plane: Length | None
) -> tuple[float, int, int]:
    size, pitch = grid.shape[axis], grid.pitch[axis]
    if size == 1:
        return 1.0, 1, 1
    scale = abs(number(retinal_scale(display, eye, plane)))
    d_el, d_eye, d_r = (number(v) for v in (display.lens_distance, display.eye_distance, eye.axial_length))
    powers = number(inverse(display.focal_length)), number(inverse(eye.focal_length))
    radii = math.inf if display.lens_radius is None else number(display.lens_radius), number(eye.pupil_radius)
    slope, width = 0.0, scale * size * pitch
    for wavelength in wavelengths:
        rays: Region = band(size * pitch / 2, wavelength / (2 * pitch))
        steep = wavelength / (2 * pitch)
        for distance, power, radius in zip((d_el, d_eye), powers, radii, strict=True):
            start = reach(rays)
            rays = travelled(rays, distance)
            # Wrapped light must not reach the opening, and all light that passes must lie within the window.
            arrives, kept = reach(rays), min(reach(rays), radius + 8 * eye.softness)
            width = max(width, start + kept, arrives + kept, 2 * kept) + 2 * fringe(wavelength, distance)
            rays = clipped(rays, kept)
            steep = max(steep, abs(power) * reach(rays))
            rays = refracted(rays, power)
            steep = max(steep, steepest(rays))
        end = reach(travelled(rays, d_r))
        width = max(width, end + scale * size * pitch / 2 + fringe(wavelength, d_r))
        slope = max(slope, _ROOM * steep / wavelength)
    factor = max(1.0, 2 * pitch * slope)
    fine = good_length(math.ceil(factor * width / pitch))
    wide = fine / factor
    needed = 0.0
    for wavelength in wavelengths:
        sine = wavelength / (2 * pitch)
        spread = d_el * sine / math.sqrt(1 - sine**2) if sine < 1 else math.inf
        needed = max(needed, min((size + wide) / 2 + (spread + fringe(wavelength, d_el)) / pitch, size + wide))
    return factor, good_length(max(math.ceil(needed), size)), fine


def _passed(
    field: Tensor,
    grid: Grid,
    wavelength: float,
    display: Display,
    eye: Eye,
    scale: Length,
    sizes: ElementSampling,
    paraxial: bool,
) -> Tensor:
    pitches = [p / m for p, m in zip(grid.pitch, sizes.oversampling, strict=True)]
    fine, padded = Grid(sizes.fine, (pitches[0], pitches[1])), Grid(sizes.padded, grid.pitch)

    def space(where: Grid, distance: Length) -> Tensor:
        # No band limit is needed: the windows are large enough for all light that passes the openings.
        kernel = (
            fresnel_kernel(where, wavelength, distance)
            if paraxial
            else angular_spectrum_kernel(where, wavelength, distance, band_limit=False)
        )
        return (kernel * carrier(wavelength, distance)).to(field.device, field.dtype)

    light = zoomed(field, space(padded, display.lens_distance), chirps(grid, padded, fine, (0.0, 0.0), field.device))
    y, x = fine.coordinates(field.device)
    square = y.square() + x.square()

    def lens(power: Length) -> Tensor:
        return turns_phasor(-power / (2 * wavelength) * square)

    eyepiece = lens(torch.as_tensor(inverse(display.focal_length), dtype=torch.float64))
    if display.lens_radius is not None:
        eyepiece = eyepiece * pupil(fine, display.lens_radius, softness=eye.softness).to(field.device)
    light = filter_spectrum(light * eyepiece.to(field.dtype), space(fine, display.eye_distance))
    iris = lens(torch.as_tensor(inverse(eye.focal_length), dtype=torch.float64)) * eye.pupil_function(y, x, wavelength)
    spectrum = fft2(light * iris.to(field.dtype))
    return _read(spectrum * space(fine, eye.axial_length), fine, grid, scale)


def _read(spectrum: Tensor, fine: Grid, grid: Grid, scale: Length) -> Tensor:
    """The field of a spectrum at ``scale`` times the points of ``grid``, times the root of abs(scale) per axis."""
    for axis, dim in ((1, -1), (0, -2)):
        size, pitch, count = fine.shape[axis], fine.pitch[axis], grid.shape[axis]
        if count == 1:
            continue
        step = scale * grid.pitch[axis] / pitch
        factors = chirp(size, step, size // 2 - count // 2 * step, count, spectrum.device)  # type: ignore[arg-type]
        before, kernel, after = (part.to(spectrum.dtype) for part in factors)
        lines = zoom(spectrum.transpose(dim, -1), (before, kernel, after)).transpose(dim, -1)
        spectrum = lines * (abs(scale) ** 0.5)
    return spectrum


__getattr__ = renamed(__name__, {"through_elements": "propagate_elements"})
