"""A kind of experiment is one folder and one line of the registry; everything else follows."""

import json
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
from paths import CONFIGS
from toy.kind import ToyKind

from holotorch.cli import main
from holotorch.experiments import registry
from holotorch.experiments.registry import KINDS, find_kind, load_config, run_name


@pytest.fixture
def config(monkeypatch, tmp_path):
    monkeypatch.setitem(registry.KINDS, "toy", "toy")
    path = tmp_path / "toy.yaml"
    path.write_text("experiment: toy\nsteps: 4\n")
    return str(path)


def test_a_new_kind_is_checked_run_and_reported(config, tmp_path, capsys):
    assert main(["check", config, "steps=5"]) == 0
    assert capsys.readouterr().out == "Steps      5\n"
    folder = tmp_path / "a"
    assert main(["run", config, "--out", str(folder)]) == 0
    assert capsys.readouterr().out == f"Steps      4\nResult     total 10\n{folder / 'report.html'}\n"
    assert {path.name for path in folder.iterdir()} == {
        *("config.yaml", "env.json", "images", "plan.json", "report.html", "summary.json")
    }
    assert json.loads((folder / "summary.json").read_text()) == {"experiment": "toy", "status": "complete", "total": 10}
    assert "total 10" in (folder / "report.html").read_text()
    assert main(["report", str(folder), str(folder), "--out", str(tmp_path / "both.html")]) == 0
    assert (tmp_path / "both.html").read_text().count("total 10") == 2


def test_a_new_kind_goes_on_where_it_was_interrupted(config, tmp_path, monkeypatch, capsys):
    def pressed(_, number: int) -> int:
        if number == 3:
            signal.raise_signal(signal.SIGINT)
        return number

    folder = tmp_path / "a"
    with monkeypatch.context() as patch:
        patch.setattr(ToyKind, "step", pressed)
        assert main(["run", config, "--out", str(folder)]) == 130
    assert capsys.readouterr().out == f"Steps      4\nUnfinished total 3\n{folder / 'report.html'}\n"
    assert json.loads((folder / "interrupted.json").read_text())["total"] == 3
    assert main(["run", config, "steps=6", "--out", str(folder)]) == 2
    assert "steps was 4 and is 6" in capsys.readouterr().err
    assert main(["resume", str(folder)]) == 0
    assert capsys.readouterr().out == f"Steps      4\nResult     total 10\n{folder / 'report.html'}\n"
    assert main(["resume", str(folder)]) == 0
    complete = "this run is complete; nothing is left to do"
    assert capsys.readouterr().out == f"{complete}\nResult     total 10\n{folder / 'report.html'}\n"
    assert json.loads((folder / "summary.json").read_text())["total"] == 10


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["steps=13"], "argument 'steps=13': steps: expected anything but 13"),
        (["step=3"], "step: unknown setting; did you mean 'steps'?"),
        (["gigabytes=10"], "needs too much"),
    ],
)
def test_mistakes_of_a_new_kind_are_said_like_those_of_others(config, words, message, tmp_path, capsys):
    for command in (["check", config, *words], ["run", config, *words, "--out", str(tmp_path / "a")]):
        assert main(command) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_has_an_example_that_it_takes_and_a_schema(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", name]) == 0
    assert capsys.readouterr().out.startswith(f"{name}.yaml; look at what it will do with: holotorch check")
    settings = load_config(f"{name}.yaml")
    assert isinstance(settings, find_kind(name).settings)
    assert main(["new", name]) == 2 and "is there already" in capsys.readouterr().err
    assert main(["schema", name]) == 0
    described = json.loads(capsys.readouterr().out)
    assert described["properties"].keys() == type(settings).model_fields.keys()
    assert described["additionalProperties"] is False


def test_a_schema_takes_what_a_configuration_may_say(capsys):
    assert main(["schema", "pec"]) == 0
    parts = json.loads(capsys.readouterr().out)["$defs"]
    grid, modulator = parts["GridSettings"]["properties"], parts["ModulatorSettings"]["properties"]
    assert "string" in json.dumps(grid["pitch"])  # 8 um
    assert {key: each for key, each in modulator["power_weight"].items() if "imum" in key} == {
        "minimum": 0,
        "maximum": 1000000.0,
    }


def test_unknown_kinds_and_places_are_refused(tmp_path, capsys):
    for words in (["new", "volumes"], ["schema", "volumes"]):
        assert main(words) == 2
        assert "no kind 'volumes'; did you mean 'volume'?" in capsys.readouterr().err
    assert main(["new", "pec", "--out", str(tmp_path / "no" / "a.yaml")]) == 2
    assert "cannot write" in capsys.readouterr().err


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_has_settings_of_its_own_name(name):
    assert find_kind(name).settings.model_fields["experiment"].annotation.__args__ == (name,)


@pytest.mark.parametrize(
    ("config", "word", "name"),
    [
        ("pec/fourier.yaml", "target.image=my photo.png", "my photo-pec"),
        ("pec/fourier.yaml", "target={image: my photo.png}", "my photo-pec"),
        ("pec/fourier.yaml", "target.image=coffee", "fourier"),  # a bundled picture is not the user's own
        ("volume/c60.yaml", "volume.path=head.v2.nii.gz", "head.v2-volume"),
        ("volume/c60.yaml", "volume.path=ct.h5::a/b", "ct-volume"),
        ("eye/teapot.yaml", "volume={path: slices/}", "slices-eye"),
        ("joint/teapot.yaml", "volume.path=.", "work-joint"),
        ("joint/teapot.yaml", "steps=3", "teapot"),
        ("tracking/track.yaml", "source=my film.mp4", "my film-track"),
        ("tracking/track.yaml", "source=0", "track"),  # a camera
        ("tracking/measure.yaml", "source=['my film.mp4']", "my film-measure"),
        ("tracking/measure.yaml", "source=[slices, 'my film.mp4']", "measure"),  # the faces of a grid
        ("tracking/measure.yaml", "source=[synthetic]", "measure"),
        ("perception/layout.yaml", "seed=3", "layout"),
    ],
)
def test_a_run_is_named_after_the_data_of_the_user_or_its_configuration(config, word, name, tmp_path, monkeypatch):
    (tmp_path / "work" / "slices").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "work")
    for file in ("my photo.png", "my film.mp4", "head.v2.nii.gz", "ct.h5"):
        (tmp_path / "work" / file).touch()
    kind = {"track": "track", "measure": "measure", "layout": "perception_layout"}.get(Path(config).stem)
    assert run_name(f"configs/{config}", ["seed=1", word], kind or config.split("/")[0]) == name


@pytest.mark.usefixtures("undrawn")
def test_the_folder_of_a_run_has_the_name_of_the_picture_that_it_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pixels = np.random.default_rng(0).integers(20, 255, (24, 24, 3), dtype=np.uint8)
    cv2.imwrite("mine.png", pixels)
    words = ["target.image=mine.png", "grid.shape=[16,16]", "solver.max_steps=2", "report.baselines=[]"]
    for number in (1, 2):
        assert main(["run", str(CONFIGS / "pec" / "fourier.yaml"), *words]) == 0
        out = capsys.readouterr().out.splitlines()
        assert out[0].startswith("Picture    mine.png") and out[-1] == f"runs/mine-pec-00{number}/report.html"
    assert "<title>holotorch: mine-pec-002</title>" in (tmp_path / out[-1]).read_text()
    assert main(["run", str(CONFIGS / "pec" / "fourier.yaml"), *words, "--out", "there"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "there/report.html"
