"""Studies and the chart of PEC on a small scale; the real ones are run by hand and committed."""

import csv
import json
import re
from pathlib import Path

import pytest
import torch
from paths import ROOT

from holotorch.cli import main
from holotorch.experiments.pec_study import bench as pec_bench
from holotorch.experiments.pec_study import chart as chart_pec
from holotorch.experiments.pec_study import studies as pec_studies
from holotorch.experiments.pec_study.bench import Bench, Track, butterworth, photograph
from holotorch.experiments.pec_study.chart import Amount
from holotorch.experiments.pec_study.studies import STUDIES

SWEEP = {"lowpass": "[0.2]"}


@pytest.mark.parametrize("study", STUDIES)
def test_every_study_fills_its_folder(study, tmp_path, capsys, monkeypatch, request):
    if study not in ("reproduction", "time"):  # one of either kind of figure is drawn
        request.getfixturevalue("undrawn")
    monkeypatch.setattr(pec_studies, "SIZES", (16, 32))
    monkeypatch.setattr(pec_studies, "DRAWS", 1)
    monkeypatch.setattr(pec_studies, "ROUNDS", 2)
    monkeypatch.setattr(pec_bench, "PASSES", 3)
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
    assert not any("goal" in str(row) for row in rows)  # a study measures; only the chart compares
    assert "method" in capsys.readouterr().out


@pytest.mark.parametrize("study", STUDIES)
def test_check_says_what_a_study_does(study, capsys):
    assert main(["check", f"configs/pec/studies/{study}.yaml"]) == 0
    out = capsys.readouterr().out
    assert f"Study      {study} of " in out
    assert "PPEC: proximal proximity effect correction" in out and "exp(-d^2/sigma^2)" in out


