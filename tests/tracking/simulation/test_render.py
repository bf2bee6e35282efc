import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.simulation.render import Look, Occluder, render

SIZE = (240, 320)
MATRIX = torch.tensor([[260.0, 0, 158], [0, 250.0, 121], [0, 0, 1]], dtype=torch.float64)
BENT = torch.tensor([-0.2, 0.05, 2e-3, -1e-3, 0], dtype=torch.float64)
LINEAR = Camera(MATRIX, BENT, "linear")
# Each band lights one channel only; nothing else is seen.
PURE = Catheter((0.03, 0.06, 0.10, 0.14), ((255, 0, 0), (0, 255, 0), (0, 0, 255)), 4e-3, 0.16)
FLAT = Look((0, 0, 0), ambient=1.0, highlight=0.0, opacity=0.0, noise_dn=0.0, blur_px=0.0)
POSES = [  # middle of the bands, tilt, roll: in line with the pixels, slanted, far off the axis, rear away
    ((0.0, 0.0, 0.3), 0, 0),
    ((0.0, 0.0, 0.3), 0, 90),
    ((0.02, -0.03, 0.25), 20, 25),
    ((0.07, 0.05, 0.25), 45, 130),
    ((-0.06, 0.05, 0.3), -35, -70),
    ((-0.02, 0.03, 0.22), 65, 200),
]


def pose(middle, tilt, roll) -> tuple[Tensor, Tensor]:
    t, r = math.radians(tilt), math.radians(roll)
    axis = torch.tensor([math.cos(t) * math.cos(r), math.cos(t) * math.sin(r), -math.sin(t)], dtype=torch.float64)
    return torch.tensor(middle, dtype=torch.float64) - 0.085 * axis, axis


def polygon(camera: Camera, tip: Tensor, axis: Tensor, start: float, end: float, radius: float) -> np.ndarray:
    """What a camera sees of a tube from ``start`` to ``end``: front arcs and the lines along which it is grazed."""
    place, way = tip.numpy(), axis.numpy()
    back = (place @ way) * way - place  # towards the camera, across the axis
    distance = float(np.linalg.norm(back))
    side = np.cross(way, back / distance)
    graze = math.acos(radius / distance)
    turns = np.linspace(-graze, graze, 400)
    arc = radius * (np.cos(turns)[:, None] * back / distance + np.sin(turns)[:, None] * side)
    along = np.linspace(start, end, 400)[:, None] * way
    outline = [start * way + arc, along + arc[-1], end * way + arc[::-1], along[::-1] + arc[0]]
    return camera.project(torch.from_numpy(place + np.concatenate(outline))).numpy()


def area_and_centre(points: np.ndarray) -> tuple[float, np.ndarray]:
    shifted = points - points.mean(0)
    following = np.roll(shifted, -1, 0)
    cross = shifted[:, 0] * following[:, 1] - following[:, 0] * shifted[:, 1]
    area = cross.sum() / 2
    return abs(area), points.mean(0) + ((shifted + following) * cross[:, None]).sum(0) / (6 * area)


def moments(light: Tensor) -> tuple[float, np.ndarray, np.ndarray]:
    """Sum, centre and second central moments (x, y) of an image [H, W]."""
    light = light.double()
    y, x = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) for side in light.shape), indexing="ij")
    total = light.sum()
    centre = torch.stack([(light * x).sum(), (light * y).sum()]) / total
    spread = torch.stack([(light * (x - centre[0]) ** 2).sum(), (light * (y - centre[1]) ** 2).sum()]) / total
    return total.item(), centre.numpy(), spread.numpy()


@pytest.mark.parametrize("where", POSES)
@pytest.mark.parametrize("blur", [0.0, 0.7])
def test_bands_lie_where_the_camera_model_puts_them(where, blur):
    """Area and centre of each band against its outline, projected point by point and never cast."""
    tip, axis = pose(*where)
    frame = render(PURE, LINEAR, tip, axis, SIZE, replace(FLAT, blur_px=blur))
    for band in range(3):
        points = polygon(LINEAR, tip, axis, PURE.edges[band], PURE.edges[band + 1], PURE.radius)
        area, centre = area_and_centre(points)
        found, at, _ = moments(frame[band] / 255)
        # Rays on a pixel's edge are counted to 1/32 of a pixel and levels to 1/510, both averaged over the outline.
        assert np.abs(at - centre).max() < 0.01
        wide = 2 * 250 * PURE.radius / 0.3
        assert abs(found - area) / wide < 0.05  # of pixels, if all of it were one edge's shift
        assert abs(found / area - 1) < 0.005


