"""The colours of a catheter from a photograph, and the forecast of how far away it can be found."""

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from holotorch.cli import main
from holotorch.experiments.tracking.devices import build_catheter, load_catheter, save_camera, save_catheter
from holotorch.experiments.tracking.forecast import range_text, working_range
from holotorch.tracking import Camera, Catheter, CatheterTracker, ChannelOrder
from holotorch.tracking.simulation.world import World, synthetic_camera

EDGES = (0.070, 0.108, 0.146, 0.184)
OTHER = Catheter(EDGES, ((225, 130, 30), (30, 160, 165), (150, 40, 160)), 1e-3, 0.35)  # orange, teal, purple
SIZE = (540, 960)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def photograph(world: World) -> list[tuple[int, int]]:
    """Write bands.png of a catheter, and return the pixels of the middles of its bands."""
    tip, along = world.pose(0.4, 0.2)
    frame = world.case("photograph", (tip, along)).frame()
    cv2.imwrite("bands.png", np.ascontiguousarray(frame.movedim(0, -1).numpy()[..., ::-1]))
    middles = (world.catheter.positions[:-1] + world.catheter.positions[1:]) / 2
    return [(round(x), round(y)) for x, y in world.camera.project(tip + middles[:, None] * along).tolist()]


def test_a_catheter_whose_colours_come_from_a_photograph_is_tracked(capsys):
    world = World(size=SIZE, catheter=OTHER)
    places = [f"{x},{y}" for x, y in photograph(world)]
    assert main(["calibrate", "catheter", "bands.png", "--bands", *places]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Band 1     [") and f"at {places[0]}" in lines[0] and lines[-1] == "catheter.yaml"
    assert "edges at 70, 108, 146, 184 mm" in lines[3] and "measure yours" in lines[3]
    tool = build_catheter(load_catheter("catheter.yaml"))
    assert (tool.edges, tool.radius, tool.length) == (EDGES, 1e-3, 0.35)
    tip, along = world.pose(0.45, -0.1, 1.0)
    frame = world.case("later", (tip, along)).frame()[None]
    pose = CatheterTracker(world.camera, tool, channels=ChannelOrder.RGB)(frame)[0]
    assert pose.answered and (pose.tip - tip).norm() < 2e-3
    ordinary = World(size=SIZE).catheter
    assert not CatheterTracker(world.camera, ordinary, channels=ChannelOrder.RGB)(frame)[0].answered


def test_the_order_of_channels_is_no_doubt_where_the_colours_come_from_the_same_frames(capsys):
    world = World(size=SIZE)  # red, green and blue: the same from the other end if red and blue are exchanged
    places = [f"{x},{y}" for x, y in photograph(world)]
    save_camera(Path("camera.yaml"), world.camera, SIZE)
    Path("film").mkdir()
    for name in ("film/0.png", "film-frame.png"):
        Path(name).write_bytes(Path("bands.png").read_bytes())
    doubt = "frames in the order BGR show this catheter in another pose"
    for source, doubtful in (("film", False), ("film-frame.png", False), ("bands.png", True)):
        own = f"{source}.yaml"
        assert main(["calibrate", "catheter", source, "--bands", *places, "--out", own]) == 0
        assert doubt in capsys.readouterr().out  # said once, of all frames that may be tracked with this file
        words = ["configs/tracking/track.yaml", "source=film", "camera=camera.yaml", "video=false"]
        assert main(["check", *words, f"catheter={own}"]) == 0
        assert (doubt in capsys.readouterr().out) is doubtful
    assert main(["check", *words, "catheter=configs/tracking/catheter.yaml"]) == 0
    assert doubt in capsys.readouterr().out
    # A recording keeps the name of its source, and the catheter's file beside it that of its colours.
    assert main(["run", *words, "catheter=film.yaml", "record=true", "--out", "run"]) == 0
    capsys.readouterr()
    assert main(["check", words[0], "source=run/recording"]) == 0 and doubt not in capsys.readouterr().out


def test_a_box_counts_its_median_and_keeps_the_geometry_of_a_file(capsys):
    picture = np.full((60, 90, 3), 128, np.uint8)
    for i, colour in enumerate(((200, 30, 40), (40, 180, 60), (50, 60, 255))):  # the third is overexposed
        picture[20:30, 30 * i : 30 * i + 20] = colour[::-1]
    picture[20:24, 0:10] = 0  # less than half of the first box
    cv2.imwrite("bands.png", picture)
    save_catheter(Path("own.yaml"), Catheter((0.02, 0.04, 0.05, 0.06), OTHER.colours, 8e-4, 0.2))
    words = ["--bands", "0,20,19,29", "40,25", "60,20,79,29", "--catheter", "own.yaml", "--out", "new/mine.yaml"]
    assert main(["calibrate", "catheter", "bands.png", *words]) == 0
    out = capsys.readouterr().out
    tool = build_catheter(load_catheter("new/mine.yaml"))
    assert tool.colours == ((200, 30, 40), (40, 180, 60), (50, 60, 255))
    assert tool.edges == (0.02, 0.04, 0.05, 0.06) and tool.radius == 8e-4
    assert "band 1 varies much within 0,20,19,29" in out and "band 2 varies" not in out
    assert "band 3 is overexposed" in out and "band 1 is overexposed" not in out
    shown = cv2.imread("new/mine-bands.png")
    assert shown is not None and shown.shape == (304, 732, 3)
    assert [tuple(shown[-10, x].tolist()[::-1]) for x in (122, 366, 610)] == [*tool.colours]
    assert main(["calibrate", "catheter", "bands.png", *words]) == 2
    assert "new/mine.yaml exists already" in capsys.readouterr().err


def test_a_position_on_a_thin_tube_gives_its_colour_and_not_that_of_its_surroundings(capsys):
    """A tube of three pixels with gloss, on a coloured background; the same positions with boxes take most of both."""
    colours, behind = ((200, 60, 40), (40, 160, 70), (50, 60, 190)), (90, 110, 150)
    picture = np.full((60, 90, 3), behind, np.uint8)
    for i, colour in enumerate(colours):
        picture[29:32, 30 * i : 30 * i + 30] = colour
    picture[29, ::2] = 245  # gloss
    cv2.imwrite("bands.png", np.ascontiguousarray(picture[..., ::-1]))
    assert main(["calibrate", "catheter", "bands.png", "--bands", "15,31", "45,30", "75,30"]) == 0
    assert build_catheter(load_catheter("catheter.yaml")).colours == colours
    out = capsys.readouterr().out
    assert "varies much" not in out and "look like a band" not in out
    boxes = ["13,28,17,34", "43,28,47,34", "73,28,77,34"]
    assert main(["calibrate", "catheter", "bands.png", "--out", "boxes.yaml", "--bands", *boxes]) == 2
    assert "found 13,28,17,34: [90, 110, 150]" in capsys.readouterr().err


def test_a_position_beside_a_band_is_noted(capsys):
    picture = np.full((60, 90, 3), 120, np.uint8)
    for i, colour in enumerate(((200, 60, 40), (40, 160, 70), (50, 60, 190))):
        picture[28:33, 30 * i : 30 * i + 30] = colour[::-1]
    picture[34, 44] = (80, 140, 60)  # one pixel of light that is neither
    cv2.imwrite("bands.png", picture)
    assert main(["calibrate", "catheter", "bands.png", "--bands", "15,30", "45,36", "75,30"]) == 0
    out = capsys.readouterr().out
    assert "band 2: only 1 of the pixels about 45,36 look like a band" in out and "band 1: only" not in out
    assert "catheter-bands.png" in out


@pytest.mark.parametrize(("offset", "expected"), [((0, 0), False), ((0, 1), False), ((3, 12), True), ((-3, -12), True)])
def test_a_position_on_the_cloth_beside_the_tube_is_noted(capsys, offset, expected):
    """The cloth's colour goes on to a side where a band's would end; here the cloth is saturated enough for a band."""
    world = World(size=SIZE, catheter=OTHER)
    places = photograph(world)
    picture = cv2.imread("bands.png")
    assert picture is not None
    grey = np.ptp(picture, -1) < 70
    picture[grey] = (picture[grey] * np.array([0.4, 1.1, 0.5])).clip(0, 255)  # a green cloth
    cv2.imwrite("bands.png", picture)
    clicked = [(x + dx, y + dy) for (x, y), (dx, dy) in zip(places, ((0, 0), offset, (0, 0)), strict=True)]
    assert main(["calibrate", "catheter", "bands.png", "--bands", *(f"{x},{y}" for x, y in clicked)]) == 0
    out = capsys.readouterr().out
    x, y = clicked[1]
    assert (f"band 2: the colour at {x},{y} continues for" in out) is expected
    assert "band 1: the colour" not in out and "band 3: the colour" not in out


def test_lengths_are_given_with_the_photograph(capsys):
    """Of more bands than the dissertation's catheter has; what is not given is kept, and said to be."""
    picture = np.full((60, 120, 3), 128, np.uint8)
    colours = ((200, 30, 40), (40, 180, 60), (50, 60, 200), (220, 170, 30))
    for i, colour in enumerate(colours):
        picture[20:30, 30 * i : 30 * i + 30] = colour[::-1]
    cv2.imwrite("bands.png", picture)
    words = ["--bands", "15,25", "45,25", "75,25", "105,25", "--edges", "20mm", "32", "mm", "5cm", "60mm", "71mm"]
    assert main(["calibrate", "catheter", "bands.png", *words]) == 2
    error = capsys.readouterr().err
    assert "4 bands have 5 edges: where each begins" in error and "got 6: 20mm, 32, mm, 5cm" in error
    words[words.index("32") : words.index("mm") + 1] = ["32mm"]
    assert main(["calibrate", "catheter", "bands.png", *words, "--radius", "0.8mm"]) == 0
    tool, out = build_catheter(load_catheter("catheter.yaml")), capsys.readouterr().out
    assert (tool.edges, tool.radius, tool.length) == ((0.02, 0.032, 0.05, 0.06, 0.071), 8e-4, 0.35)
    assert (
        tool.colours == colours and "; length of configs/tracking/catheter.yaml: measure yours and give --length" in out
    )
    words += ["--radius", "0.8mm", "--length", "0.4m", "--out", "whole.yaml"]
    assert main(["calibrate", "catheter", "bands.png", *words]) == 0
    assert build_catheter(load_catheter("whole.yaml")).length == 0.4 and "measure yours" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["bands.png"], "expected one photograph and --bands X,Y X,Y X,Y"),
        (["bands.png", "--bands", "1,1", "--axes", "RUB"], "without --board and --axes"),
        (
            ["bands.png", "--bands", "1,1", "2,2"],
            "--bands: expected 3 places, one for each band from the tip on, got 2",
        ),
        (["bands.png", "--bands", "1,1", "red", "2,2"], "expected X,Y or X0,Y0,X1,Y1 in pixels, got 'red'"),
        (
            ["bands.png", "--bands", "1,1", "40,1", "2,2"],
            "expected places on the picture of 40 x 30 px, X0,Y0 before X1,Y1, got '40,1'",
        ),
        (["bands.png", "--bands", "5,5", "9,9", "9,5"], "saturated colours"),
        (["none.png", "--bands", "5,5", "9,9", "9,5"], "none.png: no such picture"),
        (["none.mp4", "--bands", "5,5", "9,9", "9,5"], "none.mp4"),
        (["bands.png", "--bands", "5,5", "9,9", "9,5", "--catheter", "no.yaml"], "no.yaml"),
    ],
)
def test_what_cannot_be_used_is_said(words, message, capsys):
    picture = np.full((30, 40, 3), 128, np.uint8)
    picture[5, 5:10], picture[9, 9] = (120, 130, 190), (190, 120, 130)
    cv2.imwrite("bands.png", cv2.resize(picture[5:6, 5:6], (40, 30)) if "saturated" not in message else grey())
    assert main(["calibrate", "catheter", *words]) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error and not Path("catheter.yaml").exists()


