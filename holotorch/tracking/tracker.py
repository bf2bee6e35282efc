"""CatheterTracker: frames in, for each a pose with its covariance or the reason why there is none."""

import dataclasses
import math
import time
from collections.abc import Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.bands import Stretches
from holotorch.tracking.camera import Camera
from holotorch.tracking.catheter import Catheter
from holotorch.tracking.coarse import find_segments
from holotorch.tracking.colours import ColourTable
from holotorch.tracking.footprint import bulge_px, width_px
from holotorch.tracking.measure import Edges, find_bands, measure_edges
from holotorch.tracking.resection import pose_on_line
from holotorch.tracking.stations import Axis, look_across, measure_axis
from holotorch.tracking.status import Pose, Refusal, Status
from holotorch.tracking.strips import Line, Sampler

_FLOOR = 0.015  # pixels: what model and pixels leave in an edge, however little noise there is;
_ROUND = 0.008  # and of what a ring's front bulges
_UNLIKELY = {1: 10.83, 2: 13.82, 3: 16.27, 4: 18.47, 5: 20.52, 6: 22.46, 7: 24.32, 8: 26.12, 9: 27.88}  # 0.1 % of chi^2
_THIRD, _EXACT = 0.35, 0.003  # how well the width is known before there is a pose, and after
_WIDEST = 120.0  # pixels
_MOVED = 30.0  # pixels that a catheter may move between two frames


