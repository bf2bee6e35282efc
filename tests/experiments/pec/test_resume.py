"""Runs that are stopped and gone on with: the same bits as if they had never stopped."""

import csv
import json
import os
import shutil
import signal
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.pec import progress
from holotorch.experiments.pec import run as run_module
from holotorch.experiments.pec.progress import Log
from holotorch.experiments.registry import load_config
from holotorch.experiments.report import write_report

pytestmark = pytest.mark.usefixtures("tiny")
CONFIG = CONFIGS / "pec" / "fourier.yaml"
SMALL = ["grid.shape=[24,20]", "device=cpu", "report.baselines=[]"]
# 2 steps for the amplitude and 12 more; the error of stopping is measured by as many further steps as the patience.
LBFGS = "solver={kind: lbfgs, max_steps: 14, patience: 3}"
CAPPED = [LBFGS, "modulator.max_phase=6"]  # 4 steps in the box, then penalties for 3, 3, 2 and 2
FILES = ["arrays", "config.yaml", "env.json", "images", "metrics.csv", "plan.json", "report.html", "summary.json"]


def settings(*overrides: str):
    return load_config(CONFIG, [*SMALL, *overrides])


@pytest.fixture(scope="module")
def whole(tiny, tmp_path_factory):
    """Folder of the run with these settings that was never stopped; each is made once."""

    @cache
    def made(*overrides: str) -> Path:
        folder = tmp_path_factory.mktemp("whole") / "run"
        assert execute(settings(*overrides), folder)[1]
        return folder

    return made


def press_in(monkeypatch, step: int | None) -> None:
    """Press Ctrl-C in this step of the solver, or never."""

    class Stopped(Log):
        def __call__(self, solution):
            if step == 0:
                signal.raise_signal(signal.SIGINT)
            super().__call__(solution)
            if len(solution.losses) - 1 == step:
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(run_module, "Log", Stopped)


def stopped(monkeypatch, folder: Path, step: int, *overrides: str) -> Path:
    press_in(monkeypatch, step)
    assert not execute(settings(*overrides), folder)[1]
    press_in(monkeypatch, None)
    assert (folder / "checkpoint.pt").is_file() and (folder / "interrupted.json").is_file()
    return folder


def resume(folder: Path) -> int:
    return main(["resume", str(folder)])


def content(folder: Path):
    """All that must not depend on interruptions, and nothing else."""
    summary = json.loads((folder / "summary.json").read_text())
    del summary["peak_memory_bytes"]
    for numbers in summary["methods"].values():
        del numbers["seconds"]
    with open(folder / "metrics.csv", newline="") as stream:
        rows = [{name: text for name, text in row.items() if name != "seconds"} for row in csv.DictReader(stream)]
    arrays = {path.name: (np.load(path).dtype, np.load(path).tobytes()) for path in (folder / "arrays").iterdir()}
    pictures = {path.name: path.read_bytes() for path in (folder / "images").iterdir()}
    plan, config = (folder / "plan.json").read_text(), (folder / "config.yaml").read_text()
    return {"summary": summary, "rows": rows, "arrays": arrays, "pictures": pictures, "plan": plan, "config": config}


def assert_same(folder: Path, whole: Path) -> None:
    assert sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) == FILES
    found, wanted = content(folder), content(whole)
    assert found["summary"]["status"] == "complete"
    for part, value in wanted.items():
        assert found[part] == value, part


