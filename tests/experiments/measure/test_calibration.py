"""Band edges from rendered frames of a catheter whose bands are not where its file says."""

import csv
import math

import cv2
import numpy as np
import pytest
import torch
from simulated_hand import told, write

from holotorch.cli import main
from holotorch.experiments.tracking.devices import (
    build_catheter,
    load_camera,
    load_catheter,
    save_camera,
    save_catheter,
)
from holotorch.io.recording import Recorder
from holotorch.io.video import Frame
from holotorch.tracking import THESIS, Catheter
from holotorch.tracking.simulation.world import World, aimed

pytestmark = pytest.mark.usefixtures("undrawn")
TRUE = (0.0700, 0.1085, 0.1457, 0.1836)  # metres; the file says 70, 108, 146 and 184 mm
SIZE = (540, 960)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """12 frames of a catheter that is tilted about its resting tip."""
    folder = tmp_path_factory.mktemp("edges")
    world, shown = World(size=SIZE), Catheter(TRUE, THESIS.colours, THESIS.radius, THESIS.length)
    copies = {name: folder / name for name in ("camera.yaml", "catheter.yaml")}
    save_camera(copies["camera.yaml"], world.camera, SIZE)
    save_catheter(copies["catheter.yaml"], THESIS)
    tip = torch.tensor([-0.06, -0.03, 0.42], dtype=torch.float64)
    with Recorder(folder / "recording", SIZE, 30.0, "rendered", copies) as recorder:
        for i in range(12):
            along = aimed(math.radians(-28 + 56 * (i % 4) / 3), math.radians(15 + 15 * (i // 4)))
            recorder.write(Frame(i / 30, world.case(f"edges {i}", (tip, along), shown=shown).frame()))
    return folder / "recording"


def test_edges_of_a_catheter_that_the_tracker_refuses_are_measured(recording, tmp_path, capsys):
    """The tracker refuses a catheter whose bands are 0.5 mm off, and its edges are used all the same."""
    words = ["measure", "edges", str(recording), "--known", "0", "--resting", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    summary = told(tmp_path / "out")
    assert summary["answered"] == 0 and summary["frames_used"] == 12 and summary["rms_px"] < 0.1
    with open(tmp_path / "out" / "edges.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row, true in zip(rows, TRUE, strict=True):
        # Rendered edges are measured to 0.05 px here, of which the stated deviations are for 0.1 px.
        assert abs(float(row["measured_mm"]) - 1e3 * true) <= 2 * float(row["sd_mm"]) + 1e-9
        assert float(row["sd_mm"]) < 0.35
    # The lengths of the bands, in which the error of the scale is small.
    bands = [float(b["measured_mm"]) - float(a["measured_mm"]) for a, b in zip(rows, rows[1:], strict=False)]
    assert bands == pytest.approx([38.5, 37.2, 37.9], abs=0.1)
    corrected = build_catheter(load_catheter(tmp_path / "out" / "catheter.yaml"))
    assert [1e3 * edge for edge in corrected.edges] == pytest.approx([float(row["measured_mm"]) for row in rows])
    assert "0.1 px of the edges" in (tmp_path / "out" / "report.html").read_text()
    capsys.readouterr()
    again = ["measure", "still", str(recording), "--catheter", str(tmp_path / "out" / "catheter.yaml")]
    main([*again, "--out", str(tmp_path / "again")])
    # Between some frames the catheter moves by more than the 30 px in which the tracker looks for it.
    assert told(tmp_path / "again")["answered"] >= 9


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--known", "0"], "three independent distances"),
        (["--known", "0", "9", "--resting"], "known must hold edges 0 to 3"),
        (["--known", "first"], "argument --known: known.0: expected"),
        ([], "the protocol edges needs distances that are exact, such as 0 1-2"),
    ],
)
def test_mistakes_of_edges_are_said(words, message, recording, tmp_path, capsys):
    assert main(["measure", "edges", str(recording), *words, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out" / "summary.json").exists()


def test_poses_have_no_edges(tmp_path, capsys):
    path = write(tmp_path / "poses.csv", [(0, 0, 0.5)] * 5)
    assert main(["measure", "edges", str(path), "--known", "0", "--resting", "--out", str(tmp_path / "out")]) == 2
    assert "the edges are measured in the frames: expected a video" in capsys.readouterr().err


FILE = ["--camera", "c.yaml"]
EXPOSURES = ["1/1000", "1/500", "1/250", "1/125", "0.016", "0.032"]


def photographs(folder, gamma=1.8):
    """A scene of many shades at each exposure; the level of light L is 255 L^(1 / gamma)."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    scene = np.exp(rng.uniform(math.log(2e-3), math.log(20), (120, 160)))
    for i, seconds in enumerate((1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3)):
        light = np.clip(scene * seconds / 16e-3, 0, 1)
        level = np.round(255 * light ** (1 / gamma)).astype(np.uint8)
        cv2.imwrite(str(folder / f"photo{i + 8}.png"), np.repeat(level[..., None], 3, -1))  # photo8 before photo10
    return folder


def test_the_tone_of_a_camera_is_measured_and_the_rest_of_its_file_kept(tmp_path):
    folder, camera = photographs(tmp_path / "in"), tmp_path / "camera.yaml"
    camera.write_text("fx: 900\nfy: 901\ncx: 480\ncy: 270\nsize: [540, 960]\ndistortion: [0.1, 0, 0, 0, 0]\n")
    words = ["measure", "tone", str(folder), "--camera", str(camera), "--exposures", *EXPOSURES]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    found = load_camera(tmp_path / "out" / "camera.yaml")
    assert (found.fx, found.fy, found.size, found.distortion[0]) == (900, 901, (540, 960), 0.1)
    true = (np.arange(256) / 255) ** 1.8
    assert np.abs(np.array(found.tone) - true).max() < 0.01  # the light of level 255 is 1
    summary = told(tmp_path / "out")
    assert summary["exposures_s"] == pytest.approx([1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3])
    assert "measured tone curve" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["in", *FILE, "--exposures", "1/250", "1/125"],
            "expected one for each photograph, in the order of their names, got 2",
        ),
        (["in", "--exposures", *EXPOSURES], "argument --camera: camera: the protocol tone needs the camera's file"),
        (
            ["in", *FILE, "--exposures", *EXPOSURES[::-1]],
            "photograph 5 was exposed longer than photograph 6 and is darker",
        ),
        (["in", *FILE], "argument --exposures: exposures: the protocol tone needs the exposure time"),
        (["in", *FILE, "--exposures", "slow"], "argument --exposures: exposures.0: expected a number, got 'slow'"),
        (["nowhere", *FILE, "--exposures", "1/250"], "expected a folder of photographs, got nowhere"),
    ],
)
def test_mistakes_of_tone_are_said(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    photographs(tmp_path / "in")
    (tmp_path / "c.yaml").write_text("fx: 900\nfy: 900\ncx: 480\ncy: 270\n")
    assert main(["measure", "tone", *words]) == 2
    assert message in capsys.readouterr().err
