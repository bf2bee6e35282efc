"""A folder's checkpoint goes on with its own configuration and inputs only; what may change is listed and tried."""

import csv
import json
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.pec.progress import Log
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs import fingerprint as module
from holotorch.experiments.runs.fingerprint import differences, fingerprint
from holotorch.experiments.volume import run as volume_run

pytestmark = pytest.mark.usefixtures("tiny")


def interrupted(folder: Path, words: list[str]) -> Path:
    """A run with Ctrl-C in its third step or realisation."""
    calls = []

    def noted(function):
        def called(*given, **more):
            calls.append(1)
            if len(calls) == 3:
                signal.raise_signal(signal.SIGINT)
            return function(*given, **more)

        return called

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((Log, "__call__"), (volume_run.VolumeExperiment, "hologram")):
            patch.setattr(owner, name, noted(getattr(owner, name)))
        assert main(["run", *words, "--out", str(folder)]) == 130
    return folder


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    path = tmp_path_factory.mktemp("in") / "a.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(20, 255, (24, 20, 3), dtype=np.uint8))
    return path


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    path = tmp_path_factory.mktemp("in") / "a.npy"
    np.save(path, np.random.default_rng(0).integers(0, 255, (6, 6, 6), dtype=np.uint8))
    return path


def pec(picture: Path, *more: str) -> list[str]:
    words = ["grid.shape=[24,20]", "device=cpu", "report.baselines=[]", f"target.image={picture}"]
    return [str(CONFIGS / "pec" / "fourier.yaml"), *words, *(more or ["solver={kind: lbfgs, max_steps: 8}"])]


def volume(scan: Path, *more: str) -> list[str]:
    words = [
        f"volume={{path: {scan}, spacing: 1, unit: relative}}",
        "transfer={points: [[20, 1, 0.2, 0, 0], [255, 0.2, 0.9, 1, 0.9]], unit_distance: 0.05}",
        "hologram={shape: [32, 32], pitch: 3.74 um, distance: 3 mm, depths: 2, rays: 16}",
    ]
    return [str(CONFIGS / "volume" / "tooth.yaml"), *words, "device=cpu", "report.seeds=4", *more]


