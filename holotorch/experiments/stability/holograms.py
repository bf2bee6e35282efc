"""Sweeps of the holograms of points on planes, against the sum over all pairs."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.experiments.stability import reference
from holotorch.experiments.stability.sweep import ASKED, DEFAULT, DOCUMENTED, Answer, Sweep
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram, plan_hologram
from holotorch.hologram.cone import Cone

ROUNDING = 1e-5  # tolerance of sums in complex64 that document no error but rounding


@dataclass(frozen=True)
class Scene:
    """Planes of independent random sources; lengths in metres."""

    pixels: int = 32
    pitch: float = 4e-6
    nearest: float = 4e-3
    extent: float = 4e-3  # depth between the first and the last plane
    planes: int = 6
    sources: tuple[int, int] = (16, 19)
    stride: int = 1
    cone: Cone = "taper"
    tolerance: float = DEFAULT
    dtype: torch.dtype = torch.complex64

    @property
    def depths(self) -> list[float]:
        """Depths of the planes, evenly spaced."""
        step = self.extent / max(1, self.planes - 1)
        return [self.nearest + step * i for i in range(self.planes)]

    @property
    def setup(self) -> tuple[Grid, float, list[float]]:
        """Grid, wavelength and depths."""
        return Grid((self.pixels, self.pixels - 3), self.pitch), 530e-9, self.depths

    def layers(self) -> Tensor:
        """Sources, [D, h, w]."""
        return reference.noise((self.planes, *self.sources)).to(self.dtype)

    def axial(self) -> Answer:
        """What ``AxialHologram`` gives."""
        operator = AxialHologram(*self.setup, cone=self.cone, stride=self.stride, tolerance=self.tolerance)
        result = operator(self.layers())
        return Answer(result, operator.design(self.sources).predicted_error, tolerance=self.tolerance)

    def convolution(self) -> Answer:
        """What ``ConvolutionHologram`` gives; it documents rounding errors alone, except for "band"."""
        operator = ConvolutionHologram(*self.setup, cone=self.cone, stride=self.stride)
        result = operator(self.layers())
        if self.cone != "band":
            return Answer(result, tolerance=ROUNDING)
        sine = operator.wavelength / (2 * self.pitch)
        error = 2 * sine**2 / math.sqrt(min(operator.padded(self.sources)) / 2)
        return Answer(result, error, tolerance=error)

    def planned(self) -> Answer:
        """What the plan of the cheapest adequate method gives."""
        plan = plan_hologram(
            *self.setup, self.sources, stride=self.stride, tolerance=self.tolerance, cone=self.cone, dtype=self.dtype
        )
        return Answer(plan.operator(self.layers()), plan.predicted_error, plan.method, self.tolerance)


@lru_cache(maxsize=128)
def _exact(scene: Scene) -> Tensor:
    """The sum over all pairs of a source and a pixel, in float64; the same for all methods and tolerances."""
    return DirectHologram(*scene.setup, cone=scene.cone, stride=scene.stride)(scene.layers())


def sweeps() -> list[Sweep]:
    """Depth, depth range, number of planes, pitch, stride, cone and tolerance of the three methods."""
    base = Scene()
    depths = (2e-5, 1e-4, 5e-4, 2e-3, 8e-3, 0.05, 0.5)
    extents = (0.0, 1e-4, 1e-3, 1e-2, 0.02)
    tolerances = (0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
    pitches = (0.2e-6, 0.4e-6, 0.5e-6, 0.7e-6, 1e-6, 4e-6, 12e-6)
    cones = "full", "box", "disc", "taper", "band"
    double = replace(base, dtype=torch.complex128)
    methods = {
        "AxialHologram": (Scene.axial, ASKED),
        "ConvolutionHologram": (Scene.convolution, DOCUMENTED),
        "plan_hologram": (Scene.planned, ASKED),
    }
    listed = []
    for name, (method, source) in methods.items():
        listed += [
            _sweep(name, method, source, "nearest depth (m)", depths, lambda z: replace(base, nearest=z)),
            _sweep(name, method, source, "depth range (m)", extents, lambda z: replace(base, extent=z)),
            _sweep(name, method, source, "planes", (1, 2, 5, 20), lambda n: replace(base, planes=n)),
            _sweep(
                name, method, source, "pitch (m)", pitches,
                lambda p: replace(base, pitch=p, nearest=1e-4, extent=1e-4, cone="taper" if p > 0.48e-6 else "box"),
            ),
            _sweep(name, method, source, "cone", cones, lambda c: replace(base, cone=c)),
            _sweep(
                name, method, source, "cone, near", cones,
                lambda c: replace(base, cone=c, nearest=2e-4),
            ),
            _sweep(name, method, source, "stride (px)", (1, 2, 3, 5), lambda n: replace(base, stride=n)),
        ]  # fmt: skip
        if source == ASKED:
            listed += [
                _sweep(name, method, source, "tolerance", tolerances, lambda t: replace(base, tolerance=t)),
                _sweep(
                    f"{name}, complex128",
                    method,
                    source,
                    "tolerance",
                    tolerances,
                    lambda t: replace(double, tolerance=t),
                ),
            ]
    return listed


def _sweep(
    name: str, method: Callable[[Scene], Answer], source: str, swept: str, values: tuple, scene: Callable[..., Scene]
) -> Sweep:
    def exact(value: float | str) -> Tensor:
        return _exact(replace(scene(value), tolerance=DEFAULT, dtype=torch.complex128))

    return Sweep(name, swept, values, lambda v: method(scene(v)), exact, tolerance_from=source)
