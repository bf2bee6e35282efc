"""ConvergingFresnel: propagation behind a thin lens whose phase is not sampled."""

import math
import warnings

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import filter_spectrum, good_length
from holotorch.core.grid import Grid, Pair
from holotorch.core.operator import FieldOperator, Wavelengths
from holotorch.core.precision import double
from holotorch.core.quantities import DISTANCE, FOCAL_LENGTH, WAVELENGTH
from holotorch.optics.elements.lens_response import lens_matrices
from holotorch.optics.free_space.impulse_response import fresnel_taps, tap_indices
from holotorch.optics.free_space.kernels import carrier, cycles_phasor

_TRUSTED = 0.1  # rad: a warning is emitted if the paraxial model neglects a larger phase


def converging_fresnel(
    field: Tensor,
    grid: Grid,
    wavelength: float | Tensor,
    distance: float | Tensor,
    focus: float | Tensor,
    out_grid: Grid,
    *,
    offset: Pair = (0, 0),
) -> Tensor:
    """:class:`ConvergingFresnel` as a function with gradients in wavelength, distance and focus.

    Wavelength, distance and focus are numbers or tensors whose shapes broadcast against the leading axes of ``field``.

    Args:
        field: complex64 or complex128, shape [..., H, W], in front of the lens.
        grid: Sampling of ``field``.
        wavelength: In metres.
        distance: In metres, not 0.
        focus: Focal length in metres, not 0; infinite for no lens.
        out_grid: Sampling of the result.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the lens.

    Returns:
        Shape [..., H', W'], same dtype as ``field``, including the carrier exp(ikz).

    Raises:
        TypeError: A field that is not complex.
        ValueError: A field of another shape, or a number outside its range.
    """
    checks.field("field", field, grid.shape)
    for kind, value, name in (
        (WAVELENGTH, wavelength, "wavelength"),
        (DISTANCE, distance, "distance"),
        (FOCAL_LENGTH, focus, "focus"),
    ):
        checks.plausible(kind, value, name)
        if isinstance(value, Tensor) and value.is_cuda and not torch.compiler.is_compiling():
            checks.quantities(kind, value, name)
    offset = checks.offset(offset)
    checks.precise(wavelength, distance)
    wavelength, distance, focus = (double(value, field.device) for value in (wavelength, distance, focus))
    if not torch.compiler.is_compiling() and (distance == 0).any():
        raise ValueError("distance must be other than zero in metres")
    columns, rows = lens_matrices(grid, wavelength, distance, focus, out_grid, offset)
    return columns.to(field.dtype) @ field @ rows.to(field.dtype).transpose(-1, -2)


