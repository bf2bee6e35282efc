"""PupilViews: fields of a hologram through distant pupils, each at its focal distance, without lenses."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.fourier import fft2, good_length, ifft2
from holotorch.core.grid import Grid, Pair
from holotorch.core.learning import PreciseModule
from holotorch.core.operator import Wavelengths
from holotorch.core.precision import double
from holotorch.core.quantities import DISTANCE
from holotorch.core.tracing import constant_when_compiled, is_exporting
from holotorch.optics.free_space.kernels import angular_spectrum_kernel


@dataclass(frozen=True)
class View:
    """One view of a hologram: the distance an eye focuses on, and the directions that its pupil lets through.

    Attributes:
        focus: Depth in metres behind the hologram (> 0; virtual images) or in front of it (< 0) that is sharp.
        radius: Sine of the half-angle of the cone of light that the pupil accepts: for a distant eye, the radius of the
            pupil over its distance. math.inf accepts all.
        centre: Sines (y, x) of the direction of the pupil's centre.
        covered: Vector (y, x) towards the half of the pupil that is covered, as by the edge of an eye box; (0, 0) if
            the whole pupil is open.
    """

    focus: float
    radius: float = math.inf
    centre: Pair = (0.0, 0.0)
    covered: Pair = (0.0, 0.0)

    def __post_init__(self):
        checks.quantity(DISTANCE, self.focus, "focus")
        if not self.radius > 0:
            raise ValueError(f"radius of a pupil is the sine of an angle and must be above 0, got {self.radius!r}")
        checks.pair("centre", self.centre, "sines")
        checks.pair("covered", self.covered)

    @property
    def steepest(self) -> float:
        """Largest sine (y or x) of a direction within the pupil."""
        return self.radius + max(map(abs, self.centre))


class PupilViews(PreciseModule):
    """The fields of V views of a hologram, [..., C, V, H, W], from its field [..., C, H, W].

    Each view is the field propagated back to the focal distance, exactly, through a pupil far from the hologram, which
    selects directions: IFT P_v H_v FT. The forward transform is shared. The intensity of a result is the image on a
    retina whose eye has no aberrations, magnified back onto the pixels of the hologram. Pixels resolve this intensity
    if the pupil is at most half as wide as their band; for a wider pupil, they undersample it.

    Outside the window of the hologram the field is 0. The transforms are padded for the light within the pupils, at
    most over ``longest`` metres, so that it does not wrap around.

    Args:
        grid: Pixels of the hologram.
        wavelengths: In metres, one per channel.
        views: The views.
        longest: Largest distance in metres for which the padding suffices; by default that of the views.

    Raises:
        ValueError: No views; a pupil outside of the directions that the pixels can emit, or that contains none of the
            sampled directions; in a call: a field of another shape.
        TypeError: In a call: a field that is not complex.
    """

    image_axes = 3  # of a result: (V, H, W)
    single_kernel: Tensor
    double_kernel: Tensor | None

    def __init__(self, grid: Grid, wavelengths: Wavelengths, views: Sequence[View], *, longest: float | None = None):
        super().__init__()
        self.grid, self.wavelengths, self.views = grid, checks.wavelengths(wavelengths), tuple(views)
        if not self.views:
            raise ValueError("PupilViews needs at least one view, got none")
        longest = max(abs(view.focus) for view in self.views) if longest is None else abs(longest)
        self.padded = view_padding(grid, self.wavelengths, self.views, longest)
        kernel = self._kernel(torch.device("cpu"))
        for colour, v in (kernel == 0).flatten(-2).all(-1).nonzero().tolist():
            limit = self.wavelengths[colour] / 2 / max(grid.pitch)
            raise ValueError(
                f"the pupil of {self.views[v]} must lie within the directions that the pixels emit, sines up to "
                f"{limit:.3g} at {self.wavelengths[colour]:g} m, and be wide enough to contain one of them"
            )
        self.keep("single_kernel", kernel.to(torch.complex64))
        self.keep("double_kernel", None)

    def _kernel(self, device: torch.device) -> Tensor:
        """Transfer functions of all views, complex128 [C, V, P, Q]."""
        wavelength = double(self.wavelengths, device)
        return torch.stack([view_kernel(self.padded, wavelength, view, -view.focus) for view in self.views], 1)

    def kernel_for(self, field: Tensor) -> Tensor:
        """The transfer functions, complex [C, V, P, Q], in the dtype of ``field``."""
        if field.dtype == torch.complex64:
            return self.single_kernel
        if is_exporting():
            return self._kernel(field.device)
        self._keep_double_kernel(field.device)
        assert self.double_kernel is not None
        return self.double_kernel

    @constant_when_compiled
    def _keep_double_kernel(self, device: torch.device) -> None:
        """Have the kernels for complex128; torch.compile computes them when it traces, not in each call."""
        if self.double_kernel is None:
            with torch.inference_mode(False):  # a later call may need gradients
                self.double_kernel = self._kernel(device)

    def forward(self, field: Tensor) -> Tensor:
        """The fields of all views, complex [..., C, V, H, W], of ``field`` [..., C, H, W], same dtype."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        spectrum = fft2(field, self.padded.shape)
        return ifft2(spectrum[..., None, :, :] * self.kernel_for(field), self.grid.shape)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, V, H, W]; the result is [..., C, H, W]."""
        checks.field("field", field, self.grid.shape)
        expected = len(self.wavelengths), len(self.views), *self.grid.shape
        if tuple(field.shape[-4:]) != expected:
            raise ValueError(f"field must end in (C, V, H, W) = {expected}, got {tuple(field.shape)}")
        spectrum = (fft2(field, self.padded.shape) * self.kernel_for(field).conj()).sum(-3)
        return ifft2(spectrum, self.grid.shape)

    def select(self, indices: Sequence[int], channels: Sequence[int] | None = None) -> "PupilViews":
        """Some of the views, by their indices, in all or some channels; transfer functions are not computed again."""
        part, chosen = copy.copy(self), list(indices)
        rows = list(range(len(self.wavelengths)) if channels is None else channels)
        part.views = tuple(self.views[v] for v in chosen)
        part.wavelengths = tuple(self.wavelengths[c] for c in rows)
        part.single_kernel = self.single_kernel[rows][:, chosen]
        part.double_kernel = None if self.double_kernel is None else self.double_kernel[rows][:, chosen]
        return part

    def extra_repr(self) -> str:
        """Grid, wavelengths and number of views, for ``print(module)``."""
        return f"grid={self.grid}, wavelengths={self.wavelengths}, views={len(self.views)}"


def view_padding(grid: Grid, wavelengths: Sequence[float], views: Sequence[View], longest: float) -> Grid:
    """The padded grid on which light within the pupils of ``views`` travels ``longest`` metres without wrapping."""
    shape = []
    for size, pitch in zip(grid.shape, grid.pitch, strict=True):
        steepest = min(max(view.steepest for view in views), max(wavelengths) / 2 / pitch, 0.99)
        travel = longest * steepest / math.sqrt(1 - steepest**2)
        shape.append(good_length(size + 2 * math.ceil(travel / pitch)))
    return Grid((shape[0], shape[1]), grid.pitch)


def view_kernel(padded: Grid, wavelength: Tensor, view: View, distance: float) -> Tensor:
    """Transfer function over ``distance`` of the light within the pupil of ``view``, complex128 [C, P, Q]."""
    kernel = angular_spectrum_kernel(padded, wavelength, wavelength.new_tensor(distance), band_limit=False)
    fy, fx = padded.frequencies(wavelength.device)
    y, x = (wavelength[:, None, None] * f - sine for f, sine in zip((fy, fx), view.centre, strict=True))
    open_pupil = (y.square() + x.square() <= view.radius**2) & (y * view.covered[0] + x * view.covered[1] <= 0)
    return kernel * open_pupil
