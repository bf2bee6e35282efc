"""The chart of trackers, and its parts, on a few small frames; the real one is run by hand and committed."""

import csv
import math
from functools import partial

import pytest
import torch

from holotorch.cli import main
from holotorch.experiments.tracking_benchmark import bench as tracking_bench
from holotorch.experiments.tracking_benchmark import chart as chart_tracking
from holotorch.experiments.tracking_benchmark import methods as tracking_methods
from holotorch.experiments.tracking_benchmark.bound import Bounds, tip_bounds
from holotorch.experiments.tracking_benchmark.chart import Amount
from holotorch.experiments.tracking_benchmark.methods import BASE, COLD, FEWER, LITERAL, PRIOR, Answer, before, methods
from holotorch.experiments.tracking_benchmark.timing import KORNIA
from holotorch.io.images import encode_png
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.detection.stations import StationPlan
from holotorch.tracking.pose.pose import solve_pose
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation.render import Look
from holotorch.tracking.simulation.varied import VariedWorld
from holotorch.tracking.simulation.world import World, aimed

TILT = math.radians(20)
# Each pose of ``STILL`` at rest, and one of them at another point.
AT_REST = (("tip", (520, 20)), ("tip", (520, 5)), ("middle of the bands", (520, 20)))
SMALL = Amount(2, 1, 1, 10, 1, varied=2, lookalikes=2, placed=1, resting=AT_REST, stream=2, repeats=1, share=0.04)


def small(**changes) -> World:
    """What the large frame's middle shows."""
    matrix = torch.tensor([[1400.0, 0, 224], [0, 1400, 144], [0, 0, 1]])
    camera = Camera(matrix, torch.tensor([-0.05, 0.02, 1e-3, -5e-4, 0.0]))
    return World((288, 448), camera, photographs=(torch.full((3, 40, 60), 90, dtype=torch.uint8),), **changes)


