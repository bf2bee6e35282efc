"""CatheterTracker: takes frames, and gives for each a pose with its covariance or the reason why there is none."""

import cmath
import dataclasses
import math
import time
from collections.abc import Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
from scipy.special import chdtri
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import TOOL_DEVIATION
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.bands import Stretches
from holotorch.tracking.detection.channels import ChannelOrder, need_frames, stated_order
from holotorch.tracking.detection.coarse import find_segments
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.detection.ends import shows_reversed
from holotorch.tracking.detection.footprint import axis_on_plane, bulge_px, width_px
from holotorch.tracking.detection.measure import BLURRED, Edges, find_bands, halfway, measure_edges
from holotorch.tracking.detection.stations import (
    STATION_PLAN,
    THIRD,
    Axis,
    StationPlan,
    look_across,
    measure_axis,
    measure_width,
    narrowed,
)
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.resection import LinePose, on_host, pose_on_line
from holotorch.tracking.pose.status import Pose, Refusal, Status


@dataclasses.dataclass(frozen=True)
class ErrorFloors:
    """Errors of edges and line that do not shrink with the noise, 1 sigma in pixels unless said otherwise.

    Determined on synthetic frames, so that the 95 % ellipsoids of poses hold the truth in about 95 % of the frames.
    """

    model: float = 0.004  # error of one edge: the edge profile and the sampling by pixels are approximate
    transparency: float = 0.010  # more for an outermost edge: the background shines through the clear tube beside it
    bulge: float = 0.004  # more for each pixel by which the front of a ring bulges in the image
    shared: float = 0.010  # error that all edges of a frame have in common
    defocus: float = 0.08  # more for each pixel of blur in all directions: light from beside the tube leaks into it
    smear: float = 0.03  # more for each pixel of blur along the tube, from the lens or from motion
    coarse_edge: float = 0.07  # more for an edge where colours have fewer pixels than the luma (4:2:0 codecs)
    coarse_line: float = 0.17  # more for the offset of the line in the same case


@dataclasses.dataclass(frozen=True)
class WidthCheck:
    """Limits of the check that the tube is as wide as its pose says. Determined on synthetic frames."""

    slant: float = 1.5  # largest factor between the widths by a rough pose and by the length of the bands: 55 degrees
    vague: float = 0.15  # largest relative deviation of a width that may check a pose from three edges
    path: float = 2.5  # longest motion across the tube during the exposure, in widths of the tube
    path_blur: float = 0.2  # largest relative difference between the blur of the sides and that of such a motion
    path_deviation: float = 0.04  # largest relative deviation of a width that may show such a motion
    nearly: float = 0.01  # relative deviation of the width that a rough pose gives
    exact: float = 0.002  # relative deviation of the width that the fitted pose gives


@dataclasses.dataclass(frozen=True)
class SearchLimits:
    """Where the tube is searched for, and when it is measured once more; all in pixels."""

    widest: float = 120.0  # largest width of the tube
    blur: float = 0.9  # blur that fits begin with, standard deviation: that of a focused camera
    bulge_change: float = 0.1  # change of a bulge above which the edges are measured once more
    bulge_settled: float = 0.05  # change of a bulge that changes the tube's width by nothing
    aside: float = 16.0  # distance of a tube from its segment, the glow of a tube out of focus included
    motion: float = 30.0  # distance that a catheter may move between two frames


_FLOORS, _CHECK, _SEARCH = ErrorFloors(), WidthCheck(), SearchLimits()
_SIGNIFICANCE = 1e-3  # share of right poses that the chi-square test of the edges refuses
_EXCHANGED = "a frame whose red and blue are exchanged looks so; state the order of its channels (ChannelOrder)"


