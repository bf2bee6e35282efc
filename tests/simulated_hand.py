"""Poses of a simulated hand as a tracker would write them, and what a measurement of them leaves."""

import csv
import json
from pathlib import Path

import numpy as np
import torch

from holotorch.experiments.tracking.report import COLUMNS
from holotorch.tracking import Pose, Status

RATE = 30.0


def hand(points, noise=0.0, rest=24, way=9, seed=0):
    """Tips [frames, 3] of a hand that rests at each of the points [n, 3] and moves from one to the next."""
    parts = []
    for start, end in zip(points, [*points[1:], points[-1]], strict=True):
        share = np.arange(1, way + 1)[:, None] / (way + 1)
        parts += [np.repeat(start[None], rest, 0), start + share * (end - start)]
    tips = np.concatenate(parts)
    return tips + noise * np.random.default_rng(seed).standard_normal(tips.shape)


def pose(tip, sd=1e-4) -> Pose:
    covariance = torch.eye(6, dtype=torch.float64)
    covariance[:3, :3] *= sd**2 / 3
    one, along = torch.ones((), dtype=torch.float64), torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    return Pose(torch.tensor(tip, dtype=torch.float64), along, covariance, one, one, Status.OK)


def write(path: Path, tips, refused=()) -> Path:
    with open(path, "w", newline="") as stream:
        table = csv.DictWriter(stream, COLUMNS, restval="")
        table.writeheader()
        for i, tip in enumerate(tips):
            line = {"frame": i, "time_s": i / RATE, "status": "NO_CATHETER" if i in refused else "OK"}
            if i not in refused:
                names = ("cov_xx_m2", "cov_yy_m2", "cov_zz_m2")
                line |= dict(zip(COLUMNS[5:11], (*tip, 0.6, 0.0, 0.8), strict=True)) | dict.fromkeys(names, 1e-8 / 3)
                line |= dict.fromkeys(("cov_xy_m2", "cov_xz_m2", "cov_yz_m2"), 0.0) | {"chi_square": 1, "freedom": 1}
            table.writerow(line)
    return path


def told(folder: Path):
    return json.loads((folder / "summary.json").read_text())