def test_whole_tube_with_its_ends():
    """Where nothing bends, outline and ends are the hull of the two end rings."""
    camera, turns = Camera(MATRIX, torch.zeros(5), "linear"), np.linspace(0, 2 * math.pi, 720)
    look = replace(FLAT, opacity=1.0, tube=(255, 255, 255))
    white = replace(PURE, colours=((255, 255, 255), (255, 255, 0), (255, 255, 255)))
    for where in (*POSES, ((0.0, 0.0, 0.5), 89.5, 10)):
        tip, axis = pose(*where)
        side = torch.linalg.cross(axis, torch.tensor([0.3, 0.9, 0.1], dtype=torch.float64))
        side = side / side.norm()
        ring = np.cos(turns)[:, None] * side.numpy() + np.sin(turns)[:, None] * torch.linalg.cross(axis, side).numpy()
        ends = [tip.numpy() + place * axis.numpy() + white.radius * ring for place in (0, white.length)]
        points = camera.project(torch.from_numpy(np.concatenate(ends))).numpy()
        area, centre = area_and_centre(cv2.convexHull(points.astype(np.float32))[:, 0].astype(float))
        found, at, _ = moments(render(white, camera, tip, axis, SIZE, look)[0] / 255)
        assert np.abs(at - centre).max() < 0.01 and abs(found / area - 1) < 0.005


def test_blur_and_motion_keep_light_and_middle():
    tip, axis = pose(*POSES[2])
    # The tube for sum and middle; a small block, whose second moments little errors do not reach, for the spread.
    block = Occluder(((150.3, 100.2), (158.3, 100.2), (158.3, 108.2), (150.3, 108.2)), (0, 255, 0))

    def both(**changes):
        tube = render(PURE, LINEAR, tip, axis, SIZE, replace(FLAT, **changes))[1]
        small = render(None, LINEAR, None, None, SIZE, replace(FLAT, occluders=(block,), **changes))[1]
        return moments(tube / 255), moments(small / 255)

    sharp = both()
    for blur, motion in ((0.7, (0, 0)), (3.0, (0, 0)), (0.7, (9.0, -4.0)), (1.0, (-2.5, 20.0))):
        found = both(blur_px=blur, motion_px=motion)
        for (total, centre, _), (first, middle, _) in zip(found, sharp, strict=True):
            assert abs(total / first - 1) < 3e-3  # faint skirts round to 0
            assert np.abs(centre - middle).max() < 0.01
        # Second moments add up: of the block as painted, a pixel, a Gaussian, a uniform path.
        spread = (found[1][0] + 1) / 12 + blur**2 + np.square(motion) / 12
        assert np.abs(found[1][2] / spread - 1).max() < 0.01


def test_light_adds_up_before_the_tone_curve_and_noise_comes_after():
    tip, axis = pose(*POSES[2])
    look = replace(FLAT, background=(90, 90, 90), blur_px=1.5, opacity=1.0)
    curved = Camera(MATRIX, BENT)
    light = render(PURE, LINEAR, tip, axis, SIZE, replace(look, background=(26, 26, 26)))
    # Level 90 of sRGB is 0.102 of light, level 26 of a linear camera.
    seen = curved.linear(render(PURE, curved, tip, axis, SIZE, look))
    assert (seen - light / 255).abs().max() < 0.5 / 255 + 0.5 * 2.4 / 255 + 1e-3
    for colour in ((30, 30, 30), (220, 220, 220)):
        frame = render(None, curved, None, None, SIZE, Look(colour, noise_dn=4.0)).double()
        # 230 400 samples: a standard error of 0.0015 of the deviation.
        assert frame.std().item() == pytest.approx(math.sqrt(16 + 1 / 12), rel=0.01)
        assert frame.mean().item() == pytest.approx(colour[0], abs=0.05)


def test_noise_follows_the_generator_and_frames_do_not_share_it():
    def frame(seed):
        return render(None, LINEAR, None, None, SIZE, Look(), generator=torch.Generator().manual_seed(seed))

    assert torch.equal(frame(3), frame(3))
    one, other = frame(3).double() - 120, frame(4).double() - 120
    limit = 5 / math.sqrt(one.numel())
    for a, b in ((one, other), (one[0], one[1]), (one[:, 1:], one[:, :-1]), (one[..., 1:], one[..., :-1])):
        assert abs((a * b).mean() / one.var()) < limit * math.sqrt(one.numel() / a.numel())


