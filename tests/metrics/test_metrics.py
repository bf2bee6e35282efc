import sys
from types import ModuleType

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from holotorch.metrics import PerceptualSimilarity, psnr, ssim


def pair(dtype=torch.float64, shape=(2, 3, 40, 33)):
    reference = torch.rand(*shape, dtype=dtype)
    return (reference + 0.1 * torch.randn_like(reference)).clamp(0, 1), reference


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("data_range", [1.0, 255.0])
def test_both_equal_scikit_image(dtype, tolerance, data_range):
    image, reference = (tensor * data_range for tensor in pair(dtype))
    quality, noise = ssim(image, reference, data_range=data_range), psnr(image, reference, data_range=data_range)
    assert quality.shape == noise.shape == (2, 3) and quality.dtype == dtype
    for b in range(2):
        for c in range(3):
            x, y = image[b, c].double().numpy(), reference[b, c].double().numpy()
            wanted = structural_similarity(
                x, y, data_range=data_range, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
            )[1][5:-5, 5:-5].mean()
            assert quality[b, c].item() == pytest.approx(wanted, abs=tolerance)
            wanted = peak_signal_noise_ratio(y, x, data_range=data_range)
            assert noise[b, c].item() == pytest.approx(wanted, rel=tolerance)


def test_equal_images():
    image = pair()[1]
    assert torch.equal(ssim(image, image, data_range=1.0), torch.ones(2, 3, dtype=torch.float64))
    assert torch.isinf(psnr(image, image, data_range=1.0)).all()
    dark = torch.zeros(20, 20, dtype=torch.float64)
    assert ssim(dark, dark, data_range=1.0).item() == 1


def test_ssim_has_a_right_gradient():
    image, reference = pair(shape=(1, 12, 13))
    assert torch.autograd.gradcheck(lambda x: ssim(x, reference, data_range=1.0), (image.requires_grad_(),))


def test_ssim_needs_its_window():
    ok = torch.rand(11, 11)
    ssim(ok, ok, data_range=1.0)
    with pytest.raises(ValueError, match="at least 11 x 11 px, got 8 x 8; psnr has no such limit"):
        ssim(torch.rand(8, 8), torch.rand(8, 8), data_range=1.0)
    assert np.isfinite(psnr(torch.rand(8, 8), torch.rand(8, 8), data_range=1.0).item())


def test_refuses_pairs_that_do_not_match():
    with pytest.raises(ValueError, match="share a shape"):
        ssim(torch.rand(12, 12), torch.rand(12, 13), data_range=1.0)
    with pytest.raises(TypeError, match="real floating-point"):
        psnr(torch.zeros(12, 12, dtype=torch.uint8), torch.rand(12, 12), data_range=1.0)
    with pytest.raises(ValueError, match="data_range must be above zero"):
        psnr(torch.rand(12, 12), torch.rand(12, 12), data_range=0.0)
    with pytest.raises(TypeError):
        psnr(torch.rand(12, 12), torch.rand(12, 12))  # type: ignore[call-arg]


class _Distance(torch.nn.Module):
    """Stands in for the network: the mean absolute difference of colours in -1..1."""

    def __init__(self, net: str, verbose: bool):
        super().__init__()
        assert net == "alex"

    def forward(self, image, reference):
        assert image.shape[1] == 3 and image.min() >= -1 and image.max() <= 1
        return (image - reference).abs().mean((1, 2, 3), keepdim=True)


def test_perceptual_similarity_shows_the_network_what_it_was_trained_on(monkeypatch):
    module = ModuleType("lpips")
    monkeypatch.setitem(sys.modules, "lpips", module)
    module.LPIPS = _Distance  # pyright: ignore[reportAttributeAccessIssue]
    similarity = PerceptualSimilarity()
    image, reference = pair(shape=(2, 5, 1, 16, 20))
    scores = similarity(image, reference)
    assert scores.shape == (2, 5) and scores.dtype == torch.float64
    wanted = torch.exp(-2 * (image - reference).abs().mean((-3, -2, -1)))
    assert torch.allclose(scores, wanted, rtol=1e-5)  # the network works in float32
    assert torch.equal(similarity(image, image), torch.ones(2, 5, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"C = 1 \(grey\) or 3 \(RGB\)"):
        similarity(torch.rand(2, 16, 16), torch.rand(2, 16, 16))


def test_weights_that_are_there_need_no_download(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr("holotorch.metrics.quality.find_spec", lambda name: name)
    assert not PerceptualSimilarity.is_there()
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth").touch()
    assert PerceptualSimilarity.is_there()


def test_perceptual_similarity_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(ImportError, match=r"pip install 'holotorch\[lpips\]'"):
        PerceptualSimilarity()