class CatheterTracker:
    """Finds the catheter's bands on frames, and from their edges the pose.

    Coarse detection by a table of colours on every second pixel, a few line hypotheses, one strip of the frame along
    each in the lens's own coordinates, edges in linear light, the pose by :func:`pose_on_line`. With a previous pose
    only the strip around it is read. The work for a frame is bounded.

    Args:
        camera: Intrinsics and tone curve.
        catheter: What to look for; colours saturated, of hues 25 degrees apart.
        most_sd: Standard deviation of the tip in metres above which a pose is refused as UNCERTAIN.

    Attributes:
        times: Seconds that each stage of the last call took: colour, axis, edges, pose.

    Raises:
        TypeError, ValueError: In a call: frames that are not uint8 [B, 3, H, W]; as many previous poses as frames.

    Source: Chapter 3 of the thesis for bands, one camera and what is asked; the method is our own.
    """

    def __init__(self, camera: Camera, catheter: Catheter, *, most_sd: float = 1.5e-3):
        self.camera, self.catheter = camera, catheter
        self.most_sd = checks.positive("most_sd", most_sd, "m")
        self.table = ColourTable(camera, catheter)
        self.light = camera.table()
        self.times: dict[str, float] = {}

    def __call__(self, frames: Tensor, previous: Sequence[Pose] | None = None) -> list[Pose]:
        """A pose for each frame of uint8 [B, 3, H, W]; ``previous`` poses of the same cameras narrow the search."""
        if frames.ndim != 4 or frames.shape[1] != 3 or frames.dtype != torch.uint8:
            raise ValueError(f"frames must be uint8 of shape [B, 3, H, W], got {frames.dtype}, {list(frames.shape)}")
        if previous is not None and len(previous) != len(frames):
            raise ValueError(f"{len(frames)} frames take {len(frames)} previous poses, got {len(previous)}")
        self.times = dict.fromkeys(("colour", "axis", "edges", "pose"), 0.0)
        with torch.inference_mode():  # calls of a few microseconds, hundreds of them: a tenth of their time
            poses = [self._track(frame, previous[i] if previous else None) for i, frame in enumerate(frames)]
        names = ("tip", "direction", "covariance", "chi_square", "freedom")
        # Its tensors may take part in no gradient; copies may.
        return [dataclasses.replace(pose, **{name: getattr(pose, name).clone() for name in names}) for pose in poses]

    def _track(self, frame: Tensor, before: Pose | None) -> Pose:
        height, width = frame.shape[-2:]
        if height < 32 or width < 32:
            return Pose.refused(Status.BAD_FRAME, f"a frame of {height} x {width} px is too small")
        sampler = Sampler(frame, self.light.to(frame.device))
        if before is not None and before.answered:
            try:
                return self._along(sampler, self._expected(before), _MOVED, before)
            except Refusal as refusal:
                if refusal.status is Status.UNCERTAIN:  # it is there; looking everywhere finds no more of it
                    return Pose.refused(refusal.status, refusal.reason)
                # It moved more, or something hides it: look everywhere.
        with self._timed("colour"):
            segments = find_segments(frame, self.table)
        if not segments:
            return Pose.refused(Status.NO_CATHETER, "nothing thin in the bands' colours")
        first: Refusal | None = None
        ends = torch.tensor([(segment.start, segment.end) for segment in segments], dtype=torch.float64)
        for segment, plane in zip(segments, self.camera.undistort(ends.to(frame.device)), strict=True):
            try:
                line = Line.between(self.camera, plane)
                if not bool(torch.isfinite(line.origin).all()):
                    raise Refusal(Status.OUTSIDE_CAMERA, "it lies where the lens's distortion cannot be inverted")
                length = math.dist(segment.start, segment.end)
                return self._along(sampler, (line, 0.5 * length + max(40.0, 0.7 * length)), 10.0, None)
            except Refusal as refusal:
                # What came nearest to a pose tells most.
                if first is None or refusal.status > first.status:
                    first = refusal
        assert first is not None
        return Pose.refused(first.status, first.reason)

    def _expected(self, pose: Pose) -> tuple[Line, float]:
        """Where the bands of a pose lie, and half their length with room to move."""
        ends = pose.tip + self.catheter.positions[[0, -1], None] * pose.direction
        line = Line.between(self.camera, ends[:, :2] / ends[:, 2:])
        t, _ = line.place(ends[:, :2] / ends[:, 2:])
        return line, float((t[1] - t[0]).abs()) / 2 + 1.5 * _MOVED

    def _along(self, sampler: Sampler, around: tuple[Line, float], aside: float, before: Pose | None) -> Pose:
        """The pose on a line, or a Refusal."""
        line, half = around
        half = min(half, 1.5 * math.hypot(sampler.height, sampler.width))
        with self._timed("axis"):
            reach = min(0.15, 2 * aside / half) if before is not None else 0.06
            line, stretches, places = find_bands(sampler, self.camera, line, self.table, half, aside, reach)
            if stretches.known < 3:
                few = "a band hides, is drowned by its surroundings or leaves the frame"
                raise Refusal(Status.BANDS_MISSING, f"{stretches.known} edges of bands are seen, 3 are needed: {few}")
            wide, known = (self._width(stretches), _THIRD) if before is None else (self._wide(before, line), _EXACT)
            stations = look_across(sampler, self.camera, line, stretches, wide[0], 0.9)
            axis = measure_axis(stations, wide, known, 0.9)
        guess, _ = axis.line.place(line.plane(places))
        width = axis
        if before is not None:
            with self._timed("edges"):
                curve = bulge_px(before, self.catheter, axis.line)
                edges = measure_edges(sampler, self.camera, axis, guess - curve, stretches.doubtful, 0.9, curve)
            with self._timed("pose"):
                # What the bulge has changed by is set right without another look at the frame: the mean over a front.
                pose, bulge = self._solved(axis, edges), curve
                again = bulge_px(pose, self.catheter, axis.line)
                for _ in range(2):
                    edges = dataclasses.replace(edges, t=edges.t - math.pi / 4 * (again - bulge))
                    pose, bulge = self._solved(axis, edges), again
                    again = bulge_px(pose, self.catheter, axis.line)
                    if float((again - bulge).abs().max()) < 0.01:
                        break
            if float((again - curve).abs().max()) < 0.05:
                return self._judged(pose, width, edges)
        else:
            with self._timed("edges"):
                edges = measure_edges(sampler, self.camera, axis, guess, stretches.doubtful, 0.9)
            with self._timed("pose"):
                pose = self._solved(axis, edges)
        with self._timed("axis"):
            # Once more, with the width that the pose and the radius give; what was found without them is the check.
            wide = self._wide(pose, line)
            found = axis.line.plane(edges.t)
            if not stations.show(wide[0], edges.blur):
                stations = look_across(sampler, self.camera, line, stretches, wide[0], edges.blur)
            axis = measure_axis(stations, wide, _EXACT, edges.blur, axis)
        with self._timed("edges"):
            curve = bulge_px(pose, self.catheter, axis.line)
            again, _ = axis.line.place(found)
            if before is None:  # they were found as straight ones: at the mean over a front
                again = again - math.pi / 4 * curve
            edges = measure_edges(sampler, self.camera, axis, again, stretches.doubtful, edges.blur, curve)
        with self._timed("pose"):
            return self._judged(self._solved(axis, edges), width, edges)

    def _wide(self, pose: Pose, line: Line) -> tuple[float, float]:
        """Of the tube's image in pixels and its taper, as the pose gives them; a Refusal where no camera sees such."""
        width, taper = width_px(pose, self.catheter, line)
        if not 1.0 < width < _WIDEST or not abs(taper) < 1:
            raise Refusal(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
        return width, taper

    def _width(self, stretches: Stretches) -> tuple[float, float]:
        """Of the tube's image in pixels, roughly: from the bands' lengths at a slight tilt; and no taper."""
        seen = torch.isfinite(stretches.edges)
        ends = stretches.edges[seen][[0, -1]], self.catheter.positions.to(seen.device)[seen][[0, -1]]
        scale = 1.15 * float((ends[0][1] - ends[0][0]) / (ends[1][1] - ends[1][0]))
        return min(max(2 * self.catheter.radius * scale, 2.0), _WIDEST), 0.0

    def _solved(self, axis: Axis, edges: Edges) -> Pose:
        known = torch.isfinite(edges.t)
        t = edges.t[known]
        if len(t) < 3:
            count = f"{len(t)} edges"
            if edges.hidden:
                raise Refusal(Status.EDGES_UNCLEAR, f"{count} are clear, 3 are needed: something lies across")
            if edges.outside:
                raise Refusal(Status.OUT_OF_FRAME, f"{count} lie within the frame, 3 are needed")
            raise Refusal(Status.EDGES_UNCLEAR, f"{count} are clear, 3 are needed")
        along = (edges.deviation[known].square() + _FLOOR**2 + (_ROUND * edges.bulge) ** 2).sqrt()
        positions = self.catheter.positions.to(t.device)[known]
        # Shading, the same all along, moves and turns a line by more than its fit tells: over the edges both deviations
        # amount to the larger of the two.
        reach = float((t - t.mean()).square().mean().sqrt())
        about = math.hypot(axis.offset_sd, axis.slope_sd * (float(t.mean()) - axis.centre))
        most = max(about, axis.slope_sd * reach)
        pose = pose_on_line(axis.line, t, positions, along, most, most / reach)
        if not pose.answered:
            raise Refusal(Status.INCONSISTENT, pose.reason)
        return pose

    def _judged(self, pose: Pose, axis: Axis, edges: Edges) -> Pose:
        """The pose, if nothing speaks against it."""
        count = int(torch.isfinite(edges.t).sum())
        freedom = count - 3  # the line is fitted by itself, so only places along it can disagree
        limit = _UNLIKELY.get(freedom, freedom + 4 * math.sqrt(2 * freedom) + 6) if freedom else math.inf
        if float(pose.chi_square) > limit:
            text = f"edges disagree with any pose: chi-square {float(pose.chi_square):.1f} of {freedom}"
            raise Refusal(Status.INCONSISTENT, text)
        middle = float(edges.t.nanmean())
        near, taper = width_px(pose, self.catheter, axis.line)
        wide = near + taper * middle
        ratio = axis.width_at(middle) / wide
        most = min(0.45, (0.25 if freedom else 0.12) + (0.4 + 2 * axis.width_sd) / wide)
        if axis.width_sd > (0.12 if freedom else 0.08) * wide:
            raise Refusal(Status.INCONSISTENT, f"{count} edges, and a width too unclear to check them with")
        if abs(ratio - 1) > most:
            away = float((pose.tip + self.catheter.positions.to(pose.tip.device).mean() * pose.direction)[2])
            raise Refusal(Status.INCONSISTENT, f"{ratio:.2f} times as wide as it should be at {away:.2f} m")
        if float(pose.tip_sd) > self.most_sd:
            text = f"tip uncertain to {1e3 * float(pose.tip_sd):.1f} mm, above {1e3 * self.most_sd:g} mm"
            raise Refusal(Status.UNCERTAIN, text)
        status = Status.OK if freedom else Status.UNVERIFIED
        reason = "" if freedom else "three edges determine a pose and leave nothing to check it with"
        values = (pose.tip, pose.direction, pose.covariance, pose.chi_square)
        return Pose(*values, pose.freedom.new_tensor(float(freedom)), status, reason)

    @contextmanager
    def _timed(self, stage: str):
        began = time.perf_counter()
        try:
            yield
        finally:
            self.times[stage] += time.perf_counter() - began
