"""The second synthetic world: its renderer against the first one, its truth, and the variety of its scenes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from holotorch.tracking import solve_pose
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.simulation import ray_camera, surfaces
from holotorch.tracking.simulation.ray_camera import Rod, Shot, take
from holotorch.tracking.simulation.render import Look, mean_levels
from holotorch.tracking.simulation.varied import CONDITIONS, NEGATIVES, VariedWorld, tip_deviation
from holotorch.tracking.simulation.world import synthetic_camera

# Long bands and a thick tube, so that small frames determine the pose.
LARGE = Catheter((0.08, 0.16, 0.24, 0.32), THESIS.colours, 3e-3, 0.5)
WORLD = VariedWorld(LARGE, (360, 640))


@pytest.fixture(scope="module")
def trials():
    return {condition: WORLD.trial(2000 + i, condition) for i, condition in enumerate(CONDITIONS)}


def plain(trial) -> tuple[Shot, Look]:
    """The trial's pose in even light over grey, for both renderers."""
    grey = 120
    shot = replace(
        trial.shot,
        background=np.full_like(trial.shot.background, float(surfaces.linear(np.array(grey / 255)))),
        lights=(),
        ambient=(1.0, 1.0, 1.0),
        gloss=0.0,
        opacity=0.35,
        clear=tuple(surfaces.linear(np.array([228, 228, 222]) / 255)),
        tints=np.ones((1, 3)),
        gain=(1.0, 1.0, 1.0),
        blur_px=0.7,
        shot_noise=0.0,
        read_noise=0.0,
    )
    return shot, Look(background=(grey, grey, grey), ambient=1.0, highlight=0.0, noise_dn=0.0)


def test_both_renderers_give_the_same_frame(trials):
    """Within the error of the rays, 0.6 levels (1 sigma), on average to a tenth of a level."""
    trial = trials["clean"]
    shot, look = plain(trial)
    light = ray_camera._spread(shot.background, shot)
    ray_camera._trace(light, shot, np.random.default_rng(0))
    ours = trial.camera.levels(torch.from_numpy(light)).numpy().transpose(2, 0, 1)
    theirs = mean_levels(LARGE, trial.camera, (trial.tip, trial.direction), WORLD.size, look)
    on_bands = ray_camera._near(shot, WORLD.size, LARGE.edges[0], LARGE.edges[-1]) > 0
    difference = (ours - theirs)[:, on_bands]
    assert np.abs(difference.mean(1)).max() < 0.15
    assert difference.std(1).max() < 1.5


@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_shows_the_catheter(condition, trials):
    trial = trials[condition]
    frame = trial.frame()
    assert frame.dtype == torch.uint8 and frame.shape == (3, *WORLD.size)
    assert float(trial.direction.norm()) == pytest.approx(1.0)
    middle = trial.camera.project(trial.tip + (LARGE.edges[0] + LARGE.edges[-1]) / 2 * trial.direction)
    assert condition == "partial view" or bool(torch.isfinite(middle).all())


def test_scenes_depend_on_their_seed_alone():
    one, other = WORLD.trial(2001, "any hue"), WORLD.trial(2002, "any hue")
    assert torch.equal(one.frame(), WORLD.trial(2001, "any hue").frame())
    assert not torch.equal(one.tip, other.tip)
    assert WORLD.trial(len(CONDITIONS) + 1).condition == CONDITIONS[1]


def test_poses_determine_the_tip(trials):
    for condition, trial in trials.items():
        if condition != "partial view":
            tip, direction = trial.tip.numpy(), trial.direction.numpy()
            assert tip_deviation(trial.camera, LARGE, tip, direction) < 5e-4


def test_the_deviation_of_a_tip_is_that_of_solved_poses():
    """400 poses from edges with errors of 0.05 pixels; their spread has an error of 4 % (1 sigma)."""
    camera = synthetic_camera()
    tip, direction = np.array([0.01, -0.02, 0.5]), np.array([math.cos(0.3), 0.0, -math.sin(0.3)])
    edges = camera.project(torch.from_numpy(tip + np.array(THESIS.edges)[:, None] * direction))
    noise = 0.05 * torch.randn(400, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    solved = solve_pose(edges + noise, THESIS.positions, camera).tip
    spread = float((solved - torch.from_numpy(tip)).square().sum(-1).mean().sqrt())
    assert tip_deviation(camera, THESIS, tip, direction) == pytest.approx(spread, rel=0.15)


def test_what_is_hidden_is_said():
    answers = [WORLD.trial(seed, "occlusion").answerable for seed in range(2000, 2040)]
    assert 20 < sum(answers) < 40
    for seed in range(2000, 2004):
        trial = VariedWorld().trial(seed, "partial view")
        edges = trial.camera.project(trial.tip + torch.tensor(THESIS.edges)[:, None] * trial.direction)
        inside = ((edges >= 0) & (edges < torch.tensor([1920, 1080]))).all(-1)
        assert int(inside.sum()) == 3 and trial.answerable


@pytest.mark.parametrize("kind", NEGATIVES)
def test_negatives_differ_from_the_catheter(kind):
    stick = WORLD.negative(2000, kind).shot.catheter
    assert stick != LARGE and not WORLD.negative(2000, kind).answerable
    if kind == "near miss":
        assert stick is not None
        lengths = np.diff(stick.edges) / np.diff(LARGE.edges)
        assert np.sort(np.abs(lengths - 1))[-1] >= 0.1 and (np.abs(lengths - 1) > 1e-9).sum() == 1
    if kind == "wrong order":
        assert stick is not None and stick.colours not in (LARGE.colours, LARGE.colours[::-1])


def test_motion_and_a_rolling_shutter_move_the_image_as_they_should(trials):
    """The centre of the frame's change moves by the motion; the rolling shutter's by the row."""
    shot, _ = plain(trials["clean"])
    still = take(shot, 0).int()
    moved = take(replace(shot, motion=(0.02, 0.0, 0.0)), 0).int()
    assert int((moved - still).abs().max()) > 20  # smeared
    rolled = take(replace(shot, rolling=(0.0, 0.0, 0.0)), 0).int()
    assert int((rolled - still).abs().max()) <= 1


def test_a_rod_covers_what_it_says():
    rod = Rod((10.0, 10.0), (30.0, 10.0), 4.0, (0.5, 0.5, 0.5))
    cover, _ = rod.paint(np.array([20.0, 20.0, 5.0, 34.5]), np.array([10.0, 13.9, 10.0, 10.0]))
    assert cover.tolist() == [True, True, False, False]
    soft, _ = rod.paint(np.array([20.0]), np.array([14.0]), softness=0.7)
    assert float(soft[0]) == pytest.approx(0.5)


def test_unknown_conditions_and_seeds_are_named():
    with pytest.raises(ValueError, match="condition must be one of clean.*'fog'"):
        WORLD.trial(2000, "fog")
    with pytest.raises(ValueError, match="kind must be one of no catheter"):
        WORLD.negative(2000, "fog")
    with pytest.raises(ValueError, match="seed"):
        WORLD.trial(-1)
