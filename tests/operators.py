"""One list of small linear operators. A new one brings a constructor and its dense form; the contracts are shared."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from oracles import converging, dense, holograms, pixels
from torch import Tensor

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import (
    AngularSpectrum,
    Aperture,
    ConvergingFresnel,
    CroppedKernel,
    DepthStack,
    Fraunhofer,
    Fresnel,
    Lens,
    OpticalPath,
    PixelShape,
    Propagator,
    RayleighSommerfeld,
    ResampledKernel,
    SpectralFilter,
    ZoomedFilter,
)

GRID = Grid((12, 17), (5e-6, 4e-6))
FINE = Grid((12, 17), (0.2e-6, 0.25e-6))  # below half a wavelength: the corners of the spectrum are evanescent
WAVES = (630e-9, 530e-9)
PATCH = torch.rand(3, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.4
PATCH[1, 2] = 1.0


OUT, OFFSET = Grid((9, 14), (3e-6, 7e-6)), (11e-6, -30e-6)
KERNEL = torch.randn(2, 20, 24, dtype=torch.complex128, generator=torch.Generator().manual_seed(2))
DEPTHS = (0.1e-3, 0.3e-3)
SKIPS_DARK_PLANES = {"compiles": "dark planes are skipped, so what is computed depends on the data"}


@dataclass(frozen=True)
class Case:
    """An operator, its dense form, and where the contracts do not apply to it.

    Attributes:
        name: Of the test.
        build: Makes the operator.
        matrix: Makes its dense form on the flattened axes of ``shape``, without batches.
        shape: Of what it takes.
        out_shape: Of what it gives; the same by default.
        real: Takes and gives real numbers.
        tolerance: Relative to the dense form, whose phase k z of up to 2.4e4 rad carries 2.4e4 * 1e-16.
        unitary: Keeps power.
        wrong: Makes an input that does not fit out of one that does.
        exempt: Reasons why contracts do not apply, by a word of the test's name.
    """

    name: str
    build: Callable[[], Any]
    matrix: Callable[[], np.ndarray]
    shape: tuple[int, ...] = (len(WAVES), *GRID.shape)
    out_shape: tuple[int, ...] | None = None
    real: bool = False
    tolerance: float = 1e-11
    unitary: bool = False
    wrong: Callable[[Tensor], Tensor] = lambda x: x[..., 1:]
    exempt: dict[str, str] = field(default_factory=dict)

    def input(self, *batch: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """Random values that the operator takes."""
        return self._random((*batch, *self.shape), dtype)

    def output(self, *batch: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """Random values that its adjoint takes."""
        return self._random((*batch, *(self.out_shape or self.shape)), dtype)

    def _random(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        real = torch.randn(shape, dtype=dtype)
        return real if self.real else torch.complex(real, torch.randn(shape, dtype=dtype))


def by_channel(matrix: Callable[[int], np.ndarray]) -> Callable[[], np.ndarray]:
    """The dense form of an operator that treats its channels c one by one, by ``matrix(c)``."""

    def whole() -> np.ndarray:
        blocks = [matrix(c) for c in range(len(WAVES))]
        rows, columns = blocks[0].shape
        out = np.zeros((len(WAVES) * rows, len(WAVES) * columns), dtype=blocks[0].dtype)
        for c, block in enumerate(blocks):
            out[c * rows : (c + 1) * rows, c * columns : (c + 1) * columns] = block
        return out

    return whole


def each_channel(name: str, build: Callable[[], Any], matrix: Callable[[int], np.ndarray], **more: Any) -> Case:
    """A case whose dense form is ``matrix(c)`` for channel c."""
    return Case(name, build, by_channel(matrix), **more)


def _angular(name: str, grid: Grid, distance: float, pad: float, band_limit=True, unitary=False) -> Case:
    big = grid.padded(pad)
    return each_channel(
        name,
        lambda: AngularSpectrum(grid, WAVES, distance, pad=pad, band_limit=band_limit),
        lambda c: dense.spectral_filter(
            grid.shape, dense.angular_spectrum_transfer(big.shape, big.pitch, WAVES[c], distance, band_limit)
        ),
        unitary=unitary,
    )


def _fresnel_matrix(distance: float, c: int, pad: float = 2) -> np.ndarray:
    big = GRID.padded(pad)
    return dense.spectral_filter(GRID.shape, dense.fresnel_transfer(big.shape, big.pitch, WAVES[c], distance))


def _fresnel(name: str, distance: float, pad: float, unitary: bool = False) -> Case:
    return each_channel(
        name,
        lambda: Fresnel(GRID, WAVES, distance, pad=pad),
        lambda c: _fresnel_matrix(distance, c, pad),
        unitary=unitary,
    )


def _lens(c: int) -> np.ndarray:
    y, x = ((np.arange(n) - n // 2) * p for n, p in zip(GRID.shape, GRID.pitch, strict=True))
    square = y[:, None] ** 2 + x**2
    return np.diag((np.exp(-1j * np.pi / WAVES[c] * square / 2e-3) * (square <= 28e-6**2)).ravel())


def _cropped(name: str, distance: float, paraxial: bool, tolerance: float) -> Case:
    return each_channel(
        name,
        lambda: CroppedKernel(GRID, WAVES, distance, paraxial=paraxial),
        lambda c: dense.band_limited_propagation(GRID.shape, GRID.pitch, WAVES[c], distance, paraxial),
        tolerance=tolerance,
    )


def _centred(grid: Grid, offset: tuple[float, float] = (0.0, 0.0)) -> list[np.ndarray]:
    return [(np.arange(n) - n // 2) * p + aside for n, p, aside in zip(grid.shape, grid.pitch, offset, strict=True)]


def _converging(name: str, distance: float, focus: float, out: Grid | None, offset: tuple[float, float]) -> Case:
    def build() -> ConvergingFresnel:
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):
            return ConvergingFresnel(GRID, WAVES, distance, focus, out_grid=out, offset=offset)

    def matrix(c: int) -> np.ndarray:
        reached, sources = _centred(build().out_grid, offset), _centred(GRID)
        columns, rows = (
            converging.behind_lens(there, here, pitch, WAVES[c], distance, focus)
            for there, here, pitch in zip(reached, sources, GRID.pitch, strict=True)
        )
        return np.kron(columns, rows) * np.exp(2j * np.pi * np.fmod(distance / WAVES[c], 1.0))

    # Phases of the quadrature and of the carrier of up to 1e5 rad.
    return each_channel(name, build, matrix, out_shape=(len(WAVES), *(out or GRID).shape), tolerance=1e-10)


def _hologram(name: str, build: Callable[[], Any], cone: str, tolerance: float) -> Case:
    return Case(
        name,
        build,
        lambda: holograms.matrix(GRID.shape, GRID.shape, GRID.pitch, WAVES[1], DEPTHS, cone),
        shape=(len(DEPTHS), *GRID.shape),
        out_shape=GRID.shape,
        tolerance=tolerance,
        wrong=lambda x: x[1:],  # a plane less; planes may have any size
        exempt=SKIPS_DARK_PLANES,
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
    each_channel("lens", lambda: Lens(GRID, WAVES, 2e-3, radius=28e-6), _lens),
    each_channel("aperture", lambda: Aperture(GRID, WAVES, 28e-6), lambda c: np.abs(_lens(c))),
    each_channel(
        "optical path",
        lambda: OpticalPath([Lens(GRID, WAVES, 2e-3, radius=28e-6), Fresnel(GRID, WAVES, 50e-6, pad=1)]),
        lambda c: _fresnel_matrix(50e-6, c, 1) @ _lens(c),
    ),
    each_channel(
        "Rayleigh-Sommerfeld sum",
        lambda: RayleighSommerfeld(GRID, WAVES, 300e-6),
        lambda c: dense.direct_sum(GRID.shape, GRID.pitch, WAVES[c], 300e-6),
    ),
    each_channel(
        "Rayleigh-Sommerfeld sum, backwards",
        lambda: RayleighSommerfeld(GRID, WAVES, -300e-6),
        lambda c: dense.direct_sum(GRID.shape, GRID.pitch, WAVES[c], 300e-6).conj(),
    ),
    each_channel(
        "planned",
        lambda: Propagator(GRID, WAVES, 300e-6, tolerance=1e-3),
        lambda c: dense.band_limited_propagation(GRID.shape, GRID.pitch, WAVES[c], 300e-6, False),
        tolerance=1e-2,  # 1e-3 is the expectation of the mean; single samples may be ten times off
    ),
    each_channel(
        "Fraunhofer",
        lambda: Fraunhofer(GRID, WAVES),
        lambda c: dense.centred_unitary_dft(GRID.shape),
        unitary=True,
    ),
    each_channel(
        "crosstalk",
        lambda: ThermalCrosstalk(0.9, 7),
        lambda c: dense.convolution(GRID.shape, dense.heat_kernel(0.9, 7)),
        real=True,
    ),
    each_channel(
        "crosstalk, measured patch",
        lambda: ThermalCrosstalk.from_patch(PATCH),
        lambda c: dense.convolution(GRID.shape, PATCH.numpy()),
        real=True,
    ),
    each_channel(
        "any filter, onto fewer samples",
        lambda: SpectralFilter(GRID, WAVES, KERNEL, out_grid=Grid((9, 14), GRID.pitch)),
        lambda c: dense.spectral_filter(GRID.shape, KERNEL[c].numpy(), (9, 14)),
        out_shape=(2, 9, 14),
    ),
    each_channel(
        "any filter, zoomed",
        lambda: ZoomedFilter(GRID, WAVES, KERNEL, OUT, offset=OFFSET),
        lambda c: dense.zoomed_filter(GRID.shape, GRID.pitch, KERNEL[c].numpy(), OUT.shape, OUT.pitch, OFFSET),
        out_shape=(2, *OUT.shape),
    ),
    each_channel(
        "resampled",
        lambda: ResampledKernel(GRID, WAVES, 0.3e-3, OUT, offset=OFFSET),
        lambda c: dense.band_limited_to_points(GRID.shape, GRID.pitch, OUT.shape, OUT.pitch, OFFSET, WAVES[c], 0.3e-3),
        out_shape=(2, *OUT.shape),
        tolerance=7.6e-3,  # as for the cropped kernel, twice for the scatter of one small field
    ),
    _converging("behind a lens, matrices", 5e-3, 5e-3, OUT, (7e-6, -3e-6)),
    _converging("behind a lens, transforms, upright", 2e-3, 5e-3, None, (0.0, 21e-6)),
    _converging("behind a lens, transforms, inverted", 9e-3, 5e-3, None, (-8e-6, 0.0)),
    each_channel(
        "pixels of finite size",
        lambda: PixelShape(GRID, fill=(1, 0.9), orders=1),
        lambda c: pixels.pixel_matrix(GRID.shape, GRID.pitch, (1, 0.9), 1),
        out_shape=(2, 36, 51),
    ),
    each_channel(
        "depth stack",
        lambda: DepthStack([Fresnel(GRID, WAVES, distance) for distance in DEPTHS]),
        lambda c: np.vstack([_fresnel_matrix(z, c) for z in DEPTHS]),
        out_shape=(2, len(DEPTHS), *GRID.shape),
    ),
    _hologram("hologram, direct", lambda: DirectHologram(GRID, WAVES[1], DEPTHS), "box", 1e-11),
    _hologram(
        "hologram, direct, tapered", lambda: DirectHologram(GRID, WAVES[1], DEPTHS, cone="taper"), "taper", 1e-10
    ),
    _hologram("hologram, convolution", lambda: ConvolutionHologram(GRID, WAVES[1], DEPTHS), "box", 1e-11),
    _hologram(
        # 2e-7 of a wave wraps around, or is left out where the closed form takes over.
        "hologram, convolution, tapered",
        lambda: ConvolutionHologram(GRID, WAVES[1], DEPTHS, cone="taper"),
        "taper",
        1e-6,
    ),
    _hologram(
        "hologram, axial",
        lambda: AxialHologram(GRID, WAVES[1], DEPTHS, tolerance=1e-4),
        "taper",
        1e-3,  # 1e-4 is the expectation of the mean; single pixels may be ten times off
    ),
]
