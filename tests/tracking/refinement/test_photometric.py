"""The photometric fit on both synthetic renderers, and its derivatives."""

import math
from functools import cache, lru_cache

import numpy as np
import pytest
import torch
from paths import DEVICES

from holotorch.tracking import Camera
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.refinement.photometric import FitPlan, PhotometricFit
from holotorch.tracking.refinement.tube_light import Frame, TubeGeometry
from holotorch.tracking.simulation import surfaces
from holotorch.tracking.simulation.ray_camera import Rod, Shot, take
from holotorch.tracking.simulation.render import Look
from holotorch.tracking.simulation.world import World

SMALL = World(size=(540, 960))
SIMPLE = Look(noise_dn=0.5, ambient=1.0, highlight=0.0)


@lru_cache(maxsize=4)
def shot(world: World, name: str, look: Look | None = None, depth: float = 0.3, tilt: float = 20.0):
    """Frame [1, 3, H, W], tip and direction [1, 3] of a catheter on a plain table."""
    pose = world.pose(depth, math.radians(tilt))
    grey = torch.full((3, *world.size), 120, dtype=torch.uint8)
    one = World(world.size, world.camera, look=look) if look else world
    return one.case(name, pose, lambda: grey).frame()[None], pose[0][None], pose[1][None]


def ray_shot(depth: float = 0.3, tilt: float = 20.0, seed: int = 0, **changes):
    """Frame [1, 3, H, W] of the ray tracer, tip and direction [1, 3] of a catheter on a grey surface."""
    tip, direction = SMALL.pose(depth, math.radians(tilt))
    changes = {"background": np.full((*SMALL.size, 3), 0.3, np.float32), "tints": np.ones((3, 3))} | changes
    scene = Shot(SMALL.camera, catheter=THESIS, tip=tip.numpy(), direction=direction.numpy(), **changes)
    return take(scene, seed)[None], tip[None], direction[None]


@cache
def ray_shot_at_rest():
    """The frame that several tests fit, with its tip and direction."""
    return ray_shot()


def distance(found, tip: torch.Tensor) -> float:
    """Squared error of a tip in units of its covariance: 3 on average for a Gaussian."""
    error = (found.tip - tip)[0]
    return float(error @ torch.linalg.solve(found.covariance[0, :3, :3], error))


def nudged(tip: torch.Tensor, metres: float = 3e-4) -> torch.Tensor:
    return tip + metres * torch.randn(tip.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def test_it_finds_the_pose_of_a_quiet_frame_from_a_rough_one():
    frame, tip, direction = shot(SMALL, "quiet", SIMPLE)
    found = PhotometricFit(SMALL.camera, THESIS)(frame, nudged(tip), direction)
    assert float((found.tip - tip).norm()) < 2e-5 < float((nudged(tip) - tip).norm())
    assert float((found.direction - direction).norm()) < 5e-4  # two thirds of its standard deviation
    assert abs(float(found.blur) - SIMPLE.blur_px) < 0.05
    assert bool(found.used.all()) and float((found.shift / found.shift_sd).abs().max()) < 3


def test_light_from_one_side_and_gloss_do_not_move_the_pose():
    look = Look(noise_dn=0.5, light=(-0.9, -0.3, -0.4), ambient=0.2, highlight=0.5)
    frame, tip, direction = shot(SMALL, "side", look)
    found = PhotometricFit(SMALL.camera, THESIS)(frame, nudged(tip), direction)
    assert float((found.tip - tip).norm()) < 1e-4


def test_its_covariance_says_how_far_it_is_off():
    """Mean of 24 squared distances in units of the covariance: 3 for a Gaussian, with a standard error of 0.5."""
    squares = []
    fit = PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(readout=0.0))
    for i in range(24):
        frame, tip, direction = shot(SMALL, f"noise {i}", Look(noise_dn=4.0), depth=0.28 + 0.003 * i)
        found = fit(frame, nudged(tip), direction)
        error = (found.tip - tip)[0]
        squares.append(float(error @ torch.linalg.solve(found.covariance[0, :3, :3], error)))
    assert 1.0 < sum(squares) / len(squares) < 5.0


