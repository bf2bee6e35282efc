import math

import numpy as np
import pytest
import torch

from holotorch.experiments.tracking_benchmark.thesis_opencv import ThesisOpenCV, _closed_form
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.pose.pose import closed_form
from holotorch.tracking.pose.status import Status
from holotorch.tracking.simulation.render import Look, render
from holotorch.tracking.thesis import stages
from holotorch.tracking.thesis.tracker import ThesisTracker

SIZE = (400, 640)
CAMERA = Camera(
    torch.tensor([[1400.0, 0, 322], [0, 1400, 198], [0, 0, 1]]), torch.tensor([-0.12, 0.06, 8e-4, -5e-4, 0.0])
)
KORNIA, OPENCV = ThesisTracker(CAMERA, THESIS), ThesisOpenCV(CAMERA, THESIS)


def scene(depth=0.52, tilt=20.0, turn=17.0, seed=0, look=None, catheter=THESIS):
    t, r = math.radians(tilt), math.radians(turn)
    direction = torch.tensor([math.cos(t) * math.cos(r), math.cos(t) * math.sin(r), -math.sin(t)], dtype=torch.float64)
    tip = torch.tensor([0, 0, depth], dtype=torch.float64) - 0.127 * direction
    return render(catheter, CAMERA, tip, direction, SIZE, look, generator=torch.Generator().manual_seed(seed))


def test_both_find_the_same_endpoints_and_poses():
    """8-bit images and maps in 1/32 pixel put single pixels on either side of a threshold.

    A pixel at the threshold weighs 25 in a component of about 1500 and lies 4 pixels from its centre: 0.07 px each, a
    few of them at most. The tip then moves by less than its deviation for endpoints 0.3 px off.
    """
    cases = [(0.52, 5, 17), (0.52, 20, 46), (0.35, 20, -15), (0.45, 10, 190), (0.52, 0, 90), (0.4, 30, 120)]
    frames = torch.stack([scene(*case, seed=i) for i, case in enumerate(cases)])
    ours, theirs = KORNIA(frames), OPENCV(frames)
    assert all(pose.status == Status.OK for pose in ours + theirs)
    apart = np.array(KORNIA.endpoints) - np.array(OPENCV.endpoints)
    assert apart.shape == (6, 4, 2)
    assert np.abs(apart).max() < 0.25
    assert np.sqrt((apart**2).mean()) < 0.05
    for one, other in zip(ours, theirs, strict=True):
        assert (one.tip - other.tip).norm() < one.tip_sd
        torch.testing.assert_close(one.covariance, other.covariance, rtol=0.05, atol=1e-2 * float(one.covariance.max()))


def test_maps_made_anew_change_nothing_but_the_time():
    """cv2.undistort keeps its maps in 1/32 pixel too."""
    frames = torch.stack([scene(0.52, 20, 46), scene(0.4, 30, 120, seed=1)])
    for literal, usual in zip(ThesisOpenCV(CAMERA, THESIS, literal=True)(frames), OPENCV(frames), strict=True):
        assert literal.status == usual.status == Status.OK
        assert (literal.tip - usual.tip).norm() < 0.2 * usual.tip_sd


def test_both_refuse_alike():
    red, green, blue = THESIS.colours
    swapped = Catheter(THESIS.edges, (green, red, blue), THESIS.radius, THESIS.length)
    one = Catheter(THESIS.edges, (red, (120, 120, 120), (70, 70, 70)), THESIS.radius, THESIS.length)
    two = Catheter(THESIS.edges, (red, green, (70, 70, 70)), THESIS.radius, THESIS.length)
    papers = torch.full((3, *SIZE), 120, dtype=torch.uint8)
    papers[0, 40:80, 40:80] = papers[0, 200:240, 500:540] = papers[1, 300:340, 100:140] = 250
    frames = torch.stack(
        [
            torch.zeros(3, *SIZE, dtype=torch.uint8),
            torch.full((3, *SIZE), 255, dtype=torch.uint8),
            torch.randint(0, 256, (3, *SIZE), dtype=torch.uint8),
            scene(catheter=swapped),
            scene(catheter=one),
            scene(catheter=two),
            scene(depth=2.0),
            papers,
            scene(look=Look(gain=0.4)),
        ]
    )
    ours, theirs = KORNIA(frames), OPENCV(frames)
    assert [pose.status for pose in ours] == [pose.status for pose in theirs]
    assert [pose.answered for pose in ours] == [False] * 5 + [True] + [False] * 2 + [True]
    assert [pose.reason == "" for pose in ours] == [False] * 8 + [True]
    assert all(torch.isnan(pose.tip).all() for pose in theirs if not pose.answered)


def test_memory_by_planes_or_by_pixels_makes_no_difference():
    planes = torch.stack([scene(), scene(turn=70)])
    pixels = planes.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
    first = OPENCV(planes)
    for one, other in zip(first, OPENCV(pixels), strict=True):
        assert torch.equal(one.tip, other.tip) and torch.equal(one.covariance, other.covariance)


def test_maps_are_those_of_the_camera():
    """Fixed point keeps 1/32 of a pixel."""
    OPENCV(scene()[None])
    assert OPENCV._maps is not None
    whole, part = OPENCV._maps
    x, y = whole[..., 0] + (part & 31) / 32, whole[..., 1] + (part >> 5) / 32
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    plane = np.stack([(columns - 322) / 1400, (rows - 198) / 1400], -1)
    expected = CAMERA.distort(torch.from_numpy(plane)).numpy()
    assert np.abs(np.stack([x, y], -1) - expected).max() < 1 / 64 + 1e-3


def test_closed_form_is_that_of_the_library():
    """Two ways to write the same arithmetic: rounding, times a condition of at most 1e4 here."""
    edges = torch.tensor([[100, 90], [210, 130], [330, 172], [460, 220.0]], dtype=torch.float64)
    edges = edges + 3 * torch.randn(50, 4, 2, dtype=torch.float64)
    pinhole = Camera(CAMERA.matrix, torch.zeros(5))
    positions = torch.tensor([0.07, 0.1, 0.146, 0.19])
    tip, direction = closed_form(edges, positions, pinhole)
    rays = torch.cat([pinhole.undistort(edges), torch.ones(50, 4, 1, dtype=torch.float64)], -1)
    rays = torch.nn.functional.normalize(rays, dim=-1).numpy()
    found = _closed_form(rays, positions.double().numpy(), [0, 1])
    np.testing.assert_allclose(found[0], tip.numpy(), atol=1e-11)
    np.testing.assert_allclose(found[1], direction.numpy(), atol=1e-11)


def test_times_have_the_rows_of_the_table():
    OPENCV(torch.stack([scene(), torch.zeros(3, *SIZE, dtype=torch.uint8)]))
    assert tuple(OPENCV.times) == stages.STAGES
    assert all(OPENCV.times[name] > 0 for name in stages.STAGES[:-1])


def test_frames_elsewhere_than_in_the_memory_of_the_cpu_are_an_error():
    with pytest.raises(ValueError, match="frames.cpu"):
        OPENCV(torch.zeros(1, 3, 64, 64, dtype=torch.uint8, device="meta"))
