import math
import warnings

import numpy as np
import pytest
import torch
from oracles import dense
from torch.nn import functional

from holotorch.core.checks import SamplingWarning
from holotorch.core.fourier import convolve
from holotorch.modulator import ThermalCrosstalk


@pytest.mark.parametrize(("sigma", "size"), [(0.66, 7), (1.0, 7), (2.0, 7), (2.0, 15), (0.2, 5)])
def test_kernel_is_the_thesis_kernel(sigma, size):
    wanted = dense.heat_kernel(sigma, size)
    wanted[wanted < 1e-12] = 0  # taps that would only be denormal numbers in float32
    np.testing.assert_allclose(ThermalCrosstalk(sigma, size).kernel, wanted, rtol=1e-14, atol=1e-12)


@pytest.mark.parametrize(("sigma", "total"), [(0.66, 1.44), (0.8, 2.03), (1.0, 3.14), (1.5, 7.06), (2.0, 12.3)])
def test_sum_of_the_seven_tap_kernel(sigma, total):
    assert ThermalCrosstalk(sigma, 7).total == pytest.approx(total, rel=5e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_twins_conv2d_and_fft_convolution_agree(dtype):
    phase = torch.rand(2, 3, 20, 13, dtype=dtype)
    patch = torch.rand(5, 3, dtype=torch.float64) * 0.5
    patch[2, 1] = 1
    for crosstalk in (ThermalCrosstalk(0.9), ThermalCrosstalk(1.5, 7), ThermalCrosstalk.from_patch(patch)):
        kernel = crosstalk.kernel.to(dtype)
        padding = (kernel.shape[0] // 2, kernel.shape[1] // 2)
        # conv2d correlates, so the kernel is flipped for it.
        twin = functional.conv2d(phase.flatten(0, 1)[:, None], kernel.flip(0, 1)[None, None], padding=padding)
        tolerance = 50 * torch.finfo(dtype).eps * crosstalk.total
        torch.testing.assert_close(crosstalk(phase), twin.view_as(phase), rtol=0, atol=tolerance)
        torch.testing.assert_close(crosstalk(phase), convolve(phase, kernel), rtol=0, atol=tolerance)


def test_one_hot_pixel_warms_its_neighbours_and_the_edge_loses_heat():
    phase = torch.zeros(9, 9)
    phase[0, 4] = 1
    warm = ThermalCrosstalk(0.66, 7)(phase)
    assert warm[0, 4] == 1
    assert warm[0, 5].item() == pytest.approx(math.exp(-1 / 0.66**2), rel=1e-6)
    assert warm[1, 5].item() == pytest.approx(math.exp(-2 / 0.66**2), rel=1e-6)
    assert warm[8].abs().max() == 0  # nothing wraps around
    assert warm.sum() < ThermalCrosstalk(0.66, 7).total


@pytest.mark.parametrize(("sigma", "taps"), [(0, 1), (0.2, 1), (0.33, 3), (0.66, 5), (1.0, 7), (1.5, 11), (2.0, 15)])
def test_size_is_chosen_from_sigma_and_loses_almost_no_heat(sigma, taps):
    crosstalk = ThermalCrosstalk(sigma)
    assert tuple(crosstalk.kernel.shape) == (taps, taps)
    assert crosstalk.lost_heat < 1e-5


@pytest.mark.parametrize(("sigma", "lost"), [(0.66, 0.0), (1.5, 0.0013), (2.0, 0.023), (2.5, 0.087)])
def test_heat_lost_by_the_seven_taps_of_the_thesis(sigma, lost):
    assert ThermalCrosstalk(sigma, 7).lost_heat == pytest.approx(lost, abs=6e-4)


def test_narrow_kernels_hold_no_denormal_numbers():
    kernel = ThermalCrosstalk(0.3, 7).kernel.float()
    assert ((kernel == 0) | (kernel > torch.finfo(torch.float32).tiny)).all()


def test_measured_patch_is_scaled_to_its_centre():
    patch = torch.tensor([[10.0, 30.0, 5.0], [20.0, 50.0, 25.0], [0.0, 15.0, 1.0]])
    crosstalk = ThermalCrosstalk.from_patch(patch)
    torch.testing.assert_close(crosstalk.kernel, patch.double() / 50)
    assert math.isnan(crosstalk.lost_heat)
    phase = torch.zeros(5, 5, dtype=torch.float64)
    phase[2, 2] = 1
    torch.testing.assert_close(crosstalk(phase)[1:4, 1:4], patch.double() / 50)
    torch.testing.assert_close(crosstalk.adjoint(phase)[1:4, 1:4], patch.double().flip(0, 1) / 50)


def test_kernel_larger_than_the_array():
    with pytest.raises(ValueError, match="kernel of 7 x 7 px is larger than the array of 5 x 9 px"):
        ThermalCrosstalk(0.66, 7)(torch.rand(5, 9))
    # A size that was not asked for is no mistake of the user's: taps beyond the array never act.
    small = torch.rand(3, 1, dtype=torch.float64)
    wanted = dense.convolution((3, 1), dense.heat_kernel(1.5, 11)) @ small.numpy().ravel()
    np.testing.assert_allclose(ThermalCrosstalk(1.5)(small).ravel(), wanted, rtol=1e-12)


@pytest.mark.parametrize("sigma", [-0.1, float("nan"), float("inf"), 101, 1e9])
def test_refuses_an_impossible_width(sigma):
    with pytest.raises(ValueError, match="sigma_px must"):
        ThermalCrosstalk(sigma)


@pytest.mark.parametrize("size", [0, 4, -3])
def test_refuses_an_even_size(size):
    with pytest.raises(ValueError, match="odd number of taps|at least 1"):
        ThermalCrosstalk(0.66, size)


@pytest.mark.parametrize(
    ("patch", "message"),
    [
        (torch.rand(4, 5), "two odd sizes"),
        (torch.rand(5), "two odd sizes"),
        (torch.full((3, 3), float("nan")), "finite"),
        (-torch.ones(3, 3), "rises >= 0"),
        (torch.eye(3).flip(0)[[1, 0, 2]], "centre the warmest"),
        (torch.zeros(3, 3), "centre the warmest"),
    ],
)
def test_refuses_a_patch_that_is_no_response(patch, message):
    with pytest.raises(ValueError, match=message):
        ThermalCrosstalk.from_patch(patch)


def test_refuses_a_vector():
    with pytest.raises(ValueError, match=r"phase must end in \(H, W\), got \(9,\)"):
        ThermalCrosstalk(0.66)(torch.rand(9))


def test_prints_its_width():
    assert repr(ThermalCrosstalk(0.66, 7)) == "ThermalCrosstalk(sigma_px=0.66, taps=(7, 7))"


@pytest.mark.parametrize("sigma", [0.4, 0.66, 1.0, 2.3])
def test_fit_finds_the_width_of_a_measured_patch(sigma):
    y, x = torch.meshgrid(torch.arange(-3.0, 4), torch.arange(-2.0, 3), indexing="ij")
    clean = 180 * torch.exp(-(y**2 + x**2).double() / sigma**2)
    assert ThermalCrosstalk.fitted(clean).sigma_px == pytest.approx(sigma, rel=1e-9)
    if sigma < 0.6:
        return  # the neighbours are 0.2 % warm then, and drown in the noise below
    noisy = (clean + 1.8 * torch.randn(clean.shape, dtype=torch.float64)).clamp(min=0)
    noisy[3, 2] = 180  # the heated pixel itself is known well
    # 1 % noise on each of 34 pixels, of which those around the centre carry the width.
    assert ThermalCrosstalk.fitted(noisy, 7).sigma_px == pytest.approx(sigma, rel=0.05)


def test_fit_refuses_what_has_no_width():
    with pytest.raises(ValueError, match="must fall off"):
        ThermalCrosstalk.fitted(torch.ones(3, 3))
    with pytest.raises(ValueError, match="patch must have two odd sizes"):
        ThermalCrosstalk.fitted(torch.ones(2, 3))


def test_taps_that_cut_the_kernel_are_said():
    with pytest.warns(SamplingWarning, match=r"7 taps lose 18% of the heat of sigma_px=3; size=23 or size=None"):
        cut = ThermalCrosstalk(3.0, 7)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ThermalCrosstalk(3.0, 23).lost_heat < 1e-5 < cut.lost_heat
        ThermalCrosstalk(2.5, 7)  # the thesis's largest sigma


def test_a_width_in_metres_is_warned_of():
    with pytest.warns(SamplingWarning, match="sigma_px=6e-06 lets no heat reach a neighbour; it is in pixels"):
        ThermalCrosstalk(6e-6)
    assert ThermalCrosstalk(0.0).total == 1


def test_forward_mode_in_sigma_and_phase_is_the_central_difference():
    module, phase = ThermalCrosstalk(0.66, 7, learnable=True), torch.rand(2, 9, 11, dtype=torch.float64)

    def spread(sigma, phase):
        return torch.func.functional_call(module, {"sigma": sigma}, (phase,))

    sigma, step = torch.tensor(0.7, dtype=torch.float64), 1e-6
    got = torch.func.jvp(spread, (sigma, phase), (torch.ones_like(sigma), torch.sin(phase)))[1]
    ends = [spread(sigma + sign * step, phase + sign * step * torch.sin(phase)) for sign in (1, -1)]
    # The values are below 5, and the third derivatives below 100.
    torch.testing.assert_close(got, (ends[0] - ends[1]) / (2 * step), rtol=0, atol=5 * 2e-16 / step + 100 * step**2 / 6)


def test_the_name_of_a_file_in_place_of_a_patch_says_how_to_read_it():
    with pytest.raises(TypeError, match=r"got the name of a file; of a table in CSV give torch.from_numpy"):
        ThermalCrosstalk.from_patch("kernel.csv")  # type: ignore[arg-type]


def test_the_unit_of_a_learnable_table_does_not_matter():
    """The same step of a learner moves the kernel as far, whatever unit the rises have."""
    table = torch.tensor([[0.1, 0.2, 0.1], [0.2, 1.0, 0.2], [0.1, 0.2, 0.1]], dtype=torch.float64)
    one, other = (ThermalCrosstalk.from_patch(scale * table, learnable=True) for scale in (1.0, 40.0))
    assert one.patch is not None and isinstance(other.patch, torch.nn.Parameter)
    assert torch.allclose(one.patch, other.patch)
    kept = torch.nn.Parameter(40 * table)
    assert ThermalCrosstalk.from_patch(kept).patch is kept
