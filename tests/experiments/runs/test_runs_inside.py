"""Commands that are given a folder of runs, such as ``runs``, name the runs in it and what to enter."""

import os

import pytest
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.runs.record import runs_inside

PANEL = ["--slm", str(CONFIGS / "slm" / "lcos_2048.yaml")]
KIND = {"a pec": "pec", "b_volume": "volume", "c_eye": "eye", "d_joint": "joint", "e_track": "track"}


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """A folder of runs, the later the later in the alphabet; only those of kind pec and joint are not finished."""
    monkeypatch.chdir(tmp_path)
    for number, (name, kind) in enumerate(KIND.items()):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(f"# a comment\nexperiment: {kind}\n")
        (folder / "env.json").write_text("{}")
        os.utime(folder / "env.json", (number, number))
        if kind not in ("pec", "joint"):
            (folder / "summary.json").write_text("{}")
    (tmp_path / "runs" / "e_track" / "poses.csv").touch()
    (tmp_path / "runs" / "other").mkdir()
    (tmp_path / "runs" / "other" / "config.yaml").write_text("experiment: pec")  # without env.json it is no run
    return "runs"


@pytest.mark.parametrize(
    ("words", "named", "latest"),
    [
        (["export-heaters"], ["a pec", "d_joint"], "export-heaters runs/d_joint"),
        (["export-slm"], ["a pec", "b_volume", "d_joint"], "export-slm runs/d_joint --slm FILE"),
        (["resume"], ["a pec", "d_joint"], "resume runs/d_joint"),
        (["report"], list(KIND), "report runs/e_track"),
        (["view"], ["a pec", "b_volume", "c_eye", "d_joint"], "view runs/d_joint"),
        (["stream", "--view", "--replay"], ["e_track"], "stream --view --replay runs/e_track"),
    ],
    ids=lambda value: "",
)
def test_a_folder_of_runs_is_answered_by_their_names_and_the_command(words, named, latest, runs, capsys):
    assert main([*words, runs, *(PANEL if "slm" in words[0] else [])]) == 2
    error = capsys.readouterr().err
    names = ", ".join(f"runs/{name}" for name in named)
    assert error.startswith("runs holds no run") and len(error.splitlines()) == 1
    assert error.endswith(f"; give one of the runs in it: {names}; for the latest: holotorch {latest}\n")


def test_a_folder_that_does_not_exist_is_answered_by_the_runs_beside_it(runs, capsys):
    assert main(["report", f"{runs}/none"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"{runs}/none: no such folder in {runs}; give one of the runs in it: ")


def test_where_all_is_complete_there_is_nothing_to_resume(runs, tmp_path, capsys):
    for name in KIND:
        (tmp_path / "runs" / name / "summary.json").write_text("{}")
    assert main(["resume", runs]) == 2
    assert capsys.readouterr().err.endswith("are not both there; the runs in it are complete\n")


def test_the_command_for_a_name_with_a_space_can_be_pasted_and_many_names_are_cut_short(runs, tmp_path):
    os.utime(tmp_path / "runs" / "a pec" / "env.json", (99, 99))
    assert runs_inside(tmp_path / "runs", "holotorch view {}").endswith(f"view '{tmp_path}/runs/a pec'")
    for number in range(3):
        (tmp_path / "runs" / f"f{number}").mkdir()
        (tmp_path / "runs" / f"f{number}" / "interrupted.json").write_text("{}")
    assert "e_track, " in (text := runs_inside(tmp_path / "runs", "")) and "f0, ...;" in text and "f1" not in text
    assert f"{tmp_path}/runs/a pec, " in runs_inside(tmp_path, "holotorch view {}")  # in a folder of several runs
    assert runs_inside(tmp_path / "runs" / "other", "") == runs_inside(tmp_path / "nowhere", "") == ""
