"""Studies and the chart of PEC on a small scale; the real ones are run by hand and committed."""

import csv
import json

import pytest
import torch

from holotorch.cli import main
from holotorch.experiments.pec_study import chart as chart_pec
from holotorch.experiments.pec_study import studies as pec_studies
from holotorch.experiments.pec_study.bench import Bench, Track, butterworth, grey
from holotorch.experiments.pec_study.studies import STUDIES

SWEEP = {"lowpass": "[0.2]"}


@pytest.mark.parametrize("study", STUDIES)
def test_every_study_fills_its_folder(study, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pec_studies, "SIZES", (16, 32))
    words = [f"configs/pec/studies/{study}.yaml", "images=[camera,coffee]", "size=24", "max_steps=6"]
    words.append(f"sweep={SWEEP.get(study, '[0.66]')}")
    assert main(["run", *words, "--out", str(tmp_path / "s")]) == 0
    names = {path.name for path in (tmp_path / "s").iterdir()}
    assert names == {"config.yaml", "env.json", "summary.json", "table.csv", "table.txt", "report.html", "images"}
    summary = json.loads((tmp_path / "s" / "summary.json").read_text())
    with open(tmp_path / "s" / "table.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert summary["status"] == "complete" and summary["rows"] == len(rows) >= 3
    scored = [row for row in rows if row["ssim"]]
    assert all(-1 <= float(row["ssim"]) <= 1 for row in scored) and scored
    for row in rows:
        if "P <=" in row["setting"]:
            limit = float(row["setting"].split()[2]) * torch.pi
            assert float(row["peak_rad"]) <= limit + 1e-4  # of rounding in the table
    claims = [row for row in rows if row["method"] == "claim"]
    assert all(row["thesis"] and row["verdict"] and row["setting"] for row in claims)
    assert bool(claims) == (study not in ("limits", "targets", "reproduction"))  # one sigma alone shows no decline
    assert "method" in capsys.readouterr().out


@pytest.mark.parametrize("study", STUDIES)
def test_check_says_what_a_study_does(study, capsys):
    assert main(["check", f"configs/pec/studies/{study}.yaml"]) == 0
    assert f"Study      {study} of camera" in capsys.readouterr().out


def test_a_small_chart_of_pec_is_complete(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(chart_pec, "SIGMAS", (0.66,))
    monkeypatch.setattr(chart_pec, "SIZE", 32)
    monkeypatch.setattr(chart_pec, "STEPS", 24)
    monkeypatch.setattr(chart_pec, "GOALS", {0.66: (0.3, 0.6)})
    assert main(["chart", "pec", "--out", str(tmp_path / "c")]) == 0
    assert {path.name for path in (tmp_path / "c").iterdir()} == {
        "chart.csv",
        "chart.png",
        "comparison.csv",
        "verdict.txt",
    }
    assert "fourier, sigma 0.66: " in capsys.readouterr().out


def test_bench_scores_what_the_solver_is_not_asked(tmp_path):
    bench = Bench(images=("camera",), size=32, sigma_px=0.66)
    track = Track(bench, every=1)
    found = bench.lbfgs(bench.start("hot", 2), steps=30, limit=9.0, callback=track)
    scores = bench.scores(found.x)
    assert scores["peak_rad"] <= 9.0 and scores["ssim"] > 0.5
    assert [row[1] for row in track.rows] == sorted(row[1] for row in track.rows)
    assert track.reached(0.0) is not None and track.reached(1.1) is None


def test_low_pass_keeps_the_mean_and_takes_what_is_fine():
    image = grey("camera", (32, 32))
    assert torch.allclose(butterworth(image, 10.0), image, atol=1e-6)
    smooth = butterworth(image, 0.05)
    assert smooth.mean().item() == pytest.approx(image.mean().item(), abs=1e-3)
    assert smooth.diff(dim=-1).abs().mean() < 0.6 * image.diff(dim=-1).abs().mean()
