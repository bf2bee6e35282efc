"""Chart of calibration with a camera: what is recovered from how many images, and what correction gains by it."""

import time
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn
from tqdm import tqdm

from holotorch.core.grid import Grid
from holotorch.correction import calibrate, scan
from holotorch.experiments.camera.chip import LIMIT, Chip, FieldResidual, quality
from holotorch.experiments.runs.figures import figure_png, fitted_pictures
from holotorch.io.images import load_image
from holotorch.modulator import Response

GRID, WAVELENGTH = Grid(128, 9e-6), 530e-9
SIGMA, DISTANCE = 0.66, 50e-3  # px and metres, of the true chip
WRONG_SIGMA, WRONG_BY = 1.2, 1e-3  # factor on sigma, and metres of distance, in the uncalibrated model
UNITS = {"propagator.distance": 1e-5, "response.phases": 0.05}
RATE = 3e-3  # rate of Adam for the residual network


@dataclass(frozen=True)
class Amount:
    """Size of the measurement."""

    noises: tuple[float, ...] = (0.0, 0.01, 0.03, 0.1)  # standard deviation of a camera's pixel relative to its mean
    captures: tuple[int, ...] = (1, 2, 4, 16)
    seeds: tuple[int, ...] = (0, 1, 2)
    pictures: tuple[str, ...] = ("camera", "astronaut")
    nominal: tuple[float, int] = (0.01, 16)  # noise and captures whose calibration is used for correction
    frames: int = 4  # of a corrected picture
    steps: tuple[int, int] = (100, 300)  # of the correction
    training: int = 200  # steps of Adam for the residual network


FULL = Amount()
QUICK = Amount((0.01,), (1, 2), (0,), ("camera",), nominal=(0.01, 2), frames=2, steps=(10, 20), training=20)


