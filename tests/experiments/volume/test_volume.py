"""The volume experiment: from a file to holograms, pictures and a report."""

import csv
import json
import os
import re
import signal
from pathlib import Path

import numpy as np
import paths
import pytest
import torch

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs import figures
from holotorch.experiments.volume import experiment as volume_experiment
from holotorch.experiments.volume import run as volume_run
from holotorch.experiments.volume.evaluation import pooled
from holotorch.experiments.volume.experiment import Part, build
from holotorch.experiments.volume.plan import dark_picture, plan_text, plan_values
from holotorch.hologram import ConvolutionHologram
from holotorch.scene.march import March
from holotorch.scene.sampler import DVRSampler

CONFIGS = paths.CONFIGS / "volume"
TINY = [
    "volume={phantom: shells, samples: 24}",
    "transfer={points: [[20, 1, 0.2, 0, 0], [120, 1, 0.6, 0.2, 0.3], [255, 0.2, 0.9, 1, 0.9]], unit_distance: 0.05}",
    "hologram={shape: [64, 48], pitch: 3.74 um, distance: 3 mm, depths: 12, rays: 32}",
    "device=cpu",
]
FILES = ["arrays", "config.yaml", "env.json", "images", "layers.json", "metrics.csv", "plan.json", "report.html"]


def settings(*overrides: str):
    return load_config(
        CONFIGS / "tooth.yaml", [*TINY[:2], TINY[2].replace("[64, 48]", "[64, 64]"), TINY[3], *overrides]
    )


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_a_run_is_what_its_parts_give(tmp_path):
    folder, complete = execute(settings("tolerance=1e-4", "report.seeds=2"), tmp_path / "a", "a")
    assert complete and sorted(path.name for path in folder.iterdir()) == sorted([*FILES, "summary.json"])
    saved = np.load(folder / "arrays" / "hologram.npy")
    assert saved.shape == (3, 64, 64) and saved.dtype == np.complex64
    experiment = build(settings())
    layers = experiment.sampler(0)(experiment.volume).stack().to(torch.complex128)  # [D, C, h, w]
    for c, wave in enumerate(experiment.settings.wavelengths):
        exact = ConvolutionHologram(experiment.grid, wave, experiment.depths, cone="taper", stride=2)(layers[:, c])
        error = (torch.from_numpy(saved[c]) - exact).norm() / exact.norm()
        assert error < 3e-3  # the tolerance of a run
    exact = build(settings("tolerance=1e-6", "hologram.cone=box"))
    assert {each.method for each in exact.plans} == {"convolution"}
    numbers, layout = summary(folder), json.loads((folder / "layers.json").read_text())
    assert numbers["synthetic"] == "a phantom was asked for" and numbers["realisations"] == 2
    assert layout["depths_m"] == sorted(layout["depths_m"], reverse=True) and len(layout["depths_m"]) == 12
    assert numbers["ssim_in_focus"] > 0.3 and numbers["peak_memory_bytes"] > 1e8
    assert np.load(folder / "arrays" / "refocused.npy").shape == (3, 3, 32, 32)
    page = (folder / "report.html").read_text()
    assert "Synthetic volume" in page and "Direct volume rendering, synthetic" in page and "axial nodes" in page


def test_the_map_of_depths_says_what_it_is_of(tmp_path, monkeypatch, tiny):
    labels = []
    monkeypatch.setattr(figures, "channel_maps", lambda values, names, label, colours: labels.append(label) or b"")
    execute(settings(), tmp_path / "a", "a")
    assert labels == ["mean distance from the hologram (mm)"]


@pytest.mark.usefixtures("undrawn")
def test_more_realisations_have_less_speckle(tmp_path):
    execute(settings("report.seeds=8"), tmp_path / "a", "a")
    with open(tmp_path / "a" / "metrics.csv", newline="") as stream:
        contrasts = [float(row["speckle_contrast"]) for row in csv.DictReader(stream)]
    # Speckle of N independent pictures falls as 1 / sqrt(N), down to what is no speckle: blur of other depths.
    assert contrasts[-1] < 0.7 * contrasts[0]


