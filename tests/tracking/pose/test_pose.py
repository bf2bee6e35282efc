import ast
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import tracking as oracle
from oracles.tracking import DIRECTION, EDGES, LENS, MATRIX, TIP, scenes

import holotorch.tracking
from holotorch.tracking import Camera, Pose, Status, closed_form, solve_pose

CAMERA = Camera(torch.tensor(MATRIX), torch.tensor(LENS))
RADIUS = 0.9e-3


def image(
    tip=TIP, direction=DIRECTION, positions=EDGES, offset: float | np.ndarray = 0.0, matrix=MATRIX, lens=LENS
) -> torch.Tensor:
    return torch.tensor(oracle.image(tip, direction, positions, matrix, lens, offset))


def off(found: torch.Tensor, wanted: np.ndarray) -> float:
    """Largest distance; NaN fails every comparison."""
    return float(np.linalg.norm(found.numpy() - wanted, axis=-1).max())


def codes(pose: Pose) -> tuple[Status, ...]:
    assert isinstance(pose.status, tuple)
    return pose.status


@pytest.mark.parametrize("edges", range(3, 13))
def test_20_000_random_poses(edges):
    """2000 each of 3 to 12 edges of any spacing, in all directions."""
    positions, tip, direction = scenes(2000, edges, np.random.default_rng(edges))
    pose = solve_pose(image(tip, direction, positions), torch.tensor(positions), CAMERA)
    assert set(codes(pose)) == {Status.OK if edges > 3 else Status.UNVERIFIED}
    assert off(pose.tip, tip) < 1e-9 and off(pose.direction, direction) < 1e-8
    assert pose.chi_square.max() < 1e-12 and pose.freedom.eq(2 * edges - 5).all()
    assert all(v.isfinite().all() for v in (pose.covariance, pose.tip_sd))
    # One tool before the camera, whatever the order its edges are given in.
    order = np.random.default_rng(0).permutation(edges)
    again = solve_pose(image(tip, direction, positions)[:200, order], torch.tensor(positions[order]), CAMERA)
    assert off(again.tip, tip[:200]) < 1e-9


@pytest.mark.parametrize("edges", [3, 4, 7])
def test_parallel_to_the_image_and_along_the_view(edges):
    rng = np.random.default_rng(3)
    azimuth = rng.uniform(-math.pi, math.pi, 400)
    for degrees in (0, 1e-8, 1e-4, -1e-8, 1, 89.9999, -90):
        angles = np.stack([azimuth, np.full(400, math.radians(degrees))], -1)
        positions, tip, direction = scenes(400, edges, rng, oracle.unit(angles))
        pose = solve_pose(image(tip, direction, positions), torch.tensor(positions), CAMERA)
        assert off(pose.tip, tip) < 1e-9, degrees
    # Near the ray through its own middle the image shrinks to a point, and with it what is known of the pose: at 0.1
    # degrees 114 mm show as 0.5 pixels, of which 1e-13 each are rounding. Depth is then the extent's second order.
    for degrees, tolerance in ((5, 1e-9), (1, 1e-9), (0.1, 1e-6)):
        positions = np.cumsum(np.full(edges, 0.038))
        view = np.array([0.1, -0.05, 1]) / np.linalg.norm([0.1, -0.05, 1])
        side = np.cross(view, rng.normal(size=(400, 3)))
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        direction = math.cos(math.radians(degrees)) * view + math.sin(math.radians(degrees)) * side
        tip = 0.8 * view - positions.mean() * direction
        pose = solve_pose(image(tip, direction, positions), torch.tensor(positions), CAMERA)
        assert off(pose.tip, tip) < tolerance, degrees


def test_no_second_pose_before_the_camera():
    """Descents of another method, from everywhere, end in the same pose or do not explain the edges."""
    rng, explained, weakest = np.random.default_rng(4), 0, []
    for trial in range(4):
        positions, tips, directions = scenes(1, 3, rng)
        tip, direction = tips[0], directions[0]
        edges = image(tip, direction, positions)
        pose = solve_pose(edges[None], torch.tensor(positions), CAMERA)
        assert off(pose.tip, tips) < 1e-9
        # The mirror image in the plane parallel to the image, the root of Eqs. 3.8 to 3.11, and any other.
        starts = [direction * [1, 1, -1], *(v / np.linalg.norm(v) for v in rng.normal(size=(8, 3)))]
        for start in starts:
            at = tip + positions.mean() * direction - positions.mean() * start
            if (at[2] + positions * start[2] > 0.05).all():
                found, along, cost = oracle.descend(at, start, edges.numpy(), positions, MATRIX, LENS)
                if cost < 1e-8:
                    explained += 1
                    assert np.linalg.norm(found - tip) < 1e-4 and along @ direction > 1 - 1e-6, trial
        # The equations u x (A + s d) = 0 have one solution up to a factor; minus one puts it behind the camera.
        rays = np.concatenate([CAMERA.undistort(edges).numpy(), np.ones((3, 1))], -1)
        crosses = np.stack([np.cross(ray, np.eye(3)).T for ray in rays])
        shares = (positions - positions.mean()) / np.ptp(positions)
        singular = np.linalg.svd(np.concatenate([crosses, shares[:, None, None] * crosses], -1).reshape(9, 6))[1]
        assert singular[5] < 1e-12
        weakest.append(singular[4])
    assert explained > 8 and min(weakest) > 1e-6


