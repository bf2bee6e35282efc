"""A run of each kind that takes a second at most, and what of its folder an interruption must not change."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from paths import CONFIGS

VOLUME = [
    "volume={phantom: shells, samples: 8}",
    "transfer={points: [[20, 1, 0.2, 0, 0], [255, 0.2, 0.9, 1, 0.9]], unit_distance: 0.05}",
    "hologram={shape: [32, 32], pitch: 3.74 um, distance: 3 mm, depths: 2, rays: 16}",
]
SCENE = (
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 16}', "
    "'hologram={shape: [64, 64], pitch: 3.74 um, distance: 2 mm, depths: 4, rays: 32}']}"
)
EYE = [SCENE, "display={kind: planar, distance: 4 mm}", "eye={pupil_radius: 0.1 mm, axial_length: 2 mm}"]
ITEMS = "items=[{icon: boat, azimuth_deg: 50}]"
TIMES = "[{seconds: 0.45}]"
RUNS: dict[str, list[str]] = {
    "pec": ["pec/fourier.yaml", "grid.shape=[24,20]", "report.baselines=[]", "solver={kind: lbfgs, max_steps: 8}"],
    "volume": ["volume/tooth.yaml", *VOLUME, "device=cpu", "report.seeds=3"],
    "eye": ["eye/teapot.yaml", *EYE, "seeds=1", "light={sources: [laser]}", "focus=[2 mm]", "eye.tolerance=0.1"],
    "joint": [
        *("joint/teapot.yaml", *VOLUME[:2], "view={width: 0.2 mm}", "frames=3", "steps=6", "device=cpu"),
        "display={shape: [24, 20], pitch: 9 um, distance: 2 mm, depth: 2 mm, planes: 2}",
        *("eye.parallax=2", "report.baselines=[afterwards, slabs]"),
    ],
    "study": ["pec/studies/limits.yaml", "images=[camera]", "size=24", "max_steps=4", "sweep=[0.5,0.6]"],
    "measure": ["tracking/measure.yaml", "grid.rows=3", "grid.columns=2"],
    "layout": ["perception/layout.yaml", ITEMS],
    "analysis": [
        *("perception/analysis.yaml", f"targets={TIMES}", "resamples=100", "repeated_measures=false", "power=null")
    ],
}
AGAIN = {"count", "seconds", "rendering_seconds", "refocus_seconds", "peak_memory_bytes"}  # measured anew each time


def command(kind: str, folder: Path, *more: str) -> list[str]:
    """Words of the command line for the run of a kind."""
    config, *words = RUNS[kind]
    return ["run", str(CONFIGS / config), *words, *more, "--out", str(folder)]


def without(value: Any, names: set[str] = AGAIN) -> Any:
    """Nested values without what is measured anew."""
    if isinstance(value, dict):
        return {key: without(each) for key, each in value.items() if key not in names}
    return [without(each) for each in value] if isinstance(value, list) else value


def results(folder: Path) -> dict[str, object]:
    """All that an interruption must not change."""
    found: dict[str, object] = {"summary": without(json.loads((folder / "summary.json").read_text()))}
    for path in sorted(folder.rglob("*.*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".npy":
            found[name] = (np.load(path).shape, np.load(path).tobytes())
        elif path.suffix == ".csv":
            with open(path, newline="") as stream:
                found[name] = without(list(csv.DictReader(stream)))
        elif path.suffix == ".png":
            found[name] = path.read_bytes()
        else:
            found[name] = "there"
    return found