def press_in(monkeypatch, realisation: int | None):
    original = volume_run.VolumeExperiment.hologram

    def pressed(self, seed=0, advance=lambda: None, part=None):
        if seed == realisation:
            signal.raise_signal(signal.SIGINT)
        return original(self, seed, advance, part)

    monkeypatch.setattr(volume_run.VolumeExperiment, "hologram", pressed)


@pytest.mark.usefixtures("undrawn")
def test_interrupted_and_resumed_is_the_same_to_the_bit(tmp_path, monkeypatch, capsys):
    execute(settings("report.seeds=3"), tmp_path / "whole", "a")
    with monkeypatch.context() as patch:
        press_in(patch, 2)
        assert not execute(settings("report.seeds=3"), tmp_path / "a", "a")[1]
    assert (tmp_path / "a" / "interrupted.json").is_file() and (tmp_path / "a" / "checkpoint.pt").is_file()
    assert main(["resume", str(tmp_path / "a")]) == 0
    for name in ("hologram", "refocused", "rendering", "depth"):
        one, other = (np.load(tmp_path / which / "arrays" / f"{name}.npy") for which in ("a", "whole"))
        assert (one == other).all()
    assert not (tmp_path / "a" / "checkpoint.pt").exists() and not (tmp_path / "a" / "interrupted.json").exists()
    assert main(["report", str(tmp_path / "a"), str(tmp_path / "whole"), "--out", str(tmp_path / "both.html")]) == 0
    (tmp_path / "b").mkdir()
    with monkeypatch.context() as patch:
        press_in(patch, 0)
        with pytest.raises(KeyboardInterrupt):
            execute(settings(), tmp_path / "b", "b")
    assert main(["resume", str(tmp_path / "b")]) == 0