def test_only_what_the_tube_touches_changes():
    background = (torch.rand(3, *SIZE) * 255).to(torch.uint8)
    tip, axis = pose(*POSES[2])
    frame = render(PURE, Camera(MATRIX, BENT), tip, axis, SIZE, Look(background, noise_dn=0.0))
    changed = (frame != background).any(0)
    y, x = np.nonzero(changed.numpy())
    points = polygon(LINEAR, tip, axis, 0, PURE.length, PURE.radius).astype(np.float32)
    inside = [cv2.pointPolygonTest(points, (float(a), float(b)), True) for a, b in zip(x, y, strict=True)]
    assert min(inside) > -5 * 0.7 - 1 and len(inside) > 500
    behind = render(
        PURE, Camera(MATRIX, BENT), tip * torch.tensor([1, 1, -1]), -axis, SIZE, Look(background, noise_dn=0)
    )
    assert torch.equal(behind, background)


def test_a_tube_that_passes_beside_the_camera():
    """From the middle of the frame it leaves over the border, ever wider; its rear is behind the camera."""
    tip, axis = torch.tensor([0.03, 0.0, 0.25], dtype=torch.float64), torch.tensor([0, 0, -1.0], dtype=torch.float64)
    long = replace(PURE, radius=2e-3, length=0.3)
    frame = render(long, LINEAR, tip, axis, SIZE, replace(FLAT, opacity=1.0, tube=(255, 255, 255)))
    wide = (frame.amax(0) > 127).sum(0)
    # Widths 2 r f / z in the column where x = 0.03 f / z: a fifteenth of twice its distance from the centre.
    for column in range(200, 300, 20):
        assert wide[column].item() == pytest.approx(2 * 2e-3 / 0.03 * (column - 158) * 250 / 260, abs=1.6)
    assert wide[319] > 10 and not wide[:185].any()


