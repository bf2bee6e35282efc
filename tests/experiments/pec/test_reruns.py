"""A hologram with speckle noise is solved again from other phases, and the better one is kept."""

import json

import pytest
import torch

from holotorch.cli import main
from holotorch.correction import Solution
from holotorch.experiments.pec import run
from holotorch.experiments.pec.config import PECSettings
from holotorch.experiments.pec.experiment import build

SMALL = {
    "experiment": "pec",
    "grid": {"shape": [24, 24], "pitch": 9e-6},
    "wavelengths": 530e-9,
    "target": {"image": "camera"},
    "modulator": {"sigma_px": 0.66},
    "propagator": {"kind": "fraunhofer"},
    "solver": {"kind": "apg", "max_steps": 5, "reruns": 3},
}


@pytest.mark.parametrize(
    ("spots", "kept", "attempts"), [([5, 7, 2, 4], 2, 4), ([5, 0, 9, 9], 1, 2), ([0], 0, 1), ([4, 4, 4, 4], 0, 4)]
)
def test_the_attempt_with_the_fewest_dark_spots_is_kept(monkeypatch, spots, kept, attempts):
    experiment, solved = build(PECSettings.model_validate(SMALL)), []

    def solve(self, *_):
        solved.append(self.settings.seed)
        return solution(len(solved))

    def solution(number: int) -> Solution:
        nothing = torch.zeros(1)
        return Solution(torch.full((1, 24, 24), float(number)), nothing, nothing, nothing, nothing, 1)

    monkeypatch.setattr(type(experiment), "solve", solve)
    monkeypatch.setattr(run, "_dark_spots", lambda _, each: spots[int(each.x[0, 0, 0])])
    best, _, counted = run.rerun(experiment, solution(0), 0.0)
    assert best.x[0, 0, 0] == kept
    assert list(counted) == spots[:attempts] and solved == list(range(1, attempts))


@pytest.mark.usefixtures("undrawn")
def test_a_start_that_leaves_vortices_is_detected_and_solved_again(tmp_path):
    """From nearly flat phases a Fourier hologram ends with vortices, from random ones without (thesis Sec. 4.4.5.2)."""
    found = {}
    for start in ("flat", "hot"):
        changes = [f"solver.start={start}", "solver.reruns=1", "grid.shape=[48, 48]", "report.baselines=[]"]
        changes += ["solver.max_steps=150"]
        assert main(["run", "configs/pec/fourier.yaml", *changes, "--out", str(tmp_path / start)]) == 0
        found[start] = json.loads((tmp_path / start / "summary.json").read_text())["methods"]["corrected"]
    assert found["hot"]["dark_spots"] == [0, 0, 0] and found["hot"]["dark_spots_of_attempts"] == [0]
    assert len(found["flat"]["dark_spots_of_attempts"]) == 2
    assert sum(found["flat"]["dark_spots"]) == min(found["flat"]["dark_spots_of_attempts"]) > 0