@pytest.mark.parametrize(
    ("overrides", "steps"),
    [
        ([LBFGS], [1, 2, 3, 14]),
        ([*CAPPED, "frames=2"], [2, 4, 6, 9, 11, 13, 14]),
        ([LBFGS, "frames=2", "multiplexing=independent"], [2, 7]),
        ([*CAPPED, "frames=2", "multiplexing=independent", "modulator.bits=4"], [5, 12]),
        (["solver={kind: apg, max_steps: 12, patience: 3}"], [1, 10, 12]),
        (["solver={kind: apg, grow: 1.2, restart: true, max_steps: 12, patience: 3}", "frames=2"], [5]),
        (["solver={kind: apg, max_steps: 12, patience: 3}", "frames=3", "multiplexing=independent"], [5]),
        (["solver={kind: adam, max_steps: 12, patience: 3}"], [1, 7]),
        (["solver={kind: adam, max_steps: 12, patience: 3}", "frames=2"], [7]),
        # Some colours stop long before the others, which must be remembered.
        (["solver={kind: lbfgs, max_steps: 40, tolerance: 0.05, patience: 2}"], [8]),
        (["propagator={kind: fresnel, distance: [20 mm, 30 mm]}", LBFGS, "frames=2"], [9]),
        (["target.region=[12,11]", LBFGS], [9]),
    ],
    ids=lambda words: ",".join(map(str, words)),
)
def test_a_run_stopped_once_gives_the_same_bits(monkeypatch, tmp_path, capsys, whole, overrides, steps):
    uninterrupted = whole(*overrides)
    for step in steps:
        folder = stopped(monkeypatch, tmp_path / str(step), step, *overrides)
        assert json.loads((folder / "interrupted.json").read_text())["status"] == "interrupted"
        capsys.readouterr()
        assert resume(folder) == 0
        assert capsys.readouterr().out.splitlines()[-1] == str(folder / "report.html")
        assert_same(folder, uninterrupted)


def test_stopped_twice_and_resumed_twice_is_still_the_same(monkeypatch, tmp_path, capsys, whole):
    overrides = [*CAPPED, "frames=2"]
    folder = stopped(monkeypatch, tmp_path / "a", 3, *overrides)
    press_in(monkeypatch, 8)
    assert resume(folder) == 130
    words = f"interrupted; what was computed is saved; go on with: holotorch resume {folder}"
    said = capsys.readouterr()
    assert words in said.err and "Unfinished SSIM" in said.out and "Result  " not in said.out
    press_in(monkeypatch, 0)  # before its first step: the older checkpoint stays
    assert resume(folder) == 130
    press_in(monkeypatch, None)
    assert resume(folder) == 0
    assert "Result     SSIM" in capsys.readouterr().out
    assert_same(folder, whole(*overrides))


