"""Refocuser: pictures of a hologram at any depth and through any pupil, each by one inverse transform."""

import math

from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity
from holotorch.core.fourier import fft2, ifft2, multiply_even
from holotorch.core.grid import Grid
from holotorch.core.operator import Wavelengths
from holotorch.optics.free_space.kernels import cycles_phasor, direction_cosine
from holotorch.optics.viewing.pupil_views import View, view_padding


class Refocuser:
    """Intensities of views of one hologram: those of :class:`PupilViews`, for views that are not known beforehand.

    The spectrum within the last pupil is kept. A transfer function is even in both frequencies, so that a quarter of it
    is computed for each new depth.

    Args:
        fields: Fields of F frames, complex64 [F, C, H, W], whose intensities are averaged.
        grid: Pixels of the hologram.
        wavelengths: In metres, one per channel.
        longest: Largest depth in metres, for which the transforms are padded.

    Raises:
        MemoryError: The spectra need more memory than is available.
    """

    def __init__(self, fields: Tensor, grid: Grid, wavelengths: Wavelengths, longest: float):
        self.grid, self.wavelengths = grid, checks.wavelengths(wavelengths)
        self._fields, self._longest = fields, longest
        self._light = (self.wavelengths, View(longest))  # wavelengths and pupil of the kept spectrum
        self.padded = view_padding(grid, self.wavelengths, [View(longest)], longest)
        height, width = self.padded.shape
        checks.affordable(
            # While a pupil changes there are two spectra and a mask; each transform takes two fields besides.
            (2 * fields.element_size() + 9) * height * width * math.prod(fields.shape[:2]),
            f"the spectrum of the hologram on {height} x {width} samples",
            "run a smaller hologram",
        )
        self._spectrum = fft2(fields, self.padded.shape)
        self._axial: dict[tuple[float, Grid], Tensor] = {}

    def intensity(self, view: View, wavelengths: Wavelengths | None = None, frame: int | None = None) -> Tensor:
        """Mean intensity [C, H, W] of the frames in a view, or that of one ``frame``.

        ``wavelengths`` in metres replace those of the design: the hologram stays, its light changes. ValueError for a
        pupil that contains none of the sampled directions.
        """
        light = self.wavelengths if wavelengths is None else checks.wavelengths(wavelengths)
        pupil = View(self._longest, view.radius, view.centre)
        if (light, pupil) != self._light:
            padded = view_padding(self.grid, light, [pupil], self._longest)
            self._spectrum = self._within(padded, light, pupil)
            self._light, self.padded = (light, pupil), padded
        frames = self._spectrum if frame is None else self._spectrum[frame : frame + 1]
        images = frames.real.new_zeros(len(light), *self.grid.shape)
        for c, wavelength in enumerate(light):
            kernel = cycles_phasor(view.focus * self._axial_frequency(wavelength)).to(frames.dtype)
            for spectrum in frames:  # one by one, to save memory
                images[c] += intensity(ifft2(multiply_even(spectrum[c].clone(), kernel), self.grid.shape))
        return images / len(frames)

    def share(self) -> list[float]:
        """Share of the light of each colour that enters the pupil of the last view."""
        inside, whole = (intensity(field).sum((0, -2, -1)) for field in (self._spectrum, self._fields))
        return (inside / whole.clamp(min=1e-30) / math.prod(self.padded.shape)).tolist()

    def _within(self, padded: Grid, light: tuple[float, ...], pupil: View) -> Tensor:
        """The spectrum on a padded grid within a pupil."""
        spectrum = fft2(self._fields, padded.shape)
        (fy, fx), (y, x) = padded.frequencies(spectrum.device), pupil.centre
        for c, wavelength in enumerate(light):
            inside = (wavelength * fy - y).square() + (wavelength * fx - x).square() <= pupil.radius**2
            if not bool(inside.any()):
                raise ValueError(f"the pupil is too small or too far aside for light of {wavelength * 1e9:.0f} nm")
            spectrum[:, c] *= inside
        return spectrum

    def _axial_frequency(self, wavelength: float) -> Tensor:
        """Wave number in cycles per metre minus its component along the axis, first quadrant, float64."""
        key = wavelength, self.padded
        if key not in self._axial:
            if len(self._axial) >= 2 * len(self.wavelengths):
                self._axial.clear()
            fy, fx = self.padded.frequencies(self._spectrum.device)
            rows, columns = (n // 2 + 1 for n in self.padded.shape)
            sine2 = (wavelength * fy[:rows]).square() + (wavelength * fx[..., :columns]).square()
            cosine, _ = direction_cosine(sine2)
            self._axial[key] = sine2 / (1 + cosine) / wavelength
        return self._axial[key]
