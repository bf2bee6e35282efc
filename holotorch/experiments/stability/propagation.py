"""Sweeps of ``propagate``: distance, pitch, window, size, precision and tolerance."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from holotorch.core.grid import Grid, Pair
from holotorch.experiments.propagation.chart import source
from holotorch.experiments.stability import reference
from holotorch.experiments.stability.sweep import ASKED, Answer, Sweep
from holotorch.optics.planning.plan import plan_propagation
from holotorch.optics.planning.propagate import propagate


@dataclass(frozen=True)
class Case:
    """Arguments of one propagation; lengths in metres, ``content`` is "noise" or a field of the propagation chart."""

    shape: tuple[int, int] = (32, 27)
    pitch: Pair = (8e-6, 7e-6)
    wavelength: float = 530e-9
    distance: float = 5e-3
    content: str = "noise"
    tolerance: float = 1e-3
    dtype: torch.dtype = torch.complex128
    out_shape: tuple[int, int] | None = None
    out_pitch: Pair | None = None
    offset: Pair = (0.0, 0.0)
    tilt: Pair = (0.0, 0.0)
    single: bool = False  # give the distance as a float32 tensor

    @property
    def grids(self) -> tuple[Grid, Grid]:
        """Sampling of the field and of the result."""
        grid = Grid(self.shape, self.pitch)
        return grid, Grid(self.out_shape or self.shape, self.out_pitch or self.pitch)

    def field(self) -> Tensor:
        """Samples [H, W] in ``dtype``."""
        if self.content == "noise":
            return reference.noise(self.shape).to(self.dtype)
        return source(self.content, self.grids[0]).to(self.dtype)

    def answer(self) -> Answer:
        """What ``propagate`` gives, with the error and the method of its plan."""
        grid, out = self.grids
        window = {"out_grid": out, "offset": self.offset, "tilt": self.tilt}
        plan = plan_propagation(
            grid, self.wavelength, self.distance, tolerance=self.tolerance, dtype=self.dtype, **window
        )
        distance = torch.tensor(self.distance, dtype=torch.float32) if self.single else self.distance
        result = propagate(self.field(), grid, self.wavelength, distance, tolerance=self.tolerance, **window)
        paraxial = ", paraxial" if plan.paraxial else ""
        return Answer(result, plan.predicted_error, plan.method + paraxial, self.tolerance)

    def exact(self) -> Tensor:
        """The exact field in the window of the result."""
        grid, out = self.grids
        return reference.propagated(self.field(), grid, self.wavelength, self.distance, out, self.offset, self.tilt)


def swept(name: str, quantity: str, values: tuple, case_of: Callable[..., Case]) -> Sweep:
    """Sweep of ``propagate`` over the cases that ``case_of`` makes of ``values``."""
    return Sweep(
        name, quantity, values, lambda v: case_of(v).answer(), lambda v: case_of(v).exact(), tolerance_from=ASKED
    )


def sweeps() -> list[Sweep]:
    """All sweeps of ``propagate``."""
    return [*_distances(), *_samplings(), *_windows(), *_tolerances()]


BASE = Case()
# A coarse pitch, whose light spreads slowly enough that plain quadrature reaches 26 times the cross-over distance.
FAR = Case((8, 9), (40e-6, 40e-6), distance=0.5)
SINGLE = torch.complex64


def _distances() -> list[Sweep]:
    """Distances from contact to the far field, and back, for several contents and precisions."""
    lengths, far = (0.0, 1e-6, 1e-4, 1e-3, 4e-3, 15e-3, 50e-3), (0.01, 0.1, 0.5, 2.0)
    both = tuple(-z for z in reversed(lengths[1:])) + lengths
    name = "distance (m)"
    return [
        *(
            swept(f"propagate, {content}", name, lengths[1:], lambda z, c=content: replace(BASE, distance=z, content=c))
            for content in ("smooth", "slm", "white", "hard edge")
        ),
        swept("propagate", name, both, lambda z: replace(BASE, distance=z)),
        swept("propagate, far", name, far, lambda z: replace(FAR, distance=z)),
        swept("propagate, complex64", name, lengths, lambda z: replace(BASE, dtype=SINGLE, distance=z)),
        swept("propagate, far, complex64", name, far, lambda z: replace(FAR, dtype=SINGLE, distance=z)),
        swept(
            "propagate, float32 distance", name, (1e-4, 4e-3, 60e-3, 0.5, 2.0),
            lambda z: replace(FAR, distance=z, single=True),
        ),
    ]  # fmt: skip


def _samplings() -> list[Sweep]:
    """Pitches from below half a wavelength on, and numbers of pixels from one on."""
    pitches = (0.2e-6, 0.27e-6, 0.4e-6, 0.5e-6, 0.7e-6, 1e-6, 2e-6, 5e-6, 15e-6, 40e-6)
    sizes, near = (1, 2, 3, 8, 24, 48, 80), replace(BASE, distance=50e-6)
    return [
        swept("propagate", "pitch (m)", pitches, lambda p: replace(near, pitch=(p, 1.1 * p))),
        swept("propagate, smooth", "pitch (m)", pitches, lambda p: replace(near, pitch=(p, p), content="smooth")),
        swept("propagate", "size (px)", sizes, lambda n: replace(BASE, shape=(n, max(1, n - 1)))),
    ]


def _windows() -> list[Sweep]:
    """Offset, pitch and size of the window of the result, and tilt of the carrier."""
    offsets, sines = (0.0, 0.3, 0.5, 1.0, 1.5, 2.0, 4.0, 10.0), (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99)
    ratios, near = (0.05, 0.2, 0.5, 0.9, 1.0, 1.3, 2.0, 5.0, 20.0), replace(BASE, distance=1e-4)
    aside, pitch = "offset (windows)", "pitch of the result (of the field's)"
    height, width = (n * p for n, p in zip(BASE.shape, BASE.pitch, strict=True))

    def zoomed(case: Case, ratio: float) -> Case:
        return replace(case, out_pitch=(ratio * case.pitch[0], ratio * case.pitch[1]))

    return [
        swept("propagate", aside, offsets, lambda w: replace(BASE, offset=(w * height, w * width / 2))),
        swept("propagate, smooth", aside, offsets, lambda w: replace(BASE, content="smooth", offset=(w * height, 0.0))),
        swept("propagate", "tilt (sine)", sines, lambda s: _tilted(BASE, s)),
        swept("propagate, near", "tilt (sine)", sines, lambda s: _tilted(replace(BASE, distance=3e-4), s)),
        swept("propagate", pitch, ratios, lambda r: zoomed(BASE, r)),
        swept("propagate, near", pitch, ratios, lambda r: zoomed(near, r)),
        swept(
            "propagate", "size of the result (px)", (1, 2, 8, 32, 96, 200), lambda n: replace(BASE, out_shape=(n, n))
        ),
    ]


def _tolerances() -> list[Sweep]:
    """Tolerances from coarse ones to those beyond any method and any rounding."""
    values, near = (0.3, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-7, 1e-10), replace(BASE, distance=1e-3)
    return [
        swept("propagate", "tolerance", values, lambda t: replace(near, tolerance=t)),
        swept("propagate, complex64", "tolerance", values, lambda t: replace(near, dtype=SINGLE, tolerance=t)),
        swept("propagate, far, complex64", "tolerance", values, lambda t: replace(FAR, dtype=SINGLE, tolerance=t)),
    ]


def _tilted(case: Case, sine: float) -> Case:
    """The same case about a tilted carrier, with the window where the carrier arrives."""
    tilt = (0.6 * sine, 0.8 * sine)
    cosine = math.sqrt(1 - sine**2)
    return replace(case, tilt=tilt, offset=(case.distance * tilt[0] / cosine, case.distance * tilt[1] / cosine))
