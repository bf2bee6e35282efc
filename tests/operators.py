"""One list of small linear operators. A new one brings a constructor and its dense form; the contracts are shared."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from oracles import dense
from torch import Tensor

from holotorch import Grid
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import (
    AngularSpectrum,
    Aperture,
    CroppedKernel,
    Fraunhofer,
    Fresnel,
    Lens,
    OpticalPath,
    Propagator,
    RayleighSommerfeld,
)

GRID = Grid((12, 17), (5e-6, 4e-6))
FINE = Grid((12, 17), (0.2e-6, 0.25e-6))  # below half a wavelength: the corners of the spectrum are evanescent
WAVES = (630e-9, 530e-9)
PATCH = torch.rand(3, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.4
PATCH[1, 2] = 1.0


@dataclass(frozen=True)
class Case:
    name: str
    build: Callable[[], Any]
    matrix: Callable[[int], np.ndarray]  # of channel c
    real: bool = False
    tolerance: float = 1e-11  # against the matrix: its phase k z of up to 2.4e4 rad carries 2.4e4 * 1e-16
    unitary: bool = False

    def field(self, *batch: int, dtype: torch.dtype = torch.float64) -> Tensor:
        shape = (*batch, len(WAVES), *GRID.shape)
        real = torch.randn(shape, dtype=dtype)
        return real if self.real else torch.complex(real, torch.randn(shape, dtype=dtype))


def _angular(name: str, grid: Grid, distance: float, pad: float, band_limit=True, unitary=False) -> Case:
    big = grid.padded(pad)
    return Case(
        name,
        lambda: AngularSpectrum(grid, WAVES, distance, pad=pad, band_limit=band_limit),
        lambda c: dense.spectral_filter(
            grid.shape, dense.angular_spectrum_transfer(big.shape, big.pitch, WAVES[c], distance, band_limit)
        ),
        unitary=unitary,
    )


def _fresnel(name: str, distance: float, pad: float, unitary: bool = False) -> Case:
    big = GRID.padded(pad)
    return Case(
        name,
        lambda: Fresnel(GRID, WAVES, distance, pad=pad),
        lambda c: dense.spectral_filter(GRID.shape, dense.fresnel_transfer(big.shape, big.pitch, WAVES[c], distance)),
        unitary=unitary,
    )


def _lens(c: int) -> np.ndarray:
    y, x = ((np.arange(n) - n // 2) * p for n, p in zip(GRID.shape, GRID.pitch, strict=True))
    square = y[:, None] ** 2 + x**2
    return np.diag((np.exp(-1j * np.pi / WAVES[c] * square / 2e-3) * (square <= 28e-6**2)).ravel())


def _cropped(name: str, distance: float, paraxial: bool, tolerance: float) -> Case:
    return Case(
        name,
        lambda: CroppedKernel(GRID, WAVES, distance, paraxial=paraxial),
        lambda c: dense.band_limited_propagation(GRID.shape, GRID.pitch, WAVES[c], distance, paraxial),
        tolerance=tolerance,
    )


CASES = [
    _cropped("cropped paraxial kernel, near", 30e-6, True, 1e-11),
    _cropped("cropped paraxial kernel, far", -2e-3, True, 1e-11),
    # 2.1 s^2 / sqrt(N) with s = 0.079 and N = 12, as derived in test_cropped.py.
    _cropped("cropped exact kernel, near", 30e-6, False, 3.8e-3),
    _cropped("cropped exact kernel, far", 2e-3, False, 3.8e-3),
    _angular("angular spectrum", GRID, 50e-6, 2),
    _angular("angular spectrum, far, band-limited", GRID, 2e-3, 2),
    _angular("angular spectrum, backwards", GRID, -80e-6, 2.5),
    _angular("angular spectrum, evanescent", FINE, 0.3e-6, 2),
    _angular("angular spectrum, evanescent, backwards", FINE, -0.3e-6, 2),
    _angular("angular spectrum, periodic", GRID, 50e-6, 1, band_limit=False, unitary=True),
    _fresnel("Fresnel", 50e-6, 2),
    _fresnel("Fresnel, backwards", -50e-6, 2),
    _fresnel("Fresnel, periodic", 50e-6, 1, unitary=True),
    Case("lens", lambda: Lens(GRID, WAVES, 2e-3, radius=28e-6), _lens),
    Case("aperture", lambda: Aperture(GRID, WAVES, 28e-6), lambda c: np.abs(_lens(c))),
    Case(
        "optical path",
        lambda: OpticalPath([Lens(GRID, WAVES, 2e-3, radius=28e-6), Fresnel(GRID, WAVES, 50e-6, pad=1)]),
        lambda c: (
            dense.spectral_filter(GRID.shape, dense.fresnel_transfer(GRID.shape, GRID.pitch, WAVES[c], 50e-6))
            @ _lens(c)
        ),
    ),
    Case(
        "Rayleigh-Sommerfeld sum",
        lambda: RayleighSommerfeld(GRID, WAVES, 300e-6),
        lambda c: dense.direct_sum(GRID.shape, GRID.pitch, WAVES[c], 300e-6),
    ),
    Case(
        "Rayleigh-Sommerfeld sum, backwards",
        lambda: RayleighSommerfeld(GRID, WAVES, -300e-6),
        lambda c: dense.direct_sum(GRID.shape, GRID.pitch, WAVES[c], 300e-6).conj(),
    ),
    Case(
        "planned",
        lambda: Propagator(GRID, WAVES, 300e-6, tolerance=1e-3),
        lambda c: dense.band_limited_propagation(GRID.shape, GRID.pitch, WAVES[c], 300e-6, False),
        tolerance=1e-2,  # 1e-3 is the expectation of the mean; single samples may be ten times off
    ),
    Case(
        "Fraunhofer",
        lambda: Fraunhofer(GRID, WAVES),
        lambda c: dense.centred_unitary_dft(GRID.shape),
        unitary=True,
    ),
    Case(
        "crosstalk",
        lambda: ThermalCrosstalk(0.9, 7),
        lambda c: dense.convolution(GRID.shape, dense.heat_kernel(0.9, 7)),
        real=True,
    ),
    Case(
        "crosstalk, measured patch",
        lambda: ThermalCrosstalk.from_patch(PATCH),
        lambda c: dense.convolution(GRID.shape, PATCH.numpy()),
        real=True,
    ),
]
