"""Corrected pictures at two and at more than three wavelengths: targets, pictures, export, and what cannot be shown."""

import json

import numpy as np
import pytest
from paths import CONFIGS
from PIL import Image

from holotorch.cli import main
from holotorch.experiments.pec.experiment import build
from holotorch.experiments.registry import load_config
from holotorch.experiments.view.controls import checked
from holotorch.experiments.view.opening import open_viewer
from holotorch.io.colour_tables import picture_matrix

pytestmark = pytest.mark.usefixtures("undrawn")
SMALL = ["grid.shape=[24,20]", "target.image=coffee", "solver.max_steps=20", "report.baselines=[none]"]
SHARES = {
    "630nm,450nm": [[0.5, 0.5, 0], [0, 0.5, 0.5]],
    "450nm,630nm": [[0, 0.5, 0.5], [0.5, 0.5, 0]],
    "640nm,580nm,530nm,490nm,440nm": [[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]],
}


@pytest.mark.parametrize("config", ["fourier", "fresnel"])
@pytest.mark.parametrize("lengths", SHARES)
def test_each_wavelength_is_corrected_for_its_share_of_the_picture(lengths, config, tmp_path, capsys):
    path, run, shares = str(CONFIGS / "pec" / f"{config}.yaml"), tmp_path / "run", np.array(SHARES[lengths])
    assert main(["run", path, *SMALL, f"wavelengths=[{lengths}]", "--out", str(run)]) == 0
    assert "Colours    " in capsys.readouterr().out
    red_green_blue = build(load_config(path, SMALL)).image.numpy()
    target, intensity = (np.load(run / "arrays" / f"{name}.npy") for name in ("target", "intensity"))
    assert np.abs(target - np.einsum("kc,chw->khw", shares, red_green_blue)).max() < 1e-6
    methods = json.loads((run / "summary.json").read_text())["methods"]
    assert len(methods["corrected"]["ssim"]) == len(shares)
    assert methods["corrected"]["ssim_mean"] > methods["none"]["ssim_mean"] + 0.1
    # The pictures are mixed of all wavelengths. Two are in their own colours, which the gamut of sRGB holds.
    with Image.open(run / "images" / "corrected.png") as picture:
        drawn = np.asarray(picture.convert("RGB")).astype(float) / 255
    assert drawn.shape == (24, 20, 3) and np.ptp(drawn, -1).max() > 0.05
    if len(shares) == 2:
        matrix = picture_matrix([float(each.removesuffix("nm")) * 1e-9 for each in lengths.split(",")]).numpy()
        mixed = np.einsum("ck,khw->hwc", matrix, intensity).clip(0, 1)
        assert np.corrcoef(mixed.ravel(), drawn.ravel())[0, 1] > 0.95
    viewer = open_viewer(run)
    shown = viewer.show(checked(viewer.controls, {}), False, lambda: None)
    assert len(shown.pictures) == 2
    pitch = f"pitch={build(load_config(path, SMALL)).grid.pitch[0]}"
    panel = ["--slm", str(CONFIGS / "slm" / "lcos_1080p.yaml"), "shape=[24,20]", pitch]
    assert main(["export-slm", str(run), *panel]) == 0
    assert len(list((run / "slm").glob("frame-000_*.png"))) == len(shares)


@pytest.mark.parametrize(
    ("lengths", "message"),
    [
        ("1um,2um", "wavelength 1000 nm has no colour: the CIE 1931 table covers 360 to 830 nm"),
        ("630nm,640nm,650nm,660nm", "cannot be mixed to the white D65; take red, green and blue ones too"),
    ],
)
def test_wavelengths_that_no_picture_can_be_drawn_of_are_refused(lengths, message, capsys):
    path = str(CONFIGS / "pec" / "fourier.yaml")
    assert main(["check", path, *SMALL, f"wavelengths=[{lengths}]"]) == 2
    error = capsys.readouterr().err
    assert message in error and "1 or 3 wavelengths may have any length" in error
    assert main(["check", path, *SMALL, "wavelengths=[1um]"]) == 0
