"""Propagators as modules, one class per method."""

import math
import warnings
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import centred_fft2, centred_ifft2, fft2, filter_spectrum, ifft2
from holotorch.core.grid import Grid, Pair
from holotorch.core.learning import without_graph
from holotorch.core.operator import FieldOperator, Wavelengths
from holotorch.core.precision import double
from holotorch.core.quantities import DISTANCE
from holotorch.core.tracing import constant_when_compiled, is_exporting
from holotorch.optics.free_space.geometry import least_padding
from holotorch.optics.free_space.kernels import angular_spectrum_kernel, carrier, fresnel_kernel

_NEGLECTED = 2.0  # rad: neglected phase at the corner of the band for which the error of noise is half (measured)


class SpectralFilter(FieldOperator):
    """A linear operator that is diagonal in frequency.

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        kernel: Transfer function, complex [C, P, Q] in FFT order, with P >= H and Q >= W. The field is padded with
            zeros to P x Q samples. An ``nn.Parameter`` is learned.
        out_grid: Sampling of the result, which is cropped to the first samples of the padded grid; ``grid`` by default.
        learnable: Make the transfer function a Parameter, ``kernel``.

    Raises ValueError for a kernel that carries a gradient and is no Parameter.
    """

    kernel: Tensor

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        kernel: Tensor,
        *,
        out_grid: Grid | None = None,
        learnable: bool = False,
    ):
        super().__init__(grid, wavelengths, out_grid)
        self.padded = kernel.shape[-2], kernel.shape[-1]
        if learnable or isinstance(kernel, nn.Parameter):
            self.hold("kernel", kernel, learnable=True)
        else:
            self.keep("kernel", kernel)

    def _forward(self, field: Tensor) -> Tensor:
        return filter_spectrum(field, self.kernel_for(field), self.out_grid.shape)

    def _adjoint(self, field: Tensor) -> Tensor:
        return filter_spectrum(field, self.kernel_for(field).conj(), self.grid.shape)

    def kernel_for(self, field: Tensor) -> Tensor:
        """The transfer function, complex [C, P, Q], in the dtype of ``field``."""
        return self.kernel.to(field.dtype)

    def extra_repr(self) -> str:
        """Samplings, wavelengths and padded size, for ``print(module)``."""
        return f"{super().extra_repr()}, padded={tuple(self.padded)}"


class DistanceFilter(SpectralFilter):
    """A :class:`SpectralFilter` whose transfer function follows from wavelengths and a distance, which may be learned.

    The function is stored in complex64 for complex64 fields. For complex128 fields it is computed at the first
    call and then kept. If wavelengths or distance are learned, it is computed in every call.

    Args:
        grid, wavelengths, out_grid: As for :class:`FieldOperator`; wavelengths, [C], may be an ``nn.Parameter``.
        distance: In metres, negative for backward propagation; may be an ``nn.Parameter``.
        padded: Number of samples (y, x) of the transforms.
        transfer_function: Function from wavelengths [C] and distance, float64, and a dtype to the transfer function
            [C, *padded] with the factor exp(ikz).
        times: Function from a spectrum [..., C, *padded], which it may overwrite, wavelengths and distance to the
            product of the spectrum with the transfer function; used where they are learned, if it is cheaper.
        learnable: Make the distance a Parameter.

    Attributes:
        distance: In metres, a float, or a Parameter if it is learned.
        wavelength: Wavelengths as float64 tensor [C], a Parameter if they are learned.
    """

    distance: float | Tensor
    wavelength: Tensor
    single_kernel: Tensor
    double_kernel: Tensor | None

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float | Tensor,
        padded: tuple[int, int],
        transfer_function: Callable[[Tensor, Tensor, torch.dtype], Tensor],
        *,
        times: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None,
        out_grid: Grid | None = None,
        learnable: bool = False,
    ):
        FieldOperator.__init__(self, grid, checked_wavelengths(wavelengths), out_grid)
        self.padded, self._transfer_function, self._times = padded, transfer_function, times
        learned = self.hold("distance", distance, learnable=learnable)
        if isinstance(wavelengths, nn.Parameter):
            learned = self.hold("wavelength", wavelengths)
        else:
            self.keep("wavelength", torch.tensor(self.wavelengths, dtype=torch.float64))
        kernel = None if learned else self.transfer_function()
        self.keep("single_kernel", kernel if kernel is None else kernel.to(torch.complex64))
        self.keep("double_kernel", None)
        self.learned = learned

    def transfer_function(self, dtype: torch.dtype = torch.complex128) -> Tensor:
        """The transfer function for the present wavelengths and distance, complex [C, P, Q], with their gradients."""
        return self._transfer_function(*self._lengths(), dtype)

    def _lengths(self) -> tuple[Tensor, Tensor]:
        distance = double(self.distance, self.wavelength.device)
        return self.wavelength.reshape(-1), distance

    def _forward(self, field: Tensor) -> Tensor:
        if not self.learned or self._times is None:
            return super()._forward(field)
        return ifft2(self._times(fft2(field, self.padded), *self._lengths()), self.out_grid.shape)

    def _adjoint(self, field: Tensor) -> Tensor:
        if not self.learned or self._times is None:
            return super()._adjoint(field)
        return ifft2(self._times(fft2(field, self.padded).conj(), *self._lengths()).conj(), self.grid.shape)

    def kernel_for(self, field: Tensor) -> Tensor:
        """The transfer function, complex [C, P, Q], in the dtype of ``field``."""
        if self.learned:
            return self.transfer_function(field.dtype)
        if field.dtype == torch.complex64:
            return self.single_kernel
        if is_exporting():
            return self.transfer_function()
        self._keep_double_kernel()
        assert self.double_kernel is not None
        return self.double_kernel

    @constant_when_compiled
    def _keep_double_kernel(self) -> None:
        """Have the kernel for complex128; torch.compile computes it when it traces, not in each call."""
        if self.double_kernel is None:
            with torch.inference_mode(False):  # a later call may need gradients
                self.double_kernel = self.transfer_function()


