"""``holotorch calibrate`` and the files of tracking: written, read again, and wrong in many ways."""

import math

import cv2
import paths
import pytest
import torch
from oracles import boards as oracle

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking.calibrate import calibrate_photographs, calibration_text, parse_board
from holotorch.experiments.tracking.devices import (
    build_camera,
    build_catheter,
    build_headset,
    load_camera,
    load_catheter,
    load_headset,
    save_camera,
    save_catheter,
    save_headset,
)
from holotorch.io.video import PICTURES
from holotorch.tracking import THESIS, Camera
from holotorch.tracking.camera.boards import Charuco, Chessboard
from holotorch.tracking.camera.calibration import PARAMETERS, Calibration, Coverage
from holotorch.tracking.pose.alignment import headset_from_camera, tool_points

CONFIGS = paths.CONFIGS / "tracking"
SHARED = paths.SHARED / "calibration"
TAKEN = oracle.Camera([[430.0, 0, 205], [0, 434, 146], [0, 0, 1]], [-0.2, 0.08, 0.001, -0.0008, -0.01], (300, 400))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "photographs"
    folder.mkdir()
    printed, origin = oracle.charuco_print(8, 6, "DICT_4X4_50", 0.7)
    for i, (turned, at) in enumerate(oracle.handheld(8, (0.112, 0.084))):
        image = TAKEN.photograph(printed, origin, 0.028, turned, at, seed=i)
        cv2.imwrite(str(folder / f"{i}.png"), image)
    return folder


WORDS = ("charuco", "8x6", "28mm", "19.6mm", "DICT_4X4_50")


def test_photographs_become_a_camera_file(photographs, tmp_path):
    cv2.imwrite(str(tmp_path / "empty.png"), 128 * torch.ones(300, 400, dtype=torch.uint8).numpy())
    out = tmp_path / "new" / "camera.yaml"
    found, missing = calibrate_photographs([photographs, tmp_path / "empty.png"], out, WORDS)
    assert list(missing) == ["empty.png"] and "8 x 6 squares" in missing["empty.png"]
    settings = load_camera(out)
    assert settings.size == (300, 400) and settings.calibration is not None
    assert settings.calibration.deviations == found.deviations and settings.calibration.views == found.views
    again = build_camera(settings)
    assert torch.equal(again.matrix, found.camera.matrix) and torch.equal(again.distortion, found.camera.distortion)
    assert abs(settings.fx - 430) < 4 * found.deviations["fx"]
    text = calibration_text(found, missing, WORDS)
    for part in ("fx 4", " +- ", "400 x 300 px", "View       0.png: 0.", "Not used   empty.png", "Warning    Only 8"):
        assert part in text
    assert str(tmp_path) not in out.read_text()
    with pytest.raises(ConfigError, match="exists already"):
        calibrate_photographs([photographs], out, WORDS)