@pytest.mark.usefixtures("undrawn")
def test_an_interruption_while_errors_are_measured_leaves_them_to_resuming(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(volume_run, "refocusing_error", lambda *_: os.kill(os.getpid(), signal.SIGINT))
        assert not execute(settings(), tmp_path / "a", "a")[1]
    assert "measured_error" not in json.loads((tmp_path / "a" / "interrupted.json").read_text())
    assert main(["resume", str(tmp_path / "a")]) == 0
    assert json.loads((tmp_path / "a" / "summary.json").read_text())["measured_error"] > 0


@pytest.mark.parametrize("count", range(2, 12))
def test_every_plane_of_every_colour_is_added_once(count):
    parts = [Part(rank, count, 29) for rank in range(count)]
    taken = [[sum(part.takes(colour, plane) for part in parts) for plane in range(29)] for colour in range(3)]
    assert np.all(np.array(taken) == 1)
    shares = [sum(part.takes(c, j) for c in range(3) for j in range(29)) for part in parts]
    assert max(shares) <= 2.1 * 29 * 3 / count


@pytest.mark.parametrize("name", ["tooth", "c60", "teapot", "engine", "hand", "bonsai"])
def test_the_thesis_scenes_have_its_numbers(name):
    """Table 5.2; phantoms stand in where there is no network, and say so."""
    planes = {"tooth": (20, 90), "c60": (30, 58), "teapot": (40, 253)}
    planes |= {"engine": (50, 116), "hand": (60, 290), "bonsai": (70, 232)}
    config = load_config(CONFIGS / f"{name}.yaml")
    assert (round(config.hologram.distance * 1e3), config.hologram.depths) == planes[name]
    assert config.hologram.shape == (2048, 2048) and config.hologram.rays == 1024
    small = build(load_config(CONFIGS / f"{name}.yaml", ["scale=16", "volume={phantom: shells, samples: 16}"]))
    assert small.grid.shape == (128, 128) and small.rays.shape == (64, 64) and small.stride == 2
    assert len(small.depths) == planes[name][1] // 16 and small.depths[0] > small.depths[-1]
    assert small.width == pytest.approx(128 * 3.74e-6) and small.distance == pytest.approx(planes[name][0] / 16e3)
    text = plan_text(small, plan_values(small))
    assert "synthetic: a phantom was asked for" in text and "GB of memory" in text
    assert "Scale      1 / 16 of the configuration: pixels, rays, distances" in text
    assert "Method     axial nodes: a few planes stand for all planes; convolution: " in text
    assert "nm     method: axial nodes; each point lights a cone, with a soft edge (predicted" in text
    assert "nm     method: " in text and "s refocusing" in text and "s start-up and figures" in text


def test_a_scene_that_cannot_be_had_is_said(monkeypatch):
    from holotorch.experiments.volume import experiment as volume

    def unreachable(name, directory):
        raise OSError("no network: " + "a long story of connections " * 9 + "\nput it at /cache/tooth.raw")

    monkeypatch.setattr(volume, "fetch_volume", unreachable)
    stand_in = build(load_config(CONFIGS / "tooth.yaml", ["scale=16"]))
    assert stand_in.synthetic.startswith("tooth could not be fetched (no network: a long story")
    assert stand_in.synthetic.endswith("put it at /cache/tooth.raw); give its file as volume.path=FILE")
    with pytest.raises(ConfigError, match="tooth could not be fetched .*volume.path=FILE, or volume.phantom to stand"):
        build(load_config(CONFIGS / "tooth.yaml", ["volume={scene: tooth}"]))
    with pytest.raises(ConfigError, match="no checksum of hand is published; give its file as volume.path"):
        build(load_config(CONFIGS / "hand.yaml", ["volume={scene: hand}"]))


def test_a_file_is_read_and_a_broken_one_named(tmp_path):
    np.save(tmp_path / "ball.npy", np.full((6, 5, 4), 200, np.uint8))
    source = f"volume={{path: {tmp_path / 'ball.npy'}, spacing: [1, 1, 2], unit: relative}}"
    experiment = build(settings(source))
    assert experiment.volume.shape == (6, 5, 4) and experiment.volume.extent == (6, 5, 8) and not experiment.synthetic
    # As the README has it: a file takes the place of a configuration's own scene and phantom.
    words = [f"volume.path={tmp_path / 'ball.npy'}", "volume.spacing=1", "volume.unit=relative", "scale=16"]
    own = build(load_config(CONFIGS / "tooth.yaml", words))
    assert own.volume.shape == (6, 5, 4) and not own.synthetic
    with pytest.raises(ConfigError, match="volume: .*spacing"):
        build(settings(f"volume={{path: {tmp_path / 'ball.npy'}}}"))
    values = np.zeros((4, 4, 4), np.float32)
    values[1, 2, 3] = np.nan
    np.save(tmp_path / "nan.npy", values)
    with pytest.raises(ConfigError, match=r"volume: .*1, 2, 3"):
        build(settings(f"volume={{path: {tmp_path / 'nan.npy'}, spacing: 1, unit: relative}}"))


def test_a_range_above_all_values_is_named(tmp_path):
    values = np.linspace(0, 254, 64, dtype=np.uint8).reshape(4, 4, 4)
    np.save(tmp_path / "eight_bit.npy", values)
    own = f"volume={{path: {tmp_path / 'eight_bit.npy'}, spacing: 1, unit: relative}}"
    warnings = plan_values(build(settings(own, "transfer={preset: bone, low: 900, high: 1800}")))["warnings"]
    assert any(w.startswith("transfer.low 900 is not below the largest value of the file, 254") for w in warnings)


@pytest.mark.parametrize(
    ("name", "more", "cure"),
    [
        (
            "a.npy",
            "",
            "volume.spacing=[1e-3,5e-4,5e-4] (z, y, x in metres), or volume.spacing=[1,1,1] volume.unit=relative",
        ),
        ("a.npy", ", spacing: 1", "unknown, add volume.unit=relative"),
        ("a.npy", ", unit: relative", "volume.unit=relative is the unit of volume.spacing="),
        ("a.npy", ", shape: [4, 4, 5]", "but volume.shape=[4, 4, 5] was asked for"),
        ("a.raw", "", "pass volume.shape=[D,H,W] volume.dtype=uint8, or '>i2' if big-endian"),
        ("a.img", "", "under another extension, pass volume.shape=[D,H,W] volume.dtype=uint8"),
    ],
)
def test_what_a_file_does_not_state_is_asked_for_as_settings(tmp_path, name, more, cure):
    voxels = np.zeros((4, 4, 4), np.uint8)
    np.save(tmp_path / name, voxels) if name.endswith("npy") else voxels.tofile(tmp_path / name)
    with pytest.raises(ConfigError, match=re.escape(cure)):
        build(settings(f"volume={{path: {tmp_path / name}{more}}}"))


def test_an_empty_volume_is_black_and_said_to_be(tmp_path, capsys):
    np.save(tmp_path / "empty.npy", np.zeros((4, 4, 4), np.uint8))
    folder, _ = execute(
        settings(f"volume={{path: {tmp_path / 'empty.npy'}, spacing: 1, unit: relative}}"), tmp_path / "a", "a"
    )
    assert "WARNING    100 % of the picture is black" in capsys.readouterr().out
    assert "100 % of the picture is black" in (folder / "report.html").read_text()
    assert not np.load(folder / "arrays" / "hologram.npy").any()
    assert np.isfinite(np.load(folder / "arrays" / "refocused.npy")).all()
    assert summary(folder)["speckle_contrast"] is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("hologram.distance=50 um", "hologram.distance: expected the whole volume in front of the hologram"),
        ("view.width=1.9", "needs more than 0.95 m; view.width=1.9 means 1.9 m: did you mean '1.9 mm'?"),
        ("hologram.distance=-3 mm", "hologram.distance: expected a distance above zero"),
        ("hologram.rays=33", "hologram.rays: expected a number that divides the hologram's sides"),
        ("hologram.rays=7", "got 7; 'hologram.rays=null' is one ray per pixel"),
        ("volume={}", "volume: expected a path, a scene or a phantom"),
        ("volume={path: no/such.nrrd}", "volume.path: expected a file or folder that exists, got 'no/such.nrrd'"),
        ("volume={scene: tooht}", "did you mean 'tooth'"),
        ("transfer={preset: bone, low: 9, high: 3}", "transfer: a preset needs low < high"),
        ("transfer={}", "transfer: expected one of preset, file or points"),
        ("wavelengths=[]", "wavelengths: expected 1 .grey. to 32, got 0"),
        ("view={lighting: true, scattering: {}}", "view.lighting: expected false with scattering"),
        ("view.scattering={towards: [0, 0, 0]}", "view.scattering: expected towards to point to the light"),
        ("scale=3", "scale: expected a divisor of the pixels"),
        ("phase=rays", "did you mean 'ray'"),
        ("hologram.depths=[1 mm, -1 mm]", "hologram.depths"),
    ],
)
def test_bad_settings_are_named(override, message, capsys):
    with pytest.raises(ConfigError, match=message.replace("(", r"\(")):
        settings(override)


