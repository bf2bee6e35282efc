"""Sweeps of the heat crosstalk of a phased array: kernels with few taps, and deconvolution."""

from functools import partial

import torch
from torch import Tensor

from holotorch.correction.deconvolution import deconvolve, inverse
from holotorch.experiments.stability.sweep import DOCUMENTED, SILENT, Answer, Sweep
from holotorch.modulator import ThermalCrosstalk
from holotorch.modulator.crosstalk import LOST_HEAT

SHAPE = (37, 30)  # pixels of the array
TAPS = 1e-5  # tolerance of the default kernel, which has all taps of at least 1e-6


def sweeps() -> list[Sweep]:
    """Sweeps of sigma and of the number of taps."""
    sigmas = (0.0, 0.1, 0.3, 0.66, 1.0, 2.0, 5.0, 12.0, 40.0, 100.0)
    sizes = (1.0, 3.0, 5.0, 7.0, 9.0, 15.0, 29.0)
    return [
        Sweep("ThermalCrosstalk", "sigma (px)", sigmas, partial(_spread, torch.float64), _spread_exactly,
              tolerance=TAPS, tolerance_from=DOCUMENTED),
        Sweep("ThermalCrosstalk, float32", "sigma (px)", sigmas, partial(_spread, torch.float32), _spread_exactly,
              tolerance=TAPS, tolerance_from=DOCUMENTED),
        *(
            Sweep(f"ThermalCrosstalk, sigma {sigma:g}", "taps per axis", sizes,
                  partial(_cut, sigma), lambda _, s=sigma: _spread_exactly(s),
                  tolerance=LOST_HEAT / SILENT, tolerance_from=DOCUMENTED)
            for sigma in (0.66, 1.5, 3.0)
        ),
        Sweep("inverse", "sigma (px)", (0.1, 0.3, 0.5, 0.66, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0, 6.0), _inverted, _heater),
        Sweep("inverse, 7 taps", "sigma (px)", (0.3, 0.66, 1.0, 1.5, 1.6, 1.67, 1.7, 2.0),
              partial(_inverted, size=7), _heater),
        Sweep("deconvolve", "sigma (px)", (0.1, 0.3, 0.5, 0.66, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0), _deconvolved, _reached),
    ]  # fmt: skip


def _heater(_: float = 0.0) -> Tensor:
    """Heater phases in rad, float64, independent in every pixel."""
    return 2 * torch.pi * torch.rand(SHAPE, dtype=torch.float64, generator=torch.Generator().manual_seed(2))


def _dense(sigma: float, size: int) -> Tensor:
    """Matrix [size, size] of exp(-d^2 / sigma^2) between all pairs of pixels of one axis, without any cut."""
    offsets = torch.arange(size, dtype=torch.float64)
    square = (offsets[:, None] - offsets).square()
    return torch.exp(-square / sigma**2) if sigma else torch.eye(size, dtype=torch.float64)


def _spread_exactly(sigma: float, phase: Tensor | None = None) -> Tensor:
    phase = _heater() if phase is None else phase
    return _dense(sigma, SHAPE[0]) @ phase @ _dense(sigma, SHAPE[1])


def _spread(dtype: torch.dtype, sigma: float) -> Answer:
    return Answer(ThermalCrosstalk(sigma)(_heater().to(dtype)))


def _cut(sigma: float, size: float) -> Answer:
    crosstalk = ThermalCrosstalk(sigma, int(size))
    return Answer(crosstalk(_heater()), crosstalk.lost_heat)


def _inverted(sigma: float, size: int | None = None) -> Answer:
    """Heater phases recovered from the phase that they spread to."""
    crosstalk = ThermalCrosstalk(sigma, size)
    return Answer(inverse(crosstalk, crosstalk(_heater())))


def _deconvolved(sigma: float) -> Answer:
    """Phase after spreading by the complete kernel, of the heater phases from ``deconvolve``."""
    x = deconvolve(ThermalCrosstalk(sigma), _reached(sigma), max_steps=400)
    return Answer(_spread_exactly(sigma, x))


def _reached(sigma: float) -> Tensor:
    """A phase that some heater phases give after spreading."""
    return _spread_exactly(sigma)
