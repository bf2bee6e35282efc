"""An eye beside the axis, against direct sums through a displaced aperture, and against the geometry of rays."""

import math

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.optics import Display, Eye, Retina, propagate
from holotorch.optics.light.displaced import displaced_eye

WAVELENGTH, PITCH, COUNT, PLANE, FAR = 520e-9, 8e-6, 300, 0.02, 0.1
PUPIL, LENGTH = 0.4e-3, 24e-3


def seen(field, grid, position, display, plane=PLANE):
    """Intensity on the retina of a displaced eye that looks at ``plane``."""
    eye = Eye(PUPIL, LENGTH, _accommodation(display, plane))
    moved, wide = displaced_eye(field, grid, WAVELENGTH, display, plane, position)
    image = Retina(wide, WAVELENGTH, display, eye, plane=plane, tolerance=0.9, paraxial=True)(moved[None])[0]
    y, x = ((n - m) // 2 for n, m in zip(wide.shape, grid.shape, strict=True))
    return image[y : y + grid.shape[0], x : x + grid.shape[1]]


def _accommodation(display: Display, plane: float) -> float:
    s0, f = float(display.lens_distance) - plane, float(display.focal_length)
    return (s0 if math.isinf(f) else f * s0 / (f - s0)) + float(display.eye_distance)


@pytest.mark.parametrize("position", [-1.12e-3, 0.0, 0.608e-3, 1.408e-3])
def test_one_axis_is_the_direct_sum_through_a_displaced_aperture(position):
    """Fresnel's integral to the pupil, an aperture beside a lens on the axis, and Fresnel's integral to the retina.

    The positions shift by whole numbers of pixels.
    """
    generator = np.random.default_rng(2)
    x = (np.arange(COUNT) - COUNT // 2) * PITCH
    smooth = np.convolve(generator.normal(size=COUNT) + 1j * generator.normal(size=COUNT), np.hanning(5), "same")
    hologram = smooth * np.exp(-((x / 6e-4) ** 2))
    step = 2e-6
    xi = position + np.arange(-PUPIL, PUPIL, step) + step / 2
    pupil = np.exp(1j * np.pi * (x - xi[:, None]) ** 2 / (WAVELENGTH * FAR)) @ hologram
    pupil = pupil * np.exp(-1j * np.pi * xi**2 / WAVELENGTH * (1 / (FAR - PLANE) + 1 / LENGTH))
    u = -x * LENGTH / (FAR - PLANE)
    retina = np.abs(np.exp(1j * np.pi * (u[:, None] - xi) ** 2 / (WAVELENGTH * LENGTH)) @ pupil) ** 2
    field = torch.tensor(hologram)[None]
    image = seen(field, Grid((1, COUNT), PITCH), (0.0, position), Display.planar(FAR))[0].numpy()
    inside = slice(COUNT // 5, -COUNT // 5)
    retina, image = retina[inside] / retina.sum(), image[inside] / image.sum()
    assert np.linalg.norm(retina - image) < 0.06 * np.linalg.norm(retina)


@pytest.mark.parametrize(
    ("display", "beside"),
    [(Display.planar(FAR), (0.5e-3, -0.3e-3)), (Display(38e-3, 20e-3, 40e-3), (0.2e-3, -0.1e-3))],
    ids=["planar", "eyepiece"],
)
def test_points_move_as_rays_do(display, beside):
    grid, near, place = Grid((160, 160), PITCH), 0.017, (40e-6, -64e-6)
    at_focus, before = (_point(grid, place, depth) for depth in (PLANE, near))
    for position in ((0.0, 0.0), beside):
        assert _centre(seen(at_focus, grid, position, display), grid) == pytest.approx(place, abs=3e-6)
        # The ray from the point to the eye, through the ray matrices of both planes, back to the plane in focus.
        first, second, _, _ = (float(each) for each in display.matrix(near))
        slopes = [(at - first * y) / second for at, y in zip(position, place, strict=True)]
        expected = [y + slope * (PLANE - near) for y, slope in zip(place, slopes, strict=True)]
        assert _centre(seen(before, grid, position, display), grid) == pytest.approx(expected, abs=3e-6)


def _point(grid: Grid, place, depth: float) -> torch.Tensor:
    sources = torch.zeros(grid.shape, dtype=torch.complex128)
    y, x = (round(at / PITCH) + n // 2 for at, n in zip(place, grid.shape, strict=True))
    sources[y, x] = 1
    return propagate(sources, grid, WAVELENGTH, -depth, tolerance=1e-3)


def _centre(image: torch.Tensor, grid: Grid) -> list[float]:
    y, x = grid.coordinates()
    image = image * (image > 0.2 * image.max())
    return [float((image * axis).sum() / image.sum()) for axis in (y, x)]


def test_where_no_light_goes_and_what_is_no_field():
    grid = Grid((8, 8), PITCH)
    with pytest.raises(ValueError, match="must be within 0.0026 m of the axis"):
        displaced_eye(
            torch.ones(8, 8, dtype=torch.complex64), grid, WAVELENGTH, Display.planar(FAR), PLANE, (0.0, 4e-3)
        )
    with pytest.raises(TypeError, match="complex"):
        displaced_eye(torch.ones(8, 8), grid, WAVELENGTH, Display.planar(FAR), PLANE, (0.0, 0.0))
