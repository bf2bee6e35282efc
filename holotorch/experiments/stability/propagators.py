"""Sweeps of the named propagators, each at and beyond the border of its model."""

import math
from collections.abc import Callable

from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.experiments.propagation.chart import source
from holotorch.experiments.stability import reference
from holotorch.experiments.stability.sweep import DOCUMENTED, Answer, Sweep
from holotorch.optics import AngularSpectrum, CroppedKernel, Fraunhofer, Fresnel, RayleighSommerfeld

WAVELENGTH = 530e-9  # metres
COARSE, FINE = Grid((32, 28), 8e-6), Grid((32, 28), 1.5e-6)
WRAPS = 1e-2  # part of noise that wraps around within the padding that AngularSpectrum accepts, as it documents
LARGEST = 0.05  # largest documented error that counts as a tolerance; with a larger one, a method must warn
ROUNDING = 1e-3  # tolerance where the documentation says that the only error is rounding, for the sake of complex64


def sweeps() -> list[Sweep]:
    """Sweeps of distance, pitch and padding of every class; tolerances are the errors that they document."""
    lengths = (1e-5, 1e-4, 5e-4, 2e-3, 8e-3, 30e-3)
    short = (2e-6, 1e-5, 4e-5, 1.5e-4, 5e-4, 2e-3)
    pitches = (0.25e-6, 0.45e-6, 0.6e-6, 1e-6, 2e-6, 5e-6, 12e-6)
    return [
        _distance("AngularSpectrum, noise", COARSE, "noise", lengths, _angular),
        _distance("AngularSpectrum, smooth", COARSE, "smooth", lengths, _angular),
        _distance("AngularSpectrum, pad 1, noise", COARSE, "noise", lengths, lambda g, z: _angular(g, z, 1)),
        _distance("CroppedKernel, noise", COARSE, "noise", lengths, _cropped),
        _distance("CroppedKernel, smooth", COARSE, "smooth", lengths, _cropped),
        _distance("CroppedKernel, 1.5 um, noise", FINE, "noise", short, _cropped),
        _distance("Fresnel, noise", COARSE, "noise", lengths, _fresnel),
        _distance("Fresnel, smooth", COARSE, "smooth", lengths, _fresnel),
        _distance("Fresnel, 1.5 um, noise", FINE, "noise", short, _fresnel),
        # A window so wide that its light stays inside: what remains is the error of the model.
        _distance("Fresnel, 1.5 um, 128 px, noise", Grid(128, FINE.pitch), "noise", (1e-4, 3e-4, 5e-4), _fresnel),
        _pitch("AngularSpectrum, noise", pitches, _angular),
        _pitch("CroppedKernel, noise", pitches, _cropped),
        _pitch("Fresnel, noise", pitches, _fresnel),
        _far_field(),
    ]


Method = Callable[[Grid, float], tuple[Callable[[Tensor], Tensor], float]]


def _angular(grid: Grid, distance: float, pad: float = 2) -> tuple[Callable[[Tensor], Tensor], float]:
    return AngularSpectrum(grid, WAVELENGTH, distance, pad=pad), WRAPS


def _cropped(grid: Grid, distance: float) -> tuple[Callable[[Tensor], Tensor], float]:
    sine = WAVELENGTH / (2 * min(grid.pitch))
    return CroppedKernel(grid, WAVELENGTH, distance), 2 * sine**2 / math.sqrt(min(grid.shape))


def _fresnel(grid: Grid, distance: float) -> tuple[Callable[[Tensor], Tensor], float]:
    """The error that ``Fresnel`` documents, for light at the corner of the band, and what wraps around."""
    square = sum((WAVELENGTH / (2 * pitch)) ** 2 for pitch in grid.pitch)
    model = 2 * math.pi / WAVELENGTH * abs(distance) * square**2 / 8
    return Fresnel(grid, WAVELENGTH, distance), model + WRAPS


def _field(content: str, grid: Grid) -> Tensor:
    return reference.noise(grid.shape) if content == "noise" else source(content, grid)


def _answer(method: Method, grid: Grid, distance: float, content: str) -> Answer:
    propagator, documented = method(grid, distance)
    result = propagator(_field(content, grid)[None])[0]
    return Answer(
        result, documented if content == "noise" else math.nan, tolerance=min(max(documented, ROUNDING), LARGEST)
    )


def _distance(name: str, grid: Grid, content: str, values: tuple[float, ...], method: Method) -> Sweep:
    return Sweep(
        name, "distance (m)", values,
        lambda z: _answer(method, grid, z, content),
        lambda z: reference.propagated(_field(content, grid), grid, WAVELENGTH, z),
        tolerance_from=DOCUMENTED,
    )  # fmt: skip


def _pitch(name: str, values: tuple[float, ...], method: Method) -> Sweep:
    distance = 12e-6
    return Sweep(
        name, "pitch (m)", values,
        lambda p: _answer(method, Grid(COARSE.shape, p), distance, "noise"),
        lambda p: reference.propagated(reference.noise(COARSE.shape), Grid(COARSE.shape, p), WAVELENGTH, distance),
        tolerance_from=DOCUMENTED,
    )  # fmt: skip


def _far_field() -> Sweep:
    """The amplitude of ``Fraunhofer`` against what its samples, as points, send into its directions.

    The class knows no distance and cannot warn, so that what it documents is the tolerance however large.
    """
    grid = Grid((8, 8), 8e-6)
    operator, field = Fraunhofer(grid, WAVELENGTH), reference.noise(grid.shape)

    def answer(distance: float) -> Answer:
        error = math.pi / (4 * WAVELENGTH * distance) * (grid.extent[0] ** 2 + grid.extent[1] ** 2)
        return Answer(operator(field[None])[0].abs(), error, tolerance=max(error, ROUNDING))

    def exact(distance: float) -> Tensor:
        step = WAVELENGTH * distance / grid.extent[0]
        arrived = RayleighSommerfeld(grid, WAVELENGTH, distance, out_grid=Grid(grid.shape, step))(field[None])[0]
        # A unitary transform keeps the sum of squares over samples, light the integral over the plane.
        return arrived.abs() * (step / grid.pitch[0])

    distances = (1e-5, 1e-4, 1e-3, 1e-2, 0.05, 0.2)
    return Sweep("Fraunhofer, amplitude", "distance (m)", distances, answer, exact, tolerance_from=DOCUMENTED)
