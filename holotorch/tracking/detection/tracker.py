"""CatheterTracker: frames in, for each a pose with its covariance or the reason why there is none."""

import cmath
import dataclasses
import math
import time
from collections.abc import Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import TOOL_DEVIATION
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.bands import Stretches
from holotorch.tracking.detection.channels import ChannelOrder, need_frames, stated_order
from holotorch.tracking.detection.coarse import find_segments
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.detection.ends import shows_reversed
from holotorch.tracking.detection.footprint import axis_on_plane, bulge_px, width_px
from holotorch.tracking.detection.measure import BLURRED, Edges, find_bands, halfway, measure_edges
from holotorch.tracking.detection.stations import THIRD, Axis, look_across, measure_axis, measure_width, narrowed
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.resection import LinePose, on_host, pose_on_line
from holotorch.tracking.pose.status import Pose, Refusal, Status

_FLOOR = 0.004  # pixels: what model and pixels leave in an edge, however little noise;
_SHINES = 0.010  # in an outermost one, whose tube a table's grain shines through;
_ROUND = 0.004  # of what a ring's front bulges,
_SHARED = 0.010  # in all edges alike,
_SOFT = 0.08  # of blur to all sides, since what lies beside the tube leaks into it,
_SMEAR = 0.03  # and of blur along it, which is that of a lens or of a movement
_COARSE, _ASIDE = 0.07, 0.17  # pixels: what colours between other pixels than the luma leave in an edge and a line
_UNLIKELY = {1: 10.83, 2: 13.82, 3: 16.27, 4: 18.47, 5: 20.52, 6: 22.46, 7: 24.32, 8: 26.12, 9: 27.88}  # 0.1 % of chi^2
_SLANTED = 1.5  # times as wide as at a slight tilt, 55 degrees
_PATH, _ALIKE = 2.5, 0.2  # longest way across, in widths, and how well the softness of the sides must agree with it,
_CLEAR = 0.04  # where their distance is as clear as this
_NEARLY, _EXACT = 0.01, 0.002  # how well the width is known from a rough pose, and after
_VAGUE = 0.15  # of a width, to which a tube behind three edges is known, or clutter looks like one
_WIDEST = 120.0  # pixels
_BLUR = 0.9  # pixels, to begin with
_BENT = 0.1  # pixels by which fronts bulge more or less than was thought, beyond which they want another look
_FLAT = 0.05  # pixels of a bulge that change the tube's width by nothing
_ASTRAY = 16.0  # pixels aside of a segment that its tube may show, the glow of one out of focus included
_EXCHANGED = "a frame whose red and blue are exchanged looks so; state the order of its channels (ChannelOrder)"
_MOVED = 30.0  # pixels that a catheter may move between two frames


