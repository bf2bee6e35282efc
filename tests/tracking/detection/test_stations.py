"""Mid-line and width from stations across the bands, of scenes whose light follows from a formula."""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest
import torch

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line
from holotorch.tracking.detection import stations as module
from holotorch.tracking.detection.axis_fit import AxisFit
from holotorch.tracking.detection.bands import Stretches
from holotorch.tracking.detection.stations import THIRD, Stations, look_across, measure_axis, measure_width, narrowed
from holotorch.tracking.pose.status import Refusal, Status

LENS = Lens(
    Camera(torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]]), torch.tensor([-0.05, 0.02, 1e-3, -5e-4, 0]))
)
LINE = Line.between(LENS, -0.1 + 0.02j, 0.12 + 0.05j)
CUTS = (-120.0, -40.0, 40.0, 120.0)
LEVELS = np.array([[0.45, 0.03, 0.04], [0.03, 0.30, 0.07], [0.03, 0.07, 0.45]])  # light of three bands
SIDES = (np.array([0.20, 0.17, 0.12]), np.array([0.22, 0.18, 0.13]))  # and of what lies to their left and right


def rise(z: np.ndarray) -> np.ndarray:
    return 0.5 * torch.erfc(torch.from_numpy(-z / math.sqrt(2))).numpy()


@dataclasses.dataclass
class Scene:
    """In the place of a frame's sampler: a blurred tube along ``line``, bent to a parabola."""

    line: Line = LINE
    width: float = 8.0
    blur: float = 0.9
    levels: np.ndarray = dataclasses.field(default_factory=LEVELS.copy)
    sides: tuple[np.ndarray, np.ndarray] = SIDES
    noise: float = 0.002
    taper: float = 0.0
    bend: float = 0.0  # pixels aside at both ends
    gloss: float = 0.0  # white light that the last band sends back, rising from none on its left to this on its right

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        t, u = self.line.place(LENS.undistort(pixels.ravel()))
        u = u - self.bend * (t / CUTS[-1]) ** 2
        half = (self.width + self.taper * t) / 2
        left, right = rise(-(u + half) / self.blur), rise((u - half) / self.blur)
        own = self.levels[np.clip(np.digitize(t, CUTS) - 1, 0, len(self.levels) - 1)].T
        light = self.sides[0][:, None] * left + self.sides[1][:, None] * right + own * (1 - left - right)
        if self.gloss:
            q = np.linspace(-1, 1, 33)
            steps = np.diff(rise((u - half * q[:, None]) / self.blur), axis=0)  # less by what each of 32 strips shows
            light = light - (t > CUTS[-2]) * self.gloss * ((1 + (q[1:] + q[:-1]) / 2) / 2 @ steps)
        light = light + self.noise * np.random.default_rng(1).normal(size=light.shape)
        return light.reshape(3, *pixels.shape).astype(np.float32)


def stretches(*edges: float, shown: float = 1.0) -> Stretches:
    """Bands between ``edges``, of which a share is shown."""
    places = np.array(edges or CUTS)
    whole = tuple(float(gap) if math.isfinite(gap) else 0.0 for gap in np.diff(places))
    part = tuple(shown * length for length in whole)
    return Stretches(places, places, part, whole, (False,) * len(places), False)


def looked(scene: Scene, width: float | None = None, line: Line = LINE, given: Stretches | None = None) -> Stations:
    wide = scene.width if width is None else width
    return look_across(scene, LENS, line, given or stretches(), wide, 0.9)  # type: ignore[arg-type]


def aside(axis, line: Line) -> np.ndarray:
    """How far an axis lies from the true line at both ends of the bands, in pixels."""
    return line.place(axis.line.plane(np.array([CUTS[0], CUTS[-1]])))[1]


@pytest.mark.parametrize(
    ("given", "status"),
    [
        (stretches(math.nan, -40, math.nan, 120), Status.BANDS_MISSING),
        (stretches(*CUTS, shown=0.3), Status.BANDS_MISSING),
        (stretches(0, 10, 20), Status.BANDS_MISSING),
        (stretches(0, 11, math.nan), Status.TOO_NARROW),
    ],
    ids=["no two edges of one band", "bands that are hidden", "bands of 10 px", "five stations"],
)
def test_where_too_little_of_the_bands_is_seen_it_is_refused(given, status):
    with pytest.raises(Refusal) as refusal:
        looked(Scene(), given=given)
    assert refusal.value.status is status