def test_bad_photographs_are_all_named(photographs, tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    cv2.imwrite(str(tmp_path / "small.png"), 128 * torch.ones(200, 400, dtype=torch.uint8).numpy())
    files = [photographs, tmp_path / "gone.png", tmp_path / "text.png", tmp_path / "small.png"]
    with pytest.raises(ConfigError) as caught:
        calibrate_photographs(files, tmp_path / "camera.yaml", WORDS)
    text = str(caught.value)
    assert (
        "gone.png: no such file or folder" in text
        and "astronaut" not in text
        and "text.png is not a readable picture" in text
    )
    assert "small.png: 400 x 200 px, the others have 400 x 300" in text
    assert not (tmp_path / "camera.yaml").exists()


@pytest.mark.parametrize(
    ("files", "words", "expected"),
    [
        ([], WORDS, "no photographs"),
        (["0.png", "0.png"], WORDS, "given twice"),
        (["0.png", "../photographs/0.png", "1.png"], WORDS, "photographs/0.png: given twice"),
        (["0.png"], ("chessboard", "9x6", "25mm"), r"got none\n0.png: no chessboard of 9 x 6 inner corners"),
    ],
)
def test_files_without_a_view_are_refused_with_the_reason(photographs, tmp_path, files, words, expected):
    with pytest.raises(ConfigError, match=expected):
        calibrate_photographs([photographs / name for name in files], tmp_path / "camera.yaml", words)


def chessboards(folder, shown=(9, 6), count=3):
    """Photographs of a chessboard of 140 mm that is wholly in each of them."""
    printed, origin = oracle.chessboard_print(*shown)
    square = 0.14 / (shown[0] - 1)
    centre = (0.07, square * (shown[1] - 1) / 2)
    for i, (turned, at) in enumerate(oracle.handheld(count, centre, tilt=0.5)):
        cv2.imwrite(str(folder / f"{i}.png"), TAKEN.photograph(printed, origin, square, turned, at, seed=i))


@pytest.mark.parametrize("shown", [(9, 6), (7, 5)])
def test_photographs_of_a_board_of_another_size_say_which(tmp_path, shown):
    chessboards(tmp_path, shown)
    with pytest.raises(ConfigError) as caught:
        calibrate_photographs([tmp_path], tmp_path / "camera.yaml", ("chessboard", "14x10", "20mm"))
    used, reason, advice = caught.value.mistakes
    assert used.startswith("used 0 of 3") and "no chessboard of 14 x 10 inner corners found" in reason
    size = f"{shown[0]} x {shown[1]}"
    assert advice.startswith(f"the photographs seem to show one of {size} inner corners: --board chessboard")
    assert f" {shown[0]}x{shown[1]} 20mm" in advice


def test_boards_that_differ_or_that_only_some_photographs_show_get_no_advice(tmp_path):
    for i, shown in enumerate([(9, 6), (7, 5)]):
        (tmp_path / f"{i}").mkdir()
        chessboards(tmp_path / f"{i}", shown, count=1)
    files = [tmp_path / "0", tmp_path / "1"]
    for words in (("chessboard", "14x10", "20mm"), WORDS):  # neither for a ChArUco board
        with pytest.raises(ConfigError) as caught:
            calibrate_photographs(files, tmp_path / "camera.yaml", words)
        assert "seem to show" not in str(caught.value)
    calibration, missing = calibrate_photographs(files, tmp_path / "camera.yaml", ("chessboard", "9x6", "20mm"))
    assert len(missing) == 1 and "seem to show" not in calibration_text(calibration, missing)


def test_folder_without_pictures_is_named(tmp_path):
    with pytest.raises(ConfigError, match="no pictures"):
        calibrate_photographs([tmp_path], tmp_path / "camera.yaml")


def test_few_photographs_make_a_camera_that_says_so(photographs, tmp_path):
    files = [photographs / f"{i}.png" for i in range(3)]
    found, _ = calibrate_photographs(files, tmp_path / "camera.yaml", WORDS)
    assert abs(found.camera.matrix[0, 0] - 430) < 3 * found.deviations["fx"]
    text = calibration_text(found, {}, WORDS)
    assert "views: 3" in text and "Warning    Too few views to check one another (3)" in text and "between" in text
    settings = load_camera(tmp_path / "camera.yaml")
    assert settings.calibration is not None and "too inaccurate for measurements" in settings.calibration.warnings[0]


def test_shared_charuco_alone_knows_the_focal_length_to_15_percent(tmp_path):
    if not SHARED.is_dir():
        pytest.skip("the shared photographs are not beside this checkout; few synthetic ones cover the same path")
    words = ("charuco", "5x7", "40mm", "20mm", "DICT_6X6_250")
    found, missing = calibrate_photographs([SHARED / "charuco_choriginal.jpg"], tmp_path / "camera.yaml", words)
    text = calibration_text(found, missing, words)
    assert "focal length is known to 15" in text and "views: 1" in text and "between" not in text
    assert abs(load_camera(tmp_path / "camera.yaml").fx - 452.5) < 2 * found.deviations["fx"]


def test_pictures_of_every_kind_are_looked_for_in_a_folder(tmp_path):
    for i, ending in enumerate(PICTURES):
        cv2.imwrite(str(tmp_path / f"{i}{ending}"), 128 * torch.ones(60, 80, dtype=torch.uint8).numpy())
    with pytest.raises(ConfigError, match="photographs that show the board") as caught:
        calibrate_photographs([tmp_path], tmp_path / "camera.yaml")
    used, reason = caught.value.mistakes
    assert used.startswith(f"used 0 of {len(PICTURES)} photographs: a calibration needs photographs")
    # One reason for all of them is said once.
    assert sorted(reason.split(": no chessboard")[0].split(", ")) == [f"{i}{end}" for i, end in enumerate(PICTURES)]


def test_photographs_of_one_reason_and_those_that_fit_badly_are_told_in_a_line():
    one = torch.eye(3, dtype=torch.float64)
    coverage = Coverage(1.0, 1.0, (0.1, 0.7), 0.7, (0.3, 0.6))
    deviations: dict[str, float] = {name: 0.1 for name in PARAMETERS}
    views = {"a.png": 0.16, "b.png": 0.2, "c.png": 0.19}
    found = Calibration(
        Camera(one, torch.zeros(5)), (300, 400), deviations, deviations, 0.18, views, {"d.png": 23.5}, coverage, ()
    )
    text = calibration_text(found, {"e.png": "no board", "f.png": "dark", "g.png": "no board"}).splitlines()
    assert "Used       3 of 7 photographs" in text
    assert "Left out   d.png: 23.50 px, the others 0.19 px (median): another camera or board, or blurred?" in text
    assert text[-2:] == ["Not used   e.png, g.png: no board", "Not used   f.png: dark"]


def test_boards_by_their_words():
    assert parse_board(["chessboard", "9x6", "25mm"]) == Chessboard(9, 6, 0.025)
    assert parse_board(["chessboard 9x6 25mm"]) == Chessboard(9, 6, 0.025)  # quoted
    assert parse_board(["charuco", "5x7", "40mm", "0.02", "DICT_6X6_250"]) == Charuco(5, 7, 0.04, 0.02, "DICT_6X6_250")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", "chessboard 9x6 25mm"),
        ("chess 9x6 25mm", "chessboard 9x6 25mm"),
        ("chessboard 9 25mm", "expected chessboard"),
        ("chessboard 9x6 25", "--board: 25 means metres: did you mean 25mm?"),
        ("chessboard 9x6 25m", "--board: 25m means metres: did you mean 25mm?"),
        ("charuco 5x7 40mm 20 DICT_6X6_250", "--board: 20 means metres: did you mean 20mm?"),
        ("chessboard 9x6 -25mm", "--board: square must be above zero in metres, got -0.025"),
        ("chessboard 9x6 25foot", "expected a length"),
        ("chessboard 9x6 25mm 3mm", "expected chessboard"),
        ("charuco 5x7 40mm 20mm", "DICT_6X6_250"),
        ("charuco 5x7 20mm 40mm DICT_6X6_250", "smaller than square"),
        ("charuco 5x7 40mm 20mm DICT_9X9", "must be one of"),
    ],
)
def test_bad_boards_are_named(words, expected):
    with pytest.raises(ConfigError, match=expected):
        parse_board(words.split())


