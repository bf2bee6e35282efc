"""Each part of a volume looks sharpest to the eye that is focused at it: on a phantom, and on a real CT."""

import csv
import math

import pytest
import torch
from paths import CONFIGS, SHARED

from holotorch.cli import main
from holotorch.experiments.execute import execute
from holotorch.experiments.eye.config import SweepSettings
from holotorch.experiments.eye.experiment import observer
from holotorch.experiments.eye.focus import focus_sweep, in_words
from holotorch.experiments.eye.run import scene_settings
from holotorch.experiments.registry import load_config

CONFIG = CONFIGS / "eye" / "focus.yaml"
BONSAI = SHARED / "volumes" / "bonsai.nrrd"
PHANTOM = (
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 64}', "
    "'hologram={shape: [256, 256], pitch: 3.74 um, distance: 6 mm, depths: 40, rays: 256}']}"
)
REAL = (
    "scene={config: configs/volume/bonsai.yaml, change: ['volume.path=%s', "
    "'hologram={shape: [512, 512], pitch: 3.74 um, distance: 10 mm, depths: 58, rays: 512}']}"
)


def looking(*overrides: str):
    settings = load_config(CONFIG, list(overrides))
    return observer(settings, scene_settings(settings))


def in_focus(sweep, bands: int) -> None:
    """All bands are there, and each is sharpest within half a depth of focus of where it lies."""
    assert len(sweep.bands) == bands
    deep = [band.depth_of_focus for band in sweep.bands]
    assert sweep.bands[-1].depth - sweep.bands[0].depth > 2 * max(deep)  # otherwise the sweep would tell nothing
    for band in sweep.bands:
        assert abs(band.sharpest - band.depth) < band.depth_of_focus / 2, in_words(sweep)


def test_parts_of_a_phantom_are_sharpest_in_focus():
    in_focus(focus_sweep(looking(PHANTOM, "focus=[6 mm]"), SweepSettings(bands=4, steps=9, realisations=3)), 4)


@pytest.mark.skipif(not BONSAI.exists(), reason="the CT of a bonsai is not here; the phantom's test covers the path")
def test_parts_of_a_real_volume_are_sharpest_in_focus():
    eye = looking(REAL % BONSAI, "focus=[10 mm]")
    in_focus(focus_sweep(eye, SweepSettings(bands=5, steps=9, realisations=4)), 5)


def test_a_run_with_a_sweep_writes_its_table_and_picture(tmp_path, capsys):
    small = PHANTOM.replace("256", "128").replace("6 mm", "8 mm")
    sweep = "sweep={bands: 2, steps: 5, realisations: 1}"
    settings = load_config(CONFIG, [small, "focus=[8 mm]", "light={sources: [laser]}", sweep])
    folder, complete = execute(settings, tmp_path / "a", "a")
    with open(folder / "focus.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert complete and rows and all(math.isfinite(float(row["depth_of_focus_mm"])) for row in rows)
    assert (folder / "images" / "focus.png").read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.count("looks sharpest") == len(rows)


def test_a_scene_without_a_surface_is_a_mistake_of_the_sweep_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("holotorch.experiments.eye.experiment.Observer.image", lambda *_: pytest.fail("looked already"))
    small = PHANTOM.replace("256", "64")
    words = [small, "focus=[6 mm]", "sweep={bands: 2, steps: 5, realisations: 1}", "light={sources: [laser]}"]
    monkeypatch.setattr("holotorch.experiments.eye.focus._OPAQUE", 1.1)  # which no ray is opaque to
    assert main(["run", str(CONFIG), *words, "--out", str(tmp_path / "a")]) == 2
    error = capsys.readouterr().err
    assert "sweep: a sweep needs a surface: only 0 rays" in error and "leave it out" in error
    assert not (tmp_path / "a").exists()


def test_without_a_surface_there_is_nothing_to_sweep(monkeypatch):
    eye = looking(PHANTOM, "focus=[6 mm]")

    class Clear:
        def render(self, _):
            return torch.zeros(3, 8, 8), torch.zeros(8, 8)

        def depth_map(self, _):
            return torch.zeros(8, 8)

    class Wall(Clear):
        def render(self, _):
            return torch.ones(3, 16, 16), torch.ones(16, 16)

        def depth_map(self, _):
            return torch.full((16, 16), 6e-3)

    for sampler, why in ((Clear, "a sweep needs a surface: only 0 rays"), (Wall, "surface lies at 6 mm")):
        monkeypatch.setattr(type(eye.scene), "sampler", lambda _, sampler=sampler, **__: sampler())
        with pytest.raises(ValueError, match=why):
            focus_sweep(eye, SweepSettings())
