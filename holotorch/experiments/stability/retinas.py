"""Sweeps of the image on the retina: pupil, depth, field, sampling and eyepiece."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

from torch import Tensor

from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.experiments.stability import reference
from holotorch.experiments.stability.sweep import ASKED, Answer, Sweep
from holotorch.optics import Display, Eye, Retina, propagate_elements
from holotorch.optics.viewing.elementwise import least_oversampling
from holotorch.optics.viewing.retina import TOLERANCE

_FINER = 1.5  # samples of the reference for each that element-by-element propagation needs


@dataclass(frozen=True)
class View:
    """A hologram of noise, an eyepiece and an eye; lengths in metres."""

    pixels: int = 32
    pitch: float = 16e-6
    wavelength: float = 520e-9
    lens_distance: float = 45e-3
    focal_length: float = 40e-3
    lens_radius: float | None = None
    eye_distance: float = 50e-3
    pupil: float = 3e-3  # diameter
    accommodation: float = 0.25
    tolerance: float | None = TOLERANCE

    @property
    def grid(self) -> Grid:
        """Sampling of the hologram."""
        return Grid((self.pixels, self.pixels - 8), self.pitch)

    @property
    def optics(self) -> tuple[Display, Eye]:
        """Display and eye."""
        display = Display(self.lens_distance, self.focal_length, self.eye_distance, self.lens_radius)
        return display, Eye(self.pupil / 2, accommodation=self.accommodation)

    def retina(self) -> Answer:
        """What ``Retina`` gives."""
        retina = Retina(self.grid, self.wavelength, *self.optics, tolerance=self.tolerance)
        return Answer(
            retina(reference.noise_inside(self.grid)),
            retina.plan.predicted_error,
            retina.plan.method,
            self.tolerance or TOLERANCE,
        )


@lru_cache(maxsize=1)
def _exact(view: View) -> Tensor:
    """Intensity [1, H, W], element by element in complex128, on samples finer than that needs."""
    least = least_oversampling(view.grid, (view.wavelength,), *view.optics)
    (y, x), (rows, columns) = least.oversampling, least.fine
    finer = replace(
        least, oversampling=(_FINER * y, _FINER * x), fine=(math.ceil(_FINER * rows), math.ceil(_FINER * columns))
    )
    return intensity(
        propagate_elements(reference.noise_inside(view.grid), view.grid, view.wavelength, *view.optics, sampling=finer)
    )


def sweeps() -> list[Sweep]:
    """All sweeps of ``Retina``."""
    base = View()
    pupils = (0.6e-3, 1e-3, 2e-3, 3e-3, 6e-3)
    depths = (0.08, 0.12, 0.25, 1.0, 10.0)
    return [
        _retina("Retina", "pupil diameter (m)", pupils, lambda d: replace(base, pupil=d)),
        _retina("Retina", "accommodation (m)", depths, lambda s: replace(base, accommodation=s)),
        _retina("Retina", "tolerance", (0.5, 0.2, 0.1, 0.03, 0.01, 1e-3, 1e-5), lambda t: replace(base, tolerance=t)),
        _retina("Retina", "size (px)", (12, 24, 48), lambda n: replace(base, pixels=n)),
        _retina("Retina", "pitch (m)", (10e-6, 16e-6, 30e-6, 60e-6), lambda p: replace(base, pitch=p)),
        _retina(
            "Retina", "radius of the eyepiece (m)", (0.2e-3, 0.5e-3, 1e-3, 20e-3),
            lambda r: replace(base, lens_radius=r),
        ),
    ]  # fmt: skip


def _retina(name: str, swept: str, values: tuple, view: Callable[..., View]) -> Sweep:
    return Sweep(
        name,
        swept,
        values,
        lambda v: view(v).retina(),
        lambda v: _exact(replace(view(v), tolerance=None)),
        tolerance_from=ASKED,
    )
