import numpy as np
import pytest
import torch
from oracles import dense
from scipy.signal import convolve2d

from holotorch.core.fourier import centred_fft2, centred_ifft2, convolve, fft2, filter_spectrum, good_length, ifft2


def test_good_length_is_the_next_product_of_two_three_and_five():
    products = sorted({2**a * 3**b * 5**c for a in range(11) for b in range(7) for c in range(5)})
    for minimum in range(1, 700):
        assert good_length(minimum) == next(p for p in products if p >= minimum)
    with pytest.raises(ValueError, match="at least 1"):
        good_length(0)


@pytest.mark.parametrize("shape", [(5, 6), (4, 4), (7, 3), (1, 8)])
def test_centred_transform_equals_its_matrix_and_is_unitary(shape):
    field = torch.randn(*shape, dtype=torch.complex128)
    wanted = (dense.centred_unitary_dft(shape) @ field.numpy().ravel()).reshape(shape)
    np.testing.assert_allclose(centred_fft2(field), wanted, atol=1e-14)
    np.testing.assert_allclose(centred_ifft2(centred_fft2(field)), field, atol=1e-14)


@pytest.mark.parametrize("size", [(3, 3), (4, 5), (2, 1), (9, 12)])
@pytest.mark.parametrize("complex_kernel", [False, True])
def test_convolution_is_linear_and_centred(size, complex_kernel):
    image = torch.randn(2, 7, 10, dtype=torch.float64)
    kernel = torch.randn(*size, dtype=torch.complex128 if complex_kernel else torch.float64)
    out = convolve(image, kernel)
    assert out.shape == image.shape and out.dtype == kernel.dtype
    for i in range(2):
        full = convolve2d(image[i].numpy(), kernel.numpy())
        wanted = full[size[0] // 2 :, size[1] // 2 :][:7, :10]
        np.testing.assert_allclose(out[i], wanted, atol=1e-13)


def test_2048_samples_in_single_precision():
    """A scale inside torch's transform is lost at this size on some CPUs (pytorch#169670), and 2048 px is common."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # one thread is right anyway
    try:
        _check_2048_samples()
    finally:
        torch.set_num_threads(threads)


def _check_2048_samples():
    field = torch.randn(2048, 2048, dtype=torch.complex64, requires_grad=True)
    scale = field.detach().abs().max()
    assert (ifft2(fft2(field)) - field).abs().max() < 1e-5 * scale
    assert (centred_ifft2(centred_fft2(field)) - field).abs().max() < 1e-5 * scale
    power = centred_fft2(field.detach()).to(torch.complex128).norm() / field.detach().to(torch.complex128).norm()
    assert abs(power - 1) < 1e-5  # summed in double precision: in single, 4e-5 are lost on one thread
    (gradient,) = torch.autograd.grad(centred_fft2(field).abs().square().sum(), field)
    assert (gradient - 2 * field).abs().max() < 1e-5 * scale
    (gradient,) = torch.autograd.grad(ifft2(fft2(field)).abs().square().sum(), field)
    assert (gradient - 2 * field).abs().max() < 1e-5 * scale
    real = field.detach().real
    assert (convolve(real, torch.ones(1, 1)) - real).abs().max() < 1e-5 * scale


def test_a_shift_filter_moves_light_without_wrapping_it():
    field = torch.zeros(1, 6, dtype=torch.complex128)
    field[0, 4] = 1
    kernel = torch.exp(-2j * torch.pi * 3 * torch.fft.fftfreq(12, dtype=torch.float64))[None]  # 3 samples to the right
    assert filter_spectrum(field, kernel).abs().max() < 1e-15
    assert filter_spectrum(field, kernel.conj())[0, 1].real == pytest.approx(1)
