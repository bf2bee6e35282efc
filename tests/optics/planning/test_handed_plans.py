"""Plans that are handed in, plans and kernels that are remembered, and distances that are learned."""

import pytest
import torch

from holotorch import Grid
from holotorch.core.checks import PrecisionWarning
from holotorch.optics import Propagator, plan_propagation, propagate
from holotorch.optics.planning import propagate as planned
from holotorch.optics.planning.propagate import STEP, next_longer

GRID, WAVELENGTHS = Grid((24, 30), (8e-6, 7e-6)), (630e-9, 530e-9)


def field(*batch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    real, imaginary = torch.randn(2, *batch, *GRID.shape, generator=generator, dtype=torch.float64)
    return torch.complex(real, imaginary)


@pytest.mark.parametrize("options", [{}, {"out_grid": Grid((20, 30), GRID.pitch)}, {"out_grid": Grid(20, 9e-6)}])
def test_a_plan_gives_what_the_call_would_have_chosen(options):
    light = field(3)
    plan = plan_propagation(GRID, 530e-9, 5e-3, **options)
    wanted = propagate(light, GRID, 530e-9, 5e-3, **options)
    torch.testing.assert_close(propagate(light, GRID, 530e-9, 5e-3, plan=plan, **options), wanted, rtol=0, atol=1e-12)
    # The method stays when the distance changes, and so it does for a Propagator.
    moved = propagate(light, GRID, 530e-9, 5.2e-3, plan=plan, **options)
    exact = propagate(light, GRID, 530e-9, 5.2e-3, tolerance=2e-4, **options)
    assert (moved - exact).norm() < 5e-3 * exact.norm()


def test_a_plan_for_another_window_is_refused():
    plan = plan_propagation(GRID, 530e-9, 5e-3, out_grid=Grid((20, 30), GRID.pitch))
    with pytest.raises(ValueError, match=r"plan must be for a result of \(shape, pitch, offset\) \(\(24, 30\)"):
        propagate(field(), GRID, 530e-9, 5e-3, plan=plan)


def test_several_wavelengths_in_any_form_equal_a_propagator():
    light = field(2)
    wanted = Propagator(GRID, WAVELENGTHS, 5e-3)(light)
    for wavelengths in (WAVELENGTHS, list(WAVELENGTHS), torch.tensor(WAVELENGTHS, dtype=torch.float64)):
        torch.testing.assert_close(propagate(light, GRID, wavelengths, 5e-3), wanted, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="wavelength"):
        propagate(light, GRID, (630e-9, -1.0), 5e-3)


def test_plans_and_kernels_are_remembered_and_do_not_mix():
    for cache in (planned._remembered_job, planned._cached_choice, planned._constant_kernel):
        cache.cache_clear()
    light = field()
    first = propagate(light, GRID, 530e-9, 5e-3)
    for _ in range(3):
        assert torch.equal(propagate(light, GRID, 530e-9, 5e-3), first)
    assert planned._cached_choice.cache_info().misses == planned._constant_kernel.cache_info().misses == 1
    single = propagate(light.to(torch.complex64), GRID, 530e-9, 5e-3)
    assert single.dtype == torch.complex64
    assert (single - first).norm() < 1e-5 * first.norm()
    assert not torch.allclose(propagate(light, GRID, 530e-9, 5.001e-3), first)
    assert not torch.allclose(propagate(light, GRID, 531e-9, 5e-3), first)


def test_a_kernel_made_without_gradients_serves_calls_with_them():
    planned._constant_kernel.cache_clear()
    light = field()
    with torch.inference_mode():
        propagate(light, GRID, 530e-9, 6e-3)
    traced = light.clone().requires_grad_()
    propagate(traced, GRID, 530e-9, 6e-3).abs().sum().backward()
    assert traced.grad is not None and torch.isfinite(torch.view_as_real(traced.grad)).all()


def test_a_learned_distance_keeps_its_method_from_step_to_step():
    assert next_longer(0.0) == 0 and next_longer(-1.0) == -1.0
    for distance in (3e-5, 1.0, -0.2, STEP**3):
        longer = next_longer(distance)
        assert abs(distance) * (1 - 1e-9) <= abs(longer) <= STEP * abs(distance) and longer * distance > 0
    planned._cached_choice.cache_clear()
    light, low = field(), STEP**-50
    for step in range(1, 9):  # within one power
        distance = torch.tensor(low * (1 + 0.01 * step), dtype=torch.float64, requires_grad=True)
        propagate(light, GRID, 530e-9, distance)
    assert planned._cached_choice.cache_info().misses == 1
    distance = torch.tensor(5e-3, dtype=torch.float64, requires_grad=True)
    start = field()
    change = lambda u: propagate(start, GRID, 530e-9, distance.detach() + 1e-8 * u)  # noqa: E731
    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(change, (zero,), fast_mode=True)


def test_single_precision_wavelengths_still_warn():
    with pytest.warns(PrecisionWarning):
        propagate(field(), GRID, torch.tensor(530e-9), 0.5, tolerance=1e-2)


def test_something_else_than_a_plan_is_refused():
    with pytest.raises(TypeError, match="plan must be a result of plan_propagation, got str"):
        propagate(field(), GRID, 530e-9, 5e-3, plan="exact")  # type: ignore[arg-type]