def test_adaptive_rays_and_scattered_light_are_settings_of_the_view():
    plain, adaptive, lit = (
        build(settings(*words)) for words in ([], ["view.adaptive=0.9"], ["view.scattering={half_angle_deg: 30}"])
    )
    whole, fewer = plain.layers().stack(), adaptive.layers().stack()
    assert 1e-3 < (whole - fewer).norm() / whole.norm() < 0.5
    shaded = lit.layers().stack()
    ratio = shaded.abs().square()[whole.abs() > 0] / whole.abs().square()[whole.abs() > 0]
    assert 0.19 < ratio.min() < 0.6 < ratio.max() <= 1.001  # between ambient light alone and all of the light
    field, other = plain.hologram()[0], adaptive.hologram()[0]
    assert 1e-3 < (field - other).norm() / field.norm() < 0.5


def test_what_does_not_fit_into_memory_is_refused(capsys):
    words = ["check", str(CONFIGS / "bonsai.yaml"), *TINY[:1], "hologram.shape=[16384,16384]", "hologram.rays=16384"]
    assert main(words) == 2
    assert "use a smaller grid" in capsys.readouterr().err


def test_light_beside_the_rays_is_said(tmp_path):
    """A bar twice as wide as the rays: half of it is cut off."""
    np.save(tmp_path / "bar.npy", np.full((8, 8, 32), 200, np.uint8))
    source = f"volume={{path: {tmp_path / 'bar.npy'}, spacing: 1, unit: relative}}"
    wide = build(settings(source, "view={width: 0.48 mm}"))  # the rays cover 0.239 mm
    (note,) = (note for note in plan_values(wide)["notes"] if "beside the rays" in note)
    assert float(note.split(" %")[0]) == pytest.approx(50, abs=2)
    assert not any("beside" in note for note in plan_values(build(settings(source)))["notes"])