class _PaddedKernel(DistanceFilter):
    """Transfer function sampled on a padded grid; computing it takes ``bytes_each`` bytes per sample (measured)."""

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float | Tensor,
        pad: float | Pair,
        kernel: Callable[[Grid, Tensor, Tensor], Tensor],
        bytes_each: int,
        *,
        paraxial: bool,
        wraps: bool,
        learnable: bool,
    ):
        z, padded = checked_distance(distance), grid.padded(pad)
        channels = len(checked_wavelengths(wavelengths))
        checks.affordable(
            bytes_each * channels * math.prod(padded.shape),
            f"the kernel of {type(self).__name__} on {padded.shape[0]} x {padded.shape[1]} samples in "
            f"{channels} channel(s)",
            "use a smaller grid or less padding",
        )
        transfer_function = partial(_with_carrier, kernel, padded)
        value = distance if isinstance(distance, Tensor) else z
        super().__init__(grid, wavelengths, value, padded.shape, transfer_function, learnable=learnable)
        needed = least_padding(grid, max(self.wavelengths), z, paraxial=paraxial)
        actual = [big / small for big, small in zip(padded.shape, grid.shape, strict=True)]
        if all(have >= want for have, want in zip(actual, needed, strict=True)):
            return
        if all(math.isfinite(want) for want in needed):
            y, x = (math.ceil(want * 100) / 100 for want in needed)  # rounded up, so that the advice holds
            advice = f"pad=({y:.2f}, {x:.2f}) keeps all of it, CroppedKernel does at twice the window"
        else:
            advice = "no padding keeps all of it, since the pitch is at most half a wavelength"
        warnings.warn(
            f"{type(self).__name__} over {z:g} m: light of the grid's full band at {max(self.wavelengths):g} m "
            f"wavelength spreads beyond the padded window (pad {actual[0]:.3g} x {actual[1]:.3g}) and "
            f"{'re-enters on the other side' if wraps else 'is cut off'}; {advice}",
            SamplingWarning,
            stacklevel=3,
        )


def _with_carrier(
    kernel: Callable[[Grid, Tensor, Tensor], Tensor],
    padded: Grid,
    wavelength: Tensor,
    distance: Tensor,
    dtype: torch.dtype,
) -> Tensor:
    return (kernel(padded, wavelength, distance) * carrier(wavelength, distance)[:, None, None]).to(dtype)


