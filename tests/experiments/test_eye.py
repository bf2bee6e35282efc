"""What an observer sees: sources, focus, and the page of a run."""

import csv
import json
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from holotorch.cli import main
from holotorch.experiments import eye as eye_module
from holotorch.experiments.config import load_config
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.eye import observer
from holotorch.experiments.eye_run import plan_text, run_observer, scene_settings

CONFIG = Path(__file__).parents[2] / "configs" / "eye" / "teapot.yaml"
SCENE = (
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 32}', "
    "'hologram={shape: [128, 128], pitch: 3.74 um, distance: 12 mm, depths: 12, rays: 64}']}"
)
SMALL = [SCENE, "seeds=1", "light={sources: [laser, led]}", "focus=[12 mm]"]


def settings(*overrides: str):
    return load_config(CONFIG, [*SMALL, *overrides])


def test_a_run_shows_less_speckle_under_wider_sources(tmp_path):
    folder, complete = run_observer(settings(), tmp_path / "a", "a")
    names = {path.name for path in folder.iterdir()}
    assert complete and names == {
        *("arrays", "config.yaml", "env.json", "images", "plan.json", "report.html", "summary.json", "table.csv")
    }
    assert np.load(folder / "arrays" / "retina.npy").shape == (2, 1, 3, 64, 64)
    rows = json.loads((folder / "summary.json").read_text())["rows"]
    laser, led = (next(row for row in rows if row["source"] == source) for source in ("laser", "led"))
    for colour in range(3):
        assert led["contrast"][colour] < laser["contrast"][colour]
        assert led["sharpness"][colour] < laser["sharpness"][colour] + 0.05
        assert led["contrast_predicted"][colour] < laser["contrast_predicted"][colour] <= 1
        assert led["wavelengths"][colour] >= laser["wavelengths"][colour]
    with open(folder / "table.csv", newline="") as stream:
        assert len(list(csv.DictReader(stream))) == 2
    assert "Synthetic volume" in (folder / "report.html").read_text()


def test_few_wavelengths_are_as_good_as_many():
    """Against one every nanometre, as the thesis takes them: within the tolerance of a picture's rms brightness."""
    found = observer(settings(), scene_settings(settings()))
    hologram, _ = found.scene.hologram(0)
    depth = found.focus[0]
    few = found.seen(hologram, "led", depth)

    class Dense(eye_module.Observer):
        def samples(self, source, wave, depth):
            return eye_module.PRESETS[source](wave).every(1e-9)

    many = Dense(found.settings, found.scene, found.focus).seen(hologram, "led", depth)
    error = (few - many).square().mean().sqrt() / many.square().mean().sqrt()
    # 1 % expected for the integral; the sum over whole nanometres is itself that far from it.
    assert error < 0.03
    assert all(len(found.samples("led", wave, depth)[0]) <= 15 for wave in found.scene.settings.wavelengths)


def test_the_eye_sees_sharply_where_it_is_focused():
    """A point at each of two depths: the picture of each is brightest when the eye accommodates to it."""
    found = observer(settings("focus=[10 mm, 14 mm]"), scene_settings(settings()))
    grid, waves = found.scene.grid, found.scene.settings.wavelengths
    from holotorch.hologram import ConvolutionHologram

    layers = torch.zeros(2, 64, 64, dtype=torch.complex64)
    layers[0, 32, 20] = layers[1, 32, 44] = 1.0
    fields = [ConvolutionHologram(grid, wave, (10e-3, 14e-3), cone="taper", stride=2)(layers) for wave in waves]
    near, far = (found.seen(torch.stack(fields), None, depth)[1] for depth in found.focus)
    assert near[32, 20] > 1.5 * far[32, 20] and far[32, 44] > 1.5 * near[32, 44]
    assert found.accommodation(14e-3) < found.accommodation(10e-3)  # nearer to the eyepiece: the image is nearer


def test_the_plan_says_how_the_scene_is_seen():
    text, values = plan_text(observer(settings(), scene_settings(settings())))
    assert "synthetic: a phantom was asked for" in text and "laser: " in text
    assert values["accommodation_mm"][0] == pytest.approx(120, rel=1e-6)  # the middle, where the display puts it
    assert main(["check", str(CONFIG), *SMALL]) == 0


def test_interrupted_runs_keep_what_was_seen(tmp_path, monkeypatch):
    original = eye_module.Observer.seen
    seen = []

    def pressed(self, hologram, source, depth):
        seen.append(source)
        if seen.count("led") == 2:
            signal.raise_signal(signal.SIGINT)
        return original(self, hologram, source, depth)

    monkeypatch.setattr(eye_module.Observer, "seen", pressed)
    folder, complete = run_observer(settings("seeds=2"), tmp_path / "a", "a")
    saved = json.loads((folder / "interrupted.json").read_text())
    assert not complete and saved["realisations"] == 1 and not (folder / "summary.json").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("eye={pupil_radius: 0}", "eye.pupil_radius: expected a length above zero"),
        ("display={kind: magnifying, focal_length: -1 mm}", "display.*focal_length: expected a length above zero"),
        ("light={sources: [lamp]}", "light.sources"),
        ("light={sources: [lazer]}", "did you mean 'laser'"),
        ("scene={config: no.yaml}", "scene.config: expected a configuration file of a volume that exists"),
        ("seeds=0", "seeds"),
    ],
)
def test_bad_settings_are_named(override, message):
    with pytest.raises(ConfigError, match=message):
        settings(override)


def test_a_scene_that_the_display_cannot_show_is_refused():
    wrong = settings("focus=[40 mm]")  # beyond the eyepiece
    with pytest.raises(ConfigError, match=r"display: .*; a depth of 40 mm cannot be looked at"):
        observer(wrong, scene_settings(wrong))
    other = settings("scene={config: configs/demo.yaml}")
    with pytest.raises(ConfigError, match="describes no volume but 'pec'"):
        scene_settings(other)
