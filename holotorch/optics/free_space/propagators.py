"""Propagators as modules, one class per method."""

import math
import warnings
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import centred_fft2, centred_ifft2, filter_spectrum
from holotorch.core.grid import Grid, Pair
from holotorch.core.operator import FieldOperator, Wavelengths
from holotorch.core.quantities import DISTANCE
from holotorch.optics.free_space.geometry import least_padding
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, fresnel_kernel


class SpectralFilter(FieldOperator):
    """A linear operator that is diagonal in frequency.

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        kernel: Transfer function, complex128 [C, P, Q] in FFT order, with P >= H and Q >= W. The field is padded with
            zeros to P x Q samples.
        out_grid: Sampling of the result, which is cropped to the first samples of the padded grid; ``grid`` by default.

    Attributes:
        kernel: The transfer function as real pairs, float64 [C, P, Q, 2].
        single: ``kernel`` in float32, for complex64 fields; converting it in each call would take up to a quarter of
            the time of the call.
    """

    kernel: Tensor
    single: Tensor

    def __init__(self, grid: Grid, wavelengths: Wavelengths, kernel: Tensor, *, out_grid: Grid | None = None):
        super().__init__(grid, wavelengths, out_grid)
        self.register_complex("kernel", kernel)
        self.register_buffer("single", self.kernel.to(torch.float32), persistent=False)

    def _forward(self, field: Tensor) -> Tensor:
        return filter_spectrum(field, self.kernel_for(field), self.out_grid.shape)

    def _adjoint(self, field: Tensor) -> Tensor:
        return filter_spectrum(field, self.kernel_for(field).conj(), self.grid.shape)

    def kernel_for(self, field: Tensor) -> Tensor:
        """The transfer function, complex [C, P, Q], in the dtype of ``field``."""
        return torch.view_as_complex(self.single if field.dtype == torch.complex64 else self.kernel)

    def extra_repr(self) -> str:
        """Samplings, wavelengths and padded size, for ``print(module)``."""
        return f"{super().extra_repr()}, padded={tuple(self.kernel.shape[-3:-1])}"


class _PaddedKernel(SpectralFilter):
    """Transfer function sampled on a padded grid; computing it takes ``bytes_each`` bytes per sample (measured)."""

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float,
        pad: float | Pair,
        transfer_function: Callable[[Grid, Tensor, float], Tensor],
        bytes_each: int,
        *,
        paraxial: bool,
        wraps: bool,
    ):
        distance, padded = checks.quantity(DISTANCE, distance), grid.padded(pad)
        wavelength = torch.tensor(checks.wavelengths(wavelengths), dtype=torch.float64)
        checks.affordable(
            bytes_each * len(wavelength) * math.prod(padded.shape),
            f"the kernel of {type(self).__name__} on {padded.shape[0]} x {padded.shape[1]} samples in "
            f"{len(wavelength)} channel(s)",
            "use a smaller grid or less padding",
        )
        kernel = transfer_function(padded, wavelength, distance) * carrier(wavelength, distance)[:, None, None]
        super().__init__(grid, wavelengths, kernel)
        self.distance = distance
        needed = least_padding(grid, max(self.wavelengths), distance, paraxial=paraxial)
        actual = [big / small for big, small in zip(padded.shape, grid.shape, strict=True)]
        if all(have >= want for have, want in zip(actual, needed, strict=True)):
            return
        if all(math.isfinite(want) for want in needed):
            y, x = (math.ceil(want * 100) / 100 for want in needed)  # rounded up, so that the advice holds
            advice = f"pad=({y:.2f}, {x:.2f}) keeps all of it, CroppedKernel does at twice the window"
        else:
            advice = "no padding keeps all of it, since the pitch is at most half a wavelength"
        warnings.warn(
            f"{type(self).__name__} over {distance:g} m: light of the grid's full band at {max(self.wavelengths):g} m "
            f"wavelength spreads beyond the padded window (pad {actual[0]:.3g} x {actual[1]:.3g}) and "
            f"{'re-enters on the other side' if wraps else 'is cut off'}; {advice}",
            SamplingWarning,
            stacklevel=3,
        )


class AngularSpectrum(_PaddedKernel):
    """Exact scalar propagation over ``distance`` by the angular spectrum; includes the carrier exp(ikz).

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        distance: In metres, negative for backward propagation.
        pad: Zero padding as a factor >= 1, one number or one per axis (y, x). 1 is the periodic model: light that
            leaves on one side enters on the other.
        band_limit: Drop frequencies that the padded grid undersamples, as :func:`angular_spectrum_kernel` explains.

    Raises:
        ValueError: A number outside its range, or ``pad`` below 1.
        MemoryError: The padded kernel needs more memory than is available.

    Warns:
        SamplingWarning: Light at the highest frequencies of the grid leaves the padded window; the message names a
            sufficient padding. The warning may be ignored for a field of lower frequencies.

    Source: Goodman, Sec. 3.10; Matsushima and Shimobaba (2009).
    """

    def __init__(
        self, grid: Grid, wavelengths: Wavelengths, distance: float, *, pad: float | Pair = 2, band_limit: bool = True
    ):
        kernel = partial(angular_spectrum_kernel, band_limit=band_limit)
        super().__init__(grid, wavelengths, distance, pad, kernel, 90, paraxial=False, wraps=not band_limit)


class Fresnel(_PaddedKernel):
    """Paraxial propagation over ``distance`` by its transfer function; includes the carrier exp(ikz).

    Arguments, errors and the warning are those of :class:`AngularSpectrum`. The relative error is about
    k z (wavelength f)^4 / 8, where f is the highest frequency of the field. ``pad=1`` is the thesis's model (Sec. 4.5).
    """

    def __init__(self, grid: Grid, wavelengths: Wavelengths, distance: float, *, pad: float | Pair = 2):
        super().__init__(grid, wavelengths, distance, pad, fresnel_kernel, 40, paraxial=True, wraps=True)


class Fraunhofer(FieldOperator):
    """Far field: the unitary DFT with the origin of both planes on sample ``n // 2``. The adjoint is the inverse.

    Output sample m (counted from the centre) of an axis with n samples belongs to the direction
    sin(angle) = m wavelength / (n pitch). Source: thesis Eq. 4.10.
    """

    def __init__(self, grid: Grid, wavelengths: Wavelengths):
        super().__init__(grid, wavelengths)

    def _forward(self, field: Tensor) -> Tensor:
        return centred_fft2(field)

    def _adjoint(self, field: Tensor) -> Tensor:
        return centred_ifft2(field)
