"""One list of small linear operators. A new one brings a constructor and its dense form; the contracts are shared."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from oracles import converging, dense, holograms, pixels
from torch import Tensor

from holotorch import Grid
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram
from holotorch.modulator import HeatCycle, ThermalCrosstalk
from holotorch.optics import (
    AngularSpectrum,
    Aperture,
    CroppedKernel,
    DepthStack,
    Fraunhofer,
    Fresnel,
    Lens,
    OpticalPath,
    Propagator,
    PupilViews,
    RayleighSommerfeld,
    ResampledKernel,
    View,
    ZoomedFilter,
)
from holotorch.optics.elements.converging import ConvergingFresnel
from holotorch.optics.elements.pixels import PixelShape
from holotorch.optics.free_space.propagators import SpectralFilter

GRID = Grid((12, 17), (5e-6, 4e-6))
FINE = Grid((12, 17), (0.2e-6, 0.25e-6))  # below half a wavelength: the corners of the spectrum are evanescent
OTHER, OFFSET = Grid((9, 14), (3e-6, 7e-6)), (11e-6, -30e-6)  # samples that a result is computed on
WAVELENGTHS = (630e-9, 530e-9)
PATCH = torch.rand(3, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.4
PATCH[1, 2] = 1.0
MASK = torch.rand(GRID.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
TRANSFER = torch.randn(2, 20, 24, generator=torch.Generator().manual_seed(2), dtype=torch.complex128)


@dataclass(frozen=True)
class Case:
    """A linear operator and its dense form.

    Attributes:
        name: Identifies the case in the output of pytest.
        build: Constructs the operator.
        matrix: Dense form for channel c, from a flattened input to a flattened output.
        shape: Trailing axes of the input that a channel's matrix acts on.
        out_shape: Those of the output.
        channels: Axes before them, whose elements do not mix.
        real: Whether the operator takes real values.
        tolerance: Largest error against the matrix, relative to the largest value. The default is the rounding of a
            phase k z of up to 2.4e4 rad, 2.4e4 * 1e-16, with a margin.
        unitary: Whether the adjoint is the inverse.
        refusal: Message for an input whose last axis is one sample short; None for operators that take any size.
        device: Device of the operator and of its inputs.
    """

    name: str
    build: Callable[[], Any]
    matrix: Callable[[int], np.ndarray]
    shape: tuple[int, ...] = GRID.shape
    out_shape: tuple[int, ...] = GRID.shape
    channels: tuple[int, ...] = (len(WAVELENGTHS),)
    real: bool = False
    tolerance: float = 1e-11
    unitary: bool = False
    refusal: str | None = r"field must end in \(C, H, W\) = \(2, 12, 17\), got \(2, 12, 16\)"
    device: str = "cpu"

    def on(self, device: str) -> "Case":
        """The same operator on another device."""
        build = lambda: self.build().to(device)  # noqa: E731
        return replace(self, name=f"{self.name}, {device}", build=build, device=device)

    def input(self, *batch: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """Gaussian noise of the input's shape; ``dtype`` is that of the real part."""
        return self._noise((*batch, *self.channels, *self.shape), dtype)

    def output(self, *batch: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """Gaussian noise of the output's shape."""
        return self._noise((*batch, *self.channels, *self.out_shape), dtype)

    def _noise(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        real = torch.randn(shape, dtype=dtype, device=self.device)
        return real if self.real else torch.complex(real, torch.randn_like(real))


_VIEWS = (
    View(70e-6, 0.03),
    View(-40e-6, 0.02, (0.011, -0.017)),
    View(55e-6, 0.04, covered=(0.3, 1.0)),
    View(60e-6),
)


def _view_matrix(c: int, view: View) -> np.ndarray:
    padded = PupilViews(GRID, WAVELENGTHS, _VIEWS).padded.shape
    transfer = dense.angular_spectrum_transfer(padded, GRID.pitch, WAVELENGTHS[c], -view.focus, False)
    transfer = transfer * np.exp(2j * np.pi * view.focus / WAVELENGTHS[c])
    pupil = dense.pupil(padded, GRID.pitch, WAVELENGTHS[c], view.radius, view.centre, view.covered)
    return dense.spectral_filter(GRID.shape, transfer * pupil)


def _heat_left(frames: int, rate: float, moments: tuple[float, ...]) -> np.ndarray:
    """Phases at all moments of the thousandth cycle for frames of unit steady phase, one after another."""
    matrix = np.zeros((frames * len(moments), frames))
    for lit in range(frames):
        temperature = 0.0
        for cycle in range(1000):
            for frame in range(frames):
                steady = float(frame == lit)
                for m, moment in enumerate(moments):
                    if cycle == 999:
                        value = steady + (temperature - steady) * math.exp(-rate * moment)
                        matrix[frame * len(moments) + m, lit] = value
                temperature = steady + (temperature - steady) * math.exp(-rate)
    return matrix


def _angular(name: str, grid: Grid, distance: float, pad: float, band_limit=True, unitary=False) -> Case:
    big = grid.padded(pad)
    return Case(
        name,
        lambda: AngularSpectrum(grid, WAVELENGTHS, distance, pad=pad, band_limit=band_limit),
        lambda c: dense.spectral_filter(
            grid.shape, dense.angular_spectrum_transfer(big.shape, big.pitch, WAVELENGTHS[c], distance, band_limit)
        ),
        unitary=unitary,
    )


def _fresnel_matrix(c: int, distance: float, pad: float) -> np.ndarray:
    big = GRID.padded(pad)
    return dense.spectral_filter(GRID.shape, dense.fresnel_transfer(big.shape, big.pitch, WAVELENGTHS[c], distance))


def _fresnel(name: str, distance: float, pad: float, unitary: bool = False) -> Case:
    return Case(
        name,
        lambda: Fresnel(GRID, WAVELENGTHS, distance, pad=pad),
        lambda c: _fresnel_matrix(c, distance, pad),
        unitary=unitary,
    )


def _lens(c: int) -> np.ndarray:
    y, x = ((np.arange(n) - n // 2) * p for n, p in zip(GRID.shape, GRID.pitch, strict=True))
    square = y[:, None] ** 2 + x**2
    return np.diag((np.exp(-1j * np.pi / WAVELENGTHS[c] * square / 2e-3) * (square <= 28e-6**2)).ravel())


def _cropped(name: str, distance: float, paraxial: bool, tolerance: float) -> Case:
    return Case(
        name,
        lambda: CroppedKernel(GRID, WAVELENGTHS, distance, paraxial=paraxial),
        lambda c: dense.band_limited_propagation(GRID.shape, GRID.pitch, WAVELENGTHS[c], distance, paraxial),
        tolerance=tolerance,
    )


def _behind_lens(c: int, distance: float, focus: float, out: Grid, offset: tuple[float, float]) -> np.ndarray:
    """Paraxial propagation from ``GRID`` to ``out`` behind a lens, or without one where ``focus`` is infinite."""
    axes = []
    for n, p, m, q, aside in zip(GRID.shape, GRID.pitch, out.shape, out.pitch, offset, strict=True):
        reached, source = (np.arange(m) - m // 2) * q + aside, (np.arange(n) - n // 2) * p
        axes.append(converging.behind_lens(reached, source, p, WAVELENGTHS[c], distance, focus))
    return np.exp(2j * np.pi * distance / WAVELENGTHS[c]) * np.kron(*axes)


def _converging(name: str, distance: float, focus: float, out: Grid | None, offset: tuple[float, float]) -> Case:
    size = abs(1 - distance / focus)
    grid = out or Grid(GRID.shape, (GRID.pitch[0] * size, GRID.pitch[1] * size))
    return Case(
        name,
        lambda: ConvergingFresnel(GRID, WAVELENGTHS, distance, focus, out_grid=out, offset=offset),
        lambda c: _behind_lens(c, distance, focus, grid, offset),
        out_shape=grid.shape,
        tolerance=1e-10,  # the phase k z is up to 1.1e5 rad
    )


def _pixels(name: str, fill: tuple[float, float], orders: int) -> Case:
    return Case(
        name,
        lambda: PixelShape(GRID, fill=fill, orders=orders),
        lambda c: pixels.pixel_matrix(GRID.shape, GRID.pitch, fill, orders),
        out_shape=tuple((2 * orders + 1) * n for n in GRID.shape),
        refusal=r"field must end in \(H, W\) = \(12, 17\), got \(2, 12, 16\)",
    )


UNEVEN = (0.21e-3, 0.26e-3, 0.29e-3)  # depths in metres; the cones of light are about as wide as the grid
EVEN = (0.21e-3, 0.25e-3, 0.29e-3)


def _hologram(kind: type, cone: str, error: float, stride: int = 1, depths=UNEVEN, grid=GRID, **options) -> Case:
    wavelength = WAVELENGTHS[0]
    layer = (-(-grid.shape[0] // stride), -(-grid.shape[1] // stride))
    matrix = cache(lambda: holograms.matrix(layer, grid.shape, grid.pitch, wavelength, depths, cone, stride))
    return Case(
        f"{kind.__name__}, {cone}, stride {stride}, {'even' if depths[:2] == EVEN[:2] else 'uneven'} depths",
        lambda: kind(grid, wavelength, depths, cone=cone, stride=stride, **options),
        lambda c: matrix(),
        shape=(len(depths), *layer),
        out_shape=grid.shape,
        channels=(),
        tolerance=error,
        refusal=None,
    )


_STACKED = (50e-6, -80e-6, 2e-3)

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
    Case(
        "spectral filter, another window",
        lambda: SpectralFilter(GRID, WAVELENGTHS, TRANSFER, out_grid=Grid((14, 11), GRID.pitch)),
        lambda c: dense.spectral_filter(GRID.shape, TRANSFER[c].numpy(), (14, 11)),
        out_shape=(14, 11),
    ),
    Case(
        "zoomed filter",
        lambda: ZoomedFilter(GRID, WAVELENGTHS, TRANSFER, OTHER, offset=OFFSET),
        lambda c: dense.zoomed_filter(GRID.shape, GRID.pitch, TRANSFER[c].numpy(), OTHER.shape, OTHER.pitch, OFFSET),
        out_shape=OTHER.shape,
    ),
    Case(
        "depth stack",
        lambda: DepthStack([Fresnel(GRID, WAVELENGTHS, z, pad=1.5) for z in _STACKED]),
        lambda c: np.concatenate([_fresnel_matrix(c, z, 1.5) for z in _STACKED]),
        out_shape=(len(_STACKED), *GRID.shape),
    ),
    Case(
        "pupil views",
        lambda: PupilViews(GRID, WAVELENGTHS, _VIEWS),
        lambda c: np.concatenate([_view_matrix(c, view) for view in _VIEWS]),
        out_shape=(len(_VIEWS), *GRID.shape),
    ),
    Case(
        "heat cycle",
        lambda: HeatCycle(ThermalCrosstalk.from_patch(PATCH), 1.0, 0.7, moments=(0.4, 1.0)),
        lambda c: np.kron(_heat_left(3, 1 / 0.7, (0.4, 1.0)), dense.convolution(GRID.shape, PATCH.numpy())),
        shape=(3, 1, *GRID.shape),
        out_shape=(6, 1, *GRID.shape),
        channels=(),
        real=True,
        refusal=None,
    ),
    Case(
        "resampled kernel",
        lambda: ResampledKernel(GRID, WAVELENGTHS, 300e-6, OTHER, offset=OFFSET),
        lambda c: dense.band_limited_to_points(
            GRID.shape, GRID.pitch, OTHER.shape, OTHER.pitch, OFFSET, WAVELENGTHS[c], 300e-6
        ),
        out_shape=OTHER.shape,
        tolerance=7.6e-3,  # twice that of the cropped exact kernel, for the scatter of one small field
    ),
    Case(
        "resampled paraxial kernel",
        lambda: ResampledKernel(GRID, WAVELENGTHS, 2e-3, OTHER, offset=OFFSET, paraxial=True),
        lambda c: _behind_lens(c, 2e-3, math.inf, OTHER, OFFSET),
        out_shape=OTHER.shape,
        tolerance=1e-10,  # of the quadrature
    ),
    _converging("converging, in the focus, by matrices", 5e-3, 5e-3, OTHER, OFFSET),
    _converging("converging, by transforms, upright", 2e-3, 5e-3, None, (0.0, 21e-6)),
    _converging("converging, by transforms, inverted", 9e-3, 5e-3, None, (-8e-6, 0.0)),
    _pixels("pixel shape, zero order", (1.0, 0.9), 0),
    _pixels("pixel shape, two orders", (0.3, 0.8), 2),
    Case("lens", lambda: Lens(GRID, WAVELENGTHS, 2e-3, radius=28e-6), _lens),
    Case("aperture", lambda: Aperture(GRID, WAVELENGTHS, 28e-6), lambda c: np.abs(_lens(c))),
    Case("aperture, mask", lambda: Aperture(GRID, WAVELENGTHS, MASK), lambda c: np.diag(MASK.numpy().ravel())),
    Case(
        "optical path",
        lambda: OpticalPath([Lens(GRID, WAVELENGTHS, 2e-3, radius=28e-6), Fresnel(GRID, WAVELENGTHS, 50e-6, pad=1)]),
        lambda c: _fresnel_matrix(c, 50e-6, 1) @ _lens(c),
    ),
    Case(
        "Rayleigh-Sommerfeld sum",
        lambda: RayleighSommerfeld(GRID, WAVELENGTHS, 300e-6),
        lambda c: dense.direct_sum(GRID.shape, GRID.pitch, WAVELENGTHS[c], 300e-6),
    ),
    Case(
        "Rayleigh-Sommerfeld sum, backwards",
        lambda: RayleighSommerfeld(GRID, WAVELENGTHS, -300e-6),
        lambda c: dense.direct_sum(GRID.shape, GRID.pitch, WAVELENGTHS[c], 300e-6).conj(),
    ),
    Case(
        "planned",
        lambda: Propagator(GRID, WAVELENGTHS, 300e-6, tolerance=1e-3),
        lambda c: dense.band_limited_propagation(GRID.shape, GRID.pitch, WAVELENGTHS[c], 300e-6, False),
        tolerance=1e-2,  # 1e-3 is the expectation of the mean; single samples may be ten times off
    ),
    Case(
        "Fraunhofer",
        lambda: Fraunhofer(GRID, WAVELENGTHS),
        lambda c: dense.centred_unitary_dft(GRID.shape),
        unitary=True,
    ),
    Case(
        "crosstalk",
        lambda: ThermalCrosstalk(0.9, 7),
        lambda c: dense.convolution(GRID.shape, dense.heat_kernel(0.9, 7)),
        real=True,
        refusal=None,
    ),
    Case(
        "crosstalk, measured patch",
        lambda: ThermalCrosstalk.from_patch(PATCH),
        lambda c: dense.convolution(GRID.shape, PATCH.numpy()),
        real=True,
        refusal=None,
    ),
    *(_hologram(DirectHologram, cone, 1e-11) for cone in ("full", "box", "disc")),
    _hologram(DirectHologram, "taper", 1e-9),  # the integral over frequencies is exact to 1e-10
    _hologram(DirectHologram, "box", 1e-11, stride=2),
    *(_hologram(ConvolutionHologram, cone, 1e-11) for cone in ("full", "box", "disc")),
    _hologram(ConvolutionHologram, "taper", 1e-6, stride=2),  # 2e-7 of a wave wraps around, with a margin of 5
    _hologram(ConvolutionHologram, "band", 3.8e-3),  # as the cropped exact kernel
    # The tolerance is that of the mean over a field of noise; single samples may be ten times off.
    _hologram(AxialHologram, "taper", 1e-3, tolerance=1e-4),
    _hologram(AxialHologram, "taper", 1e-3, stride=2, depths=EVEN, tolerance=1e-4),
    _hologram(AxialHologram, "band", 3e-2, stride=2, tolerance=3e-3),
]
# Holograms of few planes for what takes time with each plane, such as compiling.
SHALLOW = [
    _hologram(DirectHologram, "box", 1e-11, stride=2, depths=UNEVEN[:1], grid=Grid((3, 4), GRID.pitch)),
    _hologram(ConvolutionHologram, "full", 1e-11, depths=UNEVEN[:1]),
    _hologram(ConvolutionHologram, "disc", 1e-11, depths=UNEVEN[:2]),
    _hologram(ConvolutionHologram, "taper", 1e-6, stride=2, depths=UNEVEN[:1]),
    _hologram(ConvolutionHologram, "band", 3.8e-3, depths=UNEVEN[:1]),
    _hologram(AxialHologram, "taper", 1e-3, stride=2, depths=EVEN[:2], tolerance=1e-4),
]
