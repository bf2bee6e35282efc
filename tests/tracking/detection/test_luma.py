"""Whether a codec has halved the colours' resolution, and where edges lie by what it has left: their luma."""

import math
import warnings
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from oracles import codec
from torch import Tensor
from tracked import truth

from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection import luma, measure
from holotorch.tracking.detection import tracker as tracker_module
from holotorch.tracking.detection.axis_fit import AxisFit
from holotorch.tracking.detection.channels import ChannelOrder
from holotorch.tracking.detection.fits import EdgeFit, fit_edges
from holotorch.tracking.detection.footprint import Front
from holotorch.tracking.detection.luma import coarse_colours, fit_coarse_axis, fit_luma
from holotorch.tracking.detection.stations import Axis, Stations, best_contrast, moved, variance_of
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation import scenery
from holotorch.tracking.simulation.world import Case, World, synthetic_camera

WORLD = World()
TRACKER = CatheterTracker(WORLD.camera, WORLD.catheter)
CURVE = TRACKER.lens.light
CODECS = {"4:2:0 video": codec.i420, "jpeg 95": codec.jpeg}
LINE = Line(0j, 1 + 0j, 1000.0)
ROWS, COUNT, NOISE = 5, 23, 2.5
RED, GREEN, BLUE = WORLD.catheter.colours
TUBE = (228, 228, 222)


def coded(frame: Tensor, name: str) -> Tensor:
    """Frame [3, H, W] after a codec, in the memory of a camera's frame."""
    return torch.from_numpy(np.ascontiguousarray(CODECS[name](frame.permute(1, 2, 0).numpy()))).permute(2, 0, 1)


def asked(frame: Tensor, pixels: list[complex], at_once: int = 3) -> list[bool]:
    """Answers for groups of pixels; the tracker asks for three edges at once."""
    sampler = Sampler(frame, CURVE)
    groups = [pixels[i : i + at_once] for i in range(0, len(pixels), at_once)]
    return [coarse_colours(sampler, np.array(group)) for group in groups]


def everywhere(frame: Tensor, step: int = 97) -> list[complex]:
    """Pixels all over a frame, its four corners too."""
    height, width = frame.shape[1:]
    inner = [complex(x, y) for y in range(0, height, step) for x in range(0, width, step)]
    return [*inner, complex(width - 1, 0), complex(0, height - 1), complex(width - 1, height - 1)]


@cache
def shown(roll: int) -> tuple[Tensor, list[complex]]:
    """A frame, and the pixels of its band edges."""
    pose = WORLD.pose(0.5, 0.3, math.radians(roll))
    frame = WORLD.case(f"roll {roll}", pose).frame()
    points = WORLD.camera.project(pose[0] + WORLD.catheter.positions[:, None] * pose[1])
    return frame, [complex(x, y) for x, y in points.tolist()]