def test_a_batch_is_its_items_and_levels_may_be_shares():
    shots = [shot(SMALL, name, depth=depth) for name, depth in (("one", 0.3), ("two", 0.34))]
    frames, tips, directions = (torch.cat(parts) for parts in zip(*shots, strict=True))
    fit = PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(settled=1e-6, iterations=60))
    both, shares = fit(frames, nudged(tips), directions), fit(frames.double() / 255, nudged(tips), directions)
    for i in range(2):
        alone = fit(frames[i : i + 1], nudged(tips)[i : i + 1], directions[i : i + 1])
        assert torch.allclose(both.tip[i], alone.tip[0], atol=1e-9)
    assert torch.allclose(both.tip, shares.tip, atol=1e-9)


def test_windows_off_the_frame_are_not_used():
    case = World().case("cut", World().pose(0.5, 0.3, 0.0, at=(0.62, 0.0)))
    assert case.tip is not None and case.direction is not None
    found = PhotometricFit(World().camera, THESIS)(case.frame()[None], case.tip[None], case.direction[None])
    assert found.used[0].tolist().count(False) >= 1
    assert bool(torch.isfinite(found.tip).all())


def test_the_analytic_derivatives_are_those_of_the_geometry():
    frame, tip, direction = shot(SMALL, "slopes", SIMPLE)
    fit = PhotometricFit(SMALL.camera, THESIS)
    windows = fit._windows(frame, fit._pixels(tip, direction), tip, direction)
    start = Frame.of(tip + 0.127 * direction, direction)
    moved, rest = start.moved(torch.tensor([[1e-4, -2e-4, 1e-3, 2e-3, -1e-3, -0.3]], dtype=torch.float64))

    def values(change: torch.Tensor) -> torch.Tensor:
        place = TubeGeometry.of(moved, rest + change, windows)
        return torch.stack([place.miss, place.along, place.slant, place.blur.log()], -1)[0, :, ::40]

    wanted = torch.autograd.functional.jacobian(values, torch.zeros(1, 6, dtype=torch.float64))
    given = TubeGeometry.of(moved, rest, windows).derivatives[0].permute(0, 3, 1, 2)[:, ::40]
    assert isinstance(wanted, torch.Tensor)
    assert torch.allclose(given, wanted[..., 0, :], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("motion", [(), (3.0, 1.5)])
def test_the_analytic_derivatives_are_those_of_the_light(motion):
    """Against central differences; those of turns neglect what a turn of the axis does to the blur within a pixel."""
    frame, tip, direction = shot(SMALL, "light", SIMPLE)
    fit = PhotometricFit(SMALL.camera, THESIS)
    windows = fit._windows(frame, fit._pixels(tip, direction), tip, direction)
    start = Frame.of(tip + 0.127 * direction, direction)
    own = 2e-5 * torch.randn(8, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    unknown = torch.tensor([[0.0] * 5 + [-0.3, 0.02, *motion, *own]], dtype=torch.float64)
    place, tube = fit._model(start, unknown, windows)
    colours = fit._linear(tube, windows, False).colours
    given = tube.changes(place, colours, still=not motion)
    for index in range(7 + len(motion)):
        step = torch.zeros_like(unknown)
        step[:, index] = 1e-6 if index < 4 else 1e-5
        ahead, behind = (colours @ fit._model(start, unknown + s * step, windows)[1].basis for s in (1, -1))
        wanted = (ahead - behind) / (2 * step.max())
        assert torch.allclose(given[:, :, :, index], wanted, atol=0.03 * float(wanted.abs().max()))


@pytest.mark.parametrize("what", ["focal length", "edges", "pixels"])
def test_the_pose_is_differentiable(what):
    """By the implicit function theorem, against differences of whole fits."""
    frame, tip, direction = shot(SMALL, "gradient", Look(noise_dn=1.0))
    share, plan = frame.double() / 255, FitPlan(settled=1e-10, iterations=40)
    way = torch.randn(share.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 1e-3

    def tip_of(amount: torch.Tensor) -> torch.Tensor:
        camera, pixels = SMALL.camera, share
        if what == "focal length":
            matrix = camera.matrix * (1 + amount * torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 0]]))
            camera = Camera(matrix, camera.distortion)
        if what == "pixels":
            pixels = share + amount * way
        fit = PhotometricFit(camera, THESIS, plan=plan, learnable=True)
        if what == "edges":
            positions = THESIS.positions + amount * torch.tensor([0.0, 1e-3, 0, -1e-3], dtype=torch.float64)
            return torch.func.functional_call(fit, {"positions": positions}, (pixels, tip, direction)).tip
        return fit(pixels, tip, direction).tip

    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    weights = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    (given,) = torch.autograd.grad((tip_of(zero) * weights).sum(), zero)
    step = 1e-4
    with torch.no_grad():
        ahead, behind = (float((tip_of(torch.tensor(s * step)) * weights).sum()) for s in (1, -1))
    wanted = (ahead - behind) / (2 * step)
    assert float(given) == pytest.approx(wanted, rel=2e-3, abs=1e-9)