def grey() -> np.ndarray:
    """A picture of three slightly coloured greys, which differ enough to be neighbours."""
    picture = np.full((30, 40, 3), 128, np.uint8)
    picture[:7, :7], picture[7:], picture[:7, 7:] = (60, 60, 70), (130, 130, 140), (190, 200, 200)
    return picture


def test_options_of_a_catheter_belong_to_it(capsys):
    assert main(["calibrate", "a.png", "--bands", "1,1"]) == 2
    assert "--radius and --length belong to: calibrate catheter PHOTOGRAPH" in capsys.readouterr().err


def test_without_positions_the_first_frame_of_a_video_is_saved(capsys):
    frames = np.random.default_rng(0).integers(0, 255, (2, 48, 64, 3), dtype=np.uint8)
    Path("video").mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(f"video/{i}.png", frame)
    assert main(["calibrate", "catheter", "video"]) == 0
    assert "video-frame.png, 64 x 48 px" in capsys.readouterr().out
    assert np.array_equal(np.asarray(cv2.imread("video-frame.png")), frames[0])
    lined = np.asarray(cv2.imread("video-frame-pixels.png"))
    assert lined.shape == (48 * 2 + 100, 64 * 2 + 100, 3)
    # Between the lines, the colours of the pixels are there, each two pixels wide.
    for y, x in ((7, 12), (22, 33), (41, 58)):
        assert np.abs(lined[50 + 2 * y, 50 + 2 * x].astype(int) - frames[0][y, x]).max() <= 2
    assert main(["calibrate", "catheter", "video"]) == 2
    assert "video-frame.png exists already" in capsys.readouterr().err
    assert main(["calibrate", "catheter", "none.mp4"]) == 2 and "none.mp4" in capsys.readouterr().err


