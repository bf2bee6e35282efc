"""Runs of every kind: signals, exit statuses, one run a folder, and going on by ``resume`` or by the same ``run``."""

import json
import re
import shutil
import signal
from pathlib import Path

import pytest
from tiny_runs import command, results

from holotorch.cli import main
from holotorch.experiments.eye import experiment as eye
from holotorch.experiments.eye import run as eye_run
from holotorch.experiments.joint import run as joint_run
from holotorch.experiments.measure import run as measure_run
from holotorch.experiments.pec.progress import Log
from holotorch.experiments.pec_study import bench as pec_bench
from holotorch.experiments.perception.analysis import run as perception_analysis_run
from holotorch.experiments.perception.layout import run as perception_layout
from holotorch.experiments.volume import run as volume_run
from holotorch.io import files

pytestmark = pytest.mark.usefixtures("tiny")
# A setting that makes it another run; where and in which call of it the signal comes; how many calls resuming needs,
# where it does not start over.
KINDS = {
    "pec": (
        ("seed=9", "seed was 7 and is 9"),
        (Log, "__call__", 3, 6),
    ),
    "volume": (
        ("view.azimuth_deg=9", "view.azimuth_deg was 0.0 and is 9.0"),
        (volume_run.VolumeExperiment, "hologram", 3, 1),
    ),
    "eye": (
        ("eye.chromatic=true", "eye.chromatic was false and is true"),
        (eye.Observer, "image", 9, 1),
    ),
    "joint": (
        ("eye.pupil=0.4", "eye.pupil was 0.5 and is 0.4"),
        (joint_run.Log, "__call__", 3, 4),
    ),
    "study": (
        ("max_steps=5", "max_steps was 4 and is 5"),
        (pec_bench.Bench, "scores", 25, 23),
    ),
    "measure": (
        ("rest.frames=9", "rest.frames was 10 and is 9"),
        (measure_run.Track, "take", 3, 252),
    ),
    "layout": (
        ("extrapolate=true", "extrapolate was false and is true"),
        (perception_layout, "_picture", 1, 1),
    ),
    "analysis": (
        ("resamples=101", "resamples was 100 and is 101"),
        (perception_analysis_run, "_conditions", 1, 1),
    ),
}


def pressed(patch, kind: str, number: int) -> None:
    """The signal comes in the middle of the run."""
    owner, name, call, _ = KINDS[kind][1]
    calls, original = [], getattr(owner, name)

    def noted(*words, **more):
        calls.append(1)
        if len(calls) == call:
            signal.raise_signal(number)
        return original(*words, **more)

    patch.setattr(owner, name, noted)


def counted(patch, kind: str) -> list[int]:
    owner, name, _, _ = KINDS[kind][1]
    calls, original = [], getattr(owner, name)
    patch.setattr(owner, name, lambda *words, **more: (calls.append(1), original(*words, **more))[1])
    return calls


@pytest.fixture(scope="module")
def whole(tiny, tmp_path_factory):
    """Each kind's run without an interruption, done when asked for."""
    place, done = tmp_path_factory.mktemp("whole"), {}

    def of(kind: str):
        if kind not in done:
            assert main(command(kind, place / kind)) == 0
            done[kind] = results(place / kind)
        return done[kind]

    return of


@pytest.mark.parametrize("kind", KINDS)
def test_a_signal_leaves_a_folder_that_two_commands_complete(kind, whole, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(eye_run, "_SAVE_EVERY", -1.0, raising=False)
    folder = tmp_path / "a"
    with monkeypatch.context() as patch:
        pressed(patch, kind, signal.SIGTERM)
        assert main(command(kind, folder)) == 130
    assert f"holotorch resume {folder}" in capsys.readouterr().err and not (folder / "summary.json").exists()
    if kind not in ("measure", "layout", "analysis"):
        assert (folder / "checkpoint.pt").exists() and (folder / "interrupted.json").exists()
    (folder / ".checkpoint.pt.1.partial").write_bytes(b"of a killed process")
    shutil.copytree(folder, tmp_path / "b")
    for copy, words in ((folder, ["resume", str(folder)]), (tmp_path / "b", command(kind, tmp_path / "b"))):
        with monkeypatch.context() as patch:
            calls = counted(patch, kind)
            assert main(words) == 0
        assert len(calls) == KINDS[kind][1][3]  # what was done is not done again
        assert results(copy) == whole(kind)
        assert not list(copy.glob(".*")) and not (copy / "checkpoint.pt").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_of_other_settings_is_refused(kind, tmp_path, capsys, monkeypatch):
    folder, (word, said) = tmp_path / "a", KINDS[kind][0]
    with monkeypatch.context() as patch:
        pressed(patch, kind, signal.SIGINT)
        assert main(command(kind, folder)) == 130
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    capsys.readouterr()
    assert main(command(kind, folder, word)) == 2
    cure = f"choose another --out, or go on with that one: holotorch resume {folder}"
    assert f"{folder} holds an unfinished run of another configuration: {said}; {cure}" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("kind", KINDS)
def test_a_signal_after_the_last_number_changes_nothing(kind, tmp_path, monkeypatch, capsys):
    """It comes while the page is written, when summary.json says that the run is complete."""
    replace = files.os.replace

    def late(source, target):
        if Path(target).name == "summary.json":
            replace(source, target)
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
        else:
            replace(source, target)

    monkeypatch.setattr(files.os, "replace", late)
    assert main(command(kind, tmp_path / "a")) == 0
    assert (tmp_path / "a" / "report.html").is_file() and "interrupted" not in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["eye", "study", "layout", "analysis"])
