"""Speckle against Goodman's closed forms, on fields whose statistics are known."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from oracles.speckle import developed, developed_round
from scipy.optimize import brentq
from scipy.special import j1

from holotorch.metrics import (
    anisotropy,
    dark_spots,
    grain_size,
    power_spectrum,
    seed_statistics,
    sharpness,
    speckle_contrast,
    squared_blur,
    squared_error,
)

SIDE = 512


def tensors(*images: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.stack(images))


def squares(count: int, width: float = 0.4, seed: int = 1) -> torch.Tensor:
    generator = np.random.default_rng(seed)
    return tensors(*(developed((SIDE, SIDE), (width, width), generator) for _ in range(count)))


def test_fully_developed_speckle_has_contrast_one_and_sums_less():
    pictures = squares(16)
    # Independent grains: SIDE^2 width^2 = 42 000. The variance of an exponential's contrast is 1 per grain, so 0.5 %.
    assert torch.allclose(speckle_contrast(pictures), torch.ones(16, dtype=torch.float64), atol=0.02)
    for count in (1, 4, 16):
        mean = pictures[:count].mean(0)
        assert speckle_contrast(mean).item() == pytest.approx(1 / math.sqrt(count), rel=0.02)


def test_contrast_of_a_region_and_of_a_scene():
    picture = squares(1)[0]
    scene = torch.linspace(0.2, 3, SIDE, dtype=torch.float64).expand(SIDE, SIDE)
    assert speckle_contrast(picture * scene).item() > 1.2  # the scene counts as speckle
    # The bright part counts most: fewer grains, 1 % now.
    assert speckle_contrast(picture * scene, reference=scene).item() == pytest.approx(1, abs=0.03)
    mask = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    mask[100:300, 50:400] = True
    inside = picture[100:300, 50:400]
    wanted = (inside.std(correction=0) / inside.mean()).item()
    assert speckle_contrast(picture, mask=mask).item() == pytest.approx(wanted, rel=1e-12)
    assert speckle_contrast(torch.stack([picture, 3 * picture]), mask=mask).tolist() == pytest.approx([wanted] * 2)


def test_contrast_has_a_right_gradient_and_none_where_nothing_is():
    picture = squares(1)[0][:6, :7].clone().requires_grad_()
    assert torch.autograd.gradcheck(speckle_contrast, (picture,))
    for image in (torch.zeros(4, 5), torch.full((4, 5), 2.0)):
        image.requires_grad_()
        contrast = speckle_contrast(image)
        contrast.backward()
        assert contrast.item() == 0 and image.grad is not None
        assert torch.equal(image.grad, torch.zeros(4, 5))


def test_power_spectrum_adds_up_to_the_squared_contrast_and_is_the_pupils_correlation():
    pictures = squares(8)
    power = power_spectrum(pictures)
    torch.testing.assert_close(power.sum((-2, -1)), speckle_contrast(pictures).square(), rtol=1e-12, atol=0)
    assert power[..., 0, 0].abs().max() < 1e-25
    # Correlation of a square pupil with itself: a triangle per axis, 0 beyond its width (Goodman 4.43).
    f = torch.fft.fftfreq(SIDE, dtype=torch.float64)
    triangle = (1 - f.abs() / 0.4).clamp_min(0)
    wanted = triangle[:, None] * triangle / triangle.sum() ** 2
    # Exponential numbers averaged over 8 pictures and blocks of 64 frequencies: 1 / sqrt(512) = 4.4 %, 4 sigma.
    assert power[:, wanted == 0].max() < 1e-20
    blocks = [part.mean(0)[2:194, 2:194].reshape(24, 8, 24, 8).mean((1, 3)) for part in (power, wanted[None])]
    bright = blocks[1] > 0.2 * blocks[1].max()
    assert (blocks[0][bright] / blocks[1][bright] - 1).abs().max() < 4.5 * 0.044


def root(function, low: float, high: float) -> float:
    return float(brentq(function, low, high))  # pyright: ignore[reportArgumentType]


def half_width_of_airy(level: float) -> float:
    """Argument pi D r where (2 J1(x) / x)^2 falls to ``level``."""
    return root(lambda x: (2 * j1(x) / x) ** 2 - level, 0.1, 3.8)


@cache
def square_and_round(widths: tuple[float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures of speckle of pupils that are rectangles and ellipses of these widths."""
    generator = np.random.default_rng(3)
    square = tensors(*(developed((SIDE, 400), widths, generator) for _ in range(6)))
    return square, tensors(*(developed_round((SIDE, 400), widths, generator) for _ in range(6)))