def test_10_000_poses_in_one_call_equal_single_ones():
    positions, tip, direction = scenes(10_000, 4, np.random.default_rng(5))
    edges = image(tip, direction, positions)
    pose = solve_pose(edges, torch.tensor(positions), CAMERA)
    assert len(pose) == 10_000 and off(pose.tip, tip) < 1e-9
    noise = edges[:20] + 0.1 * torch.randn(20, 4, 2, dtype=torch.float64)
    together = solve_pose(noise, torch.tensor(positions), CAMERA)
    for i in range(20):
        alone = solve_pose(noise[i : i + 1], torch.tensor(positions), CAMERA)
        # Steps end within 1e-9 of a deviation.
        assert (alone.tip[0] - together.tip[i]).norm() <= 1e-8 * together.tip_sd[i]
        torch.testing.assert_close(alone.covariance[0], together.covariance[i], rtol=1e-6, atol=0)
    none = solve_pose(edges[:0], torch.tensor(positions), CAMERA)
    assert none.tip.shape == (0, 3) and none.status == ()


def test_the_offset_of_the_visible_surface():
    positions, tip, direction = scenes(500, 4, np.random.default_rng(6))
    for offset in (1e-3, 5e-3):
        pose = solve_pose(image(tip, direction, positions, offset), torch.tensor(positions), CAMERA, offset=offset)
        assert off(pose.tip, tip) < 1e-9
    # Left out it shifts the tip toward the camera by itself or more.
    assert off(solve_pose(image(offset=RADIUS)[None], torch.tensor(EDGES), CAMERA).tip, TIP) > 0.9 * RADIUS