TOOLS = {
    "thin": (0.038, 0.070, 0.6e-3, "the tube is narrower than 2.4 px"),
    "short bands": (0.006, 0.070, 1e-3, "the tip is less certain than 2 mm"),
    "far tip": (0.010, 0.200, 1e-3, "the tip is less certain than 2 mm"),
    "bands at the tip": (0.010, 0.010, 1e-3, "the shortest band has less than 22 px"),
}


def middle(world: World) -> Camera:
    """The camera of a world whose frames are cut to the middle ``SIZE`` pixels."""
    matrix = world.camera.matrix.clone()
    matrix[:2, 2] -= torch.tensor([(whole - part) / 2 for whole, part in zip(world.size, SIZE, strict=True)]).flip(0)
    return Camera(matrix, world.camera.distortion, world.camera.tone)


@pytest.mark.parametrize("name", TOOLS)
def test_the_forecast_distance_is_where_tracking_ends(name):
    """Three frames nearer than the forecast are all answered, and three much farther are not all answered."""
    band, first, radius, reason = TOOLS[name]
    tool = Catheter(tuple(first + band * i for i in range(4)), World().catheter.colours, radius, 0.35)
    world = World(SIZE, middle(World()), tool)
    distance, why = working_range(world.camera, tool)
    assert why == reason
    tracker = CatheterTracker(world.camera, tool, channels=ChannelOrder.RGB)

    def answered(depth: float) -> int:
        poses = [world.pose(depth, 0.0, 0.4 + 0.3 * k) for k in range(3)]
        return sum(tracker(world.case(f"{k}", pose).frame()[None])[0].answered for k, pose in enumerate(poses))

    assert answered(0.9 * distance) == 3
    assert answered(1.5 * distance) < 3