def test_bundled_files_are_the_thesis_catheter_and_a_webcam():
    assert build_catheter(load_catheter(CONFIGS / "catheter.yaml")) == THESIS
    settings = load_camera(CONFIGS / "camera.yaml")
    assert settings.size == (1080, 1920) and build_camera(settings).matrix[0, 0] == 1400


def test_camera_with_a_tone_curve_comes_back(tmp_path):
    tone = torch.linspace(0, 1, 256, dtype=torch.float64) ** 2.2
    camera = Camera(torch.tensor([[800.0, 0, 320.25], [0, 801, 240], [0, 0, 1]]), 1e-5 * torch.arange(1.0, 6), tone)
    save_camera(tmp_path / "a.yaml", camera, (480, 640))
    again = build_camera(load_camera(tmp_path / "a.yaml"))
    assert isinstance(again.tone, torch.Tensor) and torch.equal(again.tone, tone)
    assert torch.equal(again.matrix, camera.matrix) and torch.equal(again.distortion, camera.distortion)


def test_catheter_comes_back(tmp_path):
    save_catheter(tmp_path / "a.yaml", THESIS)
    assert build_catheter(load_catheter(tmp_path / "a.yaml")) == THESIS
    assert load_catheter(tmp_path / "a.yaml", ["radius=1.5 mm"]).radius == 1.5e-3


