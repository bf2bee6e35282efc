import math

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.core.checks import SamplingWarning
from holotorch.optics import Display, Eye, EyeLens, propagate_collapsed
from holotorch.optics.viewing.eye import chromatic_refraction, zernike

GRID = Grid((48, 40), (8e-6, 9e-6))
RED = 636e-9
NEAR = Display.planar(20e-3)


def test_focal_length():
    assert Eye(accommodation=120e-3).focal_length == pytest.approx(20e-3)  # the thesis's display
    assert Eye().focal_length == pytest.approx(24e-3)
    focus = torch.tensor(0.12, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(torch.as_tensor(Eye(accommodation=focus).focal_length), focus)
    assert slope.item() == pytest.approx((20 / 120) ** 2)  # df / ds = (f / s)^2


def test_zernike_polynomials():
    y = torch.tensor([0.3, 0.0], dtype=torch.float64)
    x = torch.tensor([0.4, 0.0], dtype=torch.float64)
    rho, angle = 0.5, math.atan2(0.3, 0.4)
    wanted = {
        0: 1.0,
        1: 2 * rho * math.sin(angle),
        2: 2 * rho * math.cos(angle),
        3: math.sqrt(6) * rho**2 * math.sin(2 * angle),
        4: math.sqrt(3) * (2 * rho**2 - 1),
        5: math.sqrt(6) * rho**2 * math.cos(2 * angle),
        8: math.sqrt(8) * (3 * rho**3 - 2 * rho) * math.cos(angle),
        12: math.sqrt(5) * (6 * rho**4 - 6 * rho**2 + 1),
    }
    for index, value in wanted.items():
        assert zernike(index, y, x)[0].item() == pytest.approx(value)
    # Orthonormal over the disc: Gauss-Legendre in rho^2 and an even sum in angle are exact for these.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    rho, angles = torch.from_numpy(np.sqrt((nodes + 1) / 2))[:, None], torch.arange(32).double() * math.pi / 16
    basis = torch.stack([zernike(j, rho * torch.sin(angles), rho * torch.cos(angles)) for j in range(15)])
    gram = torch.einsum("iab,jab,a->ij", basis, basis, torch.from_numpy(weights)) / 64
    torch.testing.assert_close(gram, torch.eye(15, dtype=torch.float64), rtol=0, atol=1e-12)


def test_defocus_by_zernike_is_defocus_by_accommodation():
    """Power -4 sqrt(3) c / r^2: what 1 / 22 mm - 1 / 25 mm of accommodation does."""
    y, x = GRID.coordinates()
    light = torch.exp(-(y.square() + x.square()) / (2 * 12e-6**2)).to(torch.complex128)[None]
    radius = 0.5e-3
    shift = 1 / 22e-3 - 1 / 25e-3  # dioptres more than at 25 mm
    other = Eye(radius, 24e-3, 22e-3, softness=20e-6)
    same = Eye(radius, 24e-3, 25e-3, aberrations={4: -shift * radius**2 / (4 * math.sqrt(3))}, softness=20e-6)
    wanted, got, sharp = (
        propagate_collapsed(light, GRID, RED, NEAR, eye, plane=-5e-3, paraxial=True).abs()
        for eye in (other, same, Eye(radius, 24e-3, 25e-3, softness=20e-6))
    )
    # Up to a phase on all of the pupil; windows differ in the room for the blur, which wraps 1e-3 of the light.
    assert (got - wanted).norm() < 2e-3 * wanted.norm()
    assert (sharp - wanted).norm() > 0.02 * wanted.norm()


def test_colour_error_of_the_eye():
    # Thibos et al. (1992): zero at 590 nm, -1.72 dioptres at 400 nm, +0.38 at 700 nm.
    assert chromatic_refraction(589.99e-9) == pytest.approx(0, abs=1e-3)
    assert chromatic_refraction(400e-9) == pytest.approx(-1.722, abs=2e-3)
    assert chromatic_refraction(700e-9) == pytest.approx(0.382, abs=2e-3)
    with pytest.raises(ValueError, match="within 380 .. 900 nm"):
        chromatic_refraction(1.0)
    # Blue focused for red: the eye is too strong, exactly a lens of the difference.
    y, x = GRID.coordinates()
    found = Eye(1e-3, chromatic_reference=RED).pupil_function(y, x, 455e-9)
    power = chromatic_refraction(RED) - chromatic_refraction(455e-9)
    assert power > 1
    wanted = torch.polar(torch.ones(48, 40, dtype=torch.float64), -math.pi * power * (y**2 + x**2) / 455e-9)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-10)


def test_lens_of_the_eye_as_an_element():
    eye = Eye(0.1e-3, 24e-3, 25e-3, aberrations={8: 1e-7})
    lens = EyeLens(GRID, (RED, 520e-9), eye)
    x, y = (torch.randn(2, *GRID.shape, dtype=torch.complex128) for _ in range(2))
    assert abs((lens(x).conj() * y).sum() - (x.conj() * lens.adjoint(y)).sum()) < 1e-12 * x.norm() * y.norm()
    row, column = GRID.coordinates()
    wanted = torch.polar(torch.ones(48, 40).double(), -math.pi * (row**2 + column**2) / (RED * eye.focal_length))
    wanted = wanted * eye.pupil_function(row, column, RED)
    torch.testing.assert_close(lens(torch.ones_like(x))[0], wanted, rtol=0, atol=1e-10)
    with pytest.warns(SamplingWarning, match="it reaches 1.5 mm"):
        EyeLens(Grid((1, 1024), 8e-6), RED, Eye(1.5e-3, 24e-3))


def test_impossible_eyes():
    for wrong, message in (
        ({"pupil_radius": 0.0}, "pupil_radius must be above zero"),
        ({"axial_length": -1e-3}, "axial_length must be above zero"),
        ({"accommodation": 0.0}, "accommodation must be above zero in metres"),
        ({"accommodation": -0.01}, "accommodation must be above zero in metres"),
        ({"aberrations": {99: 1e-7}}, r"OSA index of 0 \.\. 27"),
        ({"chromatic_reference": 2e-6}, "within 380"),
        ({"softness": -1.0}, "softness must be at least zero in metres"),
    ):
        with pytest.raises(ValueError, match=message):
            Eye(**wrong)  # type: ignore[arg-type]


def test_polynomials_of_no_index_are_refused():
    y = x = torch.zeros(1)
    for index, error in ((-1, ValueError), (-3, ValueError), (1.0, TypeError), (True, TypeError)):
        with pytest.raises(error, match="Zernike index must be"):
            zernike(index, y, x)  # type: ignore[arg-type]
