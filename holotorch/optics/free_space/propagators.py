"""Propagators as modules: one class per method, kernels kept as buffers."""

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import centred_fft2, centred_ifft2, filter_spectrum
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE
from holotorch.optics.free_space.geometry import least_padding
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, fresnel_kernel


class SpectralFilter(nn.Module):
    """A linear operator that is diagonal in frequency: fields complex [..., C, H, W] to the same dtype.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        kernel: complex128, shape [C, P, Q], FFT order, at least as large as ``grid``; the excess is zero padding.
        out_grid: Sampling of the result, its first samples on the padded grid; that of the field by default.

    ``kernel`` is kept as a pair of float64 numbers, and ``single`` as its float32 copy: casting it in each call would
    cost up to a quarter of the call. complex64 and complex128 fields both get the best kernel of their kind; ``.to``
    and ``.float()`` move both to another device but never reduce them.
    """

    kernel: Tensor
    single: Tensor

    def __init__(
        self, grid: Grid, wavelengths: float | Sequence[float], kernel: Tensor, *, out_grid: Grid | None = None
    ):
        super().__init__()
        self.grid, self.out_grid, self.wavelengths = grid, out_grid or grid, checks.wavelengths(wavelengths)
        # A real pair: Module.to(dtype) would drop the imaginary part of a complex buffer.
        pair = torch.view_as_real(kernel).contiguous()
        self.register_buffer("kernel", pair, persistent=False)
        self.register_buffer("single", pair.to(torch.float32), persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Apply the filter to ``field`` [..., C, H, W]; TypeError if it is real, ValueError if its shape differs."""
        return filter_spectrum(field, self._kernel_for(field, self.grid), self.out_grid.shape)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W'] of the output grid."""
        return filter_spectrum(field, self._kernel_for(field, self.out_grid).conj(), self.grid.shape)

    def _kernel_for(self, field: Tensor, grid: Grid) -> Tensor:
        checks.field("field", field, (len(self.wavelengths), *grid.shape))
        return torch.view_as_complex(self.single if field.dtype == torch.complex64 else self.kernel)

    def _apply(self, fn, recurse=True):
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)

    def extra_repr(self) -> str:
        """Sampling and wavelengths, for ``print(module)``."""
        return f"grid={self.grid}, wavelengths={self.wavelengths}, padded={tuple(self.kernel.shape[-3:-1])}"


class AngularSpectrum(SpectralFilter):
    """Exact scalar propagation over ``distance`` by the angular spectrum; includes the carrier exp(ikz).

    Args:
        grid: Sampling of the field, which is also that of the result.
        wavelengths: In metres, one per channel.
        distance: In metres, negative to travel back.
        pad: Zero padding as a factor >= 1, per axis (y, x) or one for both. 1 is the periodic model: light that
            leaves on one side enters on the other.
        band_limit: Drop frequencies that the padded grid undersamples (see :func:`angular_spectrum_kernel`).

    Raises:
        ValueError: A wavelength that is not positive, a distance that is not finite, ``pad`` below 1.
        MemoryError: The padded kernel needs more memory than is available.

    Warns:
        SamplingWarning: The padding does not serve the grid's whole band at this distance; the message names the
            padding that would. Harmless for a field whose own band is narrow enough.

    Source: Goodman, Sec. 3.10; Matsushima and Shimobaba (2009).
    """

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        distance: float,
        *,
        pad: float | tuple[float, float] = 2,
        band_limit: bool = True,
    ):
        distance = checks.quantity(DISTANCE, distance)
        wavelength_tensor = torch.tensor(checks.wavelengths(wavelengths), dtype=torch.float64)
        padded = _affordable(type(self).__name__, grid.padded(pad), len(wavelength_tensor), 90)
        kernel = angular_spectrum_kernel(padded, wavelength_tensor, distance, band_limit=band_limit)
        super().__init__(grid, wavelengths, kernel * carrier(wavelength_tensor, distance)[:, None, None])
        self.distance = distance
        _warn_if_short(self, least_padding(grid, max(self.wavelengths), distance), wraps=not band_limit)


class Fresnel(SpectralFilter):
    """Paraxial propagation over ``distance`` by its transfer function; includes the carrier exp(ikz).

    Arguments, errors and warning as for :class:`AngularSpectrum`. Adequate while k z (wavelength f)^4 / 8 stays below
    the wanted error for the field's highest frequency f. ``pad=1`` is the thesis's model (Sec. 4.5).
    """

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        distance: float,
        *,
        pad: float | tuple[float, float] = 2,
    ):
        distance = checks.quantity(DISTANCE, distance)
        wavelength_tensor = torch.tensor(checks.wavelengths(wavelengths), dtype=torch.float64)
        padded = _affordable(type(self).__name__, grid.padded(pad), len(wavelength_tensor), 40)
        kernel = fresnel_kernel(padded, wavelength_tensor, distance)
        super().__init__(grid, wavelengths, kernel * carrier(wavelength_tensor, distance)[:, None, None])
        self.distance = distance
        _warn_if_short(self, least_padding(grid, max(self.wavelengths), distance, paraxial=True), wraps=True)


class Fraunhofer(nn.Module):
    """Far field: the unitary DFT, origin of both planes on sample ``n // 2``. It keeps power; its adjoint inverts it.

    Output sample m (counted from the centre) of an axis with n samples is the direction
    sin(angle) = m wavelength / (n pitch). Fields are complex [..., C, H, W]. Source: thesis Eq. 4.10.
    """

    def __init__(self, grid: Grid, wavelengths: float | Sequence[float]):
        super().__init__()
        self.grid, self.wavelengths = grid, checks.wavelengths(wavelengths)

    def extra_repr(self) -> str:
        """Sampling and wavelengths, for ``print(module)``."""
        return f"grid={self.grid}, wavelengths={self.wavelengths}"

    def forward(self, field: Tensor) -> Tensor:
        """Transform ``field`` [..., C, H, W]; TypeError if it is real, ValueError if its shape differs."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        return centred_fft2(field)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose, which is the inverse; same shapes as :meth:`forward`."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        return centred_ifft2(field)


def _affordable(name: str, padded: Grid, channels: int, each: int) -> Grid:
    """``padded``, or MemoryError if its kernel, which takes ``each`` bytes per sample (measured), is not affordable."""
    height, width = padded.shape
    checks.affordable(
        each * channels * height * width,
        f"the kernel of {name} on {height} x {width} samples in {channels} channel(s)",
        "use a smaller grid or less padding",
    )
    return padded


def _warn_if_short(module: AngularSpectrum | Fresnel, needed: tuple[float, float], *, wraps: bool) -> None:
    padded = module.kernel.shape[-3:-1]
    actual = [big / small for big, small in zip(padded, module.grid.shape, strict=True)]
    if all(have >= want for have, want in zip(actual, needed, strict=True)):
        return
    if all(math.isfinite(want) for want in needed):
        y, x = (math.ceil(want * 100) / 100 for want in needed)  # rounded up, so that the advice holds
        advice = f"pad=({y:.2f}, {x:.2f}) keeps all of it, CroppedKernel does at twice the window"
    else:
        advice = "no padding keeps all of it, since the pitch is at most half a wavelength"
    warnings.warn(
        f"{type(module).__name__} over {module.distance:g} m: light of the grid's full band at "
        f"{max(module.wavelengths):g} m wavelength spreads beyond the padded window (pad {actual[0]:.3g} x "
        f"{actual[1]:.3g}) and {'re-enters on the other side' if wraps else 'is cut off'}; {advice}",
        SamplingWarning,
        stacklevel=3,
    )