def test_a_scene_within_the_depth_of_focus_is_noted():
    """The rays' pitch of 7.48 um limits the sine to 0.0304 for 455 nm: a depth of focus of 0.49 mm."""
    shallow = settings("hologram.depths=[2.9 mm, 3.1 mm]", "wavelengths=[636 nm, 520 nm, 455 nm]")
    (note,) = (note for note in plan_values(build(shallow))["warnings"] if "depth of focus" in note)
    assert note.startswith("the scene is 0.2 mm deep and the depth of focus 0.49") and "wider hologram" in note
    deep = settings("hologram.depths=[2 mm, 4 mm]")
    assert not any("depth of focus" in note for note in plan_values(build(deep))["warnings"])


@pytest.mark.parametrize("name", ["tooth", "c60", "teapot", "engine", "hand", "bonsai"])
def test_joined_planes_are_as_dark_as_all_of_them(name, monkeypatch):
    """The joined slabs keep their opacity per metre; with all of it in one slab the picture would be another."""
    config = load_config(CONFIGS / f"{name}.yaml", ["volume={phantom: shells, samples: 24}", "hologram.depths=192"])
    pictures, warnings = [], []
    for most in (1000, 64):
        monkeypatch.setattr(volume_experiment, "_QUICK_PLANES", most)
        experiment = build(config)
        pictures.append(experiment.quick_rendering(64, lit=False))
        warnings.append(dark_picture(experiment))
    assert warnings[0] == warnings[1]
    assert (pictures[0] - pictures[1]).norm() < 0.05 * pictures[0].norm()  # slabs of up to half a voxel
    monkeypatch.setattr(volume_experiment, "_QUICK_PLANES", 3)
    assert (build(config).quick_rendering(64, lit=False) - pictures[0]).norm() > 0.1 * pictures[0].norm()


def test_depths_of_very_many_planes_follow_from_those_of_fewer(monkeypatch):
    """A plan with 65,536 planes took half a minute, most of it for this map (a find of fuzzing)."""
    scene = build(settings("hologram.depths=600", "transfer.unit_distance=0.02"))
    every = scene.sampler().depth_map(scene.volume).cpu()
    assert scene.depth_map().equal(every)
    monkeypatch.setattr(volume_experiment, "_QUICK_PLANES", 100)
    planes, exact = [], DVRSampler.depth_map

    def counted(sampler, volume):
        planes.append(len(sampler.depths))
        return exact(sampler, volume)

    monkeypatch.setattr(DVRSampler, "depth_map", counted)
    fewer = scene.depth_map()
    assert planes == [100]
    slab = (max(scene.depths) - min(scene.depths)) / 100
    both = (every > 0) & (fewer > 0)
    assert both.sum() > 0.99 * (every > 0).sum() and (fewer - every)[both].abs().max() < slab