def test_edges_and_radius_are_parameters_on_request():
    assert not list(PhotometricFit(SMALL.camera, THESIS).parameters())
    assert {name for name, _ in PhotometricFit(SMALL.camera, THESIS, learnable=True).named_parameters()} == {
        "positions",
        "radius",
    }


def test_a_flat_frame_says_nothing_about_the_pose():
    frame = torch.full((1, 3, *SMALL.size), 120, dtype=torch.uint8)
    tip, direction = (part[None] for part in SMALL.pose(0.3, 0.3))
    found = PhotometricFit(SMALL.camera, THESIS)(frame, tip, direction)
    assert not float(found.covariance[0, :3, :3].trace().sqrt()) < 1  # metres


def test_poses_off_the_frame_are_nan_and_do_not_disturb_others():
    frame, tip, direction = shot(SMALL, "beside", SIMPLE)
    aside, behind = tip + torch.tensor([5.0, 0, 0]), -tip
    fit = PhotometricFit(SMALL.camera, THESIS)
    alone = fit(frame, nudged(tip), direction)
    three = fit(frame.expand(3, -1, -1, -1), torch.cat([aside, nudged(tip), behind]), direction.expand(3, -1))
    assert torch.equal(three.tip[1], alone.tip[0])
    assert bool(three.tip[[0, 2]].isnan().all()) and not bool(three.used[[0, 2]].any())
    assert len(fit(frame[:0], tip[:0], direction[:0]).tip) == 0


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("frames", lambda value: value.short(), "uint8, or floating"),
        ("frames", lambda value: value[0], r"\[B, 3, H, W\]"),
        ("frames", lambda value: value.double() * math.nan, "finite"),
        ("tip", lambda value: value * math.nan, "finite"),
        ("tip", lambda value: value.repeat(2, 1), r"\[1, 3\]"),
        ("direction", lambda value: 2 * value, "unit"),
    ],
)
def test_wrong_input_is_named(name, change, message):
    frame, tip, direction = shot(SMALL, "input", SIMPLE)
    given = {"frames": frame, "tip": tip, "direction": direction}
    with pytest.raises((TypeError, ValueError), match=message):
        PhotometricFit(SMALL.camera, THESIS)(**given | {name: change(given[name])})


@pytest.mark.parametrize(("along", "across"), [(6.0, 0.0), (5.0, 2.0), (-5.0, 2.0)])
def test_a_motion_during_the_exposure_does_not_move_the_pose(along, across):
    """Against a ray tracer that draws the time of each ray: pixels along and across the tube, at constant speed."""
    tip, direction = SMALL.pose(0.3, math.radians(20))
    side = torch.linalg.cross(direction, tip / tip.norm())
    pixel = float((tip + 0.127 * direction).norm() / SMALL.camera.matrix[0, 0])
    motion = pixel * (along * direction + across * side / side.norm())
    frame, tip, direction = ray_shot(motion=tuple(motion.tolist()))
    found = PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(readout=0.0))(frame, nudged(tip), direction)
    blurred = PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(readout=0.0, motion_gain=math.inf))
    other = blurred(frame, nudged(tip), direction)
    assert float((found.tip - tip).norm()) < 2e-4 and distance(found, tip) < 11.3  # 99 % of a Gaussian
    assert not float((other.tip - tip).norm()) < 2 * float((found.tip - tip).norm())
    assert float(found.blur) < 0.9 < float(other.blur)


@pytest.mark.parametrize("codec", [{"video": True}, {"jpeg": 80}])
def test_coarse_chroma_does_not_bias_the_pose(codec):
    squares, errors = [], {True: [], False: []}
    for i in range(4):
        frame, tip, direction = ray_shot(depth=0.28 + 0.007 * i, seed=i, **codec)
        for luma in (True, False):
            plan = FitPlan(readout=0.0) if luma else FitPlan(readout=0.0, fine=0.0, smeared=math.inf)
            found = PhotometricFit(SMALL.camera, THESIS, plan=plan)(frame, nudged(tip), direction)
            errors[luma].append(float((found.tip - tip).norm()))
            if luma:
                squares.append(distance(found, tip))
    assert sum(square < 7.8 for square in squares) == 4  # 95 % of a Gaussian
    assert np.median(errors[True]) < 0.7 * np.median(errors[False])