def stripes(noise: float, blur: float = 0.8) -> Tensor:
    """A frame [3, 200, 300] of oblique stripes in two colours, with independent noise in each channel."""
    y, x = np.mgrid[:200, :300]
    band = (np.sin((x + 0.4 * y) / 4) > 0).astype(float)
    mixed = cv2.GaussianBlur(band, (0, 0), blur)[None]
    colours = np.array([RED, (120, 120, 120)], dtype=float)[:, :, None, None]
    levels = mixed * colours[0] + (1 - mixed) * colours[1] + noise * np.random.default_rng(1).normal(size=(3, 200, 300))
    return torch.from_numpy(np.round(levels).clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize("noise", [0.0, 1.0, 2.5, 8.0])
def test_colours_are_coarse_from_a_codec_alone_whatever_the_noise(noise):
    """Also without noise, as from cameras that remove it."""
    frame = stripes(noise)
    assert not any(asked(frame, everywhere(frame, 31)))
    for name in CODECS:
        assert all(asked(coded(frame, name), everywhere(frame, 31))), name


def test_noise_of_each_channels_own_and_flat_colours_are_no_codecs():
    levels = 120 + 2.5 * np.random.default_rng(1).normal(size=(3, 200, 300))
    frame = torch.from_numpy(np.round(levels).clip(0, 255).astype(np.uint8))
    assert not any(asked(frame, everywhere(frame, 31)))
    assert not any(asked(torch.full_like(frame, 120), everywhere(frame, 31)))


def test_colours_that_were_smoothed_all_along_are_coarse_too():
    """A ramp of red, as between two colours that a reader has mixed: it rises by more than noise, and bends by less."""
    grey = 120 + 3 * np.random.default_rng(1).normal(size=(1, 60, 60)) * np.ones((3, 1, 1))
    grey[0] += 4 * np.arange(-30, 30).clip(-14, 14)
    smooth = torch.from_numpy(np.round(grey).clip(0, 255).astype(np.uint8))
    assert asked(smooth, [30 + 30j]) == [True]
    grey[0] += 3 * np.random.default_rng(2).normal(size=(60, 60))
    noisy = torch.from_numpy(np.round(grey).clip(0, 255).astype(np.uint8))
    assert asked(noisy, [30 + 30j]) == [False]


@pytest.mark.parametrize("name", CODECS)
def test_a_desk_from_a_codec_has_coarse_colours_to_its_corners(name):
    frame = WORLD.case("desk", None).frame()
    pixels = everywhere(frame)
    assert not any(asked(frame, pixels)) and all(asked(coded(frame, name), pixels))


@pytest.mark.parametrize("roll", range(0, 180, 20))
def test_bands_at_any_roll_have_coarse_colours_from_a_codec_alone(roll):
    """At the first and last edge half of the patch is desk; between two bands of a JPEG their colours may ring."""
    frame, pixels = shown(roll)
    assert not any(asked(frame, pixels))
    assert all(asked(coded(frame, "4:2:0 video"), pixels))
    assert any(asked(coded(frame, "jpeg 95"), pixels[::3]))


def test_a_photographs_colours_are_its_own():
    """Strong shapes of all scales, with each pixel's own noise; grain of one grey is left out: it is a codec's too."""
    grainless = scenery.texture(WORLD.size, 0).numpy().transpose(1, 2, 0)
    smooth = torch.nn.functional.avg_pool2d(torch.from_numpy(grainless).permute(2, 0, 1).float(), 9, 1, 4)
    frame = WORLD.case("texture", None, lambda: smooth.round().to(torch.uint8)).frame()
    pixels = everywhere(frame)
    assert np.mean(asked(frame, pixels)) < 0.05
    assert np.mean(asked(coded(frame, "4:2:0 video"), pixels)) > 0.95


@pytest.mark.parametrize("name", [None, *CODECS])
def test_memory_makes_no_difference(name):
    frame = shown(40)[0] if name is None else coded(shown(40)[0], name)
    planar = frame.contiguous(memory_format=torch.contiguous_format)
    camera = frame.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    assert planar.stride() != camera.stride()
    pixels = [*shown(40)[1], *everywhere(frame, 301)]
    assert asked(planar, pixels) == asked(camera, pixels)


def both(places, blur, ends, levels=codec.levels_of, curve=CURVE) -> tuple[EdgeFit, EdgeFit, EdgeFit]:
    """Fits of all channels, of the surer, and of luma, to edges whose colours lie half a pixel on."""
    rng, (before, after) = np.random.default_rng(3), ends
    light = curve[codec.edges(places, blur, before, after, COUNT, ROWS, NOISE, rng, levels)]
    seen = np.ones(light.shape[:3])
    fit = fit_edges(light, seen[..., None] / variance_of(light), 0.9)
    return fit, *fit_luma(fit, light, seen, curve)


@pytest.mark.parametrize("blur", [0.7, 0.9, 1.5])
@pytest.mark.parametrize("ends", [(RED, GREEN), (GREEN, BLUE), (BLUE, TUBE)], ids=["1", "2", "3"])
def test_luma_tells_the_place_as_well_as_its_noise_lets_it(ends, blur):
    """White noise in levels leaves a place at least ``bound``; the blur, found from the same samples, a little more.

    200 errors have a root mean square that is known to 5 %, four times that is a fifth; 2 % of a blur for levels that
    colours half a pixel aside have bent and clipped. The stated deviation is 1.2 times the scatter of such samples.
    """
    place = np.random.default_rng(1).uniform(-0.5, 0.5, 200)
    every, found, luma = both(place, blur, ends)
    (before, after), noise = ends, math.hypot(NOISE, 1 / math.sqrt(12))
    least = codec.bound(blur, before, after, COUNT, ROWS, noise)
    missed = found.place - place
    scatter = math.sqrt(float((missed * missed).mean()))
    assert scatter < math.hypot(1.2 * least, 0.02 * blur)
    assert np.median(found.deviation) == pytest.approx(1.2 * least, rel=0.4)
    assert scatter < 0.5 * math.sqrt(float(((every.place - place) ** 2).mean()))
    assert np.median(found.blur) == pytest.approx(blur, rel=0.03)
    assert (found.place == luma.place).all() and (luma.told > 0).all() and luma.steps.shape == (200, ROWS, 1)


def test_edges_without_luma_keep_their_place_and_say_that_it_may_be_half_a_colour_off():
    """A linear tone curve: colours of one luma have it all along the edge, where it tells nothing."""
    flat = np.arange(256, dtype=np.float32) / 255
    ends = (150, 60, 60), (60, 60 + 90 * codec.SHARES[0] / codec.SHARES[1], 60)
    place = np.random.default_rng(1).uniform(-0.3, 0.3, 60)
    every, found, luma = both(place, 0.9, ends, lambda light: 255 * light, flat)
    kept = found.place == every.place
    assert (luma.told[kept] == 0).all()  # what light does across a tube is asked of luma alone
    assert kept.mean() > 0.9  # noise may pass for an edge
    assert (found.deviation[kept] >= 0.25).all() and np.abs(every.place - place).mean() > 0.25
    missed = np.abs(found.place - place)[kept]
    assert (missed < 3 * found.deviation[kept]).all()
    # Those channels that are as clear as before are still widened, never narrowed.
    assert (found.deviation[kept] > every.deviation[kept]).all()


@cache
def tracked(name: str, by_luma: bool) -> list[tuple[Pose, Case]]:
    """Ten poses, cold; without ``by_luma`` as if no codec had been there."""
    rng, found = np.random.default_rng(0), []
    with pytest.MonkeyPatch.context() as patch:
        if not by_luma:
            patch.setattr(measure, "coarse_colours", lambda sampler, pixel: False)
        for i in range(10):
            depth, tilt, roll = rng.uniform([0.4, 0.1, 0], [0.6, 0.5, 2 * math.pi])
            case = WORLD.case(f"coded {i}", WORLD.pose(depth, tilt, roll))
            found.append((TRACKER(coded(case.frame(), name)[None])[0], case))
    return found


def missed(found: list[tuple[Pose, Case]]) -> np.ndarray:
    """Of answered poses, in metres."""
    return np.array([float((pose.tip - truth(case)[0]).norm()) for pose, case in found if pose.answered])


@pytest.mark.parametrize("name", CODECS)
def test_frames_from_a_codec_are_answered_within_what_is_stated(name):
    """3 stated deviations of all three axes are passed once in 1000; one of ten may be refused."""
    found = tracked(name, True)
    assert sum(pose.answered or pose.status is Status.UNCERTAIN for pose, _ in found) >= 9
    stated = np.array([float(pose.tip_sd) for pose, _ in found if pose.answered])
    assert (missed(found) < 3 * stated).all() and np.median(stated) < 1e-3


@pytest.mark.parametrize("name", CODECS)
def test_an_edge_of_two_colours_of_the_same_luma_is_measured_by_its_chroma(name):
    """Mustard on a pale tube, and magenta beside it: a fit to luma alone follows noise."""
    mustard, indigo, pale = (235, 200, 60), (60, 60, 190), (228, 60, 160)
    world = World(catheter=replace(WORLD.catheter, colours=(mustard, indigo, pale)))
    tracker = CatheterTracker(world.camera, world.catheter, channels=ChannelOrder.RGB)
    rng, right = np.random.default_rng(4), []
    for i in range(20):
        depth, tilt, roll = rng.uniform([0.3, 0.1, 0], [0.4, 0.5, 2 * math.pi])
        case = world.case(f"coded {i}", world.pose(depth, tilt, roll))
        pose = tracker(coded(case.frame(), name)[None])[0]
        right.append(pose.answered and float((pose.tip - truth(case)[0]).norm()) < 4 * float(pose.tip_sd))
    assert sum(right) >= 19


@pytest.mark.parametrize("quality", [85, 95])
def test_the_axis_of_a_thin_tube_with_light_from_one_side_is_in_its_middle(quality, monkeypatch):
    """Of 5 pixels: smeared chroma moves a fit to all channels to one side, always the same."""
    catheter = replace(WORLD.catheter, colours=((225, 190, 82), (82, 88, 202), (194, 81, 141)), radius=1.4e-3)
    world = World(camera=synthetic_camera((480, 640)), catheter=catheter)
    tracker = CatheterTracker(world.camera, catheter, channels=ChannelOrder.RGB, most_sd=1e-2)
    middle = float(catheter.positions.mean())
    wall = torch.tensor([67, 111, 119], dtype=torch.uint8)[:, None, None].expand(3, *world.size)
    cases = [
        world.case(f"lit {roll}", world.pose(0.27, 0.17, math.radians(roll)), lambda: wall, noise_dn=0.5)
        for roll in (22, 23, 24, 25, 26, -155)
    ]
    frames = [codec.jpeg(case.frame().permute(1, 2, 0).numpy(), quality) for case in cases]

    def offset() -> float:
        """Root mean square of the line's distance from the tube's middle in pixels."""
        offsets = []
        for case, frame in zip(cases, frames, strict=True):
            pose = tracker(torch.from_numpy(np.ascontiguousarray(frame)).permute(2, 0, 1)[None])[0]
            tip, direction = truth(case)
            points = [tip + middle * direction, tip + (middle + 0.01) * direction, pose.point(middle)]
            start, end, measured = (complex(*world.camera.project(point[None])[0].tolist()) for point in points)
            along = (end - start) / abs(end - start)
            offsets.append(((measured - start) * along.conjugate()).imag)
        known = np.isfinite(offsets)
        assert known.sum() >= 5  # of six frames; a refused one has no place
        return float(np.sqrt(np.mean(np.square(np.array(offsets)[known]))))

    assert offset() < 0.15
    monkeypatch.setattr(tracker_module, "fit_coarse_axis", lambda _, axis, *rest: axis)
    assert offset() > 0.3


def test_an_axis_that_neither_chroma_nor_luma_shows_is_kept():
    """A grey tube as bright as its surroundings; its errors grow by the displacement of chroma."""
    rng = np.random.default_rng(3)
    light = CURVE[np.clip(120 + rng.normal(size=(3, 12, 25)), 0, 255).astype(int)]
    band = np.repeat([0, 1], 6)
    given = best_contrast(light, 6.0, band, 1)
    stations = Stations(LINE, 110.0, light, 1, given[0], given[1], np.linspace(-55, 55, 12), band, *given[2:])
    fit = AxisFit(np.r_[0.1, 0.2, 6, 0, 0.9, np.zeros(8)], np.eye(13) * 1e4, 55.0, (1.0, 1.0), np.ones(12), 0.0)
    before = moved(stations, Axis(LINE, 6.0, 0.0, 0.1, 0.0, 0.0, 0.0, fit), fit.sides[:2], fit.covariance[:2, :2])
    after = fit_coarse_axis(stations, before, CURVE, (6.0, 0.0), 0.01)
    assert after.line == before.line
    assert math.isclose(after.offset_sd, math.hypot(before.offset_sd, luma._DISPLACED), rel_tol=0.01)


def test_without_luma_the_tip_would_be_several_times_as_far_off():
    """Colours that lie half a pixel aside move edges by half a pixel; the luma's places scatter by 0.04."""
    assert np.median(missed(tracked("4:2:0 video", False))) > 3 * np.median(missed(tracked("4:2:0 video", True)))


def test_slanted_rings_of_coarse_colours_are_where_their_light_shows_them(monkeypatch):
    """Shaded paint moves all rings alike, and the depth by 0.4 mm at 30 degrees, unless luma's steps say how.

    Over 16 rolls the mean has a standard error of its own: within three of it, and farther without.
    """

    poses = [WORLD.pose(0.45, math.radians(30), i * math.pi / 8) for i in range(16)]
    cases = [WORLD.case(f"slanted {i}", pose) for i, pose in enumerate(poses)]
    frames = [coded(case.frame(), "jpeg 95")[None] for case in cases]

    tracker = CatheterTracker(WORLD.camera, WORLD.catheter, most_sd=1e-2)

    def deviations() -> float:
        both = zip(cases, frames, strict=True)
        missed = [float((tracker(frame)[0].tip - truth(case)[0])[2]) for case, frame in both]
        return float(abs(np.mean(missed)) / (np.std(missed, ddof=1) / math.sqrt(len(missed))))

    assert deviations() < 3
    monkeypatch.setattr(Front, "shift", lambda *_: 0.0)
    assert deviations() > 3


def test_the_line_is_as_far_aside_as_is_stated():
    """The middle of the bands, across: ten ratios have a root mean square that is known to 22 %, four times that."""
    ratios = []
    for pose, case in tracked("4:2:0 video", True):
        if pose.answered:
            tip, direction = truth(case)
            normal = torch.linalg.cross(tip, direction)
            normal = normal / normal.norm()
            lever = torch.cat([normal, 0.127 * normal])
            aside = float(normal @ pose.point(0.127))
            ratios.append(aside / math.sqrt(float(lever @ pose.covariance @ lever)))
    assert len(ratios) >= 8 and math.sqrt(np.mean(np.square(ratios))) < 1 + 4 * 0.22


def test_patches_end_at_the_frames_border():
    """A frame hardly larger than a patch, asked beyond all sides: the same patch as at its border."""
    frame = torch.from_numpy(np.random.default_rng(2).integers(100, 140, (3, 32, 40)).astype(np.uint8))
    other = frame.clone()
    right = 40 - luma._PATCH  # first column of the rightmost patch, in which pairs of columns are equal
    other[:, :, right:] = other[:, :, right::2].repeat_interleave(2, -1)
    assert asked(other, [-50 + 5j, 0j, 12 + 12j, 12 + 90j], 1) == [False] * 4
    assert asked(other, [39 + 5j, 99 + 31j], 1) == asked(other, [28 + 16j, 28 + 20j], 1) == [True, True]


def test_a_tube_as_wide_as_the_samples_does_not_stand_out():
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a mean over no sample is one
        assert not luma._stands_out(np.ones((4, 9)), np.zeros(4, dtype=int), 30.0).any()