@pytest.fixture(scope="module")
def stopped(tiny, picture, scan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stopped")
    return {
        "pec": interrupted(folder / "pec", pec(picture)),
        "volume": interrupted(folder / "volume", volume(scan)),
    }


def edited(folder: Path, key: str, value) -> None:
    config = yaml.safe_load((folder / "config.yaml").read_text())
    *place, name = key.split(".")
    section = config
    for part in place:
        section = section[part]
    section[name] = value
    (folder / "config.yaml").write_text(yaml.safe_dump(config))


@pytest.mark.parametrize(
    ("kind", "key", "value", "said"),
    [
        ("pec", "seed", 8, "seed was 7 and is 8"),
        ("pec", "modulator.sigma_px", 1.0, "modulator.sigma_px was 0.66 and is 1.0"),
        ("pec", "target.image", "coffee", "target.image has other contents"),
        ("pec", "solver.max_steps", 20, "solver.max_steps was 8 and is 20"),
        ("volume", "view.azimuth_deg", 30.0, "view.azimuth_deg was 0.0 and is 30.0"),
        ("volume", "volume.spacing", [1.0, 1.0, 2.0], "volume has other contents"),
        ("volume", "report.refocus", [0.003], "report.refocus was null and is [0.003]"),
    ],
)
def test_an_edited_folder_is_refused(stopped, tmp_path, capsys, kind, key, value, said):
    folder = Path(shutil.copytree(stopped[kind], tmp_path / "a"))
    before = (folder / "checkpoint.pt").read_bytes()
    edited(folder, key, value)
    capsys.readouterr()
    assert main(["resume", str(folder)]) == 2
    config = folder / "config.yaml"
    cure = f"undo that in {config}, or run into a new folder: holotorch run {config} --out NEW"
    assert f"belongs to another configuration: {said}; {cure}" in capsys.readouterr().err
    assert (folder / "checkpoint.pt").read_bytes() == before and (folder / "interrupted.json").is_file()


@pytest.mark.parametrize("kind", ["pec", "volume"])
def test_other_contents_of_a_file_are_refused(tiny, tmp_path, capsys, picture, scan, kind):
    given = {"pec": picture, "volume": scan}[kind]
    own = Path(shutil.copy(given, tmp_path / given.name))
    folder = interrupted(tmp_path / "a", {"pec": pec, "volume": volume}[kind](own))
    if kind == "pec":
        upright = cv2.imread(str(own))
        assert upright is not None
        cv2.imwrite(str(own), upright[::-1])
    else:
        np.save(own, np.load(own)[::-1])
    assert main(["resume", str(folder)]) == 2
    assert "has other contents" in capsys.readouterr().err
    shutil.copy(given, own)
    assert main(["resume", str(folder)]) == 0


@pytest.mark.parametrize("kind", ["pec", "volume"])
def test_a_checkpoint_without_a_configuration_is_refused(stopped, tmp_path, capsys, kind):
    folder = Path(shutil.copytree(stopped[kind], tmp_path / "a"))
    content = torch.load(folder / "checkpoint.pt", weights_only=True)
    del content["fingerprint"]
    torch.save(content, folder / "checkpoint.pt")
    capsys.readouterr()
    assert main(["resume", str(folder)]) == 2
    assert "does not say which configuration it belongs to, as those of older versions" in capsys.readouterr().err


def test_fewer_realisations_than_are_done_are_refused(stopped, tmp_path, capsys):
    folder = Path(shutil.copytree(stopped["volume"], tmp_path / "a"))
    edited(folder, "report.seeds", 1)
    assert main(["resume", str(folder)]) == 2
    assert "report.seeds: expected at least the 2 done, got 1" in capsys.readouterr().err
    edited(folder, "report.seeds", 2)
    assert main(["resume", str(folder)]) == 0
    assert json.loads((folder / "summary.json").read_text())["realisations"] == 2


def test_more_realisations_are_added(stopped, scan, tmp_path):
    folder = Path(shutil.copytree(stopped["volume"], tmp_path / "a"))
    edited(folder, "report.seeds", 5)
    assert main(["resume", str(folder)]) == 0
    assert main(["run", *volume(scan, "report.seeds=5"), "--out", str(tmp_path / "whole")]) == 0
    assert_same_arrays(folder, tmp_path / "whole")


@pytest.mark.parametrize("kind", ["apg", "adam"])
def test_more_steps_are_added(picture, tmp_path, kind):
    folder = interrupted(tmp_path / "a", pec(picture, f"solver={{kind: {kind}, max_steps: 8}}"))
    edited(folder, "solver.max_steps", 12)
    assert main(["resume", str(folder)]) == 0
    assert main(["run", *pec(picture, f"solver={{kind: {kind}, max_steps: 12}}"), "--out", str(tmp_path / "b")]) == 0
    assert_same_arrays(folder, tmp_path / "b")
    with open(folder / "metrics.csv", newline="") as stream:
        assert len(list(csv.DictReader(stream))) == 12


def test_a_moved_file_goes_on(picture, tmp_path):
    own = Path(shutil.copy(picture, tmp_path / "b.png"))
    folder = interrupted(tmp_path / "a", pec(own))
    edited(folder, "target.image", str(picture))
    assert main(["resume", str(folder)]) == 0


def assert_same_arrays(one: Path, other: Path) -> None:
    for path in (other / "arrays").iterdir():
        assert np.load(one / "arrays" / path.name).tobytes() == np.load(path).tobytes(), path.name


def test_large_inputs_are_sampled_from_end_to_end(monkeypatch):
    monkeypatch.setattr(module, "_HASHED_BYTES", 40)
    settings = load_config(CONFIGS / "pec" / "fourier.yaml")
    values = torch.arange(100.0).reshape(10, 10)  # 40 bytes a row
    marks = {}
    for row in (None, 0, 9):
        changed = values.clone()
        if row is not None:
            changed[row, 3] = -1
        marks[row] = fingerprint(settings, {"target": (changed,)})
    assert differences(marks[None], marks[0]) == differences(marks[0], marks[9]) == ["target has other contents"]
    assert differences(marks[None], fingerprint(settings, {"target": (values.T.contiguous().T,)})) == []
    assert not any(key.startswith("target.") for key in marks[0]) and marks[0]["modulator.sigma_px"] == 0.66


def test_a_key_of_a_later_version_that_is_not_given_changes_nothing():
    before = {"transfer.preset": "bone", "transfer.low": None}
    assert differences(before, before | {"transfer.visible_from": None}) == []
    assert differences({"transfer.preset": "bone"}, before) == []
    (line,) = differences(before, before | {"transfer.visible_from": 3.0})
    assert line == "transfer.visible_from was nothing and is 3.0"