def test_the_plan_says_the_range_of_the_camera_and_catheter_that_are_given(capsys):
    save_camera(Path("c.yaml"), synthetic_camera((540, 960)), (540, 960))
    cv2.imwrite("0.png", np.zeros((540, 960, 3), np.uint8))
    files = ["camera=c.yaml", "catheter=configs/tracking/catheter.yaml"]
    for source in ("0.png", "synthetic"):
        words = ["check", "configs/tracking/track.yaml", f"source={'.' if source == '0.png' else source}", *files]
        with warnings.catch_warnings(action="ignore"):
            assert main(words) == 0
        (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Range")]
        # 700 px of focal length, 2 mm, 2.4 px; there the bands of 38 mm have 46 px.
        assert "up to about 0.58 m" in line and "38 mm, is 46 px long and the tube 2.4 px wide" in line
        assert line.endswith("beyond, the tube is narrower than 2.4 px")


def test_more_pixels_see_farther():
    tool = World().catheter
    near, far = (working_range(synthetic_camera(size), tool)[0] for size in ((540, 960), (1080, 1920)))
    assert far == pytest.approx(2 * near, rel=1e-9)
    text = range_text(synthetic_camera(), tool)
    assert text.startswith("Range      the bands may be up to about 1.2 m") and "as of most webcams" in text
    assert "half the resolution, as this file has, up to" in range_text(synthetic_camera(), tool, coarse_colours=True)
    assert torch.isfinite(torch.tensor(far))