def camera(quick: bool = False) -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Table rows of the recovery and of the correction, PNG pictures by name, and lines of text."""
    amount = QUICK if quick else FULL
    rows, models = [], {}
    fits = list(product(amount.noises, amount.captures, amount.seeds))
    for noise, captures, seed in tqdm(fits, desc="calibrating", unit="fit"):
        row, model = _recovered(noise, captures, seed)
        rows.append(row)
        if (noise, captures) == amount.nominal:
            models[seed] = model
    corrected, shown = _corrected(models, amount)
    unmodelled = _unmodelled(amount)
    return (
        rows,
        corrected + unmodelled,
        {"chart": _draw(rows, amount), "pictures": fitted_pictures(shown)},
        _verdict(rows, corrected, unmodelled, amount),
    )


class Fault(nn.Module):
    """Effects that the model lacks: light that falls off towards the corners, and a warped chip (astigmatism)."""

    def forward(self, field: Tensor) -> Tensor:
        """Field with the fault, complex [..., H, W]."""
        y, x = (torch.linspace(-1, 1, n, dtype=torch.float64) for n in field.shape[-2:])
        y, x = y[:, None], x[None]
        return field * torch.polar(1 - 0.25 * (y.square() + x.square()), 1.5 * (y.square() - x.square()))


def true_chip(residual: nn.Module | None = None) -> Chip:
    """The chip in front of the camera; its response rises up to 5 % above that of the uncalibrated model."""
    drives = torch.linspace(0, LIMIT, 33, dtype=torch.float64)
    response = Response(LIMIT, drives * (1 + 0.05 * drives / LIMIT))
    return Chip(GRID, WAVELENGTH, response, SIGMA, DISTANCE, residual=residual)


def uncalibrated(learnable: bool = False) -> Chip:
    """The model before its calibration."""
    response = Response(LIMIT, learnable=learnable)
    return Chip(GRID, WAVELENGTH, response, WRONG_SIGMA * SIGMA, DISTANCE + WRONG_BY, learnable=learnable)


def captured(chip: Chip, noise: float, captures: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random drives [N, 1, H, W] in rad and their images by the camera."""
    generator = torch.Generator().manual_seed(seed)
    drives = LIMIT * torch.rand(captures, 1, *GRID.shape, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        images = chip(drives)
    return drives, images + noise * images.mean() * torch.randn(images.shape, generator=generator, dtype=images.dtype)


def calibrated(drives: Tensor, images: Tensor) -> tuple[Chip, dict[str, Tensor]]:
    """The model fitted to the images, and the standard deviations of its parameters."""
    model = uncalibrated(learnable=True)
    around = DISTANCE + WRONG_BY + torch.linspace(-2e-3, 2e-3, 21, dtype=torch.float64)
    scan(model, "propagator.distance", around, drives[:2], images[:2])
    return model, calibrate(model, drives, images, units=UNITS).deviations


def _recovered(noise: float, captures: int, seed: int) -> tuple[dict[str, Any], Chip]:
    """Table row of one calibration, and the model."""
    true = true_chip()
    start = time.perf_counter()
    model, deviations = calibrated(*captured(true, noise, captures, seed))
    drives = torch.linspace(0, LIMIT, 200, dtype=torch.float64)
    with torch.no_grad():
        response = (model.response(drives) - true.response(drives)).abs().max().item()
        errors = {
            "crosstalk.sigma": model.crosstalk.sigma_px - SIGMA,
            "propagator.distance": float(model.propagator.distance) - DISTANCE,
        }
    row = {
        "noise": noise,
        "captures": captures,
        "seed": seed,
        "sigma_error_percent": 100 * abs(errors["crosstalk.sigma"]) / SIGMA,
        "distance_error_mm": 1e3 * abs(errors["propagator.distance"]),
        "response_error_rad": response,
        "sigma_deviations": _ratio(errors["crosstalk.sigma"], deviations["crosstalk.sigma"]),
        "distance_deviations": _ratio(errors["propagator.distance"], deviations["propagator.distance"]),
        "seconds": time.perf_counter() - start,
    }
    return row, model


def _ratio(error: float, deviation: Tensor) -> float:
    """Error in units of the stated deviation; 0 where neither exceeds rounding."""
    return abs(error) / deviation.item() if abs(error) > 1e-12 else 0.0


def _picture(name: str) -> Tensor:
    """A photograph as light with a mean of 1, [1, H, W]."""
    grey = load_image(name).mean(0, keepdim=True)
    side = min(grey.shape[-2:])
    top, left = (grey.shape[-2] - side) // 2, (grey.shape[-1] - side) // 2
    small = nn.functional.interpolate(
        grey[None, :, top : top + side, left : left + side], GRID.shape, mode="bilinear", antialias=True
    )[0]
    return small / small.mean()


def _corrected(models: dict[int, Chip], amount: Amount) -> tuple[list[dict], dict[str, Tensor]]:
    """Table rows of the correction on the true chip by each model, and pictures of the first."""
    rows, shown, true = [], {}, true_chip()
    contenders = [("uncalibrated", 0, uncalibrated()), *(("calibrated", seed, each) for seed, each in models.items())]
    contenders.append(("exact", 0, true))
    for name, (label, seed, model) in tqdm(
        list(product(amount.pictures, contenders)), desc="correcting", unit="picture"
    ):
        target = _picture(name)
        drive = _drive(model, target, amount)
        rows.append({"chip": "as modelled", "model": label, "seed": seed, "picture": name,
                     "ssim_expected": quality(model, drive, target), "ssim": quality(true, drive, target)})  # fmt: skip
        if name == amount.pictures[0] and seed == 0:
            shown |= {"wanted": target, label: true(drive).mean(-4)}
    return rows, shown


def _drive(model: Chip, target: Tensor, amount: Amount) -> Tensor:
    """Drives that show ``target`` by the model."""
    generator = torch.Generator().manual_seed(7)
    return model.requires_grad_(False).corrected(target, frames=amount.frames, generator=generator, steps=amount.steps)


def _unmodelled(amount: Amount) -> list[dict]:
    """Table rows for a chip with a fault that the model lacks, without and with a residual network."""
    true, target = true_chip(Fault()), _picture(amount.pictures[0])
    drives, images = captured(true, *amount.nominal, seed=0)
    model, _ = calibrated(drives, images)
    rows = []
    for label in ("calibrated", "calibrated, with residual network"):
        if "network" in label:
            _train(model, drives, images, amount.training)
        drive = _drive(model, target, amount)
        rows.append({"chip": "with a fault", "model": label, "seed": 0, "picture": amount.pictures[0],
                     "ssim_expected": quality(model, drive, target), "ssim": quality(true, drive, target)})  # fmt: skip
    return rows


def _train(model: Chip, drives: Tensor, images: Tensor, steps: int) -> None:
    """Add a residual network to ``model`` and train it, with the other parameters, on the captured images."""
    torch.manual_seed(0)
    model.residual = FieldResidual(GRID)
    parts = [model.residual.parameters(), [model.crosstalk.sigma, model.response.phases]]
    optimiser = torch.optim.Adam([{"params": list(parts[0])}, {"params": parts[1], "lr": RATE / 10}], lr=RATE)
    model.requires_grad_(True)
    generator = torch.Generator().manual_seed(0)
    for _ in tqdm(range(steps), desc="training", unit="step"):
        some = torch.randperm(len(drives), generator=generator)[:4]
        optimiser.zero_grad()
        predicted = model(drives[some])
        gain = ((predicted * images[some]).sum() / predicted.square().sum()).detach()
        (gain * predicted - images[some]).square().mean().backward()
        optimiser.step()


def _verdict(rows: list[dict], corrected: list[dict], unmodelled: list[dict], amount: Amount) -> list[str]:
    noise, captures = amount.nominal
    nominal = [row for row in rows if (row["noise"], row["captures"]) == amount.nominal]
    noisy = [row for row in rows if row["noise"] > 0]

    def worst(column: str) -> float:
        return max(float(row[column]) for row in nominal)

    def asked(goal: str) -> str:
        return f" (asked {goal})" if amount == FULL else ""

    lines = [
        f"from sigma {100 * (WRONG_SIGMA - 1):.0f} % wrong, a response 5 % wrong and {1e3 * WRONG_BY:g} mm of distance "
        f"{captures} captures of {100 * noise:g} % noise recover sigma to {worst('sigma_error_percent'):.2g} %"
        f"{asked('1')}, the distance to {worst('distance_error_mm'):.2g} mm{asked('0.1')} and the response to "
        f"{worst('response_error_rad'):.2g} rad, at worst of {len(amount.seeds)} seed(s); in the median in "
        f"{np.median([row['seconds'] for row in nominal]):.0f} s",
        f"errors of sigma and distance over all {len(noisy)} fits with noise: "
        f"{np.mean([row[key] < 2 for row in noisy for key in ('sigma_deviations', 'distance_deviations')]):.0%} within "
        "2 of the stated standard deviations (95 % expected)",
    ]
    for picture in amount.pictures:
        of = {label: [r["ssim"] for r in corrected if (r["model"], r["picture"]) == (label, picture)]
              for label in ("uncalibrated", "calibrated", "exact")}  # fmt: skip
        lines.append(
            f"{picture}: SSIM on the true chip {of['uncalibrated'][0]:.3f} by the uncalibrated model, at worst "
            f"{min(of['calibrated']):.3f} by the calibrated one, {of['exact'][0]:.3f} by the exact one "
            f"({of['exact'][0] - min(of['calibrated']):+.4f} short{asked('0.01')})"
        )
    before, after = (row["ssim"] for row in unmodelled)
    lines.append(
        f"a chip with uneven light and a warp that the model lacks: SSIM {before:.3f} calibrated, {after:.3f} with a "
        f"residual network trained on the same {captures} captures"
    )
    return lines


def _draw(rows: list[dict], amount: Amount) -> bytes:
    """PNG of the errors against the number of captures, one line for each noise level; the worst of the seeds."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    columns = {"sigma_error_percent": "error of sigma in %", "distance_error_mm": "error of distance in mm",
               "response_error_rad": "largest error of response in rad"}  # fmt: skip
    for axes, (column, label) in zip(figure.subplots(1, 3), columns.items(), strict=True):
        for noise in amount.noises:
            own = [row for row in rows if row["noise"] == noise]
            worst = [max(float(row[column]) for row in own if row["captures"] == n) for n in amount.captures]
            axes.loglog(amount.captures, np.maximum(worst, 1e-9), "o-", label=f"noise {100 * noise:g} %")
        axes.set(xlabel="captures", ylabel=label)
        axes.set_xticks(amount.captures, [str(n) for n in amount.captures])
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    return figure_png(figure)