@pytest.mark.parametrize("level", [0.5, 1 / math.e])
@pytest.mark.parametrize("widths", [(0.25, 0.4), (0.1, 0.2)])
def test_grain_size_is_that_of_the_pupil(widths, level):
    square, disc = square_and_round(widths)
    sinc = root(lambda x: np.sinc(x) ** 2 - level, 0.1, 0.9)
    airy = half_width_of_airy(level) / math.pi
    for pictures, half in ((square, sinc), (disc, airy)):
        wanted = torch.tensor([2 * half / width for width in widths], dtype=torch.float64)
        # 6 pictures of 512 x 400 x 0.02 grains or more, one over their root: 0.6 %, 3 sigma.
        torch.testing.assert_close(grain_size(pictures, level=level).mean(0), wanted, rtol=0.02, atol=0)
    assert grain_size(square[0].float()).dtype == torch.float32
    if level == 0.5:
        assert [2 * sinc, 2 * airy] == pytest.approx([0.8859, 1.0290], abs=1e-4)


@pytest.mark.parametrize("turn", [0.0, 0.6, -1.2, math.pi / 2])
def test_anisotropy_is_the_ratio_of_the_pupils_diameters(turn):
    generator = np.random.default_rng(5)
    # The long diameter lies at ``turn``, so the grains are long across it.
    pictures = tensors(*(developed_round((SIDE, 384), (0.1, 0.25), generator, turn) for _ in range(4)))
    ratio, angle = anisotropy(pictures)
    # Grains: 512 x 384 x 0.02 x 3/8 for the window; second moments spread by 2 over the root of them, over 4 pictures.
    assert ratio.mean().item() == pytest.approx(2.5, rel=0.06)
    wanted = turn + math.pi / 2
    assert torch.sin(angle - wanted).abs().max() < 0.05
    assert (anisotropy(squares(2)).ratio - 1).abs().max() < 0.06


def test_seeds_give_an_unbiased_contrast_and_blur():
    generator = np.random.default_rng(11)
    scene = 1 + np.sin(np.arange(SIDE) / 20)[:, None] * np.ones(SIDE)
    blurred = 1 + 0.8 * np.sin(np.arange(SIDE) / 20)[:, None] * np.ones(SIDE)
    few, others = (
        tensors(*(picture * developed((SIDE, SIDE), (0.4, 0.4), generator) for _ in range(3)))
        for picture in (scene, blurred)
    )
    found = seed_statistics(few)
    # Uncorrected, three seeds would give 1 / sqrt(1 + 1/3) = 0.87. Grains as above: 1 % with three seeds and a scene.
    assert found.contrast.item() == pytest.approx(1, abs=0.03)
    assert found.noise.item() == pytest.approx((scene**2).mean() / 3, rel=0.05)
    true = ((scene - blurred) ** 2).mean()
    # Noise of both means, 0.9, is subtracted; what it leaves scatters by 0.9 times the root of 2 over 42 000 grains.
    assert squared_blur(few, others).item() == pytest.approx(true, abs=4 * 0.9 * math.sqrt(2 / 42000))
    assert (few.mean(0) - others.mean(0)).square().mean().item() > 20 * true
    exact = (few[0] - torch.from_numpy(blurred)).square().mean().item()
    assert squared_error(few[0], others).item() == pytest.approx(exact, rel=0.03)
    assert seed_statistics(torch.zeros(2, 4, 4)).contrast.item() == 0


