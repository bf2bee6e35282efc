import math

import pytest
import torch

from holotorch.core.complex import intensity, phasor, wrapped


@pytest.mark.parametrize(("real", "complex_"), [(torch.float32, torch.complex64), (torch.float64, torch.complex128)])
def test_phasor_and_intensity_keep_precision(real, complex_):
    phase = torch.linspace(-7, 7, 31, dtype=real)
    field = phasor(phase)
    assert field.dtype == complex_ and intensity(field).dtype == real
    torch.testing.assert_close(field, torch.exp(1j * phase))
    torch.testing.assert_close(intensity(field), torch.ones_like(phase))


def test_intensity_has_an_exact_gradient_at_zero():
    field = torch.zeros(3, dtype=torch.complex128, requires_grad=True)
    (gradient,) = torch.autograd.grad(intensity(field).sum(), field)
    assert torch.equal(gradient, torch.zeros_like(gradient))
    assert torch.autograd.gradcheck(intensity, (field,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrapped_lies_below_two_pi_even_just_under_zero(dtype):
    phase = torch.tensor([-1e-9, 0.0, 7.0, -3.0, 2 * math.pi, -2 * math.pi, 1e4], dtype=dtype)
    result = wrapped(phase)
    assert (result >= 0).all() and (result < 2 * math.pi).all()
    torch.testing.assert_close(phasor(result), phasor(phase), atol=1e-3 if dtype == torch.float32 else 1e-11, rtol=0)