def test_a_picture_that_cannot_be_written_takes_nothing_along(kind, whole, tmp_path, monkeypatch, capsys):
    write = files.replacing

    def full(path, **more):
        if path.suffix == ".png":
            raise OSError(28, "No space left on device", str(path))
        return write(path, **more)

    with monkeypatch.context() as patch:
        patch.setattr(files, "replacing", full)
        assert main(command(kind, tmp_path / "a")) == 1
    error = capsys.readouterr().err
    assert len(re.findall("warning: .*png cannot be written", error)) == 1 and "Traceback" not in error
    assert "png: No space left" in json.loads((tmp_path / "a" / "interrupted.json").read_text())["failure"]
    kept = {name for name in whole(kind) if name.endswith((".npy", ".csv"))}
    assert kept and all((tmp_path / "a" / name).is_file() for name in kept)
    assert main(["resume", str(tmp_path / "a")]) == 0
    assert results(tmp_path / "a") == whole(kind)


def test_two_runs_never_share_a_folder(tmp_path, monkeypatch, capsys):
    pytest.importorskip("fcntl", reason="folders cannot be locked here")
    original, codes = perception_layout._picture, []

    def meanwhile(*words):
        monkeypatch.setattr(perception_layout, "_picture", original)
        codes.extend([main(["resume", str(tmp_path / "a")]), main(command("layout", tmp_path / "a"))])
        return original(*words)

    monkeypatch.setattr(perception_layout, "_picture", meanwhile)
    assert main(command("layout", tmp_path / "a")) == 0 and codes == [2, 2]
    assert capsys.readouterr().err.count("is in use by another run: wait for its end, or choose another --out") == 2


def test_what_a_kill_at_the_start_leaves_is_no_obstacle(tmp_path):
    (tmp_path / "a" / "images").mkdir(parents=True)
    (tmp_path / "a" / "env.json").write_text("{}")
    (tmp_path / "a" / ".config.yaml.123.partial").write_text("experiment: perc")
    assert main(command("layout", tmp_path / "a")) == 0


@pytest.mark.parametrize("kind", ["pec", "layout"])
def test_a_kill_after_the_last_number_leaves_a_run_that_resume_tidies(kind, whole, tmp_path, monkeypatch, capsys):
    class Killed(BaseException):
        """Ends everything at once; what would be written after it is not."""

    replace = files.os.replace

    def late(source, target):
        if Path(target).name == "summary.json":
            shutil.copy(source, Path(target).with_name(".report.html.1.partial"))
            replace(source, target)
            raise Killed
        replace(source, target)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(files.os, "replace", late)
        main(command(kind, tmp_path / "a"))
    (tmp_path / "a" / "checkpoint.pt").write_bytes(b"which is removed after that")
    assert main(["resume", str(tmp_path / "a")]) == 0
    assert "this run is complete" in capsys.readouterr().out
    assert results(tmp_path / "a") == whole(kind) and not list((tmp_path / "a").glob(".*"))


def test_a_signal_before_a_run_goes_on_says_that_it_is_still_there(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "a"
    with monkeypatch.context() as patch:
        pressed(patch, "pec", signal.SIGTERM)
        assert main(command("pec", folder)) == 130
    capsys.readouterr()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    monkeypatch.setattr("holotorch.experiments.pec.experiment.build", lambda _: signal.raise_signal(signal.SIGINT))
    for words in (["resume", str(folder)], command("pec", folder)):
        assert main(words) == 130
        assert capsys.readouterr().err.strip().endswith(f"start it again with: holotorch resume {folder}")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_other_peoples_folders_are_left_alone(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    for name, text in (("config.yaml", "experiment: other"), ("env.json", "{}"), (".x.partial", "mine")):
        (tmp_path / "a" / name).write_text(text)
    assert main(command("layout", tmp_path / "a")) == 2
    assert "holds files already; choose another --out or delete it" in capsys.readouterr().err
    assert len(list((tmp_path / "a").iterdir())) == 3
