"""ConvolutionHologram: exact holograms by one convolution per plane of sources."""

import math

import torch
from torch import Tensor

from holotorch.core.complex import phasor
from holotorch.core.fourier import even_fft2, multiply_even
from holotorch.core.grid import Grid
from holotorch.core.learning import fixed
from holotorch.hologram.band_limited import point_spectrum
from holotorch.hologram.cone import Cone, cone_samples, is_plain, spherical_wave, taper, taper_margin
from holotorch.hologram.layered import LayerHologram
from holotorch.hologram.raster import Raster, has_light, span, strided_length
from holotorch.optics.free_space.plane_pair import plane_pair
from holotorch.optics.free_space.transfer import transfer_function

# Accepted amplitude of light that wraps around, relative to the spherical wave. The closed form of the full wave
# replaces the tapered wave if the two differ by less than this fraction.
TAPER_ERROR = 2e-7


class ConvolutionHologram(LayerHologram):
    """The sum of ``DirectHologram`` by FFT: thesis Eqs. 5.8 to 5.14 and Algorithm 5, exact to rounding but for "band".

    Phases are computed in float64 before they are cast to the dtype of the layers. Each plane needs one FFT of its
    sources, with one sample per source, and half an FFT for its kernel, which is even in y and x. The spectra of the
    planes are summed and transformed back together. If along an axis the sources extend over V samples, the pixels over
    H and the cone over K, no light wraps around at the padded length max(V, H, (V + H + K) / 2); Sec. 5.6.1 uses H + K.

    Arguments and exceptions as for :class:`LayerHologram`. For ``cone="taper"`` the arrays are so long that at most
    2e-7 of a wave wraps around. ``cone="band"`` uses the kernel of ``CroppedKernel``, whose relative error is about
    2 s^2 / sqrt(N / 2), where s is wavelength / (2 pitch) and N the padded length in samples.
    """

    def padded(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Size of the transforms in samples for layers of ``shape`` (h, w)."""
        displacement, least = span(self.grid, shape, self.stride)
        # The planes that are tapered in frequency are the nearest ones. Among them, and among the others, the farthest
        # plane has the widest kernel.
        depths = sorted(self.depths)
        tapered, others = 0, len(depths)
        while tapered < others:  # bisection; that of the standard library cannot be compiled
            middle = (tapered + others) // 2
            if self._in_frequency(depths[middle], displacement):
                tapered = middle + 1
            else:
                others = middle
        extents = [self._extent(depth, displacement) for depth in (depths[max(0, tapered - 1)], depths[-1])]
        # No light wraps onto a pixel if the length exceeds the largest displacement plus the half-width of the kernel.
        y, x = (
            strided_length(max(length, samples + max(extent) + 1), self.stride)
            for length, samples, extent in zip(least, displacement, zip(*extents, strict=True), strict=True)
        )
        return y, x

    def _extent(self, depth: float, displacement: tuple[int, int]) -> tuple[int, int]:
        """Half-width (y, x) in samples of the kernel at ``depth``, for displacements up to ``displacement`` samples."""
        if self._in_frequency(depth, displacement):
            sines = [self.wavelength / (2 * pitch) for pitch in self.grid.pitch]
            path = depth / math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2)  # path of the steepest light in metres
            half = [path * sine / pitch for sine, pitch in zip(sines, self.grid.pitch, strict=True)]
            y, x = (math.ceil(width + taper_margin(width, TAPER_ERROR)) for width in half)
            return y, x
        if self.cone not in ("box", "disc"):
            return displacement
        half = cone_samples(self.grid, self.wavelength, depth)
        y, x = (math.floor(min(most, width * (1 + 1e-12))) for most, width in zip(displacement, half, strict=True))
        return y, x

    def kernel_samples(self, depth: float, shape: tuple[int, int], size: tuple[int, int]) -> tuple[int, int]:
        """Size (y, x) in samples of the computed quadrant of the kernel, for layers of ``shape`` padded to ``size``."""
        displacement, _ = span(self.grid, shape, self.stride)
        if self._in_frequency(depth, displacement):
            return size[0] // 2 + 1, size[1] // 2 + 1
        extent = self._extent(depth, displacement)
        y, x = (min(samples, length // 2) + 1 for samples, length in zip(extent, size, strict=True))
        return y, x

    def _in_frequency(self, depth: float, displacement: tuple[int, int]) -> bool:
        """Whether the kernel at ``depth`` is tapered in frequency, rather than computed in space in closed form."""
        return self.cone == "taper" and not is_plain(self.grid, self.wavelength, depth, displacement, TAPER_ERROR)

    def _kernel(self, depth: float, raster: Raster, layers: Tensor) -> Tensor:
        """First quadrant of the spectrum of the spherical wave from ``depth``, in the dtype of ``layers``."""
        displacement, _ = span(self.grid, raster.shape, self.stride)
        if self.cone == "band":
            return self._band_kernel(depth, raster, displacement).to(layers.device, layers.dtype)
        if self._in_frequency(depth, displacement):
            fy, fx = raster.frequencies(layers.device)
            weights = taper(2 * self.grid.pitch[0] * fy) * taper(2 * self.grid.pitch[1] * fx)
            spectrum = point_spectrum(fy, fx, self.wavelength, depth)
            return (spectrum * (weights / math.prod(self.grid.pitch))).to(layers.dtype)
        dy, dx = (
            torch.arange(count, dtype=torch.float64, device=layers.device) * pitch
            for count, pitch in zip(self.kernel_samples(depth, raster.shape, raster.size), self.grid.pitch, strict=True)
        )
        cone: Cone = self.cone if self.cone in ("box", "disc") else "full"
        wave = spherical_wave(dy[:, None], dx[None], self.grid.pitch, self.wavelength, depth, cone)
        return even_fft2(wave.to(layers.dtype), raster.size)

    def _band_kernel(self, depth: float, raster: Raster, displacement: tuple[int, int]) -> Tensor:
        """First quadrant of the spectrum for ``cone="band"``: the band-limited transfer function times i / (w A).

        w is the axial frequency in cycles per metre and A the area of a pixel in square metres.
        """
        window = Grid((displacement[0] + 1, displacement[1] + 1), self.grid.pitch)
        planes = plane_pair(window, None, (0.0, 0.0), (0.0, 0.0), [self.wavelength])
        wavelength, distance = (torch.tensor(value, dtype=torch.float64) for value in (self.wavelength, depth))
        padded = Grid(raster.size, self.grid.pitch)
        kernel = transfer_function(planes, padded, wavelength, distance, sampled=(False, False), paraxial=False)
        rows, columns = (size // 2 + 1 for size in raster.size)
        fy, fx = (frequency.abs() for frequency in padded.frequencies())
        axial = torch.sqrt(self.wavelength**-2 - fy[:rows].square() - fx[:, :columns].square())
        return 1j * kernel[:rows, :columns] / (axial * math.prod(self.grid.pitch))

    def accumulator(self, shape: tuple[int, int], phase: Tensor | None = None) -> "ConvolutionSum":
        """Running sum over planes of ``shape`` (h, w); ``phase`` in rad, [h, w], is added to the phase of each."""
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
        raster = self.raster(shape)
        spectra = [raster.spectrum_of_pixels(item) for item in field]
        out = field.new_zeros(len(field), len(self.depths), *shape)
        for j, depth in enumerate(self.depths):
            kernel = self._kernel(depth, raster, field).conj()
            for item, spectrum in enumerate(spectra):
                out[item, j] = raster.layer(multiply_even(spectrum.clone(), kernel))
        return out

    def raster(self, shape: tuple[int, int]) -> Raster:
        """Padded array for layers of ``shape`` (h, w)."""
        return Raster(self.grid, shape, self.stride, self.padded(shape))


class ConvolutionSum:
    """Running sum of a :class:`ConvolutionHologram` over planes that are added in any order."""

    def __init__(self, operator: ConvolutionHologram, shape: tuple[int, int], phase: Tensor | None):
        fixed("phase", phase, "call the hologram with layers [..., D, h, w], which is differentiable")
        self.operator, self.raster, self.phase = operator, operator.raster(shape), phase
        self.total: Tensor | None = None

    def add(self, j: int, plane: Tensor) -> None:
        """Add the plane at ``depths[j]``, real or complex [h, w]; a plane of zeros is skipped."""
        if not has_light(plane):
            return
        fixed("plane", plane, "call the hologram with layers [..., D, h, w], which is differentiable")
        plane = plane.detach().to(torch.promote_types(plane.dtype, torch.complex64))
        if self.phase is not None:
            plane = plane * phasor(self.phase).to(plane.dtype)
        kernel = self.operator._kernel(self.operator.depths[j], self.raster, plane)
        stride = self.operator.stride
        spectrum = multiply_even(self.raster.spectrum(plane).repeat(stride, stride), kernel)
        self.total = spectrum if self.total is None else self.total.add_(spectrum)

    def finish(self) -> Tensor:
        """The field [H, W]; zeros if no plane emits light."""
        if self.total is None:
            return torch.zeros(self.operator.grid.shape, dtype=torch.complex64)
        return self.raster.pixels(self.total)