def checked_wavelengths(wavelengths: Wavelengths) -> tuple[float, ...]:
    """``wavelengths`` in metres as floats, also those of an ``nn.Parameter``, or an exception if one is implausible."""
    return checks.wavelengths(wavelengths.detach() if isinstance(wavelengths, nn.Parameter) else wavelengths)


def checked_distance(distance: float | Tensor) -> float:
    """``distance`` in metres as a float; an exception if it is implausible, or has a gradient but is no Parameter."""
    without_graph("distance", distance)
    return checks.quantity(DISTANCE, distance.detach() if isinstance(distance, Tensor) else distance)


class AngularSpectrum(_PaddedKernel):
    """Exact scalar propagation over ``distance`` by the angular spectrum; includes the carrier exp(ikz).

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        distance: In metres, negative for backward propagation. Wavelengths [C] and distance may be ``nn.Parameter``;
            the transfer function is then computed in every call.
        pad: Zero padding as a factor >= 1, one number or one per axis (y, x). 1 is the periodic model: light that
            leaves on one side enters on the other.
        band_limit: Drop frequencies that the padded grid undersamples, as :func:`angular_spectrum_kernel` explains.
        learnable: Make the distance a Parameter.

    Raises:
        ValueError: A number outside its range, or ``pad`` below 1.
        MemoryError: The padded kernel needs more memory than is available.

    Warns:
        SamplingWarning: Light at the highest frequencies of the grid leaves the padded window; the message names a
            sufficient padding. The warning may be ignored for a field of lower frequencies.

    Source: Goodman, Sec. 3.10; Matsushima and Shimobaba (2009).
    """

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float | Tensor,
        *,
        pad: float | Pair = 2,
        band_limit: bool = True,
        learnable: bool = False,
    ):
        kernel = partial(angular_spectrum_kernel, band_limit=band_limit)
        super().__init__(
            grid, wavelengths, distance, pad, kernel, 90, paraxial=False, wraps=not band_limit, learnable=learnable
        )


class Fresnel(_PaddedKernel):
    """Paraxial propagation over ``distance`` by its transfer function; includes the carrier exp(ikz).

    Arguments, errors and the warning are those of :class:`AngularSpectrum`. The relative error is about
    k z (wavelength f)^4 / 8, where f is the highest frequency of the field. ``pad=1`` is the thesis's model (Sec. 4.5).

    Warns:
        SamplingWarning: This error exceeds 2 at the highest frequencies of the grid. Noise that fills the band is then
            off by half. The warning may be ignored for a field of lower frequencies.
    """

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float | Tensor,
        *,
        pad: float | Pair = 2,
        learnable: bool = False,
    ):
        super().__init__(
            grid, wavelengths, distance, pad, fresnel_kernel, 40, paraxial=True, wraps=True, learnable=learnable
        )
        # The neglected phase is proportional to the cube of the wavelength.
        z, longest = checked_distance(distance), max(self.wavelengths)
        square = sum((longest / (2 * pitch)) ** 2 for pitch in grid.pitch)
        neglected = 2 * math.pi / longest * abs(z) * square**2 / 8
        if neglected > _NEGLECTED:
            warnings.warn(
                f"Fresnel over {z:g} m: light of the grid's highest frequencies at {longest:g} m wavelength lacks a "
                f"phase of {neglected:.2g} rad; AngularSpectrum and CroppedKernel include it",
                SamplingWarning,
                stacklevel=2,
            )


class Fraunhofer(FieldOperator):
    """Far field: the unitary DFT with the origin of both planes on sample ``n // 2``. The adjoint is the inverse.

    Output sample m (counted from the centre) of an axis with n samples belongs to the direction
    sin(angle) = m wavelength / (n pitch). No distance enters: at a distance z the relative error of the amplitude is
    about pi r^2 / (wavelength z), a phase that is neglected, with r from the axis to the corner of the window.
    Source: thesis Eq. 4.10.
    """

    def __init__(self, grid: Grid, wavelengths: Wavelengths):
        super().__init__(grid, wavelengths)

    def _forward(self, field: Tensor) -> Tensor:
        return centred_fft2(field)

    def _adjoint(self, field: Tensor) -> Tensor:
        return centred_ifft2(field)