def test_a_small_chart_of_pec_is_complete(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(chart_pec, "FULL", Amount({0.66: (0.3, 0.6)}, size=32, steps=24, runs=1))
    goals = tmp_path / "goals.yaml"
    monkeypatch.setattr(chart_pec, "GOALS", goals)
    goals.write_text("solver: {0.66: {evaluations: 0.01, seconds: 0.0001}}\ntables: {}\n")
    assert main(["chart", "pec", "--out", str(tmp_path / "c")]) == 0
    assert {path.name for path in (tmp_path / "c").iterdir()} == {
        "chart.csv",
        "chart.png",
        "comparison.csv",
        "verdict.txt",
    }
    out = capsys.readouterr().out
    assert "fourier, sigma 0.66: " in out and "exp(-d^2/sigma^2)" in out
    assert out.count("(goal 0.01/0.0001: met by APG, growing step, restart; ") == 2


@pytest.mark.skipif(not Path(chart_pec.__file__).is_relative_to(ROOT), reason="an installed package has no goals")
def test_goals_are_read_from_the_file_beside_the_charts(tmp_path, monkeypatch):
    """Only the chart command compares them; a study has none. The committed ones fit the committed table."""
    row = {"kind": "fresnel", "sigma_px": 1.0, "solver": "L-BFGS", "evaluations_ratio": 3.0, "seconds_ratio": 1.5}
    lines = chart_pec._verdict([row], chart_pec.FULL)
    assert next(line for line in lines if line.startswith("fresnel, sigma 1:")).endswith("(goal 4/1.8: not met)")
    assert lines[-1] == "targets: 32 met of 32"
    summaries = [line for line in lines if re.fullmatch(r"\w+: (\d+ [a-z ]+,? ?)+of \d+", line)]
    tables = [
        "reproduction",
        "photographs",
        "lowpass",
        "multiplexing",
        "iterations",
        "starts",
        "time",
        "focus",
        "targets",
    ]
    assert [line.split(":")[0] for line in summaries] == tables
    for line in summaries:
        assert sum(map(int, re.findall(r"(\d+) [a-z]", line.split(" of ")[0]))) == int(line.split(" of ")[1])
    monkeypatch.setattr(chart_pec, "GOALS", tmp_path / "goals.yaml")
    assert not any(
        "goal" in line or " met" in line for line in chart_pec._verdict([row], chart_pec.FULL)
    )  # an installed package
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "table.csv").write_text(
        "method,sigma_px,ssim,seconds\na,1.0,0.5,2\na,2.0,0.9,4\nb,1.0,,6\nc,0.1,0.9,1\nc,0.2,0.87,1\nc,0.3,0.8,1\n"
    )
    (tmp_path / "goals.yaml").write_text(
        """solver: {}
thesis:
  one:
    - {says: mean, rows: {method: a}, within: [0.7, 0.7]}
    - {says: range, rows: {method: [a, b], sigma_px: [1.0, 2.0]}, statistic: range, within: [0.39, 0.41]}
    - {says: ratio, column: seconds, rows: {method: b}, over: {method: a}, within: [2, 2]}
    - {says: less, rows: {method: a, sigma_px: 1.0}, within: [0.6, 1]}
    - {says: none, rows: {method: d}, within: [0, 1]}
    - {says: near, rows: {method: a, sigma_px: 1.0}, printed: 0.53, margin: 0.04}
    - {says: above, rows: {method: a, sigma_px: 1.0}, printed: 0.45, margin: 0.04}
    - {says: below, rows: {method: a, sigma_px: 1.0}, printed: 0.55, margin: 0.04}
    - {says: falls, rows: {method: c, sigma_px: [0.1, 0.2, 0.3]}, statistic: onset, fall: 0.05, within: [0.2, 0.3]}
    - {says: stays, rows: {method: c, sigma_px: [0.1, 0.2, 0.3]}, statistic: onset, fall: 0.5, within: [0.2, 0.3]}
  absent: [{says: nothing, rows: {}, within: [0, 1]}]
goals:
  one: [{says: reached, rows: {method: a}, within: [0.6, 1]}]
"""
    )
    assert chart_pec._verdict([row], chart_pec.FULL)[-12:] == [
        "one: 5 reproduced, 3 not reproduced, 1 not testable here, 1 exceeded of 10",
        "  reproduced: mean (0.7, expected 0.7 to 0.7)",
        "  reproduced: range (0.4, expected 0.39 to 0.41)",
        "  reproduced: ratio (2, expected 2 to 2)",
        "  not reproduced: less (0.5, expected 0.6 to 1)",
        "  not testable here: none (no such rows)",
        "  reproduced: near (0.5, printed 0.53, margin 0.04)",
        "  exceeded: above (0.5, printed 0.45, margin 0.04)",
        "  not reproduced: below (0.5, printed 0.55, margin 0.04)",
        "  reproduced: falls (0.3, expected 0.2 to 0.3)",
        "  not reproduced: stays (inf, expected 0.2 to 0.3)",
        "one: 1 met of 1",
    ]


def test_bench_scores_what_the_solver_is_not_asked(tmp_path):
    bench = Bench(images=("camera",), size=32, sigma_px=0.66)
    track = Track(bench, every=1)
    found = bench.lbfgs(bench.start("hot", 2), steps=30, limit=9.0, callback=track)
    scores = bench.scores(found.x)
    assert scores["peak_rad"] <= 9.0 and scores["ssim"] > 0.5
    assert [row[1] for row in track.rows] == sorted(row[1] for row in track.rows)
    assert track.reached(0.0) is not None and track.reached(1.1) is None


def test_low_pass_keeps_the_mean_and_takes_what_is_fine():
    image = photograph("camera", (32, 32))
    assert torch.allclose(butterworth(image, 10.0), image, atol=1e-6)
    smooth = butterworth(image, 0.05)
    assert smooth.mean().item() == pytest.approx(image.mean().item(), abs=1e-3)
    assert smooth.diff(dim=-1).abs().mean() < 0.6 * image.diff(dim=-1).abs().mean()
