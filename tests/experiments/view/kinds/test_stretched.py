"""The measured kernel of a chip, stretched by the slider of its page."""

import pytest
import torch
from paths import CONFIGS
from tiny_runs import RUNS

from holotorch.experiments.execute import execute
from holotorch.experiments.registry import load_config
from holotorch.experiments.view.controls import Slider, checked
from holotorch.experiments.view.kinds.pec import stretched
from holotorch.experiments.view.opening import open_viewer


@pytest.mark.parametrize("times", [0.5, 1.0, 1.3, 2.0])
def test_heat_that_falls_exponentially_is_stretched_exactly(times):
    """exp(-|x| - |y| / 2): its logarithm is linear between the taps, but not beyond the last of them."""
    y, x = torch.meshgrid(torch.arange(-3.0, 4).double(), torch.arange(-4.0, 5).double(), indexing="ij")
    kernel = torch.exp(-x.abs() - y.abs() / 2)
    found = stretched(kernel, times).kernel
    rows, columns = (torch.arange(-(n // 2), n // 2 + 1).double() / times for n in found.shape)
    wanted = torch.exp(-columns.abs() - rows.abs()[:, None] / 2)
    wanted[(rows.abs() > 3)[:, None] | (columns.abs() > 4)] = 0
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=0)


def test_cold_taps_and_rows_of_one_tap_stay_so():
    kernel = torch.tensor([[0.0, 0.4, 1.0, 0.2, 0.0]])
    torch.testing.assert_close(stretched(kernel, 1.0).kernel, kernel.double(), rtol=1e-6, atol=0)
    wide = stretched(kernel, 2.0).kernel
    assert wide.shape == (1, 9)
    torch.testing.assert_close(wide[0, [2, 6]], kernel[0, [1, 3]].double(), rtol=1e-6, atol=0)


def test_the_page_of_a_measured_kernel_stretches_it(tmp_path):
    """One step of the slider changes little, and the way back nothing."""
    kernel = tmp_path / "kernel.csv"
    kernel.write_text("3,20,3\n20,60,20\n3,20,3\n")
    config, *words = RUNS["pec"]
    words = [word for word in words if "modulator" not in word]
    chip = [f"modulator.kernel={kernel}", "modulator.sigma_px=null", "modulator.kernel_size=null"]
    assert execute(load_config(CONFIGS / config, [*words, *chip]), tmp_path / "run")[1]
    viewer = open_viewer(tmp_path / "run")
    (slider,) = (control for control in viewer.controls if isinstance(control, Slider) and control.name == "sigma")
    assert slider.unit == "times that of the measured kernel" and slider.value == 1

    def psnr(**changes) -> float:
        with torch.no_grad():
            numbers = viewer.show(checked(viewer.controls, changes), False, lambda: None).numbers
        return float(numbers["PSNR"].split()[0])

    start, near, wide = psnr(), psnr(sigma=1 + slider.step), psnr(sigma=1.5)
    assert start == psnr(sigma=1.0) and abs(near - start) < abs(wide - start)