def test_sharpness_measures_transfer_not_speckle():
    generator = np.random.default_rng(7)
    scene = torch.from_numpy(generator.random((SIDE, SIDE)))
    fy, fx = (torch.fft.fftfreq(SIDE, dtype=torch.float64) for _ in range(2))
    blur = torch.exp(-8 * (fy[:, None] ** 2 + fx**2))
    blurred = torch.fft.ifft2(torch.fft.fft2(scene) * blur).real
    radius = torch.hypot(fy[:, None], fx[None])
    band = (radius >= 0.05) & (radius <= 0.25)
    power = torch.fft.fft2(scene).abs().square()[band]
    wanted = ((blur[band] * power).sum() / power.sum()).item()
    assert sharpness(scene, scene).item() == pytest.approx(1, rel=1e-12)
    assert sharpness(blurred, scene).item() == pytest.approx(wanted, rel=1e-12)
    speckle = squares(1)[0]
    # Noise as strong as the scene's mean square against detail of variance 1/12, 46 000 frequencies: 1.7 %, 3 sigma.
    assert sharpness(blurred * speckle, scene).item() == pytest.approx(wanted, abs=0.05)


def test_refusals():
    picture = torch.rand(8, 9)
    with pytest.raises(ValueError, match="mask leaves no pixel"):
        speckle_contrast(picture, mask=torch.zeros(8, 9, dtype=torch.bool))
    with pytest.raises(TypeError, match="mask must be bool"):
        speckle_contrast(picture, mask=torch.ones(8, 9))
    with pytest.raises(ValueError, match="reference must match"):
        speckle_contrast(picture, reference=torch.ones(2, 8, 9))
    with pytest.raises(ValueError, match="mask must match"):
        speckle_contrast(picture, mask=torch.ones(9, 8, dtype=torch.bool))
    with pytest.raises(TypeError, match="real floating-point"):
        power_spectrum(torch.zeros(8, 9, dtype=torch.complex64))
    with pytest.raises(ValueError, match="no grains"):
        grain_size(torch.ones(8, 9))
    with pytest.raises(ValueError, match="level must lie"):
        grain_size(picture, level=1.0)
    with pytest.raises(ValueError, match="two seeds or more"):
        seed_statistics(picture[None])
    with pytest.raises(ValueError, match="match except in the number of seeds"):
        squared_blur(torch.rand(2, 8, 9), torch.rand(2, 9, 8))
    with pytest.raises(ValueError, match=r"picture must be \(8, 9\) like the references"):
        squared_error(torch.rand(9, 8), torch.rand(2, 8, 9))
    with pytest.raises(ValueError, match="no detail"):
        sharpness(picture, torch.ones(8, 9))
    with pytest.raises(ValueError, match="0 <= low < high"):
        sharpness(picture, picture, band=(0.2, 0.1))


def test_dark_spots_count_vortices_and_nothing_else():
    y, x = torch.meshgrid(torch.arange(32.0) - 15.7, torch.arange(32.0) - 15.7, indexing="ij")
    vortex = (x + 1j * y).abs().square()
    vortex = vortex / (vortex + 4)  # a zero at (15.7, 15.7), 1 far away
    picture = torch.ones(32, 32)
    wanted = int((vortex < 0.25).sum())
    assert 0 < wanted < 10
    assert dark_spots(torch.stack([vortex, picture, 0.3 * picture]), picture).tolist() == [wanted, 0, 0]
    half = picture.clone()
    half[:, :16] = 0.1  # dark in the reference as well: no spot there
    assert dark_spots(vortex, half).item() == int((vortex[:, 16:] < 0.25).sum())
    with pytest.raises(ValueError, match="must share"):
        dark_spots(picture, picture[:16])