def test_few_planes_show_the_whole_volume_and_not_slices_of_it():
    """Against two hundred samples for each of four planes; with one, as in the thesis, the rendering is 20 % off."""
    words = "volume={phantom: shells, samples: 48}", "hologram.depths=4"
    wanted = build(settings(*words, "view.samples=200")).rendering()[0]
    errors = {}
    for given in ("1", "null"):
        experiment = build(settings(*words, f"view.samples={given}"))
        plan = plan_values(experiment)
        errors[given] = float((experiment.rendering()[0] - wanted).norm() / wanted.norm())
        assert plan["slab_error"] == pytest.approx(errors[given], rel=0.5, abs=0.01)
        assert any("without view.samples" in note for note in plan["notes"]) == (given == "1")
        assert f"{plan['samples']} sample(s) of the volume for each" in plan_text(experiment, plan)
        light = torch.stack([plane.abs().square() for plane in experiment.layers().amplitudes()]).sum(0)[:3]
        torch.testing.assert_close(light, experiment.rendering()[0], rtol=1e-4, atol=1e-5)
    assert errors["1"] > 0.2 and errors["null"] < 0.06


@pytest.mark.parametrize(
    ("points", "view", "noted"),
    [
        ("[[10, 1, 1, 1, 0], [15, 1, 1, 1, 0.9], [255, 1, 1, 1, 0.9]]", "{}", True),
        ("[[10, 1, 1, 1, 0], [15, 1, 1, 1, 0.9], [255, 1, 1, 1, 0.9]]", "{lighting: true}", False),
        ("[[10, 1, 1, 1, 0], [255, 1, 1, 1, 0.9]]", "{}", False),
        ("[[10, 1, 1, 1, 0.9], [255, 1, 1, 1, 0]]", "{}", False),
    ],
    ids=["a steep step", "lit", "a slow rise", "clear above only"],
)
def test_opaque_surfaces_that_nothing_shades_are_noted(points, view, noted):
    plan = plan_values(build(settings(f"transfer={{points: {points}}}", f"view={view}")))
    assert any("opaque surfaces" in note for note in plan["notes"]) == noted


def test_a_focus_typed_as_the_plan_prints_it_is_answered_with_the_number_to_type():
    warnings = plan_values(build(settings("scale=2", "report.refocus=[1.5 mm]")))["warnings"]
    (warning,) = [each for each in warnings if each.startswith("report.refocus")]
    assert "report.refocus: 0.75 mm (divided by the scale, 2)" in warning
    assert warning.endswith("for 1.5 mm of this plan give 3 mm")


def test_other_samples_do_not_continue_a_run(tmp_path, monkeypatch):
    words = "report.seeds=2", "hologram.depths=4"
    with monkeypatch.context() as patch:
        press_in(patch, 1)
        assert not execute(settings(*words), tmp_path / "a", "a")[1]
    with pytest.raises(ConfigError, match="another configuration: view.samples"):
        execute(settings(*words, "view.samples=1"), tmp_path / "a", "a")
    config = tmp_path / "a" / "config.yaml"
    config.write_text(config.read_text().replace("samples: null", "samples: 1"))
    with pytest.raises(ConfigError, match="samples"):
        execute(load_config(config), tmp_path / "a", "a")


def test_a_check_of_many_planes_renders_few(monkeypatch, capsys):
    counts, picture = [], March.picture
    monkeypatch.setattr(March, "picture", lambda march, *wanted: counts.append(len(march.spans)) or picture(march))
    words = [*TINY, "hologram.shape=[64, 64]", "hologram.depths=65535"]
    assert main(["check", str(CONFIGS / "tooth.yaml"), *words]) == 0
    assert "65535 planes from" in capsys.readouterr().out
    assert 1000 in counts and sum(counts) < 6000


def test_cells_around_rays_do_not_wrap():
    """Rays on every fourth pixel: cells reach two pixels to either side, at the edges as far as there are any."""
    picture = torch.zeros(8, 12, dtype=torch.float64)
    picture[-1] = picture[:, -1] = 5.0
    picture[1, 1], picture[3, 6] = 4.0, 16.0
    cells = pooled(picture, 4)
    assert cells.shape == (2, 3)
    assert cells[0, 0] == 1.0  # 4 in 2 x 2 pixels, none of the far edges
    assert cells[1, 1] == 0.0 and cells[1, 2] == 1.0  # rows 2..5, columns 2..5 and 6..9
    assert torch.equal(pooled(picture, 1), picture)
    assert torch.allclose(pooled(torch.ones(8, 12), 4), torch.ones(2, 3))
