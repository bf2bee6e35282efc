"""A run folder is used from other folders than that in which its run was started with relative paths."""

import json
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from holotorch.cli import main
from holotorch.experiments.config.inputs import started_in, with_its_files
from holotorch.experiments.config.source import override, read_source
from holotorch.experiments.pec import run as run_module
from holotorch.experiments.registry import load_config

KERNEL = "0,0.1,0\n0.1,1,0.1\n0,0.1,0\n"
WORDS = ["grid.shape=[24,20]", "report.baselines=[]", "solver.max_steps=4", "modulator={kernel: kernel.csv}"]


@pytest.fixture
def run(tmp_path, monkeypatch, no_figures):
    """A function that starts a run in the folder "start", and leaves for the folder "other"."""
    for name in ("start", "other"):
        (tmp_path / name).mkdir()
    (tmp_path / "start" / "kernel.csv").write_text(KERNEL)
    cv2.imwrite(str(tmp_path / "start" / "mine.png"), np.random.default_rng(0).integers(0, 255, (24, 20, 3)))

    def begin(status: int = 0) -> Path:
        monkeypatch.chdir(tmp_path / "start")
        words = ["configs/pec/fourier.yaml", *WORDS, "target.image=mine.png", "--out", "../run"]
        assert main(["run", *words]) == status
        monkeypatch.chdir(tmp_path / "other")
        return tmp_path / "run"

    return begin


def test_a_run_is_exported_and_repeated_from_elsewhere(run, capsys):
    folder = run()
    Path("kernel.csv").write_text("0,0,0\n0,1,0\n0,0,0\n")  # another one, which is not that of the run
    settings = load_config(folder / "config.yaml")
    assert settings.modulator.kernel == str(folder.parent / "start" / "kernel.csv")
    assert settings.target.image == str(folder.parent / "start" / "mine.png")
    assert main(["export-heaters", str(folder), "--out", "heaters"]) == 0 and Path("heaters").is_dir()
    given = load_config(folder / "config.yaml", ["modulator.kernel=kernel.csv"])
    assert given.modulator.kernel == "kernel.csv"  # of the command line, so of this folder
    (folder.parent / "start" / "kernel.csv").unlink()
    assert load_config(folder / "config.yaml").modulator.kernel == "kernel.csv"
    Path("kernel.csv").unlink()
    assert main(["export-heaters", str(folder), "--out", "again"]) == 2
    assert "expected a file or folder that exists, got 'kernel.csv'" in capsys.readouterr().err


def test_an_interrupted_run_is_resumed_from_elsewhere(run, monkeypatch, capsys):
    class Interrupting(run_module.Log):
        def __call__(self, solution):
            super().__call__(solution)
            if len(solution.losses) == 3:
                signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "Log", Interrupting)
        folder = run(status=130)
    assert main(["resume", str(folder)]) == 0, capsys.readouterr().err
    assert json.loads((folder / "summary.json").read_text())["status"] == "complete"


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"folder": 3}', '{"folder": "nowhere"}', "\0"])
def test_a_run_whose_start_is_not_known_has_the_paths_of_its_file(tmp_path, text):
    (tmp_path / "config.yaml").write_text("experiment: pec\ntarget: {image: mine.png}\n")
    (tmp_path / "env.json").write_text(text)
    source = read_source(tmp_path / "config.yaml", [])
    assert with_its_files(source).data == {"experiment": "pec", "target": {"image": "mine.png"}}
    (tmp_path / "mine.png").touch()
    (tmp_path / "env.json").write_text(json.dumps({"folder": str(tmp_path)}))
    source = read_source(tmp_path / "config.yaml", [])
    override(source, "target.region=[1,2,3,4]", [])
    assert with_its_files(source).data["target"] == {"image": str(tmp_path / "mine.png"), "region": [1, 2, 3, 4]}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"folder": 7}', "[" * 100_000, "\xff"])
def test_an_env_file_that_says_nothing_is_no_start(text, tmp_path):
    """Deep nesting is a find of scripts/fuzz.py."""
    (tmp_path / "env.json").write_text(text, encoding="latin-1")
    assert started_in(tmp_path) is None
