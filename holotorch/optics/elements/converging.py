"""ConvergingFresnel: light that a lens makes converge or diverge, without ever sampling the phase of the lens."""

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import filter_spectrum, good_length
from holotorch.core.grid import Grid
from holotorch.core.quantities import DISTANCE, FOCAL_LENGTH, OFFSET, WAVELENGTH
from holotorch.optics.elements.lens_response import lens_matrices
from holotorch.optics.free_space.impulse_response import fresnel_taps, tap_indices
from holotorch.optics.free_space.kernels import carrier, turns_phasor

_TRUSTED = 0.1  # radians left out by the paraxial model from which a warning is due


def converging_fresnel(
    field: Tensor,
    grid: Grid,
    wavelength: float | Tensor,
    distance: float | Tensor,
    focus: float | Tensor,
    out_grid: Grid,
    *,
    offset: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """What :class:`ConvergingFresnel` does, as a function with gradients in wavelength, distance and focus.

    Args:
        field: complex64 or complex128, shape [..., H, W], in front of the lens.
        grid: Its sampling.
        wavelength: In metres: a number, or a tensor whose shape broadcasts against the leading axes of ``field``.
        distance: In metres, not 0, likewise.
        focus: In metres, not 0, likewise; infinite for no lens.
        out_grid: Sampling of the result, which stays where it is when the tensors change.
        offset: Where (y, x) in metres the axis of the result lies beside that of the lens.

    Returns:
        Same dtype, shape [..., H', W']. The carrier exp(ikz) is included.

    Raises:
        TypeError: A field that is not complex.
        ValueError: Wrong shape, a wavelength that is not positive, a distance or focus of 0.
    """
    checks.field("field", field, grid.shape)
    for kind, value, name in (
        (WAVELENGTH, wavelength, "wavelength"),
        (DISTANCE, distance, "distance"),
        (FOCAL_LENGTH, focus, "focus"),
    ):
        checks.meant(kind, value, name)
        if isinstance(value, Tensor) and value.is_cuda and not torch.compiler.is_compiling():
            checks.quantities(kind, value, name)
    y, x = checks.pair("offset", offset, "metres")
    offset = checks.quantity(OFFSET, y), checks.quantity(OFFSET, x)
    checks.precise(wavelength, distance)
    wavelength_tensor, distance_tensor, focus_tensor = (
        torch.as_tensor(value, dtype=torch.float64, device=field.device) for value in (wavelength, distance, focus)
    )
    if not torch.compiler.is_compiling() and (distance_tensor == 0).any():
        raise ValueError("distance must be other than zero in metres")
    columns, rows = (
        matrix.to(field.dtype)
        for matrix in lens_matrices(grid, wavelength_tensor, distance_tensor, focus_tensor, out_grid, offset)
    )
    return columns @ field @ rows.transpose(-1, -2)


class ConvergingFresnel(nn.Module):
    """Paraxial propagation behind a thin lens, or of light that converges anyway; includes the carrier exp(ikz).

    The field v in front of the lens is what is sampled; the light propagated is v exp(-i k r^2 / (2 focus)), the phase
    taken as continuous between the samples of band-limited v. A focus far shorter than the grid could sample is thus
    no difficulty. By the scaling theorem the result is v propagated over distance / m, m = 1 - distance / focus, seen
    m times as large and under a curvature: U(x) = exp(-i pi x^2 / (wavelength (focus - distance))) V(x / m) / m.

    On the grid scaled by m that is a linear convolution by FFT at twice the window. On any other grid each axis is one
    product with a dense matrix of its exact weights (:func:`lens_taps`), which stay finite at the focus itself.
    Both are exact in the paraxial model, to rounding.

    Args:
        grid: Sampling of the field.
        wavelengths: In metres, one per channel.
        distance: In metres, not 0, negative to travel back.
        focus: In metres, not 0: positive makes light converge to a focus there, negative diverge from one as far
            behind; infinite is no lens.
        out_grid: Sampling of the result, with any shape and pitch; by default ``grid`` with its pitch times abs(m).
        offset: Where (y, x) in metres the axis of the result lies beside that of the lens.

    Attributes:
        magnification: m; negative beyond the focus, where the picture is inverted.
        scaled: Whether the result lies on the scaled grid, so that it is computed by FFTs.
        beyond_fresnel: Phase in radians that the paraxial model leaves out, pi |z| s^4 / (4 wavelength), for the
            steepest ray that leaves the window of the field within its band and the slope of the lens, and reaches the
            window of the result; s is its slope from end to end. A maximum: most light is off by less. 0 where no ray
            arrives.

    Raises:
        ValueError: A wavelength that is not positive, a distance or focus that is 0, or no ``out_grid`` so close to the
            focus that the scaled window is smaller than one sample of the field and one spot of its light; in a call:
            a field of another shape.
        MemoryError: An ``out_grid`` whose matrices need more memory than is available.

    Warns:
        SamplingWarning: ``beyond_fresnel`` exceeds 0.1 rad.

    Source: Goodman, Sec. 4.2; Sziklas and Siegman (1975) for the scaling.
    """

    columns: Tensor
    rows: Tensor

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        distance: float,
        focus: float,
        *,
        out_grid: Grid | None = None,
        offset: tuple[float, float] = (0.0, 0.0),
    ):
        super().__init__()
        self.grid, self.wavelengths = grid, checks.wavelengths(wavelengths)
        self.distance = checks.quantity(DISTANCE, distance)
        self.focus = checks.quantity(FOCAL_LENGTH, focus, "focus")
        unbent = math.isinf(self.focus)
        y, x = checks.pair("offset", offset, "metres")
        self.offset = checks.quantity(OFFSET, y), checks.quantity(OFFSET, x)
        if self.distance == 0:
            raise ValueError("distance must not be 0; at 0 multiply the field by the phase of the lens")
        self.magnification = 1.0 if unbent else (self.focus - self.distance) / self.focus
        self.out_grid = out_grid or self._default_grid()
        self.scaled = self._is_scaled()
        wavelength_tensor = torch.tensor(self.wavelengths, dtype=torch.float64)
        distance_tensor, focus_tensor = (
            torch.tensor(value, dtype=torch.float64) for value in (self.distance, self.focus)
        )
        if self.scaled:
            columns, rows = (self._spectrum(axis, wavelength_tensor) for axis in (0, 1))
        else:
            weights = sum(n * m for n, m in zip(grid.shape, self.out_grid.shape, strict=True)) * len(wavelength_tensor)
            checks.affordable(
                35 * weights,  # measured
                f"ConvergingFresnel from {grid.shape[0]} x {grid.shape[1]} to {self.out_grid.shape[0]} x "
                f"{self.out_grid.shape[1]} samples, by dense matrices,",
                "use a smaller grid or out_grid",
            )
            columns, rows = lens_matrices(
                grid, wavelength_tensor, distance_tensor, focus_tensor, self.out_grid, self.offset
            )
        self._keep("columns", columns)
        self._keep("rows", rows)
        if self.scaled:
            share = carrier(wavelength_tensor, distance_tensor)[:, None] / self.magnification
            self._keep("column_curvature", self._curvature(0, wavelength_tensor) * share)
            self._keep("row_curvature", self._curvature(1, wavelength_tensor))
        self.beyond_fresnel = self._left_out()
        if self.beyond_fresnel > _TRUSTED:
            warnings.warn(
                f"ConvergingFresnel over {self.distance:g} m with a focus of {self.focus:g} m leaves out a phase of up "
                f"to {self.beyond_fresnel:.2g} rad for the steepest ray that reaches the result, which is not to be "
                f"trusted beyond that; {_TRUSTED} rad is small. A longer focus and distance, a smaller window or a "
                "coarser pitch lessen it; AngularSpectrum on samples fine enough for the lens has none of it",
                SamplingWarning,
                stacklevel=2,
            )

    def forward(self, field: Tensor) -> Tensor:
        """Propagate ``field``, complex [..., C, H, W], to [..., C, H', W'] of the output grid, same dtype."""
        checks.field("field", field, (len(self.wavelengths), *self.grid.shape))
        columns, rows = self._read("columns", field), self._read("rows", field)
        if not self.scaled:
            return columns @ field @ rows.transpose(-1, -2)
        picture = filter_spectrum(field, columns[..., :, None] * rows[..., None, :])
        return self._oriented(picture) * self._curvatures(field)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transpose to ``field`` [..., C, H', W'] of the output grid."""
        checks.field("field", field, (len(self.wavelengths), *self.out_grid.shape))
        columns, rows = self._read("columns", field), self._read("rows", field)
        if not self.scaled:
            return columns.transpose(-1, -2).conj() @ field @ rows.conj()
        picture = self._oriented(field * self._curvatures(field).conj())
        return filter_spectrum(picture, (columns[..., :, None] * rows[..., None, :]).conj())

    def extra_repr(self) -> str:
        """Samplings, wavelengths and lengths, for ``print(module)``."""
        return (
            f"grid={self.grid}, out_grid={self.out_grid}, wavelengths={self.wavelengths}, distance={self.distance:g}, "
            f"focus={self.focus:g}, magnification={self.magnification:g}"
        )

    def _keep(self, name: str, values: Tensor) -> None:
        # Real pairs, as in SpectralFilter.
        self.register_buffer(name, torch.view_as_real(values).contiguous(), persistent=False)

    def _read(self, name: str, field: Tensor) -> Tensor:
        return torch.view_as_complex(self.get_buffer(name).to(field.real.dtype))

    def _apply(self, fn, recurse=True):
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)

    def _oriented(self, picture: Tensor) -> Tensor:
        return picture.flip((-2, -1)) if self.magnification < 0 else picture

    def _curvatures(self, field: Tensor) -> Tensor:
        return self._read("column_curvature", field)[..., :, None] * self._read("row_curvature", field)[..., None, :]

    def _near_focus(self) -> bool:
        """Whether the scaled window is smaller than a sample of the field and than a spot of light, on both axes."""
        spread = max(self.wavelengths) * abs(self.distance)
        return all(
            abs(self.magnification) * extent < min(pitch, spread / extent)
            for extent, pitch in zip(self.grid.extent, self.grid.pitch, strict=True)
        )

    def _default_grid(self) -> Grid:
        size = abs(self.magnification)
        if self._near_focus():
            y, x = (max(self.wavelengths) * abs(self.distance) / extent for extent in self.grid.extent)
            raise ValueError(
                f"distance {self.distance:g} m is so near to the focus, {self.focus:g} m, that the grid scaled by "
                f"{size:.1e} would be smaller than a single spot of light; pass out_grid, for instance "
                f"Grid({self.grid.shape}, ({y:.4g}, {x:.4g})), which holds all light at one sample per spot"
            )
        return Grid(self.grid.shape, (self.grid.pitch[0] * size, self.grid.pitch[1] * size))

    def _is_scaled(self) -> bool:
        size = abs(self.magnification)
        same = all(
            math.isclose(step, size * pitch, rel_tol=1e-13)
            for step, pitch in zip(self.out_grid.pitch, self.grid.pitch, strict=True)
        )
        return same and self.out_grid.shape == self.grid.shape and not self._near_focus()

    def _spectrum(self, axis: int, wavelength_tensor: Tensor) -> Tensor:
        """Transform of the taps over distance / m, complex128 [C, padded]."""
        size, pitch = self.grid.shape[axis], self.grid.pitch[axis]
        shift = self.offset[axis] / (self.magnification * pitch)
        if self.magnification < 0 and size % 2 == 0:
            # Reversing an even axis moves its origin from sample n/2 to n/2 - 1.
            shift += 1
        position = tap_indices(good_length(2 * size - 1), size, size) + shift
        distance_tensor = torch.tensor(self.distance / self.magnification, dtype=torch.float64)
        return torch.fft.fft(fresnel_taps(position, pitch, wavelength_tensor, distance_tensor))

    def _curvature(self, axis: int, wavelength_tensor: Tensor) -> Tensor:
        """exp(-i pi x^2 / (wavelength (focus - distance))) on the output's samples, complex128 [C, n']."""
        position = self.out_grid.coordinates()[axis].reshape(-1) + self.offset[axis]
        return turns_phasor(-position.square() / (2 * wavelength_tensor[:, None] * (self.focus - self.distance)))

    def _left_out(self) -> float:
        phases = [0.0]
        for wavelength in self.wavelengths:
            y, x = (self._steepest(axis, wavelength) for axis in (0, 1))
            if y is not None and x is not None:
                phases.append(math.pi * abs(self.distance) * (y * y + x * x) ** 2 / (4 * wavelength))
        return max(phases)

    def _steepest(self, axis: int, wavelength: float) -> float | None:
        """Largest slope |x - q| / |z| of a ray from q in the field to x in the result, None where there is none.

        Such rays have |x - m q| <= wavelength |z| B. The largest slope lies on a corner of this polygon in (q, x), and
        every corner has q or x at the end of its window.
        """
        m, reach = self.magnification, wavelength * abs(self.distance) * 0.5 / self.grid.pitch[axis]
        half, half_out = self.grid.extent[axis] / 2, self.out_grid.extent[axis] / 2
        low, high = self.offset[axis] - half_out, self.offset[axis] + half_out
        slopes = []
        for q in (-half, half):
            begin, end = max(low, m * q - reach), min(high, m * q + reach)
            slopes += [abs(begin - q), abs(end - q)] if begin <= end else []
        for x in (low, high) if m else ():
            first, last = sorted(((x - reach) / m, (x + reach) / m))
            begin, end = max(-half, first), min(half, last)
            slopes += [abs(x - begin), abs(x - end)] if begin <= end else []
        return max(slopes) / abs(self.distance) if slopes else None
