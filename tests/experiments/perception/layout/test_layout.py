"""The layout's run, the weighted correction and its zones, and the commands that lead to them."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from paths import CONFIGS
from PIL import Image
from skimage.metrics import structural_similarity

from holotorch.cli import _parser, main
from holotorch.correction import PECProblem
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.pec.experiment import build
from holotorch.experiments.pec.weight import weight_map, zone_scores
from holotorch.experiments.perception.layout import run as perception_layout
from holotorch.experiments.registry import load_config

LAYOUT, PEC = CONFIGS / "perception" / "layout.yaml", CONFIGS / "pec" / "peripheral.yaml"
TINY = ["grid.shape=[16,32]", "solver.max_steps=3"]


def read(folder: Path):
    return json.loads((folder / "summary.json").read_text())


def test_one_command_draws_the_layout(tmp_path, capsys):
    assert main(["run", str(LAYOUT), "--out", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "a" / "report.html")
    with open(tmp_path / "a" / "layout.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    summary = read(tmp_path / "a")
    assert len(rows) == len(summary["items"]) == 33 and summary["status"] == "complete"
    first = {(row["azimuth_deg"], row["label"]): row for row in rows[:11]}
    # 0.47 * 70 - 11.04; the pond at 80 deg keeps 5 deg and says why.
    assert float(first["70.0", "wheel"]["size_deg"]) == pytest.approx(21.86) and first["70.0", "wheel"]["note"] == ""
    assert float(first["-80.0", "pond"]["size_deg"]) == 5
    assert first["-80.0", "pond"]["note"] == "not scaled: beyond 70 deg it would need extrapolation"
    assert first["10.0", "first aid"]["note"] == "not scaled: nearer than 40 deg"
    assert [target["overlaps"] for target in summary["targets"].values()] == [[], [], []]
    page = (tmp_path / "a" / "report.html").read_text()
    assert page.count("data:image/png") == 1 and "Pinlight" in page
    # The tiled display shows 75 deg to each side: E + (0.47 E - 11.04) / 2 = 75 at 65.2 deg.
    with open(tmp_path / "a" / "displays.csv", newline="") as stream:
        assert list(csv.DictReader(stream))[6]["5 deg at 10 deg"] == "to 65 deg"


def test_extrapolation_and_small_lines_are_flagged(capsys):
    assert main(["check", str(LAYOUT), "extrapolate=true"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (
        "1 extrapolated, 1 of a size that was not tested, no icons overlap, none cut by the edge" in lines[0]
        and "to 26.6 deg" in lines[0]
    )
    assert main(["check", str(LAYOUT), "items=[{icon: boat, azimuth_deg: 10}]"]) == 0
    words = "Perceived as soon as 5 deg at 10 deg: 0 icons scaled by Table 2.2, 1 with the size of the target, no icons"
    assert words in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"targets\.0: Table 2\.2 has no target of 7"):
        perception_layout.build_layouts(load_config(LAYOUT, ["targets=[{size_deg: 7, eccentricity_deg: 10}]"]))
    with pytest.raises(ConfigError, match=r"items\.0\.azimuth_deg.*180"):
        load_config(LAYOUT, ["items=[{icon: boat, azimuth_deg: 200}]"])


def test_icons_at_the_edge_of_the_field_are_reported(tmp_path, capsys):
    # The tent of 5 deg at 27.5 deg ends exactly at the edge of the field; the boat at 65 deg is scaled to
    # 0.47 * 65 - 11.04 = 19.51 deg and extends to 74.755 deg, beyond 74.75 deg.
    assert main(["run", str(LAYOUT), "field_deg=[60, 149.5]", "items=[{icon: boat, azimuth_deg: 65}, "
                 "{icon: first_aid, azimuth_deg: 20, elevation_deg: 28}, {icon: tent, azimuth_deg: -20, "
                 "elevation_deg: 27.5}]", "--out", str(tmp_path / "a")]) == 0  # fmt: skip
    assert "2 cut by the edge of the field (boat, first aid)" in capsys.readouterr().out
    summary = read(tmp_path / "a")
    assert summary["targets"]["5 deg at 10 deg"]["cut"] == [0, 1]
    notes = [row["note"] for row in summary["items"][:3]]
    assert notes[0] == "cut by the edge of the field" and "cut" not in notes[2]
    assert "cut by the edge of the field" in (tmp_path / "a" / "report.html").read_text()


def test_own_icons_are_drawn_in_their_place_and_size(tmp_path, monkeypatch):
    picture = np.zeros((20, 40, 3), np.uint8)
    picture[:, :20], picture[:, 20:] = (255, 0, 0), (0, 0, 255)
    Image.fromarray(picture).save(tmp_path / "my_sign.png")
    drawn = []
    figure_png = perception_layout.figure_png
    monkeypatch.setattr(perception_layout, "figure_png", lambda figure: [drawn.append(figure), figure_png(figure)][1])
    items = f"items=[{{icon: {tmp_path / 'my_sign.png'}, azimuth_deg: 60}}, {{icon: boat, azimuth_deg: -20}}]"
    assert main(["run", str(LAYOUT), items, "--out", str(tmp_path / "a")]) == 0
    axes = drawn[0].axes[0]
    (image,) = axes.images
    size = 0.47 * 60 - 11.04  # the longer side has the size of the icon
    assert image.get_extent() == pytest.approx([60 - size / 2, 60 + size / 2, -size / 4, size / 4])
    assert [list(pixel) for pixel in image.get_array()[0, [0, -1]]] == [[1, 0, 0], [0, 0, 1]]
    assert axes.get_xlim() == (-95, 95) and "my sign\n17.2 deg" in [text.get_text() for text in axes.texts]


def test_an_icon_that_is_none_is_said(tmp_path, capsys):
    assert main(["check", str(LAYOUT), "items=[{icon: coastr, azimuth_deg: 10}]"]) == 2
    error = capsys.readouterr().err
    assert "or a picture file (PNG, JPEG) that exists, got 'coastr'; did you mean 'coaster'?" in error
    (tmp_path / "text.png").write_text("no picture")
    assert main(["check", str(LAYOUT), f"items=[{{icon: {tmp_path / 'text.png'}, azimuth_deg: 10}}]"]) == 2
    assert "items.0.icon: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("display", "wanted"),
    [
        # 0.47 E - 11.04 is the size at E: E + size / 2 = 50 at 44.95 deg, where 12 pixels across 10.09 deg are needed.
        ("{field_deg: 100, arcmin: 3, name: mine}", "to 44 deg"),
        ("{field_deg: 100, arcmin: 60, name: mine}", "to 44 deg, too coarse"),
        ("{field_deg: 100, name: mine}", "to 44 deg, resolution unknown"),
        ("{field_deg: 60, arcmin: 3, name: mine}", "not at 40 deg"),
    ],
)
@pytest.mark.usefixtures("no_figures")
def test_an_own_display_is_checked_before_those_of_the_table(display, wanted, tmp_path):
    assert main(["run", str(LAYOUT), f"display={display}", "--out", str(tmp_path / "a")]) == 0
    with open(tmp_path / "a" / "displays.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert rows[0]["display"] == "mine" and rows[0]["5 deg at 10 deg"] == wanted and len(rows) == 15
    assert "mine" in (tmp_path / "a" / "report.html").read_text()


@pytest.mark.parametrize("extrapolate", [False, True])
def test_the_legend_holds_what_is_drawn_and_items_have_their_names(extrapolate, monkeypatch, tmp_path):
    drawn = []

    def keep(figure):
        drawn.append(figure)
        return figure_png(figure)

    figure_png = perception_layout.figure_png
    monkeypatch.setattr(perception_layout, "figure_png", keep)
    main(["run", str(LAYOUT), f"extrapolate={str(extrapolate).lower()}", "--out", str(tmp_path / "a")])
    (figure,) = drawn
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert ("* extrapolated beyond 70 deg" in legend) == extrapolate
    assert all(axes.title.get_window_extent().y1 < figure.bbox.y1 for axes in figure.axes)
    assert legend[-1] == "40 and 70 deg: where the lines of Table 2.2 begin and end"
    words = [text.get_text() for text in figure.axes[0].texts]
    assert words[1] == "castle\n16.3 deg" and words[0] == ("pond\n26.6 deg *" if extrapolate else "pond\n5.0 deg")
    page = (tmp_path / "a" / "report.html").read_text()
    assert ("* extrapolated" in page) == extrapolate


def test_weight_leads_to_the_loss_that_it_says():
    experiment = build(load_config(PEC, TINY))
    peripheral = experiment.settings.target.weight
    assert peripheral is not None
    weight = weight_map(peripheral, (16, 32))
    phase = torch.rand(3, 16, 32, dtype=torch.float64)
    problem, plain = experiment.problem(torch.float64), experiment.unweighted.problem(torch.float64)
    formed = problem.intensity(phase)
    square = (formed - experiment.target).square()
    torch.testing.assert_close(problem(phase), (weight * square).sum((-2, -1)))
    assert torch.equal(plain(phase), square.sum((-2, -1)))
    assert plain.mask is None and isinstance(plain, PECProblem)
    # Weights of 1 everywhere are no weights.
    even = build(load_config(PEC, [*TINY, "target.weight.least=1"])).problem(torch.float64)
    torch.testing.assert_close(even(phase), plain(phase), rtol=1e-12, atol=0)
    # By hand at the two middle columns of the top row: 140 / 32 deg per pixel, half a pixel beside the gaze.
    step = 140 / 32
    assert weight[0, 15].item() == pytest.approx(weight[0, 16].item())
    ratio = ((1 + step * math.hypot(7.5, 15.5) / 10) / (1 + step * math.hypot(0.5, 0.5) / 10)) ** 2
    assert (weight[8, 16] / weight[0, 0]).item() == pytest.approx(ratio)
    looked = weight_map(load_config(PEC, [*TINY, "target.weight.gaze_deg=[0,50]"]).target.weight, (16, 32))
    assert divmod(int(looked.argmax()), 32)[1] == 27  # 50 deg: 11.4 px right of the middle, at 15.5


def test_zones_are_scored_by_their_own_pixels():
    settings = load_config(PEC, ["grid.shape=[48,96]"])
    generator = torch.Generator().manual_seed(5)
    image = torch.rand(3, 48, 96, generator=generator, dtype=torch.float64)
    noise = 0.05 * torch.rand(3, 48, 96, generator=generator, dtype=torch.float64)
    noise[:, :, 48:] = 0
    lit = torch.tensor([True, False, True])
    rows = zone_scores(settings.target.weight, (image + noise).clamp(0, 1), image, lit)
    assert [row["zone"] for row in rows] == ["central", "near", "middle", "far"]
    assert sum(row["pixels"] for row in rows) == 48 * 96
    assert sum(row["error"] for row in rows) == pytest.approx(1)
    y, x = torch.meshgrid(torch.arange(48) - 23.5, torch.arange(96) - 47.5, indexing="ij")
    near = torch.hypot(y, x) * 140 / 96
    near = (near >= 8) & (near < 30)
    both = [(image + noise).clamp(0, 1)[lit], image[lit]]
    error = (both[0] - both[1]).square()[:, near].mean().item()
    assert rows[1]["psnr"] == pytest.approx(-10 * math.log10(error))
    maps = [
        structural_similarity(
            a.numpy(), b.numpy(), data_range=1, gaussian_weights=True, use_sample_covariance=False, full=True
        )[1]
        for a, b in zip(*both, strict=True)
    ]
    wanted = sum(part[near.numpy()].mean() for part in maps) / 2
    assert rows[1]["ssim"] == pytest.approx(
        wanted, abs=1e-4
    )  # skimage's window is 11 px too, its tail differs a little
    for picture in (image, image.float()):
        perfect = zone_scores(settings.target.weight, picture, picture, lit)
        assert all(row["psnr"] is None and row["error"] == 0 for row in perfect)
        assert all(row["ssim"] == pytest.approx(1) for row in perfect)


def test_error_moves_from_the_middle_to_the_far_periphery(tmp_path, tiny):
    words = ["grid.shape=[32,64]", "solver.max_steps=80", "report.baselines=[unweighted]"]
    folder, complete = execute(load_config(PEC, words), tmp_path / "a")
    assert complete
    methods = read(folder)["methods"]
    weighted, alike = ({row["zone"]: row for row in methods[name]["zones"]} for name in ("corrected", "unweighted"))
    assert weighted["central"]["psnr"] > alike["central"]["psnr"] + 6
    assert weighted["near"]["psnr"] > alike["near"]["psnr"] + 1
    assert weighted["far"]["psnr"] < alike["far"]["psnr"] - 3
    assert weighted["far"]["error"] > 1.5 * alike["far"]["error"]
    page = (folder / "report.html").read_text()
    assert "By eccentricity" in page and "central, 0 to 8 deg" in page and "errors weighted equally" in page
    assert (folder / "images" / "weight.png").is_file()


def test_without_a_weight_nothing_is_said_of_zones():
    settings = load_config(CONFIGS / "pec" / "fourier.yaml", ["grid.shape=[16,16]"])
    experiment = build(settings)
    assert settings.target.weight is None and experiment.weights is experiment.mask is None
    for words, text in (
        (["report.baselines=[unweighted]"], "unweighted asks for a target.weight"),
        (["target.weight={kind: peripheral, field_deg: 90}", "target.region=[11,11]"], "no region beside a weight"),
        (["target.weight={kind: peripheral, field_deg: 400}"], "target.weight.field_deg"),
        (["target.weight={kind: peripheral, field_deg: 300}", "grid.shape=[32,16]"], "360 deg in height.*, got 600"),
    ):
        with pytest.raises(ConfigError, match=text):
            load_config(CONFIGS / "pec" / "fourier.yaml", ["grid.shape=[16,16]", *words])


def test_the_study_has_its_command():
    options = _parser().parse_args(["study", "a.yaml", "--port", "8123", "--participant", "7", "--out", "b"])
    assert (options.config, options.port, options.participant, options.out) == ("a.yaml", 8123, 7, Path("b"))