def test_a_texture_behind_the_tube_widens_the_covariance():
    squares, deviations = [], []
    for i in range(6):
        weave = surfaces.gauze(np.random.default_rng(i), SMALL.size)
        frame, tip, direction = ray_shot(depth=0.28 + 0.007 * i, seed=i, background=weave)
        found = PhotometricFit(SMALL.camera, THESIS)(frame, nudged(tip), direction)
        squares.append(distance(found, tip))
        deviations.append(float(found.covariance[0, :3, :3].trace().sqrt()))
    frame, tip, direction = ray_shot(depth=0.3)
    plain = PhotometricFit(SMALL.camera, THESIS)(frame, nudged(tip), direction)
    assert sum(not square > 7.8 for square in squares) >= 5 and sum(square < 7.8 for square in squares) >= 3
    assert np.nanmedian(deviations) > 1.5 * float(plain.covariance[0, :3, :3].trace().sqrt())


def test_a_rolling_shutter_widens_the_covariance():
    frame, tip, direction = ray_shot_at_rest()
    still, rolling = (
        PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(readout=readout))(frame, nudged(tip), direction)
        for readout in (0.0, 1e-3)
    )
    assert torch.equal(still.tip, rolling.tip)
    frame, tip, direction = ray_shot(rolling=(1e-3, 5e-4, 0.0))
    moved = PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(readout=1e-3))(frame, nudged(tip), direction)
    assert distance(moved, tip) < 7.8
    error = (moved.tip - tip)[0]
    assert float(error @ torch.linalg.solve(still.covariance[0, :3, :3], error)) > 11.3


@pytest.mark.parametrize("pixels", [-25.0, -12.0, -4.0, 4.0, 12.0, 25.0])
def test_a_rough_pose_may_be_4_pixels_off_and_one_that_shows_no_edges_is_refused(pixels):
    frame, tip, direction = ray_shot_at_rest()
    start = tip + pixels * tip.norm() / SMALL.camera.matrix[0, 0] * direction
    found = PhotometricFit(SMALL.camera, THESIS)(frame, start, direction)
    if abs(pixels) < 5:
        assert float((found.tip - tip).norm()) < 1e-4
    else:
        assert bool(found.tip.isnan().all()) and bool(found.covariance.isnan().all())


def test_a_fit_that_has_not_converged_is_nan():
    frame, tip, direction = ray_shot_at_rest()
    found = PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(iterations=2))(frame, nudged(tip, 1e-3), direction)
    assert bool(found.tip.isnan().all()) and bool(found.covariance.isnan().all()) and bool(found.used.all())


def test_an_edge_that_disagrees_is_noticed():
    """A finger over an edge between bands, of which the pose from the other edges knows nothing."""
    frame, tip, direction = ray_shot_at_rest()
    centre = SMALL.camera.project(tip + 0.1095 * direction)[0].numpy()
    along = SMALL.camera.project(tip + 0.12 * direction)[0].numpy() - centre
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    rod = Rod(tuple(centre - 60 * across), tuple(centre + 60 * across), 7.0, (0.6, 0.35, 0.25))
    frame, tip, direction = ray_shot(before=(rod,))
    found = PhotometricFit(SMALL.camera, THESIS, plan=FitPlan(readout=0.0))(frame, nudged(tip), direction)
    assert bool(found.tip.isnan().all()) or distance(found, tip) < 11.3


@pytest.mark.skipif(not DEVICES[1:], reason="no CUDA device")
def test_a_gpu_finds_the_same_poses_and_gradients():
    shots = [shot(SMALL, name, SIMPLE) for name in ("here", "there")]
    frames, tips, directions = (torch.cat(each) for each in zip(*shots, strict=True))
    results = []
    for device in DEVICES:
        given = frames.double().div(255).to(device).requires_grad_()
        fit = PhotometricFit(SMALL.camera, THESIS, learnable=True).to(device)
        found = fit(given, nudged(tips).to(device), directions.to(device))
        gradients = torch.autograd.grad(found.tip.sum(), (given, fit.positions, fit.radius))
        results.append([value.detach().cpu() for value in (found.tip, found.direction, found.covariance, *gradients)])
    for here, there in zip(*results, strict=True):
        assert here.isfinite().all() and torch.allclose(here, there, rtol=1e-5, atol=1e-6 * here.abs().max().item())
