"""Liquid crystal at other wavelengths than the one a panel was calibrated with."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import CAUCHY_B, WAVELENGTH

Birefringence = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Cauchy:
    """Birefringence dn(lambda) = a + b / lambda^2, b in m^2; the defaults are those of a common nematic mixture.

    Called with wavelengths in metres, any shape; returns float64 of the same shape, differentiable. Raises ValueError
    for a birefringence that is not positive at some wavelength.
    """

    a: float = 0.18
    b: float = 0.0085e-12

    def __post_init__(self):
        checks.finite("a", self.a)
        checks.quantity(CAUCHY_B, self.b)

    def __call__(self, wavelength: Tensor) -> Tensor:
        """Birefringence at ``wavelength``."""
        value = self.a + self.b / _waves(wavelength).square()
        if bool((value.detach() <= 0).any()):
            raise ValueError(
                f"birefringence must be positive, got {value.detach().min().item():g} from a = {self.a:g}, "
                f"b = {self.b:g} m^2; b of 0.0085 um^2 is 8.5e-15"
            )
        return value


@dataclass(frozen=True)
class BirefringenceTable:
    """Measured birefringence, linear in 1 / lambda^2 between its rows; that is exact where Cauchy's law is.

    Only ratios count for :func:`phase_scale`, so the values may be in any unit, such as phase times wavelength.

    Args:
        wavelengths: In metres, at least two, each once, in any order.
        values: Birefringence at each, above zero.

    Raises:
        ValueError: Fewer than two rows, a wavelength given twice, values that are not positive; in a call: a
            wavelength outside the table.
    """

    wavelengths: tuple[float, ...]
    values: tuple[float, ...]

    def __init__(self, wavelengths: Sequence[float], values: Sequence[float]):
        waves = checks.wavelengths(wavelengths)
        if len(waves) != len(values) or len(waves) < 2 or len(set(waves)) < len(waves):
            raise ValueError(
                f"a birefringence table needs at least two different wavelengths with one value each, got "
                f"{len(waves)} wavelengths ({len(set(waves))} different) and {len(values)} values"
            )
        rows = sorted(zip(waves, (checks.positive("birefringence", value) for value in values), strict=True))
        object.__setattr__(self, "wavelengths", tuple(row[0] for row in rows))
        object.__setattr__(self, "values", tuple(row[1] for row in rows))

    def __call__(self, wavelength: Tensor) -> Tensor:
        """Birefringence at ``wavelength``."""
        waves = _waves(wavelength)
        low, high = self.wavelengths[0], self.wavelengths[-1]  # to 1e-6: float32 rounds the ends themselves
        if bool(((waves.detach() < low * (1 - 1e-6)) | (waves.detach() > high * (1 + 1e-6))).any()):
            raise ValueError(
                f"wavelengths {waves.min().item() * 1e9:.6g} to {waves.max().item() * 1e9:.6g} nm lie outside the "
                f"birefringence table, {low * 1e9:.6g} to {high * 1e9:.6g} nm; measure there, or fit it by fit_cauchy"
            )
        at = torch.tensor(self.wavelengths, dtype=torch.float64, device=waves.device).square().reciprocal()
        values = torch.tensor(self.values, dtype=torch.float64, device=waves.device)
        place = waves.square().reciprocal()  # falls along the table
        row = torch.bucketize(-place.detach(), -at).clamp(1, len(at) - 1)
        part = (place - at[row - 1]) / (at[row] - at[row - 1])
        return values[row - 1] + part * (values[row] - values[row - 1])


def phase_scale(light: float | Tensor, design: float | Tensor, birefringence: Birefringence | None = None) -> Tensor:
    """Factor on the phase of a panel calibrated at ``design`` when it is lit at ``light``: (l0 / l) dn(l) / dn(l0).

    Args:
        light: Wavelengths in metres; broadcasts against ``design``.
        design: Wavelengths in metres of the calibration.
        birefringence: :class:`Cauchy` with its defaults if not given, or a :class:`BirefringenceTable`.

    Returns:
        float64, differentiable in both wavelengths. The voltage's part of the retardation is taken to be the same at
        both wavelengths: the director does not see the light.

    Source: thesis Sec. 6.4.1, which asks for it; phi = 2 pi d dn / lambda for a cell of thickness d.
    """
    law = Cauchy() if birefringence is None else birefringence
    lit, at = _waves(light), _waves(design)
    return at / lit * (law(lit) / law(at))


def kinoform_efficiency(scale: Tensor) -> Tensor:
    """Part of the light that a kinoform of phases on [0, 2 pi) keeps in its picture when they are scaled.

    sinc^2(1 - scale) for phases that are uniformly distributed, as those of a blaze or of a diffuse picture are.
    Source: Goodman, Sec. 4.4; Dammann (1970), blazed gratings of the wrong depth.
    """
    return torch.sinc(1 - scale).square()


def zero_order(scale: Tensor) -> Tensor:
    """Part of the light that stays undiffracted from phases uniform on [0, 2 pi) scaled by ``scale``: sinc^2."""
    return torch.sinc(scale).square()


@dataclass(frozen=True)
class CauchyFit:
    """Result of :func:`fit_cauchy`.

    Attributes:
        law: The birefringence; with no path length given, times a length in metres, which ratios do not see.
        residuals: Measured minus fitted phase in rad, in the table's order.
        rms: Their root mean square.
        errors: Standard errors of (a, b) from the residuals; NaN where the table has but two rows.
    """

    law: Cauchy
    residuals: tuple[float, ...]
    rms: float
    errors: tuple[float, float]


def fit_cauchy(wavelengths: Sequence[float], phases: Sequence[float], *, path: float = 1.0) -> CauchyFit:
    """Fit a and b to an interferometric table: the phase between no and full drive at several wavelengths.

    Least squares in the phase, which is linear in both: phi = 2 pi path (a / lambda + b / lambda^3).

    Args:
        wavelengths: In metres, at least two different ones; three give residuals a meaning.
        phases: In rad, not wrapped: their true numbers of turns.
        path: Way of the light through the crystal in metres, twice the cell's thickness in reflection. Without it only
            b / a is found, which is all that :func:`phase_scale` needs.

    Raises:
        ValueError: Fewer than two wavelengths, unequal lengths, phases that are not positive, or phases that no
            positive birefringence gives: most likely they are wrapped.
    """
    waves = checks.wavelengths(wavelengths)
    wanted = torch.tensor([checks.positive("phase", phase, "rad") for phase in phases], dtype=torch.float64)
    if len(waves) != len(wanted) or len(set(waves)) < 2:
        raise ValueError(
            f"a Cauchy fit needs at least two different wavelengths with one phase each, got {len(waves)} wavelengths "
            f"({len(set(waves))} different) and {len(wanted)} phases"
        )
    length = checks.positive("path", path, "metres")
    at, unit = torch.tensor(waves, dtype=torch.float64), 1e-6  # columns of like size: micrometres
    matrix = 2 * math.pi * torch.stack([unit / at, (unit / at) ** 3], 1)
    solution = torch.linalg.lstsq(matrix, wanted[:, None]).solution[:, 0]
    residuals = wanted - matrix @ solution
    a, b = solution[0].item() * unit / length, solution[1].item() * unit**3 / length
    if min(a + b / wave**2 for wave in waves) <= 0:
        raise ValueError(
            "no positive birefringence gives these phases; expected unwrapped ones, falling with wavelength"
        )
    spare = len(waves) - 2
    errors = (math.nan, math.nan)
    if spare:
        covariance = torch.linalg.inv(matrix.T @ matrix) * residuals.square().sum() / spare
        deviation = covariance.diagonal().sqrt().tolist()
        errors = deviation[0] * unit / length, deviation[1] * unit**3 / length
    return CauchyFit(Cauchy(a, b), tuple(residuals.tolist()), residuals.square().mean().sqrt().item(), errors)


def _waves(wavelength: float | Tensor) -> Tensor:
    waves = torch.as_tensor(wavelength, dtype=torch.float64)
    checks.quantities(WAVELENGTH, waves)
    return waves
