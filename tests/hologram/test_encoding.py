"""Encodings as phase: gradients that stay finite, and fields that have no phase."""

import pytest
import torch

from holotorch.hologram import double_phase, error_diffused, iterated, kinoform

ENCODINGS = [kinoform, double_phase, error_diffused, lambda field: iterated(field, torch.fft.fft2, torch.fft.ifft2)]


def random_field(*shape: int, dtype: torch.dtype = torch.complex128) -> torch.Tensor:
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(5))


@pytest.mark.parametrize("encode", [kinoform, double_phase])
def test_gradients_are_those_of_finite_differences(encode):
    """The brightest pixel included: its share of the largest amplitude stays 1."""
    assert torch.autograd.gradcheck(encode, random_field(2, 4, 5).requires_grad_())


@pytest.mark.parametrize("encode", [kinoform, double_phase])
@pytest.mark.parametrize("scale", [0.0, 1e-42, 1e-30, 1.0, 1e30])
def test_gradients_are_finite_at_every_brightness(encode, scale):
    """Squares of amplitudes under- or overflow at three of them."""
    field = (scale * random_field(2, 4, 5).to(torch.complex64)).requires_grad_()
    encode(field).sum().backward()
    assert field.grad is not None and field.grad.isfinite().all()


def test_gradients_are_finite_where_some_pixels_are_dark_or_all_are_alike():
    field = random_field(4, 5)
    field[1:3, 2:] = 0
    for item in (field, torch.ones(3, 4, dtype=torch.complex128)):
        item = item.clone().requires_grad_()
        double_phase(item).square().sum().backward()
        assert item.grad is not None and item.grad.isfinite().all()
        assert not item.grad[item.detach() == 0].any()


@pytest.mark.parametrize("encode", ENCODINGS)
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused(encode, bad):
    field = random_field(4, 5)
    field[1, 2] = bad
    with pytest.raises(ValueError, match=r"field must be finite, but element \(1, 2\)"):
        encode(field)


@pytest.mark.parametrize("encode", ENCODINGS)
def test_what_is_no_hologram_is_refused(encode):
    with pytest.raises(TypeError, match=r"field must be a complex tensor \(..., H, W\), got torch.float32"):
        encode(torch.zeros(4, 5))
    with pytest.raises(ValueError, match=r"field must end in \(H, W\), both at least 1, got \(4, 0\)"):
        encode(torch.zeros(4, 0, dtype=torch.complex64))
    assert encode(torch.zeros(0, 4, 5, dtype=torch.complex64)).shape == (0, 4, 5)


@pytest.mark.parametrize("encode", ENCODINGS)
def test_a_black_hologram_is_no_division_by_zero(encode):
    assert encode(torch.zeros(6, 5, dtype=torch.complex64)).isfinite().all()
