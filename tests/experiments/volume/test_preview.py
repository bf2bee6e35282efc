"""A look at an own volume before any hologram: preview, presets from the histogram, and the same keys in eye runs."""

import json
import re

import numpy as np
import pytest
import torch
import yaml
from tiny_runs import EYE, VOLUME

from holotorch.cli import main
from holotorch.experiments.eye.run import scene_settings
from holotorch.experiments.registry import find_kind, load_config
from holotorch.experiments.volume import preview as figure_preview
from holotorch.experiments.volume.config import ViewSettings
from holotorch.io.images import load_image

TINY = ["configs/volume/tooth.yaml", VOLUME[2], "device=cpu"]


@pytest.fixture
def scan(tmp_path):
    """A ball of value 200 in air of about 20, and one hot voxel."""
    z, y, x = np.mgrid[:20, :20, :20] - 9.5
    values = np.where(z**2 + y**2 + x**2 < 36, 200, 20) + (np.arange(8000).reshape(20, 20, 20) % 3)
    values[0, 0, 0] = 255
    np.save(tmp_path / "ball.npy", values.astype(np.uint8))
    return f"{{path: {tmp_path / 'ball.npy'}, spacing: 1, unit: relative}}"


def test_a_preset_without_values_lies_between_air_and_the_brightest(scan, capsys):
    words = [*TINY, f"volume={scan}", "transfer={preset: bone}"]
    kind = find_kind("volume")
    experiment = kind.build(load_config(words[0], words[1:]))
    assert experiment.preset_range is not None
    low, high = experiment.preset_range
    assert 22 <= low < 200 and 200 <= high <= 203  # not the 255 of one voxel of 8000
    colour, opacity = experiment.transfer(torch.tensor([21.0, 201.0]))
    assert opacity[0] == 0 < opacity[1]
    assert main(["check", *words]) == 0
    said = capsys.readouterr().out
    assert "the preset bone lies between" in said
    assert main(["check", *words[:-1], "transfer={preset: bone, low: 3}"]) == 2
    assert "expected both low and high, or neither" in capsys.readouterr().err
    assert main(["check", *words[:-1], "transfer=bone", "transfer.low=30", "transfer.high=180"]) == 0
    assert "lies between" not in capsys.readouterr().out
    assert main(["check", *words[:-1], "transfer.preset=bone"]) == 2  # beside the points of the file
    assert "expected one of preset, file or points, got preset and points; 'transfer=" in capsys.readouterr().err


def plant(path, faint=0.15, noise=0.0):
    """A trunk of value 200 with a branch of value 60 in air of 0, as a volume of its own; noise is Gaussian."""
    values = np.zeros((20, 20, 20))
    values[8:12, 8:12, :], values[9:11, :, 9:11] = 200, np.where(np.arange(20) < 20 * faint, 60, 0)[:, None]
    values[8:12, 8:12, :] += np.arange(20) % 3  # so that there are more values than parts
    np.save(path, (values + noise * np.random.default_rng(5).standard_normal(values.shape)).astype(np.float32))
    return f"volume={{path: {path}, spacing: 1, unit: relative}}"


def build(*words):
    return find_kind("volume").build(load_config(TINY[0], [*TINY[1:], *words]))


def test_a_note_on_a_preset_proposes_a_range_that_shows_what_it_hides(tmp_path, capsys):
    words = [plant(tmp_path / "plant.npy", faint=1, noise=2.0), "transfer=soft_tissue"]
    experiment = build(*words)
    assert experiment.background is not None and 6 < experiment.background < 60  # 3 deviations of the noise
    assert main(["check", *TINY, *words]) == 0
    said = capsys.readouterr().out
    (proposed,) = re.findall(r"'(transfer=.*?)' shows them", said)
    assert "where the background ends; " in said
    air, branch = torch.tensor([6.0]), torch.tensor([60.0])
    shown = build(words[0], proposed).transfer
    assert experiment.transfer(branch)[1] == 0 < shown(branch)[1] and shown(air)[1] == 0
    assert main(["check", *TINY, words[0], proposed]) == 0 and "where the background" not in capsys.readouterr().out
    assert main(["check", *TINY, words[0], "transfer=bone"]) == 0  # which is to hide what is soft
    assert "where the background ends (in a patient, soft tissue)" in capsys.readouterr().out


