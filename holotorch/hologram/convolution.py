"""ConvolutionHologram: exact holograms by one convolution per plane of sources."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core.complex import phasor
from holotorch.core.fourier import even_fft2, multiply_even
from holotorch.core.grid import Grid
from holotorch.hologram.band_limited import point_spectrum
from holotorch.hologram.cone import Cone, cone_samples, is_plain, spherical_wave, taper, taper_margin
from holotorch.hologram.layered import LayerHologram
from holotorch.hologram.raster import Raster, has_light, span, strided_length
from holotorch.optics.free_space.plane_pair import plane_pair
from holotorch.optics.free_space.transfer import transfer_function

# Amplitude, relative to the spherical wave, up to which light may wrap around the padded array. It is also the
# largest difference at which the closed form of the unlimited wave replaces the tapered one.
TAPER_ERROR = 2e-7


class ConvolutionHologram(LayerHologram):
    """The sum of ``DirectHologram`` by FFT: thesis Eqs. 5.8 to 5.14 and Algorithm 5, exact to rounding.

    Phases are computed in float64 and cast last. Each plane needs an FFT of its sources, at their own spacing of
    ``stride`` pixels, and half an FFT for its kernel, which is even, so that a quadrant suffices. Planes are summed in
    frequency and transformed back together. The padded length max(V, H, (V + H + K) / 2) keeps light from wrapping
    around, where sources cover V samples, pixels H and the cone of light K; Sec. 5.6.1 uses H + K.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Distances of the planes from the hologram in metres, above 0; any order and spacing.
        cone: The part of each spherical wave that is kept, see ``holotorch.hologram.cone``. ``taper`` is applied in
            frequency, on arrays so long that at most 2e-7 of a wave wraps around. ``band`` uses the kernel of
            ``CroppedKernel``, with a relative error of about 2 s^2 / sqrt(N / 2), where s is the sine of the steepest
            light and N the padded length in samples.
        stride: Distance between neighbouring sources of a plane in pixels.

    Raises:
        TypeError, ValueError: Invalid arguments; in a call: layers that are not complex [..., D, h, w].
    """

    def __init__(self, grid: Grid, wavelength: float, depths: Sequence[float], *, cone: Cone = "box", stride: int = 1):
        super().__init__(grid, wavelength, depths, cone, stride)

    def padded(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Size of the transforms in samples for layers of ``shape`` (h, w)."""
        apart, least = span(self.grid, shape, self.stride)
        extents = [self._extent(depth, apart) for depth in self.depths]
        # No wave wraps onto a pixel if the length exceeds the largest displacement of a pair plus the kernel's extent.
        y, x = (
            strided_length(max(length, distance + max(extent) + 1), self.stride)
            for length, distance, extent in zip(least, apart, zip(*extents, strict=True), strict=True)
        )
        return y, x

    def _extent(self, depth: float, apart: tuple[int, int]) -> tuple[int, int]:
        """Largest displacement (y, x) in samples at which the kernel of a depth is not negligible."""
        if self._in_frequency(depth, apart):
            sines = [self.wavelength / (2 * pitch) for pitch in self.grid.pitch]
            path = depth / math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2)  # path of the steepest light in metres
            y, x = (
                math.ceil(path * sine / pitch + taper_margin(path * sine / pitch, TAPER_ERROR))
                for sine, pitch in zip(sines, self.grid.pitch, strict=True)
            )
            return y, x
        if self.cone not in ("box", "disc"):
            return apart
        half = cone_samples(self.grid, self.wavelength, depth)
        y, x = (math.floor(min(distance, width * (1 + 1e-12))) for distance, width in zip(apart, half, strict=True))
        return y, x

    def kernel_samples(self, depth: float, shape: tuple[int, int], size: tuple[int, int]) -> tuple[int, int]:
        """Size (y, x) in samples of the computed quadrant of a kernel, for layers of ``shape`` padded to ``size``."""
        apart, _ = span(self.grid, shape, self.stride)
        if self._in_frequency(depth, apart):
            return size[0] // 2 + 1, size[1] // 2 + 1
        y, x = (min(extent, length // 2) + 1 for extent, length in zip(self._extent(depth, apart), size, strict=True))
        return y, x

    def _in_frequency(self, depth: float, apart: tuple[int, int]) -> bool:
        """Whether the taper changes the kernel of a depth, which is then computed in frequency."""
        return self.cone == "taper" and not is_plain(self.grid, self.wavelength, depth, apart, TAPER_ERROR)

    def _kernel(self, depth: float, raster: Raster, layers: Tensor) -> Tensor:
        """A quadrant of the spectrum of the spherical wave from ``depth``."""
        apart, _ = span(self.grid, raster.shape, self.stride)
        if self.cone == "band":
            return self._band_kernel(depth, raster, apart).to(layers.device, layers.dtype)
        if self._in_frequency(depth, apart):
            return self._tapered_kernel(depth, raster, layers.device).to(layers.dtype)
        extent = self._extent(depth, apart)
        dy, dx = (
            torch.arange(min(count, size // 2) + 1, dtype=torch.float64, device=layers.device) * pitch
            for count, size, pitch in zip(extent, raster.size, self.grid.pitch, strict=True)
        )
        cone: Cone = self.cone if self.cone in ("box", "disc") else "full"
        wave = spherical_wave(dy[:, None], dx[None], self.grid.pitch, self.wavelength, depth, cone)
        return even_fft2(wave.to(layers.dtype), raster.size)

    def _tapered_kernel(self, depth: float, raster: Raster, device: torch.device) -> Tensor:
        """The quadrant for ``cone="taper"``, divided by the area of a sample."""
        fy, fx = (
            torch.arange(size // 2 + 1, dtype=torch.float64, device=device) / (size * pitch)
            for size, pitch in zip(raster.size, self.grid.pitch, strict=True)
        )
        weights = taper(2 * self.grid.pitch[0] * fy)[:, None] * taper(2 * self.grid.pitch[1] * fx)
        spectrum = point_spectrum(fy[:, None], fx[None], self.wavelength, depth)
        return spectrum * (weights / math.prod(self.grid.pitch))

    def _band_kernel(self, depth: float, raster: Raster, apart: tuple[int, int]) -> Tensor:
        """The quadrant for ``cone="band"``: a band-limited transfer function times i / w over the area of a sample."""
        planes = plane_pair(
            Grid((apart[0] + 1, apart[1] + 1), self.grid.pitch), None, (0.0, 0.0), (0.0, 0.0), [self.wavelength]
        )
        wavelength, distance = (torch.tensor(value, dtype=torch.float64) for value in (self.wavelength, depth))
        padded = Grid(raster.size, self.grid.pitch)
        kernel = transfer_function(planes, padded, wavelength, distance, sampled=(False, False), paraxial=False)
        rows, columns = (size // 2 + 1 for size in raster.size)
        fy, fx = (frequency.abs() for frequency in padded.frequencies())
        axial = torch.sqrt(self.wavelength**-2 - fy[:rows].square() - fx[:, :columns].square())
        return 1j * kernel[:rows, :columns] / (axial * math.prod(self.grid.pitch))

    def accumulator(self, shape: tuple[int, int], phase: Tensor | None = None) -> "ConvolutionSum":
        """Running sum to which planes [h, w], real or complex, are added; ``phase`` [h, w] is common to all planes."""
        return ConvolutionSum(self, shape, phase)

    def _forward(self, layers: Tensor) -> Tensor:
        fields = layers.new_zeros(len(layers), *self.grid.shape)
        for item, field in zip(layers, fields, strict=True):
            total = self.accumulator((item.shape[-2], item.shape[-1]))
            for j, plane in enumerate(item):
                total.add(j, plane)
            field.copy_(total.finish())
        return fields

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        raster = self._raster(shape)
        spectra = [raster.spectrum_of_pixels(item) for item in field]
        out = field.new_zeros(len(field), len(self.depths), *shape)
        for j, depth in enumerate(self.depths):
            kernel = self._kernel(depth, raster, field).conj()
            for item, spectrum in enumerate(spectra):
                out[item, j] = raster.layer(multiply_even(spectrum.clone(), kernel))
        return out

    def _raster(self, shape: tuple[int, int]) -> Raster:
        return Raster(self.grid, shape, self.stride, self.padded(shape))


class ConvolutionSum:
    """Running sum of a :class:`ConvolutionHologram` over planes that are added in any order."""

    def __init__(self, operator: ConvolutionHologram, shape: tuple[int, int], phase: Tensor | None):
        self.operator, self.raster, self.phase = operator, operator._raster(shape), phase
        self.total: Tensor | None = None

    def add(self, j: int, plane: Tensor) -> None:
        """Add the plane at ``depths[j]``; a plane of zeros is skipped."""
        if not has_light(plane):
            return
        plane = plane.detach().to(torch.promote_types(plane.dtype, torch.complex64))
        if self.phase is not None:
            plane = plane * phasor(self.phase).to(plane.dtype)
        kernel = self.operator._kernel(self.operator.depths[j], self.raster, plane)
        spectrum = multiply_even(self.raster.repeated(self.raster.spectrum(plane)), kernel)
        self.total = spectrum if self.total is None else self.total.add_(spectrum)

    def finish(self) -> Tensor:
        """The field [H, W]; zeros if no plane emits light."""
        if self.total is None:
            return torch.zeros(self.operator.grid.shape, dtype=torch.complex64)
        return self.raster.pixels(self.total)