class ConvergingFresnel(FieldOperator):
    """Paraxial propagation of a field behind a thin lens; includes the carrier exp(ikz).

    The field v in front of the lens is sampled and band-limited, but the phase of the lens, exp(-i k r^2 / (2 focus)),
    is taken as continuous, so the focus may be much shorter than the grid could sample. By the scaling theorem, with
    m = 1 - distance / focus and V the field v propagated over distance / m, the result is
    U(x) = exp(-i pi x^2 / (wavelength (focus - distance))) V(x / m) / m.

    On the grid scaled by m this is a linear convolution by FFTs of twice the window. On any other grid each axis is one
    product with a dense matrix of exact weights (:func:`lens_taps`), which are finite at the focus too. Both methods
    are exact in the paraxial model, up to rounding.

    Args:
        grid, wavelengths: As for :class:`FieldOperator`.
        distance: In metres, not 0, negative for backward propagation.
        focus: Focal length in metres, not 0; positive converges, negative diverges, infinite is no lens.
        out_grid: Sampling of the result, with any shape and pitch; by default ``grid`` with its pitch times abs(m).
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the lens.

    Attributes:
        magnification: m; negative beyond the focus, where the picture is inverted.
        scaled: Whether ``out_grid`` is the scaled grid, so that the result is computed by FFTs.
        beyond_fresnel: Phase in radians that the paraxial model neglects, pi |z| s^4 / (4 wavelength), where s is the
            largest slope of a ray that the field and the lens send from the window of the field to the window of the
            result; 0 if there is no such ray.

    Raises:
        ValueError: A number outside its range, or a missing ``out_grid`` for a result so close to the focus that the
            scaled window is smaller than a sample of the field and than a diffraction-limited spot.
        MemoryError: An ``out_grid`` whose matrices need more memory than is available.

    Warns SamplingWarning if ``beyond_fresnel`` exceeds 0.1 rad.
    Source: Goodman, Sec. 4.2; Sziklas and Siegman (1975) for the scaling.
    """

    columns: Tensor
    rows: Tensor
    column_curvature: Tensor
    row_curvature: Tensor

    def __init__(
        self,
        grid: Grid,
        wavelengths: Wavelengths,
        distance: float,
        focus: float,
        *,
        out_grid: Grid | None = None,
        offset: Pair = (0, 0),
    ):
        super().__init__(grid, wavelengths)
        self.distance, self.offset = checks.quantity(DISTANCE, distance), checks.offset(offset)
        self.focus = checks.quantity(FOCAL_LENGTH, focus, "focus")
        if self.distance == 0:
            raise ValueError("distance must not be 0; at 0 multiply the field by the phase of the lens")
        self.magnification = 1.0 if math.isinf(self.focus) else (self.focus - self.distance) / self.focus
        self.out_grid, self.scaled = self._choose_grid(out_grid)
        wavelength, z, f = (
            torch.tensor(value, dtype=torch.float64) for value in (self.wavelengths, self.distance, self.focus)
        )
        if self.scaled:
            columns, rows = (self._spectrum(axis, wavelength) for axis in (0, 1))
            factor = carrier(wavelength, z)[:, None] / self.magnification
            self.keep("column_curvature", self._curvature(0, wavelength) * factor)
            self.keep("row_curvature", self._curvature(1, wavelength))
        else:
            weights = sum(n * m for n, m in zip(grid.shape, self.out_grid.shape, strict=True)) * len(wavelength)
            checks.affordable(
                35 * weights,  # bytes, measured
                f"ConvergingFresnel from {grid.shape[0]} x {grid.shape[1]} to {self.out_grid.shape[0]} x "
                f"{self.out_grid.shape[1]} samples, by dense matrices,",
                "use a smaller grid or out_grid",
            )
            columns, rows = lens_matrices(grid, wavelength, z, f, self.out_grid, self.offset)
        self.keep("columns", columns)
        self.keep("rows", rows)
        self.beyond_fresnel = self._neglected_phase()
        if self.beyond_fresnel > _TRUSTED:
            warnings.warn(
                f"ConvergingFresnel over {self.distance:g} m with a focus of {self.focus:g} m leaves out a phase of up "
                f"to {self.beyond_fresnel:.2g} rad for the steepest ray that reaches the result, which is "
                f"accurate up to {_TRUSTED} rad. A longer focus and distance, a smaller window or a coarser pitch "
                "reduce this phase; AngularSpectrum includes it, on samples fine enough for the lens",
                SamplingWarning,
                stacklevel=2,
            )

    def _forward(self, field: Tensor) -> Tensor:
        columns, rows = self.columns.to(field.dtype), self.rows.to(field.dtype)
        if not self.scaled:
            return columns @ field @ rows.transpose(-1, -2)
        picture = filter_spectrum(field, columns[..., :, None] * rows[..., None, :])
        return self._oriented(picture) * self._curvatures(field)

    def _adjoint(self, field: Tensor) -> Tensor:
        columns, rows = self.columns.to(field.dtype), self.rows.to(field.dtype)
        if not self.scaled:
            return columns.transpose(-1, -2).conj() @ field @ rows.conj()
        picture = self._oriented(field * self._curvatures(field).conj())
        return filter_spectrum(picture, (columns[..., :, None] * rows[..., None, :]).conj())

    def extra_repr(self) -> str:
        """Samplings, wavelengths and lengths, for ``print(module)``."""
        return (
            f"{super().extra_repr()}, distance={self.distance:g}, focus={self.focus:g}, "
            f"magnification={self.magnification:g}"
        )

    def _oriented(self, picture: Tensor) -> Tensor:
        return picture.flip((-2, -1)) if self.magnification < 0 else picture

    def _curvatures(self, field: Tensor) -> Tensor:
        columns, rows = self.column_curvature.to(field.dtype), self.row_curvature.to(field.dtype)
        return columns[..., :, None] * rows[..., None, :]

    def _choose_grid(self, out_grid: Grid | None) -> tuple[Grid, bool]:
        """``out_grid``, by default the scaled grid, and whether the result is computed by FFTs."""
        grid, size = self.grid, abs(self.magnification)
        y, x = spots = [max(self.wavelengths) * abs(self.distance) / extent for extent in grid.extent]
        windows = zip(grid.extent, grid.pitch, spots, strict=True)
        near_focus = all(size * extent < min(pitch, spot) for extent, pitch, spot in windows)
        if out_grid is None and near_focus:
            raise ValueError(
                f"distance {self.distance:g} m is so near to the focus, {self.focus:g} m, that the grid scaled by "
                f"{size:.1e} would be smaller than a single spot of light; pass out_grid, for instance "
                f"Grid({grid.shape}, ({y:.4g}, {x:.4g})), which holds all light at one sample per spot"
            )
        scaled = grid.pitch[0] * size, grid.pitch[1] * size
        out_grid = out_grid or Grid(grid.shape, scaled)
        same_pitch = all(math.isclose(*pitches, rel_tol=1e-13) for pitches in zip(out_grid.pitch, scaled, strict=True))
        return out_grid, same_pitch and out_grid.shape == grid.shape and not near_focus

    def _spectrum(self, axis: int, wavelength: Tensor) -> Tensor:
        """DFT of the taps of a propagation over distance / m, complex128 [C, padded]."""
        size, pitch = self.grid.shape[axis], self.grid.pitch[axis]
        shift = self.offset[axis] / (self.magnification * pitch)
        if self.magnification < 0 and size % 2 == 0:
            shift += 1  # the reversal of an even axis moves the origin from sample n/2 to n/2 - 1
        position = tap_indices(good_length(2 * size - 1), size, size) + shift
        distance = torch.tensor(self.distance / self.magnification, dtype=torch.float64)
        return torch.fft.fft(fresnel_taps(position, pitch, wavelength, distance))

    def _curvature(self, axis: int, wavelength: Tensor) -> Tensor:
        """exp(-i pi x^2 / (wavelength (focus - distance))) on the samples of the result, complex128 [C, n']."""
        position = self.out_grid.coordinates()[axis].reshape(-1) + self.offset[axis]
        return cycles_phasor(-position.square() / (2 * wavelength[:, None] * (self.focus - self.distance)))

    def _neglected_phase(self) -> float:
        phases = [0.0]
        for wavelength in self.wavelengths:
            y, x = (self._steepest(axis, wavelength) for axis in (0, 1))
            if y is not None and x is not None:
                phases.append(math.pi * abs(self.distance) * (y * y + x * x) ** 2 / (4 * wavelength))
        return max(phases)

    def _steepest(self, axis: int, wavelength: float) -> float | None:
        """Largest slope |x - q| / |z| of a ray from q in the field to x in the result, None if there is no ray.

        The highest frequency B = 1 / (2 pitch) of the field restricts the rays to |x - m q| <= wavelength |z| B. The
        largest slope lies at a corner of this polygon in (q, x), where q or x is at an end of its window.
        """
        m, spread = self.magnification, wavelength * abs(self.distance) * 0.5 / self.grid.pitch[axis]
        half, half_out = self.grid.extent[axis] / 2, self.out_grid.extent[axis] / 2
        low, high = self.offset[axis] - half_out, self.offset[axis] + half_out
        slopes = []
        for q in (-half, half):
            start, end = max(low, m * q - spread), min(high, m * q + spread)
            slopes += [abs(start - q), abs(end - q)] if start <= end else []
        for x in (low, high) if m else ():
            first, last = sorted(((x - spread) / m, (x + spread) / m))
            start, end = max(-half, first), min(half, last)
            slopes += [abs(x - start), abs(x - end)] if start <= end else []
        return max(slopes) / abs(self.distance) if slopes else None
