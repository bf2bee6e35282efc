"""Calibration against a model with known parameters, and against least squares on paper."""

import pytest
import torch
from torch import Tensor, nn

from holotorch import Grid
from holotorch.correction import calibrate, scan
from holotorch.experiments.camera.chip import LIMIT, Chip, FieldResidual, quality
from holotorch.modulator import Response

GRID, WAVELENGTH, DISTANCE = Grid(32, 9e-6), 530e-9, 5e-3
TRUE_SIGMA = 0.66


def true() -> Chip:
    drives = torch.linspace(0, LIMIT, 5, dtype=torch.float64)
    return Chip(GRID, WAVELENGTH, Response(LIMIT, drives * (1 + 0.05 * drives / LIMIT)), TRUE_SIGMA, DISTANCE)


def model(distance: float = DISTANCE + 1e-4) -> Chip:
    return Chip(GRID, WAVELENGTH, Response(LIMIT, knots=5, learnable=True), 0.8, distance, learnable=True)


def captures(count: int, noise: float = 0.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    drives = LIMIT * torch.rand(count, 1, *GRID.shape, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        images = true()(drives)
    return drives, images + noise * images.mean() * torch.randn(images.shape, generator=generator, dtype=images.dtype)


class Line(nn.Module):
    """A straight line, whose least squares are known on paper."""

    def __init__(self):
        super().__init__()
        self.slope = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        return 1 + self.slope * x


def test_a_line_with_an_unknown_gain():
    x = torch.linspace(0, 1, 50, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    y = 2 * (1 + 3 * x) + 0.1 * torch.randn(50, generator=generator, dtype=torch.float64)
    line = Line()
    fit = calibrate(line, x, y, tolerance=1e-12)
    design = torch.stack([torch.ones_like(x), x], 1)
    intercept, slope = torch.linalg.lstsq(design, y[:, None]).solution[:, 0].tolist()
    assert fit.converged and fit.gain == pytest.approx(intercept, rel=1e-6)
    assert line.slope.item() == pytest.approx(slope / intercept, rel=1e-6)
    residual = y - design @ torch.tensor([intercept, slope], dtype=torch.float64)
    covariance = torch.linalg.inv(design.T @ design) * residual.square().sum() / 48
    # The deviation of slope / intercept, by linear propagation.
    change = torch.tensor([-slope / intercept**2, 1 / intercept], dtype=torch.float64)
    assert fit.deviations["slope"].item() == pytest.approx((change @ covariance @ change).sqrt().item(), rel=1e-3)


def test_recovers_a_chip_without_noise():
    fitted = model()
    fit = calibrate(fitted, *captures(3), units={"propagator.distance": 1e-6}, tolerance=1e-12, max_steps=60)
    assert fit.losses[-1] < 1e-12 * fit.losses[0] and fit.gain == pytest.approx(1)
    assert fitted.crosstalk.sigma_px == pytest.approx(TRUE_SIGMA, rel=1e-6)
    assert float(fitted.propagator.distance) == pytest.approx(DISTANCE, abs=1e-9)
    drive = torch.linspace(0, LIMIT, 40, dtype=torch.float64)
    torch.testing.assert_close(fitted.response(drive), true().response(drive), rtol=0, atol=1e-6)


def test_errors_agree_with_the_stated_deviations():
    ratios = []
    for seed in range(6):
        fitted = model()
        fit = calibrate(fitted, *captures(2, 0.05, seed), units={"propagator.distance": 1e-6})
        ratios.append((fitted.crosstalk.sigma_px - TRUE_SIGMA) / fit.deviations["crosstalk.sigma"].item())
        ratios.append((float(fitted.propagator.distance) - DISTANCE) / fit.deviations["propagator.distance"].item())
    # The mean square of 12 normal deviates lies between 0.2 and 2.7 with a probability of 0.999.
    assert 0.2 < sum(ratio**2 for ratio in ratios) / len(ratios) < 2.7


def test_a_scan_leads_back_from_a_distance_that_no_gradient_would():
    fitted = model(DISTANCE + 2e-3)
    drives, images = captures(2)
    values = DISTANCE + torch.linspace(-3e-3, 3e-3, 31, dtype=torch.float64)
    losses = scan(fitted, "propagator.distance", values, drives, images)
    assert losses.argmin() == 15 and float(fitted.propagator.distance) == pytest.approx(DISTANCE)
    assert losses[10] < 1.2 * losses[0]  # 1 mm off is as bad as 3 mm


def test_correction_gains_by_calibration():
    fitted = model(DISTANCE + 5e-4)
    drives, images = captures(4, 0.01)
    scan(fitted, "propagator.distance", DISTANCE + torch.linspace(-1e-3, 1e-3, 21).double(), drives, images)
    calibrate(fitted, drives, images, units={"propagator.distance": 1e-6})
    y, x = GRID.coordinates()
    target = (1 + (torch.sin(x * 7e4) > 0) * (y > 0))[None].double()
    target = target / target.mean()
    shown = {}
    before = Chip(GRID, WAVELENGTH, Response(LIMIT), 0.8, DISTANCE + 5e-4)
    for name, each in (("before", before), ("after", fitted), ("exact", true())):
        drive = each.requires_grad_(False).corrected(target, frames=2, generator=torch.Generator().manual_seed(0))
        shown[name] = quality(true(), drive, target)
    assert shown["after"] > shown["before"] + 0.2
    assert shown["after"] > shown["exact"] - 0.01


def test_a_residual_network_changes_nothing_at_first_and_depends_on_the_place():
    field = torch.polar(torch.rand(2, 1, *GRID.shape), 6 * torch.rand(2, 1, *GRID.shape))
    residual = FieldResidual(GRID)
    torch.testing.assert_close(residual(field), field)
    nn.init.normal_(residual.layers[-1].weight)  # type: ignore[arg-type]
    ones = torch.ones(1, 1, *GRID.shape, dtype=torch.complex64)
    assert residual(ones).abs().std() > 0
    torch.testing.assert_close(residual(field)[0], residual(field[:1])[0])


def test_refusals():
    drives, images = captures(1)
    with pytest.raises(ValueError, match="model must have a parameter that requires a gradient"):
        calibrate(true(), drives, images)
    with pytest.raises(ValueError, match="units must name parameters of the model, .*; got sigma"):
        calibrate(model(), drives, images, units={"sigma": 1.0})
    with pytest.raises(ValueError, match=r"images must have the shape of model\(patterns\)"):
        calibrate(model(), drives, images[..., :-1])
    with pytest.raises(ValueError, match="images must be finite"):
        calibrate(model(), drives, images * torch.nan)
    with pytest.raises(ValueError, match="name must be a parameter of the model, one of .*; got 'distance'"):
        scan(model(), "distance", torch.ones(2), drives, images)