@pytest.mark.parametrize("width", [4.0, 10.0, 30.0, 60.0, 100.0])
def test_wide_tubes_take_fewer_stations_and_never_too_few(width):
    """8 or, of wide tubes, so many that they have 700 samples; one for each band more, and 6 at least."""
    found = looked(Scene(width=width))
    count, across = found.signal.shape
    assert across >= 1.2 * width + 8 and across % 2 == 1 and found.show(width, 0.9)
    assert 6 <= count <= min(8, max(6, 700 // across)) + 3
    assert found.weight.shape == found.signal.shape and found.t.shape == found.band.shape == (count,)
    assert found.level.shape == found.bright.shape == (3,)
    inner = np.array(CUTS)
    assert (found.t - inner[found.band] > 3).all() and (inner[found.band + 1] - found.t > 3).all()


def test_a_band_shorter_than_a_station_has_one_all_the_same():
    """222 px of three bands make stations some 28 px long; the one in the middle has 6 px within its edges."""
    line = LINE.moved(0.4, 0.002)
    found = looked(Scene(line), given=stretches(-120, -6, 6, 120))
    assert found.band.tolist() == [0] * 4 + [1] + [2] * 4 and np.isfinite(found.signal).all()
    axis = measure_axis(found, (8.0, 0.0), 0.01, 0.9)
    assert np.abs(aside(axis, line)).max() < 4 * axis.offset_sd + 0.01


@pytest.mark.parametrize("known", [0.01, THIRD])
@pytest.mark.parametrize("width", [4.0, 8.0, 25.0])
def test_line_width_and_deviations_of_a_tube_are_right(width, known):
    """4 stated deviations, and a hundredth of a pixel for what sampling between lines of bent strips leaves."""
    line = LINE.moved(0.6, -0.003)
    axis = measure_axis(looked(Scene(line, width, taper=0.004)), (width, 0.004), known, 0.9)
    reach = np.abs(np.array([CUTS[0], CUTS[-1]]) - axis.centre)
    assert (np.abs(aside(axis, line)) < 4 * np.hypot(axis.offset_sd, axis.slope_sd * reach) + 0.01).all()
    assert float(axis.width_at(0.0)) == pytest.approx(width, abs=4 * axis.width_sd + 0.01)
    assert axis.blur == pytest.approx(0.9, abs=0.1)
    assert axis.offset_sd < 0.012 * width + 0.02


def test_a_band_whose_channels_cancel_in_its_mix_does_not_pull_the_axis():
    """Its level is nought where it was first looked for, 1 px beside one end; its channels are not.

    Its gloss is free within what channels may amount to that do not cancel; bound to nought, it would pass for a tube
    that lies 0.05 px aside. 4 deviations of the noise, 0.007 px at an end, and a hundredth of a pixel.
    """
    line, own = LINE.moved(0.5, 0.5 / 120), np.array([0.30, 0.30, 0.06])
    away = line.place(LINE.plane(np.array([CUTS[0], CUTS[-1]])))[1]
    assert np.abs(away).min() < 0.01 and np.abs(away).max() == pytest.approx(1.0, abs=0.01)

    def scene(green: float) -> Scene:
        around = np.array([0.20, green, 0.06])
        return Scene(line, 8.0, levels=np.stack([LEVELS[0], LEVELS[2], own]), sides=(around, around), gloss=0.1)

    low, high = 0.32, 1.0
    for _ in range(50):  # the surroundings of which that is true
        green = (low + high) / 2
        low, high = (low, green) if looked(scene(green)).level[2] < 0 else (green, high)
    found = looked(scene(low))
    assert abs(found.level[2]) < 1e-6 and found.bright[2] > 0.1
    axis = measure_axis(found, (8.0, 0.0), 0.01, 0.9)
    noise = math.sqrt(axis.fit.covariance[0, 0] + axis.fit.covariance[1, 1] * CUTS[-1] ** 2)
    assert noise < 0.008
    assert np.abs(aside(axis, line)).max() < 4 * noise + 0.01


def fitted(monkeypatch, width: float, **changes) -> None:
    """Fits that end at a width, whatever is seen."""
    unknown = np.zeros(17)
    unknown[2], unknown[4] = width, 0.9
    fit = AxisFit(unknown, np.eye(17), 100.0, (1.0, 0.9), np.ones(12), 0.0)
    monkeypatch.setattr(module, "fit_axis", lambda *given: dataclasses.replace(fit, **changes))


@pytest.mark.parametrize(
    ("width", "changes", "status", "reason"),
    [
        (-3.0, {}, Status.NO_AXIS, "no clear sides"),
        (19.5, {}, Status.NO_AXIS, "no clear sides"),
        (8.0, {"normal": np.full((17, 17), np.nan)}, Status.NO_AXIS, "no clear sides"),
        (8.0, {"contrast": (0.14, 1.0)}, Status.NO_AXIS, "too wide"),
        (8.0, {"weight": np.array([1.0] * 5 + [0.1] * 7)}, Status.NO_AXIS, "one straight line"),
        (8.0, {"moving": 4.0}, Status.NO_AXIS, "no clear sides"),
        (1.3, {}, Status.TOO_NARROW, "2.4 px are needed"),
    ],
    ids=["negative", "twice as wide", "nothing seen", "one-sided", "bent", "restless", "narrow"],
)
def test_fits_that_are_no_tube_are_refused(monkeypatch, width, changes, status, reason):
    found = looked(Scene())
    fitted(monkeypatch, 8.0)
    assert measure_axis(found, (8.0, 0.0), THIRD, 0.9).width == 8.0
    fitted(monkeypatch, width, **changes)
    with pytest.raises(Refusal, match=reason) as refusal:
        measure_axis(found, (8.0, 0.0), THIRD, 0.9)
    assert refusal.value.status is status


REFUSED = {
    "the bands' colours go on to one side": (Scene(sides=(SIDES[0], LEVELS[1]), levels=LEVELS[[1] * 3]), 8.0),
    "bent": (Scene(bend=20.0), 8.0),
    "narrow": (Scene(width=1.2, noise=0.0005), 2.0),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_straight_tube_with_two_sides_is_refused(kind):
    scene, width = REFUSED[kind]
    with pytest.raises(Refusal) as refusal:
        measure_axis(looked(scene, width), (width, 0.0), 0.1, 0.9)
    assert refusal.value.status in (Status.NO_AXIS, Status.TOO_NARROW)
    assert (refusal.value.status is Status.TOO_NARROW) == (kind == "narrow")


@pytest.mark.parametrize("width", [3.0, 6.0, 12.0, 30.0])
def test_the_rough_width_is_right_to_a_pixel(width):
    """Samples a pixel apart of which a sharp tube covers ``width``, one more or less; half as much again is seen."""
    found = looked(Scene(width=width), 1.5 * width)
    assert found.rough_width() == pytest.approx(width, abs=1.5)


@pytest.mark.parametrize(("width", "wide"), [(8.0, 8.0), (8.0, 9.0), (13.0, 8.0), (5.0, 10.0)])
def test_the_width_of_its_own_is_found_whatever_was_thought(width, wide):
    """Also where the tube reaches beyond what was looked at; the axis is that of the width that was thought."""
    scene = Scene(LINE.moved(0.3, 0.001), width)
    looks = []

    def look(wide: float, blur: float) -> Stations:
        looks.append(wide)
        return look_across(scene, LENS, LINE, stretches(), wide, blur)  # type: ignore[arg-type]

    first = looked(scene, wide)
    start = measure_axis(first, (wide, 0.0), 0.3, 0.9)
    found, axis, own = measure_width(look, first, start, (wide, 0.0), 0.3)
    assert own.width == pytest.approx(width, abs=4 * own.width_sd + 0.02) and own.width_sd < 0.05 * width
    assert found.show(own.width, own.blur) and bool(looks) == (found is not first)
    assert bool(looks) == (not first.show(own.width, own.blur))
    assert np.abs(aside(own, scene.line)).max() < 0.1
    assert (axis is start) == (not looks)


def test_a_width_that_is_free_already_is_its_own():
    found = looked(Scene())
    start = measure_axis(found, (8.0, 0.0), THIRD, 0.9)
    _, axis, own = measure_width(partial(pytest.fail, "no second look"), found, start, (8.0, 0.0), THIRD)  # type: ignore[arg-type]
    assert own is start and axis is start


def test_what_comes_to_be_known_changes_an_axis_as_a_new_fit_would():
    """To first order: a width that is 3 % wrong moves the rest by thousandths of a pixel, and narrows deviations."""
    scene = Scene(LINE.moved(0.3, 0.001), 8.0)
    found = looked(scene)
    free = measure_axis(found, (8.3, 0.0), THIRD, 0.9)
    one, other = narrowed(found, free, (8.0, 0.0), 0.002), measure_axis(found, (8.0, 0.0), 0.002, 0.9, free)
    both = (free.width_sd**-2 + 0.016**-2) ** -0.5
    assert one.width == pytest.approx(8.0, abs=4 * both) and one.width_sd == pytest.approx(both, rel=0.05)
    assert abs(complex(one.line.origin - other.line.origin)) * LENS.scale < 0.02
    assert one.width_sd < free.width_sd and one.offset_sd <= free.offset_sd
