"""The closed form of a learned distance against autograd of the same transfer function, and where it gives way."""

from functools import partial

import pytest
import torch
from torch.autograd import forward_ad

from holotorch import Grid
from holotorch.optics.free_space import transfer
from holotorch.optics.free_space.learned_distance import has_closed_form
from holotorch.optics.free_space.plane_pair import PlanePair

WAVELENGTHS = torch.tensor([530e-9, 640e-9], dtype=torch.float64)
CASES = [
    (Grid((12, 15), (8e-6, 7e-6)), (27, 31)),
    (Grid((12, 15), (8e-6, 7e-6)), (64, 80)),
    (Grid(32, 8e-6), (64, 64)),
    (Grid((33, 20), (1e-6, 2e-6)), (70, 45)),
]


def by_both(grid, shape, distance, **options):
    planes, padded = PlanePair(grid, grid), Grid(shape, grid.pitch)
    z = torch.tensor(distance, dtype=torch.float64, requires_grad=True)
    assert has_closed_form(planes, WAVELENGTHS, z)
    by_autograd = partial(transfer.transfer_function, planes, padded, WAVELENGTHS, z)
    dtype = options.pop("dtype")
    spectrum = torch.ones(shape, dtype=dtype, requires_grad=True)
    closed = transfer.times_transfer_function(spectrum, WAVELENGTHS, z, planes=planes, padded=padded, **options)
    return z, closed, by_autograd(**options, dtype=dtype)


@pytest.mark.parametrize("distance", [3e-4, -3e-3, 0.05])
@pytest.mark.parametrize("sampled", [(True, True), (False, False), (True, False)])
@pytest.mark.parametrize("paraxial", [True, False])
@pytest.mark.parametrize(("grid", "shape"), CASES)
def test_values_and_slopes_are_those_of_autograd(grid, shape, distance, sampled, paraxial):
    for dtype, tolerance in ((torch.complex128, 1e-10), (torch.complex64, 1e-6)):
        z, closed, autograd = by_both(grid, shape, distance, sampled=sampled, paraxial=paraxial, dtype=dtype)
        assert (closed - autograd).norm() < tolerance * autograd.norm()
        weight = torch.randn(closed.shape, dtype=dtype)
        (slope,), (expected,) = (torch.autograd.grad(kernel, z, weight) for kernel in (closed, autograd))
        # k = 2 pi / wavelength is the scale of the slope of each of the N samples.
        scale = 2 * torch.pi / 530e-9 * weight.numel() ** 0.5
        assert (slope - expected).abs() < 10 * tolerance * scale


def test_a_second_derivative_is_that_of_autograd():
    z, *kernels = by_both(*CASES[0], 3e-4, sampled=(False, False), paraxial=False, dtype=torch.complex128)
    weight = torch.randn(kernels[0].shape, dtype=torch.complex128)
    curvatures = []
    for kernel in kernels:
        (slope,) = torch.autograd.grad(kernel, z, weight, create_graph=True)
        curvatures.append(torch.autograd.grad(slope, z)[0])
    torch.testing.assert_close(*curvatures, rtol=1e-9, atol=0)


def test_the_closed_form_gives_way_where_it_loses_digits_or_does_not_apply():
    grid = Grid((12, 15), (8e-6, 7e-6))
    planes = PlanePair(grid, grid)
    z = torch.tensor(3e-4, dtype=torch.float64, requires_grad=True)
    assert has_closed_form(planes, WAVELENGTHS, z)
    border = 64e-12 / 530e-9  # one squared pitch per wavelength
    for factor, applies in ((1.01, True), (0.99, False), (0.0, False), (-0.99, False), (-1.01, True)):
        at_border = torch.tensor(factor * border, dtype=torch.float64, requires_grad=True)
        assert has_closed_form(planes, WAVELENGTHS, at_border) == applies
    assert not has_closed_form(planes, WAVELENGTHS.clone().requires_grad_(), z)
    assert not has_closed_form(planes, WAVELENGTHS, z.detach())
    assert not has_closed_form(planes, WAVELENGTHS, torch.stack([z, z]))
    assert not has_closed_form(PlanePair(grid, grid, (1e-6, 0.0)), WAVELENGTHS, z)
    fine = Grid((12, 15), 0.89 * 640e-9)
    assert not has_closed_form(PlanePair(fine, fine), WAVELENGTHS, z)
    with torch.no_grad():
        assert not has_closed_form(planes, WAVELENGTHS, z)
    with forward_ad.dual_level():
        assert not has_closed_form(planes, WAVELENGTHS, forward_ad.make_dual(z, torch.ones_like(z)))


@pytest.mark.parametrize("batch", [(), (2,), (3, 2), (3, 1)])
def test_the_spectrum_gets_the_gradient_of_a_product(batch):
    """Also where it broadcasts against the wavelengths, and for the adjoint, whose spectrum is conjugate."""
    grid, shape = CASES[0]
    planes, padded = PlanePair(grid, grid), Grid(shape, grid.pitch)
    z = torch.tensor(3e-4, dtype=torch.float64, requires_grad=True)
    options = {"sampled": (True, False), "paraxial": False}
    spectrum = torch.randn(*batch, *shape, dtype=torch.complex128, requires_grad=True)
    for given in (spectrum, spectrum.conj()):
        closed = transfer.times_transfer_function(given, WAVELENGTHS, z, planes=planes, padded=padded, **options)
        wanted = given * transfer.transfer_function(planes, padded, WAVELENGTHS, z, **options)
        torch.testing.assert_close(closed, wanted, rtol=0, atol=1e-9)
        weight = torch.randn_like(wanted)
        slopes, expected = (torch.autograd.grad(each, (spectrum, z), weight) for each in (closed, wanted))
        torch.testing.assert_close(slopes, expected, rtol=1e-9, atol=1e-9)