@pytest.mark.parametrize("preset", ["bone", "soft_tissue", "skin", "vessels", "industrial"])
@pytest.mark.parametrize("high", [None, 150])
def test_a_preset_is_visible_from_the_value_that_is_asked_for(tmp_path, preset, high):
    volume = plant(tmp_path / "plant.npy")
    transfer = f"transfer={{preset: {preset}, visible_from: 70}}"
    experiment = build(volume, transfer, *[f"transfer.high={high}"] * (high is not None))
    end = high or 200  # the brightest are 200 to 202
    values = torch.tensor([60.0, 69.9, 70.0, 70.1, 100.0])
    assert (experiment.transfer(values)[1] > 0).tolist() == [False, False, False, True, True]
    assert experiment.transfer.positions[-1].item() == pytest.approx(end, abs=2)
    assert experiment.preset_range is None  # which the plan would say


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "preset: bone, visible_from: 70, low: 3",
            "transfer.visible_from: expected in place of the low of a preset, got",
        ),
        ("visible_from: 70, points: [[0, 1, 1, 1, 0], [1, 1, 1, 1, 1]]", "the low of a preset, got no preset"),
        ("preset: bone, visible_from: 70, high: 60", "expected less than transfer.high, 60, got 70"),
        ("preset: bone, visible_from: 700", "transfer.visible_from must be below 2"),
    ],
)
def test_mistakes_of_what_is_visible_are_said(tmp_path, capsys, words, message):
    assert main(["check", *TINY, plant(tmp_path / "plant.npy"), f"transfer={{{words}}}"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("noise", [0.5, 5.0, 20.0])
def test_noise_alone_is_no_faint_tissue(tmp_path, capsys, noise):
    words = [plant(tmp_path / "plant.npy", faint=0, noise=noise), "transfer=soft_tissue"]
    air = build(*words).background
    assert air is None or 4 * noise < air < 200 - 4 * noise  # above the noise, below what is there
    assert main(["check", *TINY, *words]) == 0
    assert "the preset soft_tissue lies" in (said := capsys.readouterr().out) and "shows them" not in said


@pytest.mark.parametrize("values", [(0, 100), (7, 7.5)])
def test_a_volume_of_two_values_has_no_background_of_three_parts(tmp_path, capsys, values):
    one, other = values
    np.save(tmp_path / "two.npy", np.where(np.arange(8000).reshape(20, 20, 20) < 400, other, one).astype(np.float32))
    words = [f"volume={{path: {tmp_path / 'two.npy'}, spacing: 1, unit: relative}}", "transfer=soft_tissue"]
    assert build(*words).background is None
    assert main(["check", *TINY, *words, "view={width: 0.1 mm}", "--preview", str(tmp_path / "look.png")]) == 0
    assert "percentiles (of the 5 % of voxels above the smallest value): " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("low", "high", "noted"), [(100, 255, False), (900, 1800, True), (20, 30, False), (20, 22, True), (-900, 40, True)]
)
def test_points_that_are_meant_for_another_scan_are_noted(scan, capsys, low, high, noted):
    transfer = f"transfer={{points: [[{low}, 1, 1, 1, 0], [{high}, 1, 1, 1, 0.5]]}}"
    assert main(["check", *TINY, f"volume={scan}", transfer]) == 0
    words = (
        f"the points of the transfer function lie between {low} and {high}, the values of this volume between 20 and"
    )
    assert (words in capsys.readouterr().out) is noted


def test_a_scan_of_which_nothing_is_visible_has_no_score(scan, tmp_path, capsys):
    words = [*TINY, f"volume={scan}", "transfer={preset: bone, low: 900, high: 1800}", "--out", str(tmp_path / "dark")]
    assert main(["run", *words]) == 0
    text = capsys.readouterr().out
    assert "Result     nothing of the volume is visible" in text
    assert "ssim_in_focus" not in json.loads((tmp_path / "dark" / "summary.json").read_text())


def test_a_preview_shows_the_volume_and_its_values(scan, tmp_path, capsys):
    words = [*TINY, f"volume={scan}", "transfer={preset: bone}", "view={width: 0.1 mm}"]
    picture = tmp_path / "look.png"
    assert main(["check", *words, "--preview", str(picture)]) == 0
    out = capsys.readouterr().out
    # 904 of 8000 voxels lie in the ball.
    assert (
        "Values     20 to 255; percentiles (of the 11 % of voxels above 22.29, where the background ends): 200" in out
    )
    assert "202 at 99 %" in out and "Visible    11 %" in out
    pixels = load_image(picture).movedim(0, -1).numpy() * 255
    left = pixels[:, : pixels.shape[1] // 3]
    black = (left.sum(-1) < 30).mean()
    assert 0.2 < black < 0.9  # the frame of the rendering is black around the ball, which is not
    assert main(["check", *words, "--preview", str(picture)]) == 2 and "is there already" in capsys.readouterr().err
    dark = [*words[:-2], "transfer={points: [[250, 1, 1, 1, 0], [254, 1, 1, 1, 0]]}"]
    assert main(["check", *dark, "--preview", str(tmp_path / "dark.png")]) == 0
    assert "the rendering is black" in capsys.readouterr().out
    assert main(["check", "configs/pec/fourier.yaml", "--preview", str(tmp_path / "no.png")]) == 2
    assert "has no preview" in capsys.readouterr().err and not (tmp_path / "no.png").exists()


def test_a_preview_shows_which_direction_of_a_scan_may_point_up(tmp_path):
    """A bar along -z, whose end is bright: only one of six small pictures has the bright end above the dark one."""
    values = np.zeros((20, 20, 20), np.uint8)
    values[2:18, 9:11, 9:11], values[2:6, 7:13, 7:13] = 100, 200
    np.save(tmp_path / "bar.npy", values)
    words = [*TINY, f"volume={{path: {tmp_path / 'bar.npy'}, spacing: 1, unit: relative}}"]
    words += ["transfer={points: [[50, 1, 1, 1, 0], [100, 1, 1, 1, 0.9]]}", "view={width: 0.1 mm}"]
    assert main(["check", *words, "--preview", str(tmp_path / "look.png")]) == 0
    pixels = load_image(tmp_path / "look.png").mean(0)
    row = pixels[int(0.75 * len(pixels)) :]  # below rendering and histogram
    leads = []
    for part in row.tensor_split(7, dim=1)[:6]:  # the last one is seen from behind
        rows = (part < 0.1).any(1).nonzero()
        black = part[rows.min() : rows.max() + 1]  # a picture without its title
        half = len(black) // 2
        columns = slice(black.shape[1] // 10, -black.shape[1] // 10)
        leads.append((black[:half, columns].sum() / black[half:, columns].sum()).item())
    order = ("-y", "y", "z", "-z", "x", "-x")
    assert leads[order.index("-z")] > 2 and leads[order.index("z")] < 0.5
    assert all(0.8 < leads[order.index(up)] < 1.25 for up in ("-y", "y"))  # a bar along the axis of sight


def test_the_preview_of_a_patient_also_shows_him_upright(tmp_path, monkeypatch):
    values = (np.arange(8000).reshape(20, 20, 20) % 251).astype(np.uint8)
    shown, real = [], figure_preview._show
    monkeypatch.setattr(figure_preview, "_show", lambda *words: (shown.append(words[-1]), real(*words)))
    for name, frame in (("patient", "space: left-posterior-superior\n"), ("thing", "")):
        directions = "space directions: (1,0,0) (0,1,0) (0,0,1)\n" if frame else "spacings: 1 1 1\n"
        header = f"NRRD0004\ntype: uint8\ndimension: 3\n{frame}sizes: 20 20 20\n{directions}encoding: raw\n\n"
        (tmp_path / f"{name}.nrrd").write_bytes(header.encode() + values.tobytes())
        words = [*TINY, f"volume={{path: {tmp_path / name}.nrrd}}", "transfer={preset: bone}", "view={width: 0.1 mm}"]
        assert main(["check", *words, "--preview", str(tmp_path / f"{name}.png")]) == 0
        directions = [title.removeprefix("view.up=").removesuffix(" (above)") for title in shown[1:]]
        ups = ["-y", "y", "z", "-z", "x", "-x"] + ["head"] * (name == "patient")
        assert directions == [*ups, "azimuth_deg=180"]
        shown.clear()


def test_an_eye_sees_an_own_volume_by_the_same_keys(scan, tmp_path, capsys):
    change = EYE[0].removeprefix("scene=")
    words = ["configs/eye/teapot.yaml", f"scene={change}", *EYE[1:], "seeds=1", "light={sources: [laser]}"]
    words += ["focus=[2 mm]", "tolerance=0.1", f"volume={scan}"]
    kind = find_kind("eye")
    own, shipped = (kind.build(load_config(words[0], words[1:n])) for n in (len(words), len(words) - 1))
    assert own.scene.volume.shape == (20, 20, 20) != shipped.scene.volume.shape
    assert own.scene.grid == shipped.scene.grid  # the scene's hologram is kept
    assert main(["check", *words, "transfer={preset: bone}", "--preview", str(tmp_path / "look.png")]) == 0
    text = capsys.readouterr().out
    assert (tmp_path / "look.png").is_file() and "the preset bone" in text
    assert "ball.npy, with view and hologram of configs/volume/c60.yaml and scene.change: " in text
    assert main(["run", *words, "transfer={preset: bone}", "--out", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["status"] == "complete"
    assert main(["check", *words, "volume={}"]) == 2
    assert "expected a path, a scene or a phantom" in capsys.readouterr().err


def test_an_eye_takes_view_and_scale_by_the_keys_of_a_volume(tmp_path):
    change = EYE[0].removeprefix("scene=")
    words = [f"scene={change}", *EYE[1:], "seeds=1", "light={sources: [laser]}", "focus=[1 mm]", "tolerance=0.1"]
    path = "configs/eye/teapot.yaml"
    scene = scene_settings(load_config(path, words))
    given = ["view.lighting=true", "view.azimuth_deg=20", "scale=2"]
    changed = scene_settings(settings := load_config(path, [*words, *given]))
    view = scene.view.model_copy(update={"lighting": True, "azimuth_deg": 20.0})
    assert changed == scene.model_copy(update={"view": view, "scale": 2})
    assert scene.view != ViewSettings()  # so that another key of its view is kept
    (tmp_path / "saved.yaml").write_text(yaml.safe_dump(settings.model_dump(mode="json")))
    assert scene_settings(load_config(tmp_path / "saved.yaml")) == changed
    assert (
        "; view.azimuth_deg=20.0, view.lighting=true, scale=2"
        in (kind := find_kind("eye")).plan(kind.build(settings)).text
    )


def test_the_percentiles_of_a_scan_that_is_mostly_empty_are_those_of_what_is_in_it(tmp_path, capsys):
    values = np.zeros((20, 20, 20), np.uint8)
    values[8:12, 8:12, 8:12] = 100 + np.arange(64).reshape(4, 4, 4)  # 0.8 % of all
    np.save(tmp_path / "vessel.npy", values)
    scan = f"{{path: {tmp_path / 'vessel.npy'}, spacing: 1, unit: relative}}"
    words = [*TINY, f"volume={scan}", "transfer={preset: vessels}", "view={width: 0.1 mm}"]
    assert main(["check", *words, "--preview", str(tmp_path / "look.png")]) == 0
    out = capsys.readouterr().out
    found = re.search(
        r"0 to 163; percentiles \(of the 0.8 % of voxels above (.*), where the background ends\): 100.63", out
    )
    assert found and 0 <= float(found[1]) < 100 and "131.5 at 50 %" in out


def test_a_picture_refocused_beside_the_scene_is_announced_with_the_scale(capsys):
    words = ["configs/volume/tooth.yaml", VOLUME[2], "device=cpu", "scale=4"]
    scene = find_kind("volume").build(load_config(words[0], words[1:])).depths
    inside, beside = sum(scene) / len(scene), 2 * max(scene)
    assert main(["check", *words, f"report.refocus=[{4 * inside}, {4 * beside}]"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    both = f"{1e3 * inside:.4g} mm, {1e3 * beside:.4g} mm"
    assert f"refocused at {both}, as report.refocus asks (divided by the scale, 4)" in out
    assert f"WARNING report.refocus: {1e3 * beside:.4g} mm (divided by the scale, 4) lies beside the scene" in out


@pytest.mark.parametrize("dtype", ["uint16", "uint32", "int16", "float32", "float64"])
@pytest.mark.parametrize("up", ["z", "-z", "y", "x", "-x"])
def test_a_scan_of_any_type_is_seen_from_all_sides(tmp_path, capsys, dtype, up):
    """torch neither flips nor compares some integers, and stands scans upright by reversing axes.

    Renderings of float64 are in double precision, those of other types in single precision.
    """
    z, y, x = np.mgrid[:20, :18, :16] - np.array([9.5, 8.5, 7.5])[:, None, None, None]
    values = np.where(z**2 + y**2 + (x / (1.5 + 0.05 * z)) ** 2 < 40, 20000 + 900 * y, 20 + x)
    np.save(tmp_path / "scan.npy", values.astype(dtype))
    np.save(tmp_path / "same.npy", values.astype(dtype).astype(np.float64))
    pictures = []
    for name in ("scan", "same"):
        source = f"volume={{path: {tmp_path / name}.npy, spacing: 1, unit: relative}}"
        experiment = find_kind("volume").build(
            load_config(TINY[0], [*TINY[1:], source, f"view.up={up}", "transfer=bone"])
        )
        pictures.append(experiment.quick_rendering(32))
    assert float(pictures[1].max()) > 0.05
    torch.testing.assert_close(pictures[0].double(), pictures[1].double(), rtol=0, atol=1e-6)
    source = f"volume={{path: {tmp_path / 'scan.npy'}, spacing: 1, unit: relative}}"
    for transfer, words in (
        ("{preset: bone, low: 60000, high: 70000}", "not below the largest value of the file"),
        ("{points: [[0, 1, 1, 1, 0], [255, 1, 1, 1, 0.5]]}", "are they meant for this file?"),
    ):
        assert main(["check", *TINY, source, f"view.up={up}", f"transfer={transfer}"]) == 0
        assert words in capsys.readouterr().out
