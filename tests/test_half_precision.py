"""Figures of merit of half-precision pictures: what float16 and bfloat16 cannot sum is summed in float32."""

import math

import pytest
import torch

from holotorch import metrics
from holotorch.optics import equal_power

HALVES = pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])


def speckled(dtype: torch.dtype, scale: float = 1.0) -> torch.Tensor:
    """256 x 256 exponentially distributed intensities, whose count alone is more than float16 can hold."""
    generator = torch.Generator().manual_seed(3)
    return (scale * torch.empty(2, 256, 256, dtype=torch.float64).exponential_(generator=generator)).to(dtype)


@HALVES
@pytest.mark.parametrize("scale", [1.0, 1e-3, 500.0])
def test_speckle_contrast(dtype, scale):
    picture = speckled(dtype, scale)
    exact = picture.double()
    wanted = exact.std((-2, -1), correction=0) / exact.mean((-2, -1))
    assert (wanted > 0.9).all()
    torch.testing.assert_close(metrics.speckle_contrast(picture).double(), wanted, rtol=1e-5, atol=0)
    mask = torch.rand(256, 256) < 0.5
    for options in ({"mask": mask}, {"reference": torch.full_like(picture, scale)}):
        double = {name: part.double() if part.is_floating_point() else part for name, part in options.items()}
        wanted = metrics.speckle_contrast(exact, **double)
        torch.testing.assert_close(metrics.speckle_contrast(picture, **options).double(), wanted, rtol=1e-5, atol=0)


@HALVES
@pytest.mark.parametrize(
    "merit",
    [
        lambda one, two: metrics.psnr(one, two, data_range=0.004),
        lambda one, two: metrics.ssim(one, two, data_range=0.004),
        lambda one, two: metrics.ssim_map(one, two, data_range=0.004),
        lambda one, _: metrics.power_spectrum(one),
        lambda one, _: metrics.grain_size(one),
        lambda one, _: metrics.anisotropy(one).ratio,
        lambda one, two: metrics.sharpness(one, two),
        lambda one, two: metrics.seed_statistics(torch.stack([one, two])).mean,
        lambda one, two: metrics.seed_statistics(torch.stack([one, two])).noise,
        lambda one, two: metrics.seed_statistics(torch.stack([one, two])).contrast,
        lambda one, two: metrics.squared_error(one, torch.stack([two, one])),
        lambda one, two: metrics.squared_blur(torch.stack([one, one + two]), torch.stack([two, one])),
    ],
)
def test_agrees_with_float64(dtype, merit):
    one = speckled(dtype, 1e-3)
    two = (one.double() * torch.linspace(0.5, 1.5, 256, dtype=torch.float64)).to(dtype)
    got, wanted = merit(one, two), merit(one.double(), two.double())
    assert torch.isfinite(wanted).all() and got.dtype == torch.float32
    # float32 sums of squares of like size, and what cancels in them.
    torch.testing.assert_close(got.double(), wanted, rtol=1e-3, atol=1e-4 * wanted.abs().max().item())


@HALVES
def test_equal_power(dtype):
    one, two = speckled(dtype, 100.0), speckled(dtype, 0.01)
    got = equal_power(one, two)
    assert got.dtype == dtype
    step = 2.0 ** -(10 if dtype == torch.float16 else 7)
    assert (got.double().mean() / two.double().mean()).item() == pytest.approx(1, abs=2 * step)
    assert math.isfinite(got.double().sum().item())
