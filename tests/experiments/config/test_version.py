"""Configurations of run folders carry a version: older ones keep their meaning, later ones are refused."""

import shutil
from pathlib import Path

import pytest
import yaml

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.version import FIRST_LINE, VERSION
from holotorch.experiments.registry import load_config

OLD = {
    "experiment": "eye",
    "scene": {"config": "configs/volume/c60.yaml"},
    "display": {"kind": "planar"},
    "eye": {"pupil_radius": 1.5e-3},
    "light": {"tolerance": 0.02},
    "tolerance": 0.07,
}


def test_an_eye_run_of_the_version_before_keeps_its_way_to_the_retina(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(OLD))
    assert load_config(path).tolerance == 0.07  # a user's file means what it says
    (tmp_path / "env.json").write_text("{}")
    old = load_config(path)
    assert old.tolerance is None and old.eye.tolerance == 0.07 and old.light.tolerance == 0.02
    path.write_text(FIRST_LINE + yaml.safe_dump(OLD))
    assert load_config(path).tolerance == 0.07 and load_config(path).eye.tolerance is None


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of a run."""
    words = ["configs/pec/fourier.yaml", "grid.shape=[24,20]", "report.baselines=[]", "solver.max_steps=2"]
    folder = tmp_path_factory.mktemp("run") / "a"
    assert main(["run", *words, "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize("command", ["run", "resume", "export-heaters"])
def test_a_later_version_is_refused_with_what_to_do(command, run, tmp_path, capsys):
    folder = Path(shutil.copytree(run, tmp_path / "a"))
    path = folder / "config.yaml"
    text = path.read_text()
    assert text.startswith(FIRST_LINE)
    path.write_text(text.replace(f"version {VERSION}", f"version {VERSION + 1}", 1))
    (folder / "summary.json").unlink()
    capsys.readouterr()
    assert main([command, str(path if command == "run" else folder)]) == 2
    error = capsys.readouterr().err
    assert f"version {VERSION} or older, got {VERSION + 1}" in error and "pip install -U holotorch" in error


def test_a_strangers_first_line_is_no_version(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("# holotorch configuration, version two\n" + yaml.safe_dump(OLD))
    assert load_config(path).tolerance == 0.07
    with pytest.raises(ConfigError):
        load_config(tmp_path / "none.yaml")