class CatheterTracker:
    """Detects the bands of a catheter in frames and computes its pose from their edges.

    The tracker classifies every second pixel with a table of colours, proposes a few lines, and samples a strip of the
    frame along each line in coordinates without distortion. It measures the band edges in linear light, or in luma
    where a codec has reduced the resolution of the colours, and computes the pose with :func:`pose_on_line`. With a
    previous pose the tracker reads only a strip of 30 pixels to each side of that pose. It refuses a frame in which the
    catheter has left this strip; a call without a previous pose searches the whole frame again. The work per frame is
    bounded.

    Without a previous pose, two more checks apply: the width of the tube, measured independently, must agree with the
    pose, and the tube must not be visible where only bands in the reversed order would put it
    (:func:`shows_reversed`). With a previous pose, the detected bands are assumed to be those of the same catheter.

    Frames may be on any device. The pixels that the tracker needs (every second one of every second row, or about
    15,000 with a previous pose) are copied to the CPU, because the computation consists of about a thousand small
    calls, each of which takes less time than the launch of a kernel on a GPU. Poses are on the CPU.

    Args:
        camera: Intrinsics and tone curve.
        catheter: Catheter to track; its colours must be saturated, with hues at least 25 degrees apart.
        most_sd: Standard deviation of the tip in metres above which a pose is refused as UNCERTAIN.
        channels: Order of the frames' channels. Without it, frames are assumed to be RGB, and the tracker warns once
            if the catheter is ambiguous under another order (:func:`ambiguities`).
        stations: How many cross-sections of the tube determine its axis and its width.

    Attributes:
        times: Seconds that each stage of the last call took, summed over its frames: colour, axis, edges, pose.

    Raises:
        TypeError, ValueError: ``most_sd`` is not positive, or the colours are grey, too similar, or the same from both
            ends. In a call: the frames are not uint8 [B, 3, H, W], or the number of previous poses differs from theirs.

    Source: Chapter 3 of the thesis defines the task (coloured bands, one camera). The method differs from the thesis.
    """

    def __init__(
        self,
        camera: Camera,
        catheter: Catheter,
        *,
        most_sd: float = 2e-3,
        channels: ChannelOrder | None = None,
        stations: StationPlan = STATION_PLAN,
    ):
        self.camera, self.catheter = camera, catheter
        self.most_sd = checks.quantity(TOOL_DEVIATION, most_sd, "most_sd")
        self.table = ColourTable(camera, catheter)
        self.channels = stated_order(channels, camera, catheter)
        self.lens, self.stations = Lens(camera), stations
        self._positions: list[float] = catheter.positions.tolist()
        self._chi_square_limits = _chi_square_limits(len(catheter.edges))
        self.times: dict[str, float] = {}

    def __call__(self, frames: Tensor, previous: Sequence[Pose] | None = None) -> list[Pose]:
        """Track each frame of a batch, uint8 [B, 3, H, W]; ``previous`` holds one pose per frame to search around."""
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
                return self._search_frame(sampler)
            return self._along(sampler, *self._near(sampler, found), found)
        except Refusal as refusal:
            return Pose.refused(refusal.status, refusal.reason)

    def _search_frame(self, sampler: Sampler) -> Pose:
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
                shown = self._shown(sampler, line, half, _SEARCH.aside, onward=False)
            except Refusal as refusal:
                # Report the refusal of the latest stage. Keep only its text: the exception keeps the frame in memory.
                if refusal.status > furthest[0]:
                    furthest = refusal.status, refusal.reason
            else:  # only the first line with all bands in order is measured: it is seldom anything but the catheter
                return self._along(sampler, *shown, None)
        raise Refusal(*furthest)

    def _near(self, sampler: Sampler, found: LinePose) -> tuple[Line, Stretches]:
        """Line near a previous pose and the bands on it.

        Raises:
            Refusal: No bands; its reason names exchanged channels where the bands have the reversed order.
        """
        line, half = self._expected(found)
        try:
            return self._shown(sampler, line, half, _SEARCH.motion, onward=True)
        except Refusal as refusal:
            if not refusal.turned:
                raise
            try:
                turned = Line(line.origin, -line.along, line.scale)
                self._shown(sampler, turned, half, _SEARCH.motion, onward=True)
            except Refusal:
                raise refusal from None
            raise Refusal(
                refusal.status, f"the bands lie along the previous line, in the other direction: {_EXCHANGED}"
            ) from None

    def _expected(self, found: LinePose) -> tuple[Line, float]:
        """Line through the bands of a pose, and half of their length plus a margin for motion, in pixels."""
        start, end = (axis_on_plane(found, self._positions[n]) for n in (0, -1))
        return Line.between(self.lens, start, end), abs(end - start) * self.lens.scale / 2 + 1.5 * _SEARCH.motion

    def _shown(
        self, sampler: Sampler, line: Line, half: float, aside: float, *, onward: bool
    ) -> tuple[Line, Stretches]:
        """Line near a first one of half-length ``half`` pixels, and the bands on it.

        Raises:
            Refusal: Fewer than three band edges are visible.
        """
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
        """Pose of the catheter whose bands lie on ``line``; raises a Refusal where there is none."""
        lens = self.lens
        with self._timed("axis"):
            places = stretches.edges if before else halfway(sampler, lens, line, stretches.edges)
            near = before or self._rough(line, places)
            wide, known = (self._wide(near, line), _CHECK.nearly) if near else (self._slight(places), THIRD)
            stations = look_across(sampler, lens, line, stretches, wide[0], _SEARCH.blur, self.stations)
            axis = width = measure_axis(stations, wide, known, _SEARCH.blur)
            if before is None:
                if stretches.known == 3 and axis.width_sd > _CHECK.vague * axis.width:
                    raise Refusal(Status.INCONSISTENT, "3 edges, and a width too unclear to check them with")
                look = partial(look_across, sampler, lens, line, stretches, plan=self.stations)
                stations, axis, width = measure_width(look, stations, axis, wide, known)
        with self._timed("edges"):
            first = curve = self._bulge(near, axis.line) if near else np.zeros(len(places))
            guess, _ = axis.line.place(line.plane(places))
            edges = measure_edges(sampler, lens, axis, guess - curve, stretches.doubtful, _SEARCH.blur, curve)
        with self._timed("pose"):
            # A changed bulge shifts the edges by its mean over the front of a ring, pi / 4 of its height. Only a large
            # change makes a second measurement necessary.
            found = self._solved(axis, edges, rough=True)
            for _ in range(2):
                bulge = self._bulge(found, axis.line)
                change, curve = bulge - curve, bulge
                edges = dataclasses.replace(edges, t=edges.t - math.pi / 4 * change)
                if float(np.abs(change).max()) < _SEARCH.bulge_settled:
                    break
                found = self._solved(axis, edges, rough=True)
            plane, wide = axis.line.plane(edges.t), self._wide(found, line)
        with self._timed("axis"):
            # Fit the axis with the width that pose and radius give; the width measured without them is the check.
            if before is None or abs(wide[0] - axis.width) > _CHECK.nearly * wide[0]:
                rest = axis.blur, axis
                axis = (
                    narrowed(stations, axis, wide, _CHECK.exact)
                    if near
                    else measure_axis(stations, wide, _CHECK.exact, *rest)
                )
                edges = dataclasses.replace(edges, t=axis.line.place(plane)[0])
        if float(np.abs(curve - first).max()) > _SEARCH.bulge_change or abs(edges.blur - edges.expected) > BLURRED:
            with self._timed("edges"):
                edges = measure_edges(sampler, lens, axis, edges.t, stretches.doubtful, edges.blur, curve)
        with self._timed("pose"):
            found = self._solved(axis, edges)
            pose = self._checked(found, width, edges, cold=before is None)
            if before is None and shows_reversed(sampler, lens, found, self.catheter):
                raise Refusal(Status.INCONSISTENT, f"the tube goes on beyond its end on one side only: {_EXCHANGED}")
            return pose

    def _rough(self, line: Line, places: np.ndarray) -> LinePose | None:
        """First pose, from the positions where colours change; None where one of these may not be a band edge."""
        seen = [(t, s) for t, s in zip(places.tolist(), self._positions, strict=True) if math.isfinite(t)]
        if (count := len(seen)) < 4:
            return None
        t, positions = zip(*seen, strict=True)
        found = pose_on_line(line, t, positions, [1.0] * count, 1.0, 0.01, rough=True)
        wide = width_px(found, self._positions, self.catheter.radius, line)[0] if found else 0.0
        slight = self._slight(places)[0]
        return found if slight / _CHECK.slant < wide < slight * _CHECK.slant else None

    def _slight(self, places: np.ndarray) -> tuple[float, float]:
        """Rough width of the tube's image in pixels, from the length of the bands at a slight tilt; taper 0."""
        seen = [(s, t) for s, t in zip(self._positions, places.tolist(), strict=True) if math.isfinite(t)]
        (near, a), (far, b) = seen[0], seen[-1]
        return min(max(2 * self.catheter.radius * 1.15 * (b - a) / (far - near), 2.0), _SEARCH.widest), 0.0

    def _bulge(self, found: LinePose, line: Line) -> np.ndarray:
        return bulge_px(found, self._positions, self.catheter.radius, line)

    def _wide(self, found: LinePose, line: Line) -> tuple[float, float]:
        """Width of the tube's image in pixels and its taper by a pose; raises a Refusal where these are impossible."""
        width, taper = width_px(found, self._positions, self.catheter.radius, line)
        if not 1.0 < width < _SEARCH.widest or not abs(taper) < 1:
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
        soft, smeared = (max(0.0, blur - _SEARCH.blur) for blur in (axis.blur, edges.blur))
        floor = math.hypot(
            _FLOORS.model,
            _FLOORS.coarse_edge * edges.coarse,
            _FLOORS.bulge * edges.bulge,
            _FLOORS.defocus * min(soft, smeared),
            _FLOORS.smear * smeared,
        )
        shines = (_FLOORS.transparency if n in (0, last) else 0.0 for n in known)
        along = [math.hypot(*each, floor) for each in zip(edges.deviation[known].tolist(), shines, strict=True)]
        # Shading that is constant along the tube shifts and rotates the line by more than its fit tells. Both of its
        # deviations are therefore raised to the larger one, as a displacement at the edges.
        middle = sum(t) / len(t)
        reach = math.sqrt(sum((place - middle) ** 2 for place in t) / len(t))
        about = math.hypot(axis.offset_sd, axis.slope_sd * (middle - axis.centre), _FLOORS.coarse_line * edges.coarse)
        most = max(about, axis.slope_sd * reach)
        positions = [self._positions[n] for n in known]
        found = pose_on_line(axis.line, t, positions, along, most, most / max(reach, 1e-9), _FLOORS.shared, rough=rough)
        if found is None:
            raise Refusal(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
        return found

    def _checked(self, found: LinePose, axis: Axis, edges: Edges, *, cold: bool) -> Pose:
        """Pose after all checks. ``cold``: no previous pose; the width of ``axis`` was then measured independently.

        Raises:
            Refusal: A check fails.
        """
        seen = edges.t[np.isfinite(edges.t)]
        count = len(seen)
        freedom = count - 3  # the line is fitted separately, so only positions along it can disagree with the pose
        if found.chi_square > self._chi_square_limits[freedom]:
            text = f"edges disagree with any pose: chi-square {found.chi_square:.1f} of {freedom}"
            raise Refusal(Status.INCONSISTENT, text)
        middle = float(seen.sum()) / count
        near, taper = self._wide(found, axis.line)
        wide = near + taper * middle
        ratio = float(axis.width_at(middle)) / wide
        most = min(
            0.45, (0.25 if freedom else 0.12) + (0.4 + 2 * axis.width_sd + max(0.0, axis.blur - _SEARCH.blur)) / wide
        )
        if axis.width_sd > (0.2 if freedom else 0.08) * wide:
            raise Refusal(Status.INCONSISTENT, f"{count} edges, and a width too unclear to check them with")
        # A tube that moves across itself by more than its width appears as wide as its path, and the blur of its sides
        # is that of a box of the tube's width.
        own = wide / math.sqrt(12)
        due = math.hypot(edges.blur, own)
        clear = axis.width_sd < _CHECK.path_deviation * axis.width
        moved = clear and 1 < ratio < _CHECK.path and abs(axis.blur / due - 1) < _CHECK.path_blur
        both = math.hypot(axis.blur, own * ratio) / due  # well determined, even where width or blur alone is not
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


def _chi_square_limits(edges: int) -> list[float]:
    """Largest chi-square of a pose by its degrees of freedom, 0 to ``edges`` - 3: quantiles, looser ones from 10 on."""
    limits = [float(chdtri(freedom, _SIGNIFICANCE)) for freedom in range(1, min(edges - 2, 10))]
    return [math.inf, *limits, *(freedom + 4 * math.sqrt(2 * freedom) + 6 for freedom in range(10, edges - 2))]