def test_alignment_comes_back(tmp_path):
    tips = torch.tensor([[0.0, 0, 0.5], [0.1, 0, 0.4], [0, 0.1, 0.45]], dtype=torch.float64)
    camera = tool_points(tips, torch.tensor([[1.0, 0, 0], [1.0, 0, 0.01], [0, 1, 0]], dtype=torch.float64))
    turn = torch.tensor(oracle.rotation((0.3, -0.2, 0.5)))
    found = headset_from_camera(camera, camera @ turn.mT + torch.tensor([0.03, -0.08, 0.05]))
    assert found.leave_one_out[2] == math.inf
    save_headset(tmp_path / "a.yaml", found)
    settings = load_headset(tmp_path / "a.yaml")
    assert torch.equal(build_headset(settings), found.headset_from_camera)
    assert settings.alignments == 3 and settings.leave_one_out[2] is None


CAMERA = "fx: 800\nfy: 800\ncx: 320\ncy: 240\n"
CATHETER = "edges: [70 mm, 108 mm, 146 mm, 184 mm]\ncolours: [[200, 40, 45], [40, 150, 70], [40, 70, 190]]\n"


@pytest.mark.parametrize(
    ("load", "text", "expected"),
    [
        (load_camera, CAMERA + "tones: srgb\n", "a.yaml:5:1: tones: unknown setting; did you mean 'tone'?"),
        (load_camera, CAMERA.replace("fy: 800", "fy: -1"), "a.yaml:2:1: fy: expected greater than 0, got -1"),
        (load_camera, "fx: 800\nfy: 800\ncx: 320\n", "cy: required, but missing"),
        (load_camera, CAMERA + "tone: gamma\n", "a.yaml:5:1: tone: expected srgb, linear, or the light of"),
        (load_camera, CAMERA + "tone: [0, 0.5, 1]\n", "the light of the 256 levels"),
        (load_camera, CAMERA + "distortion: [0, 0]\n", "a.yaml:5:1: distortion: expected"),
        (load_camera, CAMERA + "distortion: [0, .nan, 0, 0, 0]\n", "a.yaml:5:17: distortion.1: expected a finite"),
        (
            load_catheter,
            CATHETER + "radius: 1\nlength: 0.4\n",
            "a.yaml:3:1: radius: expected a length within 10 um .. 50 mm",
        ),
        (load_catheter, CATHETER + "radius: 1 mm\nlength: 0.1\n", "a.yaml:4:1: length: must reach the last edge"),
        (load_catheter, CATHETER.replace("108", "60") + "radius: 1 mm\nlength: 0.4\n", "a.yaml:1:1: edges: must be"),
        (load_catheter, CATHETER.replace("200", "300") + "radius: 1 mm\nlength: 0.4\n", "a.yaml:2:12: colours.0.0: "),
        (
            load_catheter,
            CATHETER.replace("184 mm", "184 mm, 190 mm, 200 mm") + "radius: 1 mm\nlength: 0.4\n",
            "a.yaml:2:1: colours: must be one for each band: 6 edges bound 5 bands, got 3 colours; bands touch",
        ),
        (
            load_catheter,
            CATHETER.replace("[40, 150, 70]", "null") + "radius: 1 mm\nlength: 0.4\n",
            "colours.1: expected a colour (bands touch each other, so that N colours take N + 1 edges; an unc",
        ),
        (load_headset, "headset_from_camera: [[1, 0, 0, 0]]\n", "a.yaml:1:"),
        (
            load_headset,
            "headset_from_camera: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n",
            "a.yaml:1:1: headset_from_camera: must be a rotation",
        ),
        (load_camera, "", "empty"),
    ],
)
def test_mistakes_are_named_with_their_place(tmp_path, load, text, expected):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert expected in str(caught.value)
