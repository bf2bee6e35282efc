"""``holotorch sweep``: all runs of a grid, here, side by side or as jobs; what is complete is not computed again."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import pytest
from toy.kind import ToyKind
from undrawn import without_figures

from holotorch.cli import main
from holotorch.experiments import registry
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.sweep.points import points

PEC = ["configs/pec/fourier.yaml", "grid.shape=[24,20]", "report.baselines=[]", "solver={kind: lbfgs, max_steps: 3}"]


@pytest.fixture
def toy(monkeypatch, tmp_path):
    monkeypatch.setitem(registry.KINDS, "toy", "toy")
    path = tmp_path / "toy.yaml"
    path.write_text("experiment: toy\nsteps: 4\n")
    return str(path)


def rows(folder):
    with open(folder / "sweep.csv", newline="") as stream:
        return list(csv.DictReader(stream))


def test_values_are_split_at_commas_outside_of_brackets_and_quotes():
    grid = points(["a.b=1,2", "c=[1, 2],[3]", "d={x: 1, y: 2}", "e='p,q','r'"])
    assert len(grid) == 8
    assert grid[0].overrides == ("d={x: 1, y: 2}", "a.b=1", "c=[1, 2]", "e='p,q'")
    assert grid[-1].values == {"a.b": "2", "c": "[3]", "e": "'r'"}
    assert len({point.name for point in grid}) == 8
    assert points(["a.b=1,2"])[1].name == "b=2"
    assert all("/" not in point.name and not point.name.startswith(".") for point in points(["f=../x,/etc/y"]))
    # Names do not depend on the other values, so that a larger sweep finds the runs of a smaller one.
    assert {p.name for p in points(["a=1,2"])} < {p.name for p in points(["a=1,2,3"])}
    assert all(len(point.name) <= 80 for point in points([f"k={'1' * 200},2{'1' * 200}"]))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a"], "argument 'a': expected key=value, or key=a,b,c"),
        (["a=1"], "nothing to sweep"),
        (["a=1,1"], "a value appears twice"),
        (["a=1,"], "a value is missing beside a comma"),
        (["a=1,2", "a=3"], "a is given twice"),
        ([f"{k}={','.join(map(str, range(30)))}" for k in "abc"], "at most 10000 runs"),
    ],
)
def test_what_is_no_grid_is_refused(words, message):
    with pytest.raises(ConfigError, match=message):
        points(words)


def test_a_second_call_computes_only_what_is_missing(toy, tmp_path, monkeypatch, capsys):
    out, steps = tmp_path / "s", []
    monkeypatch.setattr(ToyKind, "step", lambda _, number: steps.append(number) or number)
    assert main(["sweep", toy, "steps=2,4", "--out", str(out)]) == 0
    assert len(steps) == 6
    assert [(row["steps"], row["status"], row["total"]) for row in rows(out)] == [
        ("2", "complete", "3"), ("4", "complete", "10"),
    ]  # fmt: skip
    monkeypatch.setattr(ToyKind, "outcome", lambda _, summary: [f"Total      {summary['total']}"], raising=False)
    assert main(["sweep", toy, "steps=2,4,5", "--out", str(out)]) == 0
    assert len(steps) == 11 and len(rows(out)) == 3
    text = capsys.readouterr().out
    assert "3 runs: 3 complete" in text and "steps=2  Total      3\n" in text and "steps=5  Total      15\n" in text
    page = (out / "report.html").read_text()
    assert "total 3" in page and "total 15" in page and "sweep.csv" in page
    # The folders belong to this sweep: with another fixed setting they are not overwritten.
    assert main(["sweep", toy, "steps=2,4", "gigabytes=2", "--out", str(out)]) == 2
    assert "holds a run of another configuration: gigabytes was 1 and is 2" in capsys.readouterr().err


def test_mistakes_of_all_runs_are_said_before_any_begins(toy, tmp_path, capsys):
    assert main(["sweep", toy, "steps=2,13,0", "--out", str(tmp_path / "s")]) == 2
    error = capsys.readouterr().err
    assert "steps: expected anything but 13" in error and "argument 'steps=0'" in error
    assert not (tmp_path / "s").exists()
    assert main(["sweep", toy, "steps=2,3", "--jobs", "0", "--out", str(tmp_path / "s")]) == 2
    assert "--jobs: expected 1 or more" in capsys.readouterr().err


def test_a_run_that_fails_stops_no_other(toy, tmp_path, monkeypatch, capsys):
    def step(_, number: int) -> int:
        if number == 3:
            raise ArithmeticError("three")
        return number

    with monkeypatch.context() as patch:
        patch.setattr(ToyKind, "step", step)
        assert main(["sweep", toy, "steps=2,3,1", "--out", str(tmp_path)]) == 1
    assert [row["status"] for row in rows(tmp_path)] == ["complete", "failed", "complete"]
    assert "steps=3: ArithmeticError: three" in capsys.readouterr().err
    assert "ArithmeticError: three" in (tmp_path / "steps=3.log").read_text()
    assert main(["sweep", toy, "steps=2,3,1", "--out", str(tmp_path)]) == 0
    assert [row["total"] for row in rows(tmp_path)] == ["3", "6", "1"]


def test_an_interrupted_sweep_is_completed_to_the_same_table(toy, tmp_path, monkeypatch, capsys):
    def step(_, number: int) -> int:
        if number == 2:
            signal.raise_signal(signal.SIGTERM)
        return number

    whole, out = tmp_path / "whole", tmp_path / "s"
    assert main(["sweep", toy, "steps=1,3,5", "--out", str(whole)]) == 0
    with monkeypatch.context() as patch:
        patch.setattr(ToyKind, "step", step)
        assert main(["sweep", toy, "steps=1,3,5", "--out", str(out)]) == 130
    assert [row["status"] for row in rows(out)] == ["complete", "interrupted", "missing"]
    assert "the same command continues the sweep" in capsys.readouterr().err
    assert main(["sweep", toy, "steps=1,3,5", "--out", str(out)]) == 0
    assert (out / "sweep.csv").read_bytes() == (whole / "sweep.csv").read_bytes()


def test_a_check_says_how_many_runs_and_what_they_cost(capsys):
    assert main(["sweep", *PEC, "seed=0,1,2", "modulator.sigma_px=0.3,0.66", "--check"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("6 runs of configs/pec/fourier.yaml over seed (3), modulator.sigma_px (2): about ")
    assert "GB of memory for each" in out


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """Words of a sweep, and its folder, filled by this process."""
    folder, words = tmp_path_factory.mktemp("here"), [*PEC, "modulator.sigma_px=0.3,0.66"]
    with without_figures():
        assert main(["sweep", *words, "--out", str(folder)]) == 0
    return words, folder


@pytest.mark.parametrize(
    "engine", [["--jobs", "2"], ["--slurm", "cluster=local", "timeout_min=5"]], ids=["joblib", "jobs"]
)
def test_other_processes_give_what_this_one_gives(engine, here, tmp_path, capsys):
    if engine[0] == "--slurm":
        pytest.importorskip("submitit", reason="pip install 'holotorch[cluster]'")
    words, folder = here
    assert main(["sweep", *words, "--out", str(tmp_path / "there"), *engine]) == 0
    measured = ("seconds", "memory")
    tables = [
        [{k: v for k, v in row.items() if not any(each in k for each in measured)} for row in rows(where)]
        for where in (folder, tmp_path / "there")
    ]
    assert tables[0] == tables[1] and len(tables[0]) == 2
    for name in ("sigma_px=0.3", "sigma_px=0.66"):
        arrays = [(where / name / "arrays" / "phase.npy").read_bytes() for where in (folder, tmp_path / "there")]
        assert arrays[0] == arrays[1]
    assert (tmp_path / "there" / "sweep.png").is_file()


def test_a_signal_reaches_the_runs_side_by_side(tmp_path):
    """SIGTERM to the sweep alone: its runs save what they have, and those that wait do not begin."""
    out = tmp_path / "s"
    words = [PEC[0], "grid.shape=[96,96]", "solver={kind: apg, max_steps: 3000, tolerance: 0}", "seed=0,1,2,3"]
    command = [sys.executable, "-m", "holotorch", "sweep", *words, "--jobs", "2", "--out", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, env=os.environ | {"OMP_NUM_THREADS": "1"})
    end = time.monotonic() + 60
    while sum("loss/start=" in path.read_text() for path in out.glob("*.log")) < 2 and time.monotonic() < end:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said.decode()
    statuses = [row["status"] for row in rows(out)]
    assert statuses.count("interrupted") == 4 and not (out / ".stop").exists()
    begun = [path for path in out.glob("seed=?") if (path / "interrupted.json").is_file()]
    assert len(begun) == 2
    assert all(json.loads((path / "interrupted.json").read_text())["status"] == "interrupted" for path in begun)