def test_a_small_chart_is_complete(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(chart_tracking, "scene", lambda _: small())
    monkeypatch.setattr(chart_tracking, "FULL", SMALL)
    monkeypatch.setattr(chart_tracking, "VariedWorld", partial(VariedWorld, size=(540, 960)))
    for module in (chart_tracking, tracking_bench):
        monkeypatch.setattr(module, "STILL", {(520, 20): 0.2, (520, 5): None})
    monkeypatch.setattr(tracking_bench, "tip_bounds", lambda *_: Bounds(1e-9 * torch.eye(3), 2e-9 * torch.eye(3)))
    assert main(["chart", "tracking", "--out", str(tmp_path)]) == 0
    names = [
        "codecs",
        "conditions",
        "grids",
        "lights",
        "negatives",
        "occlusions",
        "real_pixels",
        "reliability",
        "second_world",
        "slowest",
        "stages",
        "still",
        "times",
    ]
    files = {f"{name}.csv" for name in ["chart", *names]} | {"chart.png", "real_pixels.png", "verdict.txt"}
    assert {path.name for path in tmp_path.iterdir()} == files
    tables = {}
    for name in ["chart", *names]:
        with open(tmp_path / f"{name}.csv", newline="") as stream:
            tables[name] = list(csv.DictReader(stream))
    assert [row["method"] for row in tables["chart"]] == [BASE, COLD, PRIOR, FEWER, "dissertation"]
    assert tables["chart"][-1]["3D_acc_mm"] == "0.85" and tables["chart"][-1]["data"].startswith("real camera")
    assert {row["method"] for row in tables["times"]} == {BASE, LITERAL, COLD, PRIOR, FEWER, KORNIA}
    assert all(row["ratio"] == "1.0" for row in tables["times"] if row["method"] == BASE)
    # Of each kind a few frames, each with a status.
    assert all(sum(int(part.split()[1]) for part in row["status"].split(", ")) == 2 for row in tables["times"])
    for method in (BASE, KORNIA, COLD, PRIOR):
        shares = {row["stage"]: float(row["percent"]) for row in tables["stages"] if row["method"] == method}
        # Up to ten stages, each rounded to 0.01.
        assert shares.pop("Total") == 100 and sum(shares.values()) == pytest.approx(100, abs=0.1)
    assert sum(int(row["frames"]) for row in tables["negatives"]) == 20
    for row in tables["reliability"]:
        assert int(row["right"]) + int(row["wrong"]) + int(row["refused"]) == int(row["frames"])
    darker = [row for row in tables["lights"] if row["light"].endswith("of it")]
    assert len(tables["lights"]) == 5 and len(darker) == 2 and all(int(row["points"]) > 1 for row in darker)
    second = {(row["condition"], row["method"]): row for row in tables["second_world"]}
    assert {condition for condition, _ in second} == {
        "all conditions",
        "all without the catheter",
        *(world.trial(1000 + i).condition for world in [VariedWorld()] for i in range(2)),
        *(world.negative(1000 + i).condition for world in [VariedWorld()] for i in range(2)),
    }
    assert all(int(row["wrong"]) == 0 for row in second.values() if row["method"] != BASE)
    said = capsys.readouterr().out
    assert "mm (goal <= 0.2: " in said and "(dissertation, real camera: Acc 0.85)" in said
    text = (tmp_path / "verdict.txt").read_text().splitlines()
    assert all("synthetic" in line for line in text) and len(text) > 30


def test_rows_of_a_catheter_at_rest(monkeypatch):
    """A method whose error is known: 1 and 3 mm along x in turn, with 2 mm of deviation stated."""
    monkeypatch.setattr(tracking_bench, "STILL", {(520, 20): 0.05})
    monkeypatch.setattr(
        tracking_bench, "tip_bounds", lambda *_: Bounds(*(torch.diag(torch.tensor([v, 0, 0])) for v in (4e-8, 9e-8)))
    )
    turn = iter([1e-3, 3e-3] * 10)

    def known(_, case):
        pose = before(case, (next(turn), 0, 0), 0.0)
        return Pose(pose.tip, pose.direction, 4e-6 * torch.eye(6), pose.chi_square, pose.freedom, pose.status)

    world = small()
    (row, other), said = tracking_bench.still(world, {"known": known}, 10)
    # Two frames at each of five places: changes of 2 mm, deviation sqrt(2 (1 mm)^2 / 1).
    # Bias 2 mm; 1 and 3 mm are within 2.8 deviations of 2 mm.
    assert row["s_rms_mm"] == 2 and row["sd_mm"] == pytest.approx(math.sqrt(2), abs=1e-4) and row["bias_mm"] == 2
    assert row["efficiency"] == pytest.approx(0.04 / 2, abs=1e-3) and row["coverage"] == 1
    assert row["bound_mm"] == 0.2 and row["edges_bound_mm"] == 0.3 and row["s_rms_error_mm"] == 0
    assert [answer.right for answer in said] == [True] * 20
    # The same once more, with another point at the same distance.
    numbers = ("depth_mm", "tilt_deg", "frames", "s_rms_mm", "s_rms_goal_mm", "sd_mm")
    assert [row[key] for key in numbers] == [other[key] for key in numbers]
    for place, answer in zip((0.0, 0.127), (said[0], said[10]), strict=True):
        tip = torch.tensor(answer.truth, dtype=torch.float64)
        assert (tip + place * aimed(TILT))[2] == pytest.approx(0.52, abs=1e-12)
        assert (tip + 0.127 * aimed(TILT))[:2].abs().max() < 0.52 / 1400
    assert (row["point"], other["point"]) == ("tip", "middle of the bands")


def test_right_wrong_and_refused():
    world = small()
    case, none = world.still(0.52, TILT, 1)[0], world.case("nothing", None, answerable=False)
    near, far = before(case), before(case, (6e-3, 0, 0))
    cold = Pose.refused(Status.NO_AXIS, "none")
    told = [
        Answer.of("a", *pair, 0.0) for pair in ((case, near), (case, far), (case, cold), (none, near), (none, cold))
    ]
    assert [answer.right for answer in told] == [True, False, False, False, False]
    assert [answer.wrong for answer in told] == [False, True, False, True, False]
    assert before(none).status == Status.NO_CATHETER
    row = chart_tracking._share("conditions", "a", told[:3])
    assert row["refused_though_answerable"] == 1 and row["refused_though_answerable_percent"] == 33.33


def test_refusals_are_given_their_reason():
    world = small()

    def refuses(status):
        return {"a": lambda *_: Pose.refused(status, "so")}

    rows, _ = tracking_bench.scenes(world, refuses(Status.NO_CATHETER), 1, "conditions", 0.2)
    fits = {row["scene"]: row["reason_fits"] for row in rows}
    assert all((row["reason_fits"] == "") == row["answerable"] for row in rows)
    rows, _ = tracking_bench.scenes(world, refuses(Status.EDGES_UNCLEAR), 1, "occlusions", 0.3)
    fits |= {row["scene"]: row["reason_fits"] for row in rows}
    assert 0 in fits.values() and 1 in fits.values()


def test_photographs_come_from_a_folder_or_from_scikit_image(tmp_path):
    bundled = tracking_methods.photographs()
    assert len(bundled) == 3 and all(image.dtype == torch.uint8 and image.shape[0] == 3 for image in bundled)
    picture = torch.rand(3, 16, 20, dtype=torch.float64)
    (tmp_path / "grey.png").write_bytes(encode_png(picture[:1]))
    with pytest.raises(ValueError, match="must hold colour photographs"):
        tracking_methods.photographs(tmp_path)
    (tmp_path / "one.png").write_bytes(encode_png(picture))
    found = tracking_methods.photographs(tmp_path)
    assert len(found) == 1
    assert (found[-1] - 255 * picture).abs().max() <= 0.5 + 1e-6


def test_fewer_stations_are_fewer():
    world = small()
    case = world.still(0.52, TILT, 1)[0]
    some = methods(world, (COLD, FEWER))
    many, few = (track(case.frame(), case) for track in some.values())
    assert many.answered and few.answered and float((many.tip - few.tip).norm()) > 0
    assert StationPlan().most > tracking_methods.FEWER_STATIONS.most


def test_the_bounds_are_those_of_pixels_and_edges():
    """Along an edge's normal, noise and contrast of a known edge give its deviation; the pose's follows from four.

    An edge of contrast c (levels) over w rows, blurred to sigma, has sd = n sqrt(2 sigma sqrt(pi)) / (c sqrt(w)) in
    one channel. The bands differ by about 120 levels in two channels, are 5.4 px wide, and unknown blur does not
    matter to a place. Shading and the transparent tube beside the bands give and take something: the bound of edges
    must lie within a factor of 1.5 of that of four such ones.
    """
    world = small(look=Look(highlight=0.0))
    tip, direction = pose = world.pose(0.52, TILT)
    found, edges_only = tip_bounds(world, pose, 1)
    assert bool((torch.linalg.eigvalsh(found) > 0).all())
    sigma = math.sqrt(0.7**2 + 1 / 12)
    deviation = 2.5 * math.sqrt(2 * sigma * math.sqrt(math.pi)) / (120 * math.sqrt(2 * 5.4))
    edges = world.camera.project(tip + world.catheter.positions[:, None] * direction)
    stated = solve_pose(edges[None], world.catheter.positions, world.camera, along_px=deviation, across_px=deviation)
    assert 1 / 1.5 < float(edges_only.trace().sqrt() / stated.tip_sd) < 1.5
    louder, edges_louder = tip_bounds(small(look=Look(highlight=0.0, noise_dn=5.0)), pose, 1)
    # Twice the noise: 25.083 / 6.333 of the variance. Each bound comes from renderings with noise of its own: over
    # eight seeds it scatters by 3.5 %, so the ratio of two by 5 %; twice that.
    assert float(louder.trace() / found.trace()) == pytest.approx(25.083 / 6.333, rel=0.1)
    assert float(edges_louder.trace() / edges_only.trace()) == pytest.approx(25.083 / 6.333, rel=0.1)
    with pytest.raises(ValueError, match="within the frame"):
        tip_bounds(world, world.pose(0.3, 0.0))


def test_of_even_light_all_pixels_tell_what_the_edges_do():
    """Where light comes from all sides a tube is as bright at any slant; where it shines back from gloss, it is not.

    0.1 is twice what the renderings' noise leaves, as above.
    """
    even, glossy = small(look=Look(highlight=0.0, ambient=1.0)), small()
    pixels, edges = (bound.trace() for bound in tip_bounds(even, even.pose(0.52, math.radians(5)), 1))
    assert float(pixels / edges) == pytest.approx(1, abs=0.1)
    pixels, edges = (bound.trace() for bound in tip_bounds(glossy, glossy.pose(0.52, math.radians(5)), 1))
    assert float(edges) > 1.5 * float(pixels)