class CatheterTracker:
    """Finds the catheter's bands on frames, and from their edges the pose.

    Coarse detection by a table of colours on every second pixel, a few line hypotheses, one strip of the frame along
    each in the lens's own coordinates, edges in linear light, or in luma where a codec has left colours fewer pixels,
    the pose by :func:`pose_on_line`. With a previous pose only the strip around it is read, 30 pixels to each side:
    what has left it is refused, and found again on a frame that comes without one. The work for a frame is bounded.

    Without a previous pose the tube's width, measured by itself, must agree with the pose, and the tube must not show
    where only the bands read from the other end would put it (:func:`shows_reversed`); with one, what was found is
    taken for the same catheter.

    Frames may be on any device; what is read of them (every second pixel of every second row, or with a previous pose
    some 15,000 pixels) is worked on by the host, where one of the thousand small calls costs less than its start does
    elsewhere. Poses are the host's.

    Args:
        camera: Intrinsics and tone curve.
        catheter: What to look for; colours saturated, of hues 25 degrees apart.
        most_sd: Standard deviation of the tip in metres above which a pose is refused as UNCERTAIN.
        channels: Order of the frames' channels. Where it is not stated frames are taken for RGB, with one warning if
            the catheter looks like itself in another order (:func:`ambiguities`).

    Attributes:
        times: Seconds that each stage of the last call took, all frames together: colour, axis, edges, pose.

    Raises:
        TypeError, ValueError: ``most_sd`` not above 0; colours that are grey, alike, or the same from both ends; in a
            call frames that are not uint8 [B, 3, H, W], or another number of previous poses.

    Source: Chapter 3 of the thesis for bands, one camera and what is asked; the method is our own.
    """

    def __init__(
        self, camera: Camera, catheter: Catheter, *, most_sd: float = 2e-3, channels: ChannelOrder | None = None
    ):
        self.camera, self.catheter = camera, catheter
        self.most_sd = checks.quantity(TOOL_DEVIATION, most_sd, "most_sd")
        self.table = ColourTable(camera, catheter)
        self.channels = stated_order(channels, camera, catheter)
        self.lens = Lens(camera)
        self._positions: list[float] = catheter.positions.tolist()
        self.times: dict[str, float] = {}

    def __call__(self, frames: Tensor, previous: Sequence[Pose] | None = None) -> list[Pose]:
        """A pose for each frame, uint8 [B, 3, H, W]; ``previous`` poses of the same cameras narrow the search."""
        need_frames(frames)
        self.camera.need_size(frames)
        if isinstance(previous, Pose) or not all(isinstance(pose, Pose) for pose in previous or ()):
            raise TypeError("previous must be a list with a Pose for each frame")
        if previous is not None and len(previous) != len(frames):
            raise ValueError(f"{len(frames)} frames take {len(frames)} previous poses, got {len(previous)}")
        frames = self.channels.to_rgb(frames)
        self.times = dict.fromkeys(("colour", "axis", "edges", "pose"), 0.0)
        return [self._track(frame, previous[i] if previous else None) for i, frame in enumerate(frames)]

    def _track(self, frame: Tensor, before: Pose | None) -> Pose:
        height, width = frame.shape[-2:]
        if height < 32 or width < 32:
            return Pose.refused(Status.BAD_FRAME, f"a frame of {height} x {width} px is too small")
        sampler = Sampler(frame, self.lens.light)
        found = on_host(before) if before is not None and before.answered else None
        try:
            if found is None:
                return self._anywhere(sampler)
            return self._along(sampler, *self._near(sampler, found), found)
        except Refusal as refusal:
            return Pose.refused(refusal.status, refusal.reason)

    def _anywhere(self, sampler: Sampler) -> Pose:
        with self._timed("colour"):
            segments = find_segments(sampler.frame, self.table)
        furthest = Status.OK, ""
        planes = self.lens.undistort(np.array([(segment.start, segment.end) for segment in segments]).ravel())
        for segment, (start, end) in zip(segments, planes.reshape(-1, 2).tolist(), strict=True):
            try:
                line = Line.between(self.lens, start, end)
                if not cmath.isfinite(line.origin + line.along):
                    raise Refusal(Status.OUTSIDE_CAMERA, "it lies where the lens's distortion cannot be inverted")
                length = abs(segment.end - segment.start)
                half = 0.5 * length + max(40.0, 0.7 * length)
                shown = self._shown(sampler, line, half, _ASTRAY, onward=False)
            except Refusal as refusal:
                # What came nearest to a pose tells most; the refusal itself would keep the frame alive.
                if refusal.status > furthest[0]:
                    furthest = refusal.status, refusal.reason
            else:  # only one line is measured: what shows the bands in their order is seldom something else
                return self._along(sampler, *shown, None)
        raise Refusal(*furthest)

    def _near(self, sampler: Sampler, found: LinePose) -> tuple[Line, Stretches]:
        """The line near a previous pose, and which bands it shows; a Refusal says so where they lie the other way."""
        line, half = self._expected(found)
        try:
            return self._shown(sampler, line, half, _MOVED, onward=True)
        except Refusal as refusal:
            if not refusal.turned:
                raise
            try:
                turned = Line(line.origin, -line.along, line.scale)
                self._shown(sampler, turned, half, _MOVED, onward=True)
            except Refusal:
                raise refusal from None
            raise Refusal(
                refusal.status, f"the bands lie along the previous line, in the other direction: {_EXCHANGED}"
            ) from None

    def _expected(self, found: LinePose) -> tuple[Line, float]:
        """Where the bands of a pose lie, and half their length with room to move."""
        start, end = (axis_on_plane(found, self._positions[n]) for n in (0, -1))
        return Line.between(self.lens, start, end), abs(end - start) * self.lens.scale / 2 + 1.5 * _MOVED

    def _shown(
        self, sampler: Sampler, line: Line, half: float, aside: float, *, onward: bool
    ) -> tuple[Line, Stretches]:
        """The line near a first one, ``half`` its length, and which bands it shows; a Refusal where these are few."""
        half = min(half, 1.5 * math.hypot(sampler.height, sampler.width))
        with self._timed("axis"):
            reach = min(0.15, 2 * aside / half) if onward else 0.06
            line, stretches = find_bands(sampler, self.lens, line, self.table, half, aside, reach, onward=onward)
        if stretches.known < 3:
            few = "a band hides, is drowned by its surroundings or leaves the frame"
            text = f"{stretches.known} edges of bands are seen, 3 are needed: {few}"
            raise Refusal(Status.BANDS_MISSING, text, turned=stretches.turned)
        return line, stretches

    def _along(self, sampler: Sampler, line: Line, stretches: Stretches, before: LinePose | None) -> Pose:
        """The pose on a line that shows the bands, or a Refusal."""
        lens = self.lens
        with self._timed("axis"):
            places = stretches.edges if before else halfway(sampler, lens, line, stretches.edges)
            near = before or self._rough(line, places)
            wide, known = (self._wide(near, line), _NEARLY) if near else (self._slight(places), THIRD)
            stations = look_across(sampler, lens, line, stretches, wide[0], _BLUR)
            axis = width = measure_axis(stations, wide, known, _BLUR)
            if before is None:
                if stretches.known == 3 and axis.width_sd > _VAGUE * axis.width:
                    raise Refusal(Status.INCONSISTENT, "3 edges, and a width too unclear to check them with")
                look = partial(look_across, sampler, lens, line, stretches)
                stations, axis, width = measure_width(look, stations, axis, wide, known)
        with self._timed("edges"):
            first = curve = self._bulge(near, axis.line) if near else np.zeros(len(places))
            guess, _ = axis.line.place(line.plane(places))
            edges = measure_edges(sampler, lens, axis, guess - curve, stretches.doubtful, _BLUR, curve)
        with self._timed("pose"):
            # What the bulge has changed by is set right without another look at the frame: the mean over a front.
            found = self._solved(axis, edges, rough=True)
            for _ in range(2):
                bulge = self._bulge(found, axis.line)
                change, curve = bulge - curve, bulge
                edges = dataclasses.replace(edges, t=edges.t - math.pi / 4 * change)
                if float(np.abs(change).max()) < _FLAT:
                    break
                found = self._solved(axis, edges, rough=True)
            plane, wide = axis.line.plane(edges.t), self._wide(found, line)
        with self._timed("axis"):
            # With the width that the pose and the radius give; what was found without them is the check.
            if before is None or abs(wide[0] - axis.width) > _NEARLY * wide[0]:
                rest = axis.blur, axis
                axis = narrowed(stations, axis, wide, _EXACT) if near else measure_axis(stations, wide, _EXACT, *rest)
                edges = dataclasses.replace(edges, t=axis.line.place(plane)[0])
        if float(np.abs(curve - first).max()) > _BENT or abs(edges.blur - edges.expected) > BLURRED:
            with self._timed("edges"):
                edges = measure_edges(sampler, lens, axis, edges.t, stretches.doubtful, edges.blur, curve)
        with self._timed("pose"):
            found = self._solved(axis, edges)
            pose = self._judged(found, width, edges, cold=before is None)
            if before is None and shows_reversed(sampler, lens, found, self.catheter):
                raise Refusal(Status.INCONSISTENT, f"the tube goes on beyond its end on one side only: {_EXCHANGED}")
            return pose

    def _rough(self, line: Line, places: np.ndarray) -> LinePose | None:
        """A first pose, from where the colours change; None where one of these places may be no edge."""
        seen = [(t, s) for t, s in zip(places.tolist(), self._positions, strict=True) if math.isfinite(t)]
        if (count := len(seen)) < 4:
            return None
        t, positions = zip(*seen, strict=True)
        found = pose_on_line(line, t, positions, [1.0] * count, 1.0, 0.01, rough=True)
        wide = width_px(found, self._positions, self.catheter.radius, line)[0] if found else 0.0
        slight = self._slight(places)[0]
        return found if slight / _SLANTED < wide < slight * _SLANTED else None

    def _slight(self, places: np.ndarray) -> tuple[float, float]:
        """Of the tube's image in pixels, roughly: from the bands' lengths at a slight tilt; and no taper."""
        seen = [(s, t) for s, t in zip(self._positions, places.tolist(), strict=True) if math.isfinite(t)]
        (near, a), (far, b) = seen[0], seen[-1]
        return min(max(2 * self.catheter.radius * 1.15 * (b - a) / (far - near), 2.0), _WIDEST), 0.0

    def _bulge(self, found: LinePose, line: Line) -> np.ndarray:
        return bulge_px(found, self._positions, self.catheter.radius, line)

    def _wide(self, found: LinePose, line: Line) -> tuple[float, float]:
        """Of the tube's image in pixels and its taper, as the pose gives them; a Refusal where no camera sees such."""
        width, taper = width_px(found, self._positions, self.catheter.radius, line)
        if not 1.0 < width < _WIDEST or not abs(taper) < 1:
            raise Refusal(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
        return width, taper

    def _solved(self, axis: Axis, edges: Edges, *, rough: bool = False) -> LinePose:
        known, last = np.isfinite(edges.t).nonzero()[0].tolist(), len(edges.t) - 1
        t: list[float] = edges.t[known].tolist()
        if len(t) < 3:
            gone = edges.outside and not edges.hidden
            status, where = (
                (Status.OUT_OF_FRAME, "lie within the frame") if gone else (Status.EDGES_UNCLEAR, "are clear")
            )
            why = ": something lies across" if edges.hidden else ""
            raise Refusal(status, f"{len(t)} edges {where}, 3 are needed{why}")
        soft, smeared = (max(0.0, blur - _BLUR) for blur in (axis.blur, edges.blur))
        floor = math.hypot(
            _FLOOR, _COARSE * edges.coarse, _ROUND * edges.bulge, _SOFT * min(soft, smeared), _SMEAR * smeared
        )
        shines = (_SHINES if n in (0, last) else 0.0 for n in known)
        along = [math.hypot(*each, floor) for each in zip(edges.deviation[known].tolist(), shines, strict=True)]
        # Shading, the same all along, moves and turns a line by more than its fit tells: over the edges both deviations
        # amount to the larger of the two.
        middle = sum(t) / len(t)
        reach = math.sqrt(sum((place - middle) ** 2 for place in t) / len(t))
        about = math.hypot(axis.offset_sd, axis.slope_sd * (middle - axis.centre), _ASIDE * edges.coarse)
        most = max(about, axis.slope_sd * reach)
        positions = [self._positions[n] for n in known]
        found = pose_on_line(axis.line, t, positions, along, most, most / max(reach, 1e-9), _SHARED, rough=rough)
        if found is None:
            raise Refusal(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
        return found

    def _judged(self, found: LinePose, axis: Axis, edges: Edges, *, cold: bool) -> Pose:
        """The pose, if nothing speaks against it; ``axis`` is that with a width of its own where the frame is cold."""
        seen = edges.t[np.isfinite(edges.t)]
        count = len(seen)
        freedom = count - 3  # the line is fitted by itself, so only places along it can disagree
        limit = _UNLIKELY.get(freedom, freedom + 4 * math.sqrt(2 * freedom) + 6) if freedom else math.inf
        if found.chi_square > limit:
            text = f"edges disagree with any pose: chi-square {found.chi_square:.1f} of {freedom}"
            raise Refusal(Status.INCONSISTENT, text)
        middle = float(seen.sum()) / count
        near, taper = self._wide(found, axis.line)
        wide = near + taper * middle
        ratio = float(axis.width_at(middle)) / wide
        most = min(0.45, (0.25 if freedom else 0.12) + (0.4 + 2 * axis.width_sd + max(0.0, axis.blur - _BLUR)) / wide)
        if axis.width_sd > (0.2 if freedom else 0.08) * wide:
            raise Refusal(Status.INCONSISTENT, f"{count} edges, and a width too unclear to check them with")
        # What moves across by more than its width looks as wide as its path, with sides as soft as it is wide.
        own = wide / math.sqrt(12)
        due = math.hypot(edges.blur, own)
        clear = axis.width_sd < _CLEAR * axis.width
        moved = clear and 1 < ratio < _PATH and abs(axis.blur / due - 1) < _ALIKE
        both = math.hypot(axis.blur, own * ratio) / due  # where width and blur are hard to tell apart, their sum is not
        if min(axis.blur, edges.blur) > own or (cold and both > max(ratio, 1.0)):
            ratio = both
        if abs(ratio - 1) > most and not moved:
            away = float((found.tip + sum(self._positions) / len(self._positions) * found.direction)[2])
            raise Refusal(Status.INCONSISTENT, f"{ratio:.2f} times as wide as it should be at {away:.2f} m")
        if found.tip_sd > self.most_sd:
            text = f"tip uncertain to {1e3 * found.tip_sd:.1f} mm, above {1e3 * self.most_sd:g} mm"
            raise Refusal(Status.UNCERTAIN, text)
        status = Status.OK if freedom else Status.UNVERIFIED
        reason = "" if freedom else "three edges determine a pose and leave nothing to check it with"
        tip, direction, covariance = map(torch.from_numpy, (found.tip, found.direction, found.covariance))
        chi_square, degrees = torch.from_numpy(np.array([found.chi_square, freedom], dtype=np.float64))
        return Pose(tip, direction, covariance, chi_square, degrees, status, reason)

    @contextmanager
    def _timed(self, stage: str):
        began = time.perf_counter()
        try:
            yield
        finally:
            self.times[stage] += time.perf_counter() - began
