import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.simulation import scenery, trials
from holotorch.tracking.simulation.render import Look
from holotorch.tracking.simulation.world import Case, World, synthetic_camera

SIZE = (270, 480)
WORLD = World(SIZE)


def cases():
    return [
        *WORLD.still(0.52, 0.1, 2),
        *WORLD.grid_2d(),
        *itertools.chain(*WORLD.grid_3d().values()),
        *trials.occlusions(WORLD, 2),
        *trials.conditions(WORLD),
        *trials.negatives(WORLD, 30),
    ]


def truth(case: Case) -> tuple[Tensor, Tensor]:
    assert case.tip is not None and case.direction is not None
    return case.tip, case.direction


def edges_px(case: Case, world: World = WORLD) -> np.ndarray:
    tip, direction = truth(case)
    return np.asarray(world.camera.project(tip + THESIS.positions[:, None] * direction))


def test_the_camera_covers_its_frame():
    camera = synthetic_camera()
    assert camera.matrix.tolist() == [[1400, 0, 960], [0, 1400, 540], [0, 0, 1]]
    assert not camera.undistort(torch.tensor([[0.0, 0], [1919, 0], [0, 1079], [1919, 1079]])).isnan().any()
    point = torch.tensor([0.1, -0.05, 0.5])
    torch.testing.assert_close(synthetic_camera(SIZE).project(point), camera.project(point) / 4)


def test_frames_are_made_alike_each_time_and_names_are_unique():
    found = cases()
    assert len({case.name for case in found}) == len(found)
    some = [case for i, case in enumerate(found) if i % 23 == 0]
    for case in some:
        frame = case.frame()
        assert frame.dtype == torch.uint8 and frame.shape == (3, *SIZE) and torch.equal(frame, case.frame()), case.name
    again = {case.name: case for case in cases()}
    assert all(torch.equal(again[case.name].frame(), case.frame()) for case in some[:6])
    one, other = World(SIZE, seed=5).still(0.5, 0.2, 2)
    assert not torch.equal(one.frame(), other.frame())
    assert not torch.equal(one.frame(), WORLD.still(0.5, 0.2, 1)[0].frame())


def test_truth_is_complete_and_answerable_bands_are_in_view():
    for case in cases():
        assert (case.tip is None) == (case.direction is None) and case.why or case.answerable
        if case.tip is None:
            assert not case.answerable
            continue
        assert truth(case)[1].norm().item() == pytest.approx(1, abs=1e-12)
        inside = [all(2 < at < side - 3 for at, side in zip(edge, SIZE[::-1], strict=True)) for edge in edges_px(case)]
        # Two neighbouring bands with their edges at least.
        assert any(all(inside[i : i + 3]) for i in range(2)) or not case.answerable, case.name
        if "out of frame" not in case.name and case.name != "line of sight":
            assert all(inside), case.name


def test_still_is_where_it_says():
    for case in WORLD.still(0.45, math.radians(20), 3):
        tip, direction = truth(case)
        middle = tip + 0.127 * direction
        torch.testing.assert_close(middle, torch.tensor([0, 0, 0.45], dtype=torch.float64))
        assert math.degrees(math.asin(-direction[2])) == pytest.approx(20)
    for point, at in ((0.0, (0.0, 0.0)), (0.07, (0.05, -0.02))):
        (case,) = WORLD.still(0.45, math.radians(20), 1, at, point)
        tip, direction = truth(case)
        assert float((tip + point * direction)[2]) == pytest.approx(0.45, abs=1e-12)
        middle = tip + 0.127 * direction
        torch.testing.assert_close(middle[:2] / middle[2], torch.tensor(at, dtype=torch.float64))
    with pytest.raises(ValueError, match="depth"):
        WORLD.still(-1.0, 0.0, 1)
    with pytest.raises(ValueError, match="point"):
        WORLD.pose(0.45, 0.0, point=math.nan)
    with pytest.raises(ValueError, match="in front of the camera, got -0.02"):
        WORLD.pose(0.1, math.radians(75), point=0.0)


@pytest.mark.parametrize("codec", [{}, {"video": True}, {"jpeg_quality": 80}], ids=["none", "video", "jpeg"])
def test_frames_at_rest_are_those_that_are_rendered_one_by_one(codec):
    world = World(SIZE, look=Look(**codec))
    for case in world.still(0.5, 0.3, 3):
        assert torch.equal(case.frame(), world.case(case.name, truth(case)).frame())


