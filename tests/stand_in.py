"""A tracker that knows the tip from the grey level of a frame, pictures for it, and what a run with it leaves."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import torch

from holotorch.experiments.execute import execute
from holotorch.experiments.tracking.config import TrackSettings
from holotorch.tracking import Camera, Pose, Status

SIZE = (48, 64)
CAMERA = Camera(torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), torch.zeros(5))
DIRECTION = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)


def grey(level: int) -> torch.Tensor:
    return torch.full((3, *SIZE), level, dtype=torch.uint8)


class StandIn:
    """Refuses black frames; the tip of others lies ``level`` / 3 mm to the right."""

    def __init__(self):
        self.previous: list = []
        self.times = {"colour": 2e-3, "edges": 6e-3}

    def __call__(self, frames, previous=None):
        assert frames.shape == (1, 3, *SIZE) and frames.dtype == torch.uint8
        self.previous.append(previous)
        level = int(frames[0, 0, 0, 0])
        if level == 0:
            return [Pose.refused(Status.NO_CATHETER, "nothing of the bands' colours, thin and long")]
        tip = torch.tensor([level / 3e3, 0.0, 0.5], dtype=torch.float64)
        covariance = torch.diag(torch.tensor([1.0, 2, 3, 4, 5, 6], dtype=torch.float64)) * 1e-8
        covariance[0, 2] = covariance[2, 0] = 1e-9 / 3
        one = torch.ones((), dtype=torch.float64)
        return [Pose(tip, DIRECTION, covariance, one / 7, one, Status.OK)]


def pictures(folder: Path, levels: list[int | None]) -> Path:
    """A folder of pictures; None is one that cannot be read."""
    folder.mkdir()
    for number, level in enumerate(levels):
        path = folder / f"{number}.png"
        if level is None:
            path.write_bytes(b"\x89PNG cut off")
        else:
            cv2.imwrite(str(path), np.full((*SIZE, 3), level, np.uint8))
    return folder


def track(out: Path, source, **options) -> tuple[Path, bool]:
    """As ``holotorch run`` does it; ``options`` are settings."""
    return execute(TrackSettings(experiment="track", source=str(source), **options), out, "track")


def tracked(tmp_path: Path, source, name: str = "out", **options) -> tuple[Path, bool]:
    files = {name: str(tmp_path / f"{name}.yaml") for name in ("camera", "catheter")}
    return track(tmp_path / name, source, **(files | options))


def read(folder: Path) -> list[dict[str, str]]:
    with open(folder / "poses.csv", newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def summary(folder: Path, name: str = "summary.json"):
    return json.loads((folder / name).read_text())