def test_shading_gain_and_highlight():
    tip, axis = pose((0.0, 0.0, 0.3), 0, 0)
    middle = round(LINEAR.project(tip + 0.085 * axis)[0].item())

    def rows(**changes) -> Tensor:
        # Dark enough for the upper side, which gets 1.3 times what a surface gets that faces the camera.
        look = replace(FLAT, **({"gain": 0.5, "ambient": 0.2, "light": (0.0, -1.0, -1.0)} | changes))
        return render(PURE, LINEAR, tip, axis, SIZE, look)[:, :, middle].double()

    plain = rows()[1]
    lit = plain.nonzero()[:, 0]
    upper, lower = plain[lit[: len(lit) // 2]], plain[lit[-(len(lit) // 2) :]]
    assert upper.sum() > 1.2 * lower.sum()  # the light comes from above
    middle_row = round(LINEAR.project(tip + 0.085 * axis)[1].item())
    assert plain[middle_row].item() == pytest.approx(0.5 * 255, abs=4)  # what faces the camera shows its own colour,
    behind = rows(light=(0.0, 0.0, 1.0))[1][middle_row].item()
    assert behind == pytest.approx(4 * 0.2 * 0.5 * 255, abs=1)  # but where there is a quarter of that light or less
    assert (rows(gain=0.25)[1] - plain / 2).abs().max() <= 0.75
    assert (rows(ramp=(0.0, -0.5))[1] / plain)[lit[1:-1]].median() == pytest.approx(1, abs=0.02)  # at the centre
    gloss = rows(highlight=0.5)
    assert gloss[0].sum() > 50 and torch.equal(gloss[0], gloss[2])  # white: in the channels that were dark
    # The mirror stands half way between the light, 45 degrees up, and the camera: the lobe is 0.15 rad wide.
    row = (gloss[0] * torch.arange(SIZE[0])).sum() / gloss[0].sum()
    above = LINEAR.project(tip + 0.085 * axis)[1] - row
    assert above.item() == pytest.approx(250 * 4e-3 / 0.3 * math.sin(math.pi / 8), abs=0.15)


def test_ramp_changes_the_background_in_linear_light():
    frame = render(None, Camera(MATRIX, BENT), None, None, SIZE, Look((128, 128, 128), ramp=(0.4, 0.2), noise_dn=0))
    light = Camera(MATRIX, BENT).linear(frame)[0]
    centre = light[SIZE[0] // 2, SIZE[1] // 2].item()
    for row, column, factor in ((0, 0, 0.4), (0, -1, 1.2), (-1, 0, 0.8), (-1, -1, 1.6)):
        assert light[row, column].item() / centre == pytest.approx(factor, rel=0.03)  # half a level of 100


def test_video_shares_the_chroma_of_each_two_by_two_pixels():
    """The luma (BT.601) stays to the rounding of three channels, two of chroma and back: 3 levels."""
    size = (33, 47)
    noise = torch.randint(40, 200, (3, *size), generator=torch.Generator().manual_seed(3), dtype=torch.uint8)
    frame = render(None, LINEAR, None, None, size, Look(noise, noise_dn=0, video=True)).double()
    shares = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64)
    luma = lambda levels: torch.einsum("c,chw->hw", shares, levels.double())  # noqa: E731
    red = frame[0] - luma(frame)
    spread = torch.nn.functional.unfold(red[None, None, :32, :46], 2, stride=2).std(1)
    assert spread.mean() < 2 and red.std() > 15
    inside = (frame > 0).all(0) & (frame < 255).all(0)  # others are clipped
    assert (luma(frame) - luma(noise))[inside].abs().max() < 3 and inside.double().mean() > 0.5


def test_jpeg_halves_the_chroma():
    background = torch.zeros(3, *SIZE, dtype=torch.uint8)
    background[0, :, ::2], background[2, :, 1::2] = 200, 200
    frame = render(None, LINEAR, None, None, SIZE, Look(background, noise_dn=0, jpeg_quality=100)).double()
    # Neighbouring columns differ only in brightness: red less blue is alike, where it was 200 one way and the other.
    assert (frame[0] - frame[2]).abs().mean() < 40
    tip, axis = pose(*POSES[2])
    plain, fine, coarse = (
        render(PURE, LINEAR, tip, axis, SIZE, replace(FLAT, blur_px=0.7, jpeg_quality=q)).double()
        for q in (None, 90, 40)
    )
    assert 0 < (fine - plain).abs().mean() < (coarse - plain).abs().mean() < 10


def test_occluders_hide_and_are_blurred():
    tip, axis = pose((0.0, 0.0, 0.3), 0, 0)
    x, y = LINEAR.project(tip + 0.085 * axis).tolist()
    block = Occluder(((x - 5, y - 20), (x + 5, y - 20), (x + 5, y + 20), (x - 5, y + 20)), (0, 0, 255))
    sharp = render(PURE, LINEAR, tip, axis, SIZE, replace(FLAT, occluders=(block,)))
    inside = sharp[:, round(y) - 15 : round(y) + 15, round(x) - 3 : round(x) + 3]
    assert (inside[2] == 255).all() and not inside[:2].any()
    found, at, _ = moments(render(None, LINEAR, None, None, SIZE, replace(FLAT, occluders=(block,)))[2] / 255)
    # Painted polygons reach up to 0.2 pixels beyond their corners.
    assert found == pytest.approx(400, abs=0.2 * 100) and np.abs(at - [x, y]).max() < 0.13
    soft = render(None, LINEAR, None, None, SIZE, replace(FLAT, occluders=(block,), blur_px=2.0))[2]
    assert 0 < soft[round(y), round(x + 7)] < 128 < soft[round(y), round(x + 3)] < 255
    pill = Occluder.capsule((40.0, 50.0), (70.0, 50.0), 8.0, (255, 255, 255))
    area = moments(render(None, LINEAR, None, None, SIZE, replace(FLAT, occluders=(pill,)))[0] / 255)[0]
    assert area == pytest.approx(16 * 30 + math.pi * 64, rel=0.04)


def test_bad_input_is_refused():
    tip, axis = pose(*POSES[2])
    changes: tuple[tuple[dict[str, Any], str], ...] = (
        (dict(background=torch.zeros(3, 8, 8)), "uint8"),
        (dict(background=(1, 2, 300)), "8-bit"),
        (dict(gain=0.0), "gain"),
        (dict(noise_dn=math.nan), "noise_dn"),
        (dict(blur_px=-1.0), "blur_px"),
        (dict(light=(0.0, 0.0, 0.0)), "light"),
        (dict(ramp=(0.7, 0.7)), "ramp"),
        (dict(motion_px=(math.inf, 0.0)), "motion_px"),
        (dict(jpeg_quality=0), "jpeg_quality"),
    )
    for bad, words in changes:
        with pytest.raises(ValueError, match=words):
            Look(**bad)
    for corners in (((0.0, 0.0), (1.0, 1.0)), ((0.0, 0.0), (1.0, 1.0), (math.nan, 0.0))):
        with pytest.raises(ValueError, match="corners"):
            Occluder(corners, (0, 0, 0))
    for at, along, error, words in (
        (tip, 2 * axis, ValueError, "unit vector"),
        (tip * math.nan, axis, ValueError, "finite"),
        (tip[:2], axis, TypeError, "shape"),
        (None, axis, TypeError, "tip"),
        (-0.05 * axis, axis, ValueError, "camera"),
    ):
        with pytest.raises(error, match=words):
            render(PURE, LINEAR, at, along, SIZE)
    with pytest.raises(ValueError, match="size"):
        render(PURE, LINEAR, tip, axis, (4, 320))
    with pytest.raises(ValueError, match="background"):
        render(PURE, LINEAR, tip, axis, SIZE, Look(torch.zeros(3, 10, 10, dtype=torch.uint8)))
