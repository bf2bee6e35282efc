"""Predicted errors of heat kernels and stopping rules, against what they do to phases and losses."""

import math

import pytest
import torch

from holotorch.core.complex import intensity, phasor
from holotorch.experiments.planning.correction import (
    HeaterPhases,
    complete_kernel,
    cropped_taps,
    cropping_error,
    needed_taps,
    scaled_error,
    solver_precision,
    spread_completely,
    stopping_error,
    stopping_tolerance,
)
from holotorch.modulator import ThermalCrosstalk


def formed(phase):
    return intensity(torch.fft.fft2(phasor(phase), norm="ortho"))


@pytest.mark.parametrize(("sigma_px", "taps"), [(0.66, 3), (0.66, 1), (1.5, 5), (2.0, 7), (2.0, 11)])
def test_a_cropped_kernel_errs_as_predicted(sigma_px, taps):
    """In the far field of random phases, within a factor of 2 below saturation."""
    shape, generator = (61, 75), torch.Generator().manual_seed(3)
    phase = 2 * math.pi * torch.rand(3, *shape, generator=generator, dtype=torch.float64)
    crosstalk = ThermalCrosstalk.from_patch(complete_kernel(sigma_px).kernel)
    radius, kept = crosstalk.kernel.shape[0] // 2, taps // 2
    cropped = crosstalk.kernel[radius - kept : radius + kept + 1, radius - kept : radius + kept + 1]
    few = ThermalCrosstalk.from_patch(cropped.clone())
    measured = scaled_error(formed(few(phase)), formed(crosstalk(phase)))
    predicted = cropping_error(sigma_px, taps, HeaterPhases(phase.mean().item(), phase.std().item(), shape))
    assert predicted / 3 < measured < 2 * predicted


def test_no_more_taps_than_the_share_needs():
    heaters = HeaterPhases(3.0, 2.0, (64, 64))
    for share in (0.1, 1e-2, 1e-4):
        taps = cropped_taps(1.5, share, heaters)
        assert cropping_error(1.5, taps, heaters) <= share < cropping_error(1.5, taps - 2, heaters)
    every = 2 * ThermalCrosstalk(1.5).radius + 1
    assert cropped_taps(1.5, 0.0, heaters) == every
    assert needed_taps(1.5, every) is None and needed_taps(1.5, 3) == 3
    assert cropped_taps(0.0, 1e-3, heaters) == 1


def test_heat_spreads_completely_on_an_array_smaller_than_its_kernel():
    phase = torch.rand(2, 3, 12, 13, dtype=torch.float64)
    kernel = complete_kernel(3.0).kernel
    assert kernel.shape[0] > 13
    spread = spread_completely(3.0, phase)
    y, x = torch.arange(12).double(), torch.arange(13).double()
    by_hand = sum(
        phase[1, 2, i, j] * torch.exp(-((y[:, None] - i) ** 2 + (x - j) ** 2) / 9) for i in range(12) for j in range(13)
    )
    torch.testing.assert_close(spread[1, 2], torch.as_tensor(by_hand), rtol=1e-6, atol=1e-6)


def test_a_stopping_rule_and_its_error_are_inverse():
    for share in (1e-4, 1e-2, 0.3):
        assert stopping_error(stopping_tolerance(share, 7), 7) == pytest.approx(share)
    # A loss that falls by a factor of 1 - t in each step loses t * patience of itself, and the residual its root.
    loss, t = 0.09, 1e-4
    removed = math.sqrt(loss - loss * (1 - t) ** 10)
    assert stopping_error(t, 10) == pytest.approx(removed, rel=1e-2)


def test_only_a_stopping_rule_that_float32_cannot_follow_takes_float64():
    assert solver_precision(0.0) == solver_precision(1e-4) == torch.float32
    assert solver_precision(1e-9) == torch.float64


def test_the_scale_of_an_image_is_no_error():
    image = torch.rand(2, 5, 6)
    assert scaled_error(3 * image, image) < 1e-6 and scaled_error(0 * image, 0 * image) == 0
