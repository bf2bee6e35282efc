"""Holograms of volumes, and what an eye sees of them, at one, at two and at more than three wavelengths."""

import json

import numpy as np
import pytest
import torch
from paths import CONFIGS
from PIL import Image
from tiny_runs import RUNS

from holotorch.cli import main
from holotorch.experiments.view.controls import checked
from holotorch.experiments.view.opening import open_viewer
from holotorch.io.colour_tables import picture_matrix, srgb_matrix

pytestmark = pytest.mark.usefixtures("undrawn")
TINY = [
    "volume={phantom: shells, samples: 24}",
    "transfer={points: [[20, 1, 0.2, 0, 0], [120, 1, 0.6, 0.2, 0.3], [255, 0.2, 0.9, 1, 0.9]], unit_distance: 0.05}",
    "hologram={shape: [64, 64], pitch: 3.74 um, distance: 3 mm, depths: 12, rays: 32}",
    "device=cpu",
]
PINNED = "phase=constant", "view.samples=3"  # by default, the samples follow from the colours that are shown
SHARES = {
    "520 nm": [[1 / 3, 1 / 3, 1 / 3]],
    "636 nm, 455 nm": [[0.5, 0.5, 0], [0, 0.5, 0.5]],
    "455 nm, 636 nm": [[0, 0.5, 0.5], [0.5, 0.5, 0]],
    "640 nm, 580 nm, 530 nm, 490 nm, 440 nm": [[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]],
}


@pytest.fixture(scope="module")
def in_three(tmp_path_factory):
    out = tmp_path_factory.mktemp("volume") / "run"
    assert main(["run", str(CONFIGS / "volume" / "tooth.yaml"), *TINY, *PINNED, "--out", str(out)]) == 0
    return np.load(out / "arrays" / "rendering.npy")


@pytest.mark.parametrize("wavelengths", SHARES)
def test_each_wavelength_shows_its_share_of_the_colours(wavelengths, in_three, tmp_path, capsys):
    out, words = tmp_path / "run", [*TINY, *PINNED, f"wavelengths=[{wavelengths}]"]
    assert main(["run", str(CONFIGS / "volume" / "tooth.yaml"), *words, "--out", str(out)]) == 0
    assert "Colours    " in capsys.readouterr().out
    shares = np.array(SHARES[wavelengths])
    hologram, rendering = (np.load(out / "arrays" / f"{name}.npy") for name in ("hologram", "rendering"))
    assert hologram.shape == (len(shares), 64, 64)
    # Opacity does not depend on the colour, so that the light of a ray is linear in it.
    assert np.abs(rendering - np.einsum("ck,khw->chw", shares, in_three)).max() < 1e-5
    assert json.loads((out / "summary.json").read_text())["ssim_in_focus"] > 0
    with Image.open(out / "images" / "rendering.png") as picture:
        grey = np.asarray(picture.convert("RGB")).astype(int)
    assert (np.ptp(grey, -1).max() == 0) == (len(shares) == 1)
    viewer = open_viewer(out)
    with torch.no_grad():
        shown = viewer.show(checked(viewer.controls, {}), False, lambda: None)
    assert len(shown.pictures) == 2
    panel = [
        "--slm",
        str(CONFIGS / "slm" / "lcos_1080p.yaml"),
        "shape=64",
        "pitch=3.74 um",
        "--out",
        str(tmp_path / "slm"),
    ]
    assert main(["export-slm", str(out), *panel]) == 0
    assert len(list((tmp_path / "slm").glob("*.png"))) == len(shares)


@pytest.mark.parametrize("count", [4, 5, 9, 32])
def test_equal_light_of_many_wavelengths_is_grey_and_none_is_left_out(count):
    wavelengths = torch.linspace(650e-9, 440e-9, count, dtype=torch.float64).tolist()
    matrix = picture_matrix(wavelengths)
    torch.testing.assert_close(matrix.sum(1), torch.ones(3, dtype=torch.float64), atol=1e-3, rtol=0)
    shown = torch.tensor([matrix[:, 0].argmax(), matrix[:, -1].argmax()])
    assert shown.tolist() == [0, 2]  # the longest is reddest, the shortest bluest
    alone = torch.tensor([srgb_matrix([each]).norm() for each in wavelengths])
    assert (matrix.norm(dim=0) > 1e-3 * alone).all()


