"""Phase of a liquid-crystal panel at wavelengths other than that of its calibration."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.precision import double
from holotorch.core.quantities import CAUCHY_B, WAVELENGTH

Birefringence = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Cauchy:
    """Cauchy's law of birefringence, dn = a + b / lambda^2, b in m^2; the defaults describe a common nematic mixture.

    A call takes wavelengths in metres and returns the birefringence, float64 of the same shape and differentiable. It
    raises ValueError where the birefringence is not positive.
    """

    a: float = 0.18
    b: float = 0.0085e-12

    def __post_init__(self):
        checks.finite("a", self.a)
        checks.quantity(CAUCHY_B, self.b)

    def __call__(self, wavelength: Tensor) -> Tensor:
        """Birefringence at ``wavelength``."""
        value = self.a + self.b / _checked(wavelength).square()
        if bool((value.detach() <= 0).any()):
            raise ValueError(
                f"birefringence must be positive, got {value.detach().min().item():g} from a = {self.a:g}, "
                f"b = {self.b:g} m^2; b of 0.0085 um^2 is 8.5e-15"
            )
        return value


@dataclass(frozen=True)
class BirefringenceTable:
    """Measured birefringence, interpolated linearly in 1 / lambda^2, which is exact for :class:`Cauchy`'s law.

    Args:
        wavelengths: In metres, at least two different ones in any order; they are sorted.
        values: Birefringence at each wavelength, above zero. A common factor does not matter for :func:`phase_scale`,
            so that they may be phases times wavelengths.

    Raises:
        ValueError: Fewer than two rows, equal wavelengths, values that are not positive; in a call: a wavelength
            outside the table.
    """

    wavelengths: Sequence[float]
    values: Sequence[float]

    def __post_init__(self):
        lengths = checks.wavelengths(self.wavelengths)
        if len(lengths) != len(self.values) or len(lengths) < 2 or len(set(lengths)) < len(lengths):
            raise ValueError(
                f"a birefringence table needs at least two different wavelengths with one value each, got "
                f"{len(lengths)} wavelengths ({len(set(lengths))} different) and {len(self.values)} values"
            )
        rows = sorted(zip(lengths, (checks.positive("birefringence", value) for value in self.values), strict=True))
        for name, column in zip(("wavelengths", "values"), zip(*rows, strict=True), strict=True):
            object.__setattr__(self, name, column)

    def __call__(self, wavelength: Tensor) -> Tensor:
        """Birefringence at ``wavelength``."""
        lengths = _checked(wavelength)
        low, high = self.wavelengths[0], self.wavelengths[-1]
        # A margin of 1e-6 admits end points that were rounded to float32.
        if bool(((lengths.detach() < low * (1 - 1e-6)) | (lengths.detach() > high * (1 + 1e-6))).any()):
            raise ValueError(
                f"wavelengths {lengths.min().item() * 1e9:.6g} to {lengths.max().item() * 1e9:.6g} nm lie outside the "
                f"birefringence table, {low * 1e9:.6g} to {high * 1e9:.6g} nm; measure there, or fit it by fit_cauchy"
            )
        nodes = double(self.wavelengths, lengths.device).square().reciprocal()
        values = double(self.values, lengths.device)
        x = lengths.square().reciprocal()
        row = torch.bucketize(-x.detach(), -nodes).clamp(1, len(nodes) - 1)  # the signs make the nodes increase
        part = (x - nodes[row - 1]) / (nodes[row] - nodes[row - 1])
        return values[row - 1] + part * (values[row] - values[row - 1])


def phase_scale(light: float | Tensor, design: float | Tensor, birefringence: Birefringence | None = None) -> Tensor:
    """Phase at the wavelength l = ``light`` divided by that at l0 = ``design``: (l0 / l) dn(l) / dn(l0).

    This follows from the phase 2 pi d dn(l) / l of a cell of thickness d. The orientation of the crystal depends on the
    voltage and not on the wavelength. Source: thesis Sec. 6.4.1, which asks for this correction.

    Args:
        light: Wavelengths of the light in metres, which broadcast against ``design``.
        design: Wavelengths of the calibration in metres.
        birefringence: Such as a :class:`BirefringenceTable`; :class:`Cauchy` with its defaults if not given.

    Returns:
        float64, differentiable with respect to both wavelengths.
    """
    law = Cauchy() if birefringence is None else birefringence
    lit, calibrated = _checked(light), _checked(design)
    return calibrated / lit * (law(lit) / law(calibrated))


def kinoform_efficiency(scale: Tensor) -> Tensor:
    """Share of the light that forms the image of a kinoform whose phases on [0, 2 pi) are multiplied by ``scale``.

    It is sinc^2(1 - scale) for uniformly distributed phases. Source: Goodman, Sec. 4.4; Dammann (1970).
    """
    return torch.sinc(1 - scale).square()


def zero_order(scale: Tensor) -> Tensor:
    """Share of undiffracted light for phases uniform on [0, 2 pi) that are multiplied by ``scale``: sinc^2(scale)."""
    return torch.sinc(scale).square()


@dataclass(frozen=True)
class CauchyFit:
    """Result of :func:`fit_cauchy`.

    Attributes:
        law: The birefringence; without a path length, only the ratio b / a is meaningful.
        residuals: Measured minus fitted phase in rad, in the order of the measurements.
        rms: Root mean square of the residuals in rad.
        errors: Standard errors of (a, b), estimated from the residuals; NaN for two measurements.
    """

    law: Cauchy
    residuals: tuple[float, ...]
    rms: float
    errors: tuple[float, float]


def fit_cauchy(wavelengths: Sequence[float], phases: Sequence[float], *, path: float = 1.0) -> CauchyFit:
    """Fit a and b of Cauchy's law to the phase range of a panel, from the lowest to the highest voltage.

    Linear least squares: the phase is 2 pi path (a / lambda + b / lambda^3).

    Args:
        wavelengths: In metres, at least two different ones; with two, the fit is exact.
        phases: Phase range at each wavelength in rad, not wrapped.
        path: Length of the light's path through the crystal in metres, in reflection twice the thickness of the cell.
            :func:`phase_scale` needs only the ratio b / a, which does not depend on it.

    Raises:
        ValueError: Fewer than two wavelengths, unequal lengths, phases that are not positive, or phases that no
            positive birefringence gives, most likely because they are wrapped.
    """
    lengths = checks.wavelengths(wavelengths)
    measured = torch.tensor([checks.positive("phase", phase, "rad") for phase in phases], dtype=torch.float64)
    if len(lengths) != len(measured) or len(set(lengths)) < 2:
        raise ValueError(
            f"a Cauchy fit needs at least two different wavelengths with one phase each, got "
            f"{len(lengths)} wavelengths ({len(set(lengths))} different) and {len(measured)} phases"
        )
    length = checks.positive("path", path, "metres")
    unit = 1e-6  # wavelengths in micrometres make the two columns of the matrix similar in size
    inverse = unit / torch.tensor(lengths, dtype=torch.float64)
    matrix = 2 * math.pi * torch.stack([inverse, inverse**3], 1)
    solution = torch.linalg.lstsq(matrix, measured[:, None]).solution[:, 0]
    residuals = measured - matrix @ solution
    a, b = solution[0].item() * unit / length, solution[1].item() * unit**3 / length
    if min(a + b / wavelength**2 for wavelength in lengths) <= 0:
        raise ValueError(
            "no positive birefringence gives these phases; expected unwrapped ones, falling with wavelength"
        )
    errors = (math.nan, math.nan)
    if len(lengths) > 2:
        covariance = torch.linalg.inv(matrix.T @ matrix) * residuals.square().sum() / (len(lengths) - 2)
        deviation = covariance.diagonal().sqrt().tolist()
        errors = deviation[0] * unit / length, deviation[1] * unit**3 / length
    return CauchyFit(Cauchy(a, b), tuple(residuals.tolist()), residuals.square().mean().sqrt().item(), errors)


def _checked(wavelength: float | Tensor) -> Tensor:
    """Wavelengths as float64; ValueError outside the range of light."""
    lengths = torch.as_tensor(wavelength, dtype=torch.float64)
    checks.quantities(WAVELENGTH, lengths)
    return lengths