@pytest.mark.parametrize("moment", ["evaluate", "baseline", "save_picture"])
def test_stopped_after_the_solver_is_the_same(monkeypatch, tmp_path, whole, moment):
    words = [LBFGS, "report.baselines=[none]"]
    uninterrupted = whole(*words)
    original = getattr(run_module, moment)

    def pressed(*arguments, **more):
        signal.raise_signal(signal.SIGINT)
        return original(*arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(run_module, moment, pressed)
        assert not execute(settings(*words), tmp_path / "a")[1]
    assert resume(tmp_path / "a") == 0
    assert_same(tmp_path / "a", uninterrupted)


def test_stopped_before_anything_was_found_starts_anew(monkeypatch, tmp_path, whole):
    press_in(monkeypatch, 0)
    with pytest.raises(KeyboardInterrupt):
        execute(settings(LBFGS), tmp_path / "a")
    with pytest.raises(ConfigError, match="finish it with: holotorch resume .*a$"):
        write_report([tmp_path / "a"], tmp_path / "report.html")
    press_in(monkeypatch, None)
    assert not (tmp_path / "a" / "checkpoint.pt").exists()
    assert resume(tmp_path / "a") == 0
    assert_same(tmp_path / "a", whole(LBFGS))


def killed_in_its_seventh_checkpoint(folder: Path, *overrides: str) -> int:
    """Exit status of a process of its own that runs this, and that SIGKILL ends while it writes a checkpoint."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    save, done = torch.save, []

    def killed(content, stream):
        done.append(stream)
        if len(done) == 7:
            stream.write(b"half a checkpoint")
            stream.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        save(content, stream)

    try:
        progress._SAVE_EVERY, torch.save = -1.0, killed
        execute(settings(*overrides), folder)
    finally:
        os._exit(1)


def test_killed_while_it_saves_goes_on_from_the_checkpoint_before(tmp_path, whole):
    folder = tmp_path / "a"
    assert killed_in_its_seventh_checkpoint(folder, *CAPPED, "frames=2") == -signal.SIGKILL
    assert (folder / "checkpoint.pt").is_file()
    assert not (folder / "interrupted.json").exists() and not (folder / "summary.json").exists()
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Log, "__call__", lambda self, solution, call=Log.__call__: (seen.append(0), call(self, solution)))
        assert resume(folder) == 0
    assert len(seen) == 14 - 6  # only what was missing is computed
    assert_same(folder, whole(*CAPPED, "frames=2"))


@pytest.fixture(scope="module")
def interrupted(tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stopped") / "a"
    with pytest.MonkeyPatch.context() as patch:
        return stopped(patch, folder, 3, LBFGS)


@pytest.fixture
def broken(interrupted, tmp_path):
    return Path(shutil.copytree(interrupted, tmp_path / "a"))


def state_of(folder: Path):
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*") if path.is_file()}


def test_resuming_a_complete_run_changes_nothing(broken, capsys):
    assert resume(broken) == 0
    before = state_of(broken)
    capsys.readouterr()
    assert resume(broken) == 0
    out = capsys.readouterr().out.splitlines()
    first, result, error, pictures, last = out
    assert (first, last) == ("this run is complete; nothing is left to do", str(broken / "report.html"))
    assert [line.split()[0] for line in (result, error, pictures)] == ["Result", "Error", "Pictures"]
    assert state_of(broken) == before


def refused(folder: Path, capsys) -> str:
    """The one line with which a folder is refused."""
    capsys.readouterr()
    assert resume(folder) == 2
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line and "correcting" not in line]
    assert "Traceback" not in error and len(lines) == 1, error
    return lines[0]


@pytest.mark.parametrize("missing", [["config.yaml", "env.json"], ["config.yaml"], ["env.json"]])
def test_a_folder_without_a_run_is_refused(broken, capsys, missing):
    for name in missing:
        (broken / name).unlink()
    assert refused(broken, capsys) == f"{broken} holds no run to resume: config.yaml and env.json are not both there"
    assert "holds no run to resume" in refused(broken / "nowhere", capsys)


@pytest.mark.parametrize("damage", ["truncated", "empty", "text", "bytes", "other"])
def test_a_damaged_checkpoint_is_refused(broken, capsys, damage):
    path = broken / "checkpoint.pt"
    whole = path.read_bytes()
    damaged = {"truncated": whole[: len(whole) // 2], "empty": b"", "text": b"hello\n", "bytes": b"\x80\x02}q\xff"}
    if damage == "other":
        torch.save([1, 2], path)
    else:
        path.write_bytes(damaged[damage])
    line = refused(broken, capsys)
    assert line.startswith(f"{path} cannot be read: ") and line.endswith("; delete the folder and run again")
    assert (broken / "interrupted.json").is_file()  # what was found stays


def test_a_damaged_configuration_or_plan_is_refused(broken, capsys):
    config, plan = broken / "config.yaml", broken / "plan.json"
    text = config.read_text()
    config.write_text(text.replace("sigma_px", "sgima_px"))
    capsys.readouterr()
    assert resume(broken) == 2
    assert "modulator.sgima_px: unknown setting; did you mean 'sigma_px'?" in capsys.readouterr().err
    config.write_text(text[:20] + "{")
    assert f"{config}:" in refused(broken, capsys)
    config.write_text(text.replace("- 24\n", "- 28\n"))
    assert "belongs to another configuration: grid.shape was [24, 20] and is [28, 20]; undo" in refused(broken, capsys)
    config.write_text(text)
    plan.write_text(plan.read_text()[:40])
    assert resume(broken) == 0  # planned anew


def test_resume_is_listed(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert caught.value.code == 0
    assert "go on with an interrupted run" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("words", "stages"), [([LBFGS], [2, 12]), (CAPPED, [4, 3, 3, 2, 2])])
def test_the_progress_bar_names_the_stage_and_the_loss_of_the_first(words, stages, monkeypatch, tmp_path):
    """Each stage has a loss of its own, and later ones begin near their end; every step of L-BFGS lowers it."""
    shown = []

    class Watched(Log):
        def __call__(self, solution):
            super().__call__(solution)
            shown.append(dict(part.split("=") for part in str(self.bar.postfix).split(", ")))

    monkeypatch.setattr(run_module, "Log", Watched)
    assert execute(settings(*words), tmp_path / "run")[1]
    names = [f"{k}/{len(stages)}" for k, steps in enumerate(stages, 1) for _ in range(steps)]
    assert [each["stage"] for each in shown] == names
    losses = [float(each["loss/start"]) for each in shown[: stages[0]]]
    assert losses == sorted(losses, reverse=True) and losses[0] <= 1
    assert not any("loss/start" in each for each in shown[stages[0] :])