def test_wavelengths_that_cannot_show_white_or_are_given_twice_are_said(capsys):
    config = str(CONFIGS / "volume" / "tooth.yaml")
    assert main(["check", config, *TINY, "wavelengths=[600 nm, 610 nm, 620 nm, 630 nm]"]) == 2
    assert "600, 610, 620, 630 nm cannot be mixed to the white D65" in capsys.readouterr().err
    assert main(["check", config, *TINY, "wavelengths=[640 nm, 530 nm, 450 nm, 450 nm]"]) == 2
    assert "wavelengths: expected wavelengths that all differ" in capsys.readouterr().err
    many = ", ".join(f"{400 + 5 * k} nm" for k in range(33))
    assert main(["check", config, *TINY, f"wavelengths=[{many}]"]) == 2
    assert "wavelengths: expected 1 (grey) to 32, got 33" in capsys.readouterr().err


@pytest.mark.parametrize("wavelengths", ["636 nm, 455 nm", "640 nm, 580 nm, 530 nm, 490 nm, 440 nm"])
def test_a_hot_chip_shows_any_number_of_wavelengths(wavelengths, tmp_path):
    config, *words = RUNS["joint"]
    out, count = tmp_path / "run", len(SHARES[wavelengths])
    words += [f"wavelengths=[{wavelengths}]", "report.baselines=[]"]
    assert main(["run", str(CONFIGS / config), *words, "--out", str(out)]) == 0
    assert np.load(out / "arrays" / "phase.npy").shape == (3, count, 24, 20)
    assert np.load(out / "arrays" / "target.npy").shape[1] == count
    viewer = open_viewer(out)
    with torch.no_grad():
        shown = viewer.show(checked(viewer.controls, {}), False, lambda: None)
    assert len(shown.pictures) == 2


@pytest.mark.parametrize("wavelengths", ["520 nm", "636 nm, 455 nm", "640 nm, 580 nm, 530 nm, 490 nm, 440 nm"])
def test_an_eye_sees_few_wavelengths(wavelengths, tmp_path):
    change = "'volume={phantom: c60, samples: 24}', "
    change += "'hologram={shape: [64, 64], pitch: 3.74 um, distance: 12 mm, depths: 8, rays: 32}'"
    words = [f"scene={{config: configs/volume/c60.yaml, change: [{change}]}}", "seeds=1"]
    words += ["light={sources: [laser, sled]}", "focus=[12 mm]", "tolerance=0.3", f"wavelengths=[{wavelengths}]"]
    out = tmp_path / "run"
    assert main(["run", str(CONFIGS / "eye" / "teapot.yaml"), *words, "--out", str(out)]) == 0
    count = len(SHARES[wavelengths])
    assert np.load(out / "arrays" / "retina.npy").shape == (2, 1, count, 32, 32)
    summary = json.loads((out / "summary.json").read_text())
    assert all(len(row["contrast"]) == count for row in summary["rows"])
    viewer = open_viewer(out)
    with torch.no_grad():
        assert viewer.show(checked(viewer.controls, {}), True, lambda: None).pictures


def test_two_wavelengths_are_shown_in_their_own_colours_and_one_in_grey():
    red, blue = picture_matrix([636e-9, 455e-9]).T
    assert red.argmax() == 0 and blue.argmax() == 2 and min(red.min(), blue.min()) >= 0
    assert (picture_matrix([520e-9]) == 1).all()
    torch.testing.assert_close(
        picture_matrix([636e-9, 520e-9, 455e-9]).sum(1), torch.ones(3, dtype=torch.float64), atol=1e-3, rtol=0
    )
    with pytest.raises(ValueError, match="at least one wavelength"):
        picture_matrix([])