def test_grids_have_the_thesis_s_measures():
    tips = torch.stack([truth(case)[0] for case in WORLD.grid_2d()]).reshape(9, 9, 3)
    assert tips[..., 2].std() == 0
    torch.testing.assert_close(tips[0, -1] - tips[0, 0], torch.tensor([0.0816, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(tips[-1, 0] - tips[0, 0], torch.tensor([0, 0.0816, 0], dtype=torch.float64))
    assert len({tuple(truth(case)[1].tolist()) for case in WORLD.grid_2d()}) == 1
    normals = []
    for face in WORLD.grid_3d().values():
        holes = torch.stack([truth(case)[0] for case in face]).reshape(8, 8, 3)
        down, right = holes.diff(dim=0), holes.diff(dim=1)
        assert all((step.norm(dim=-1) - 0.01).abs().max() < 1e-12 for step in (down, right))
        assert (down[:, :7] * right[:7]).sum(-1).abs().max() < 1e-15
        normal = torch.linalg.cross(down[0, 0], right[0, 0]) / 1e-4
        normal = normal * -torch.sign(normal @ holes[3, 3])  # towards the camera
        assert truth(face[0])[1] @ normal > 0.3  # the needle comes from outside
        assert holes[..., 2].min() > 0.49 and holes[..., 2].max() < 0.6
        normals.append(normal)
    torch.testing.assert_close(torch.stack(normals) @ torch.stack(normals).mT, torch.eye(3, dtype=torch.float64))


def test_occlusions_hide_what_they_say():
    """An edge that counts as seen looks as it does without the finger; one that counts as hidden does not."""
    world = World((540, 960), look=Look(noise_dn=0.0))
    found = {True: 0, False: 0}
    for case in trials.occlusions(world):
        open_ = world.case("open", truth(case)).frame().double()
        changed = (case.frame().double() - open_).abs().amax(0)
        px = edges_px(case, world).round().astype(int).tolist()
        # Tiles that begin elsewhere may round a level the other way.
        seen = [bool(changed[y - 1 : y + 2, x - 1 : x + 2].max() <= 1) for x, y in px]
        assert any(all(seen[i : i + 3]) for i in range(2)) == case.answerable, (case.name, seen)
        found[case.answerable] += 1
    assert found[True] >= 11 and found[False] >= 5


def stick(kind: str, rng: np.random.Generator) -> Catheter:
    found = trials._stick(THESIS, kind, rng)
    assert found is not None
    return found


def test_negatives_hold_no_right_catheter():
    world = World(SIZE, photographs=(torch.randint(0, 255, (3, 100, 160), dtype=torch.uint8),))
    found = trials.negatives(world, 40)
    kinds = {case.name.split(", ")[1] for case in found}
    assert kinds == set(trials._KINDS) and not any(case.answerable for case in found)
    rng = np.random.default_rng(1)
    lengths = np.diff(THESIS.edges)
    for _ in range(20):
        order = stick("wrong order", rng)
        assert order.colours not in (THESIS.colours, THESIS.colours[::-1]) and order.edges == THESIS.edges
        assert set(order.colours) == set(THESIS.colours)
        others = stick("other colours", rng)
        assert min(math.dist(a, b) for a in others.colours for b in THESIS.colours) > 80
        unequal = stick("unequal bands", rng)
        # No view makes one of the other: the cross-ratio of the four edges is what a camera keeps.
        a, b, c = np.diff(unequal.edges)
        assert abs((a + b) * (b + c) / (b * (a + b + c)) / (4 / 3) - 1) > 0.05
        thick = stick("thick", rng)
        assert thick.radius >= 3 * THESIS.radius and np.allclose(np.diff(thick.edges), lengths)
    for kind in ("bare", "papers", "hand"):
        assert trials._stick(THESIS, kind, rng) is None


def test_look_alikes_exist_for_another_catheter():
    four = Catheter((0.03, 0.05, 0.08, 0.1, 0.13), ((200, 0, 0), (0, 150, 0), (200, 0, 0), (0, 0, 200)), 1.5e-3, 0.3)
    world = World(SIZE, catheter=four)
    for case in (*trials.negatives(world, 10), *trials.occlusions(world)):
        assert case.frame().shape == (3, *SIZE)


def test_conditions_cover_the_list():
    world = World(SIZE, photographs=(torch.zeros(3, 50, 50, dtype=torch.uint8),))
    names = {case.name: case.answerable for case in trials.conditions(world)}
    for way, path in itertools.product(("along", "across"), (2, 5, 10, 20)):
        assert f"motion {way} {path} px" in names
    wanted = "plain|defocus 3 px|video 4:2:0|jpeg 90|jpeg 60|noise 12|gain 0.25|gain 1.8|highlight|tilt 45|tilt 60"
    wanted += (
        "|photograph 0|cloth as band 3|white glove behind|blue glove behind|heavy clutter|rear out of frame from band 3"
    )
    assert all(names[name] for name in wanted.split("|"))
    refused = "tilt 75|1200 mm away|line of sight|motion across 20 px|rear out of frame from band 2"
    assert not any(names[name] for name in refused.split("|"))


def test_blur_along_the_axis_leaves_its_sides_sharp():
    """The path follows the image of the axis: the tube's side profile hardly widens, across it does."""
    world = World((540, 960), look=Look(noise_dn=0.0))
    by_name = {case.name: case for case in trials.conditions(world)}
    plain = by_name["plain"].frame().double()
    along, across = ((by_name[f"motion {way} 5 px"].frame() - plain).abs().mean() for way in ("along", "across"))
    assert across > 3 * along


@pytest.mark.parametrize("make", [scenery.desk, scenery.drape, scenery.skin, scenery.texture])
def test_backgrounds_follow_their_seed(make):
    one, again, other = make((135, 241), 1), make((135, 241), 1), make((135, 241), 2)
    assert one.dtype == torch.uint8 and one.shape == (3, 135, 241)
    assert torch.equal(one, again) and not torch.equal(one, other)
    assert one.double().std() > 1  # not one colour


def test_papers_and_clutter_show_the_bands_colours():
    for make in (scenery.papers, scenery.clutter):
        image = make(SIZE, 3, THESIS.colours).double()
        for colour in THESIS.colours:
            distance = (image - torch.tensor(colour)[:, None, None]).square().sum(0).sqrt()
            assert (distance < 40).sum() > 20


def test_photographs_cover_the_frame():
    ramp = torch.arange(0, 240, 2, dtype=torch.uint8).expand(3, 40, 120).contiguous()
    image = scenery.photograph(ramp, SIZE, 4)
    assert image.shape == (3, *SIZE)
    steps = image[0, 0].int().diff()
    assert (steps >= 0).all() or (steps <= 0).all()  # scaled and cropped, not tiled
    assert image.max() - image.min() > 60
    with pytest.raises(ValueError, match="photograph"):
        scenery.photograph(torch.zeros(3, 10, 10), SIZE)