def test_missing_edges():
    positions = np.array([0.03, 0.07, 0.108, 0.146, 0.184])
    edges = image(positions=positions).expand(6, 5, 2).clone()
    seen = torch.ones(6, 5, dtype=torch.bool)
    seen[1, 0] = seen[2, 1:3] = False
    edges[1:3][~seen[1:3]] = 12.0  # and wrong where they are not seen
    edges[3, 2:4] = torch.nan
    edges[4, 2, 0] = torch.nan
    seen[4, :2] = False
    edges[5] = torch.nan
    pose = solve_pose(edges, torch.tensor(positions), CAMERA, seen=seen)
    assert pose.status == (
        Status.OK,
        Status.OK,
        Status.UNVERIFIED,
        Status.UNVERIFIED,
        Status.BANDS_MISSING,
        Status.BANDS_MISSING,
    )
    assert pose.freedom.tolist() == [5, 3, 1, 1, 0, 0]
    assert off(pose.tip[:4], TIP) < 1e-9
    for value in (pose.tip, pose.direction, pose.covariance, pose.chi_square):
        assert value[4:].isnan().all()
    fewer = solve_pose(edges[:1, [0, 3, 4]], torch.tensor(positions[[0, 3, 4]]), CAMERA)
    torch.testing.assert_close(pose.tip[2], fewer.tip[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(pose.covariance[2:3], fewer.covariance, rtol=1e-6, atol=0)
    assert pose.tip_sd[0] < pose.tip_sd[1] < pose.tip_sd[2]
    assert pose[2].answered and not pose[4].answered


def test_outside_the_camera():
    strong = Camera(torch.tensor(MATRIX), torch.tensor([-0.5, 0, 0, 0, 0]))
    edges = image(lens=np.array([-0.5, 0, 0, 0, 0]))[None].expand(3, 4, 2).clone()
    edges[1, :2] += 5000
    edges[2, 0] += 5000
    pose = solve_pose(edges, torch.tensor(EDGES), strong)
    assert pose.status == (Status.OK, Status.OUTSIDE_CAMERA, Status.UNVERIFIED)
    assert pose.tip[1].isnan().all() and off(pose.tip[::2], TIP) < 1e-9


def test_edges_no_tool_could_show():
    """Edges in one point are refused; others that contradict the positions too, or chi square tells."""
    good = image()
    same = good[:1].expand(4, 2)
    near = same + 1e-9 * torch.randn(4, 2, dtype=torch.float64)
    ends = good[[0, 0, 3, 3]]
    pair = good[[0, 0, 2, 3]]
    swapped = good[[1, 0, 2, 3]]
    mixed = good[[2, 0, 3, 1]]
    bent = good + torch.tensor([[0.0, 0], [0, 30], [0, -30], [0, 0]])
    pose = solve_pose(torch.stack([same, near, ends, pair, swapped, mixed, bent]), torch.tensor(EDGES), CAMERA)
    assert codes(pose)[:2] == (Status.INCONSISTENT,) * 2
    for i, status in enumerate(codes(pose)):
        values = torch.cat([pose.tip[i], pose.direction[i], pose.covariance[i].flatten(), pose.chi_square[i : i + 1]])
        if status is Status.INCONSISTENT:
            assert values.isnan().all()
        else:  # chi square with 3 degrees of freedom is above 16.3 once in a thousand
            assert values.isfinite().all() and pose.chi_square[i] > 1e4
    # Of three edges two in one point: the tool would touch the camera.
    three = solve_pose(torch.stack([same, pair, ends])[:, :3], torch.tensor(EDGES[:3]), CAMERA)
    assert set(codes(three)) == {Status.INCONSISTENT} and three.tip.isnan().all()
    # From back to front, with equal bands, is a tool that points the other way: only the colours can tell.
    back = solve_pose(good.flip(0)[None], torch.tensor(EDGES), CAMERA)
    assert back.status == (Status.OK,) and back.direction[0].numpy() @ DIRECTION < -0.999
    anywhere = solve_pose(1000 * torch.rand(500, 4, 2, dtype=torch.float64), torch.tensor(EDGES), CAMERA)
    assert (anywhere.chi_square > 16.3).logical_or(anywhere.tip.isnan().any(-1)).all()


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"edges_px": torch.zeros(4, 2)}, ValueError, r"edges_px must be floating, of shape \[B, N, 2\]"),
        ({"edges_px": torch.zeros(1, 4, 2, dtype=torch.int64)}, ValueError, "edges_px must be floating"),
        ({"positions_m": torch.tensor(EDGES[:3])}, ValueError, r"positions_m must be of shape \[4\], got \[3\]"),
        ({"positions_m": torch.tensor([0.1, 0.2, 0.2, 0.3])}, ValueError, "positions_m must all differ"),
        ({"positions_m": torch.tensor([0.1, 0.2, torch.nan, 0.3])}, ValueError, "positions_m must be finite"),
        ({"along_px": 0.0}, ValueError, "along_px must be above zero"),
        ({"across_px": -1.0}, ValueError, "across_px must be above zero"),
        ({"across_px": math.nan}, ValueError, "across_px must be finite"),
        ({"along_px": torch.ones(3)}, ValueError, r"along_px must be a number or of shape \[1, 4\], got \[3\]"),
        ({"offset": math.inf}, ValueError, "offset must be finite"),
        ({"offset": torch.zeros(2)}, ValueError, r"offset must be a number or of shape \[1\], got \[2\]"),
        ({"seen": torch.ones(1, 3, dtype=torch.bool)}, ValueError, r"seen must be bool of shape \[1, 4\]"),
        ({"seen": torch.ones(1, 4)}, ValueError, "seen must be bool"),
        ({"along_px": "wide"}, TypeError, "str"),
    ],
)
def test_impossible_input(change, kind, message):
    given = {"edges_px": image()[None], "positions_m": torch.tensor(EDGES), "camera": CAMERA, **change}
    with pytest.raises(kind, match=message):
        solve_pose(**given)


def test_two_edges_are_too_few():
    for function in (solve_pose, closed_form):
        with pytest.raises(ValueError, match="a pose takes at least three edges, got 2"):
            function(image()[None, :2], torch.tensor(EDGES[:2]), CAMERA)


def test_opencv_s_pose_solvers_are_never_called():
    """On points of one line some of them return success with a pose that is half a metre off.

    Boards are not lines: ``boards``, ``calibration`` and ``few_views`` may use them, and know nothing of catheters.
    """
    files = sorted(Path(holotorch.tracking.__file__).parent.glob("**/*.py"))
    assert {"pose.py", "camera.py"} <= {file.name for file in files}
    for file in files:
        called, imported = set(), set()
        for node in ast.walk(ast.parse(file.read_text())):
            called |= {str(getattr(node, key, "")) for key in ("attr", "id", "name", "value")}
            imported |= {str(getattr(node, "module", ""))}
        solvers = [name for name in called if name.lower().startswith(("solvepnp", "solvep3p", "solve_pnp"))]
        if file.name in ("boards.py", "calibration.py", "few_views.py"):
            assert not imported & {f"holotorch.tracking.{name}" for name in ("pose", "catheter", "band_edges")}
        else:
            assert not solvers, file.name


def test_millimetres_are_refused():
    positions, tip, direction = scenes(1, 4, np.random.default_rng(0))
    pixels = image(tip, direction, positions)
    assert solve_pose(pixels, torch.tensor(positions), CAMERA).status == (Status.OK,)
    with pytest.raises(ValueError, match=r"positions_m must lie within -3 m .. 3 m, got .*looks like millimetres"):
        solve_pose(pixels, 1e3 * torch.tensor(positions), CAMERA)
    with pytest.raises(ValueError, match="offset must lie within -50 mm .. 50 mm, got 1 m; 1 looks like millimetres"):
        solve_pose(pixels, torch.tensor(positions), CAMERA, offset=1.0)
