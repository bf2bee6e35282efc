"""CatheterTracker: for each frame, a pose of the catheter with its covariance, or the reason for its refusal."""

import cmath
import dataclasses
import itertools
import math
import time
from collections.abc import Sequence
from contextlib import contextmanager, suppress
from functools import partial

import numpy as np
import torch
from scipy.special import chdtri
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.quantities import TOOL_DEVIATION
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Line, Sampler
from holotorch.tracking.detection.bands import Stretches
from holotorch.tracking.detection.channels import ChannelOrder, as_levels, stated_order
from holotorch.tracking.detection.coarse import find_segments
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.detection.completion import complete_edges, lies_across
from holotorch.tracking.detection.ends import shows_other_colour, shows_reversed
from holotorch.tracking.detection.footprint import axis_on_plane, bulge_px, width_px
from holotorch.tracking.detection.luma import fit_coarse_axis
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
from holotorch.tracking.pose.rolling_shutter import READOUT, readout_covariance
from holotorch.tracking.pose.status import THREE_EDGES, Pose, Refusal, Status
from holotorch.tracking.refinement.photometric import PhotometricFit


@dataclasses.dataclass(frozen=True)
class ErrorFloors:
    """Errors (1 sigma) of edges and line that do not shrink with the noise: pixels, or pixels per pixel of a cause.

    Independent errors of one edge add in quadrature. Determined on synthetic frames such that the 95 % ellipsoids of
    poses contain the true pose in about 95 % of the frames.
    """

    model: float = 0.004  # every edge: the edge profile and the sampling by pixels are approximate
    transparency: float = 0.010  # outermost edges: the background is visible through the clear tube beside them
    texture: float = 0.5  # outermost edges: per variation of the background relative to the edge's step of light
    bulge: float = 0.004  # common to all edges of a frame: per pixel by which a ring's front bulges along the line
    shared: float = 0.010  # common to all edges, too
    defocus: float = 0.08  # per pixel of blur in all directions, which lets light from beside the tube leak in
    smear: float = 0.03  # per pixel of blur along the tube, from the lens or from motion
    coarse_edge: float = 0.07  # edges of frames whose chroma has fewer pixels than their luma (4:2:0 codecs)
    line: float = 0.02  # offset of the line: light from one side moves the apparent middle of the tube
    stations: float = 2.5  # ratio of the line's deviations to those of its fit: background textures are correlated


@dataclasses.dataclass(frozen=True)
class WidthCheck:
    """Limits of the check that the tube's measured width agrees with its pose. Determined on synthetic frames.

    Relative deviations are standard deviations of a width divided by the width.
    """

    narrow: float = 0.8  # least ratio of the widths of a blurred tube, measured over expected, as standard deviations
    slant: float = 1.5  # largest ratio of the width from a rough pose to that from the bands' length: 55 degrees
    vague: float = 0.15  # largest relative deviation of a width that is used to check a pose from three edges
    path: float = 2.5  # longest motion across the tube during the exposure, in widths of the tube
    path_blur: float = 0.2  # largest relative difference between the blur of the sides and that of such a motion
    path_deviation: float = 0.04  # largest relative deviation of a width that can indicate such a motion
    nearly: float = 0.01  # relative deviation of the width from a rough pose
    exact: float = 0.002  # relative deviation of the width from the fitted pose


@dataclasses.dataclass(frozen=True)
class SearchLimits:
    """Limits of the search for the tube and of repeated measurements, in pixels unless stated otherwise."""

    widest: float = 120.0  # largest width of the tube
    blur: float = 0.9  # initial standard deviation of the blur in fits: that of a focused camera
    bulge_change: float = 0.1  # change of a ring's bulge above which the edges are measured again
    bulge_settled: float = 0.05  # change of a ring's bulge below which the pose is not computed again
    aside: float = 16.0  # largest distance of the tube, with its blur, from a segment of the search of a whole frame
    vague: float = 3.7  # largest ratio of the deviations of two edges, if colours do not show all edges
    full: float = 0.8  # fraction of a band's length that shows its colour if the whole band is visible
    motion: float = 30.0  # largest motion of the catheter between two frames


_FLOORS, _CHECK, _SEARCH = ErrorFloors(), WidthCheck(), SearchLimits()
MOST_SD = 2e-3  # metres: deviation of a tip above which its pose is of no use
_NEAR = (
    6.0  # pixels: half the distance up to which an object across the tube disturbs an edge, and error of a rough pose
)
_SIGNIFICANCE = 1e-3  # fraction of correct poses that the chi-square test of the edges refuses
_CONFIRMED = 5.0  # standard deviations of both by which a fit to the pixels may differ from the pose of the edges
_EXCHANGED = "bands not named from the tip on, or exchanged red and blue channels (ChannelOrder), can cause this"


class CatheterTracker(nn.Module):
    """Detects the bands of a catheter in frames and computes its pose from their edges.

    The tracker classifies every second pixel with a table of colours, proposes a few lines, and samples a strip of the
    frame along each line in coordinates without distortion. It measures the band edges in linear light, or in luma
    where a codec has reduced the resolution of the colours, and computes the pose with :func:`pose_on_line`. With a
    previous pose the tracker reads only a strip of 30 pixels to each side of that pose. It refuses a frame in which the
    catheter has left this strip; a call without a previous pose searches the whole frame again. The work per frame is
    bounded.

    Without a previous pose, two more checks apply. The width of the tube, measured independently, must agree with the
    pose. And the tube must not be visible at a position that only bands in the reversed order explain
    (:func:`shows_reversed`). With a previous pose, the detected bands are assumed to be those of the same catheter.

    Frames may be on any device. The pixels that the tracker needs (every second pixel of every second row, or about
    15,000 pixels with a previous pose) are copied to the CPU: the computation consists of about a thousand small calls,
    each of which takes less time than the launch of a kernel on a GPU. Poses are on the CPU.

    Args:
        camera: Intrinsics and tone curve.
        catheter: Catheter to track; its colours must be saturated, with hues at least 25 degrees apart.
        most_sd: Standard deviation of the tip in metres above which a pose is refused as UNCERTAIN.
        readout: Standard deviation in metres, along each axis, of the motion of the catheter while a rolling shutter
            reads the rows of a frame. A frame does not show this motion, so that it is in each covariance. 0 for a
            camera with a global shutter, or a catheter at rest. A ``refinement`` has its own, in its plan.
        channels: Order of the frames' channels. If it is None, frames are assumed to be RGB, and the constructor warns
            if another order would show the catheter in another valid pose (:func:`ambiguities`).
        stations: How many cross-sections of the tube determine its axis and its width.
        refinement: Fit to the pixels around the edges that starts from each pose; without one, poses are those of the
            edges. It takes several times as long, and states deviations that hold in more scenes: behind textures,
            under codecs, with a rolling shutter. A pose that it does not confirm is refused as INCONSISTENT.

    Attributes:
        times: Seconds that each stage ("colour", "axis", "edges", "pose", and "refinement" where there is one) of the
            last call took, summed over frames.
        edges_px: For each frame of the last call the pixels (x, y) of the centres of the edges' rings, float64 [N, 2],
            NaN for an edge that was not measured; None for a frame in which none was. They are there also where the
            edges contradict the catheter, so that :func:`fit_band_edges` can correct it.

    Raises:
        TypeError, ValueError: ``most_sd`` is not positive, ``readout`` is negative, or the colours are grey, too
            similar, or the same from both ends. In a call: the frames are not [B, 3, H, W], uint8 or floating from 0 to
            1; they require a gradient; or their number differs from that of the previous poses.

    Source: Chapter 3 of the thesis defines the task (coloured bands, one camera). The method differs from the thesis.
    """

    def __init__(
        self,
        camera: Camera,
        catheter: Catheter,
        *,
        most_sd: float = MOST_SD,
        readout: float = READOUT,
        channels: ChannelOrder | None = None,
        stations: StationPlan = STATION_PLAN,
        refinement: PhotometricFit | None = None,
    ):
        super().__init__()
        self.camera, self.catheter = camera, catheter
        self.most_sd = checks.quantity(TOOL_DEVIATION, most_sd, "most_sd")
        self.readout = checks.nonnegative("readout", readout, "m")
        self.table = ColourTable(camera, catheter)
        self.channels = stated_order(channels, camera, catheter)
        self.lens, self.stations, self.refinement = Lens(camera), stations, refinement
        self._positions: list[float] = catheter.positions.tolist()
        self._chi_square_limits = _chi_square_limits(len(catheter.edges))
        self.times: dict[str, float] = {}
        self.edges_px: list[Tensor | None] = []

    def forward(self, frames: Tensor, previous: Sequence[Pose] | Pose | None = None) -> list[Pose]:
        """Poses [B] of the catheter in frames [B, 3, H, W], uint8 or floating from 0 to 1.

        Each frame is searched near its ``previous`` pose, of a sequence or of a batch.
        """
        frames = as_levels(frames)
        self.camera.need_size(frames)
        before = [None] * len(frames) if previous is None else list(previous)
        if previous is not None and not all(isinstance(pose, Pose) for pose in before):
            raise TypeError("previous must hold a Pose for each frame")
        if len(before) != len(frames):
            raise ValueError(f"{len(frames)} frames take {len(frames)} previous poses, got {len(before)}")
        frames = self.channels.to_rgb(frames)
        self.times = dict.fromkeys(("colour", "axis", "edges", "pose"), 0.0)
        self.edges_px = []
        poses = []
        for frame, pose in zip(frames, before, strict=True):
            self.edges_px.append(None)  # the measurement replaces it
            poses.append(self._track(frame, pose))
        return poses if self.refinement is None else self._refined(self.refinement, frames, poses)

    def _refined(self, refinement: PhotometricFit, frames: Tensor, poses: list[Pose]) -> list[Pose]:
        """The ``poses`` [B] after a fit to the ``frames``, all at once; refusals stay as they are."""
        chosen = [i for i, pose in enumerate(poses) if pose.answered]
        if not chosen:
            return poses
        self.times["refinement"] = 0.0
        with self._timed("refinement"):
            tip, direction = (torch.stack([getattr(poses[i], name) for i in chosen]) for name in ("tip", "direction"))
            fitted = refinement(frames[chosen], tip.to(frames.device), direction.to(frames.device)).poses()
        poses = list(poses)
        for i, pose in zip(chosen, fitted, strict=True):
            before, poses[i] = poses[i], pose
            if pose.answered and float(pose.tip_sd) > self.most_sd:
                poses[i] = Pose.refused(Status.UNCERTAIN, _uncertain(float(pose.tip_sd), self.most_sd))
            elif pose.answered and (gap := _distance(before, pose)) > _CONFIRMED:
                text = f"the fit to the pixels moves the tip by {gap:.3g} standard deviations"
                poses[i] = Pose.refused(Status.INCONSISTENT, text)
        return poses

    def _track(self, frame: Tensor, before: Pose | None) -> Pose:
        height, width = frame.shape[-2:]
        if height < 32 or width < 32:
            return Pose.refused(Status.BAD_FRAME, f"a frame of {height} x {width} px is too small")
        sampler = Sampler(frame, self.lens.light)
        line_pose = on_host(before) if before is not None and before.answered else None
        try:
            if line_pose is None:
                return self._search_frame(sampler)
            return self._along(sampler, *self._near(sampler, line_pose), line_pose)
        except Refusal as refusal:
            return Pose.refused(refusal.status, refusal.reason)

    def _search_frame(self, sampler: Sampler) -> Pose:
        """Pose from the whole frame: by the colours alone, and if these show no bands, by thin objects alone."""
        try:
            return self._search_lines(sampler, thin=False)
        except Refusal as refusal:
            if refusal.final:
                raise
            try:
                return self._search_lines(sampler, thin=True)
            except Refusal as other:
                raise max(refusal, other, key=lambda one: one.status) from None

    def _search_lines(self, sampler: Sampler, *, thin: bool) -> Pose:
        with self._timed("colour"):
            segments = find_segments(sampler.frame, self.table, thin=thin)
        furthest = Status.OK, ""
        planes = self.lens.undistort(np.array([(segment.start, segment.end) for segment in segments]).ravel())
        for segment, (start, end) in zip(segments, planes.reshape(-1, 2).tolist(), strict=True):
            try:
                line = Line.between(self.lens, start, end)
                if not cmath.isfinite(line.origin + line.along):
                    raise Refusal(Status.OUTSIDE_CAMERA, "it lies where the lens's distortion cannot be inverted")
                length = abs(segment.end - segment.start)
                half = 0.5 * length + max(40.0, 0.7 * length)
                line, stretches = self._shown(sampler, line, half, _SEARCH.aside, onward=False, thin=thin, least=1)
                return self._measured(sampler, line, stretches)
            except Refusal as refusal:
                if refusal.final:
                    raise
                # The refusal of the latest stage is reported; the exception itself would keep the frame in memory.
                if refusal.status > furthest[0]:
                    furthest = refusal.status, refusal.reason
        raise Refusal(*furthest)

    def _near(self, sampler: Sampler, line_pose: LinePose) -> tuple[Line, Stretches]:
        """Line near a previous pose, and the bands on it; for reversed bands the Refusal names exchanged channels."""
        line, half = self._expected(line_pose)
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

    def _expected(self, line_pose: LinePose) -> tuple[Line, float]:
        """Line through the bands of a pose, and half of the bands' length plus a margin for motion, in pixels."""
        start, end = (axis_on_plane(line_pose, self._positions[n]) for n in (0, -1))
        return Line.between(self.lens, start, end), abs(end - start) * self.lens.scale / 2 + 1.5 * _SEARCH.motion

    def _shown(
        self,
        sampler: Sampler,
        line: Line,
        half: float,
        aside: float,
        *,
        onward: bool,
        thin: bool = False,
        least: int = 3,
    ) -> tuple[Line, Stretches]:
        """Line of the tube within ``half`` pixels along ``line`` and ``aside`` across, and the bands on it.

        ``onward``: t is known to rise from the tip. Raises a Refusal if fewer than ``least`` band edges are visible.
        """
        half = min(half, 1.5 * math.hypot(sampler.height, sampler.width))
        with self._timed("axis"):
            reach = min(0.15, 2 * aside / half) if onward else 0.06
            kind = {"onward": onward, "thin": thin}
            line, stretches = find_bands(sampler, self.lens, line, self.table, half, aside, reach, **kind)
        if stretches.known < least:
            few = "a band is hidden, has the colour of its surroundings or leaves the frame"
            text = f"{stretches.known} edges of bands are seen, {least} are needed: {few}"
            raise Refusal(Status.BANDS_MISSING, text, turned=stretches.turned)
        return line, stretches

    def _measured(self, sampler: Sampler, line: Line, stretches: Stretches) -> Pose:
        """Pose from the bands on ``line``; from the two surest edges where colours put the others in wrong places."""
        earlier = None
        if stretches.known > 2:
            try:
                return self._along(sampler, line, stretches, None)
            except Refusal as refusal:
                if refusal.final or self._rough(line, stretches.edges):
                    raise
                earlier = refusal.status, refusal.reason
        try:
            return self._along(sampler, *self._completed(sampler, line, stretches), None, completed=True)
        except Refusal as refusal:
            if earlier and not refusal.final:
                raise Refusal(*earlier) from None
            raise

    def _completed(self, sampler: Sampler, line: Line, stretches: Stretches) -> tuple[Line, Stretches]:
        """The tube's line, and the bands with all edges, from the two edges of the surest band on ``line``."""
        refusal = Refusal(Status.BANDS_MISSING, "too few edges of bands are seen, and no others that fit them")
        last = len(self._positions) - 1
        known, whole = np.isfinite(stretches.edges), np.array(stretches.whole)
        both, full = known[:-1] & known[1:], np.array(stretches.shown) > _SEARCH.full * whole
        inner = np.minimum(np.arange(last), last - 1 - np.arange(last)) > 0
        # An edge between two bands shows the colours of both; bare tube beyond an outer one may have any colour.
        worth = np.where(both, 2 + inner, (known[:-1] | known[1:]) & full)
        first = int(worth.argmax())
        if not worth[first]:
            raise refusal
        pair = (first, first + 1)
        with self._timed("axis"):
            only = np.full(last + 1, np.nan)
            only[list(pair)] = stretches.cuts[list(pair)]
            rough_t = halfway(sampler, self.lens, line, only)
            one = dataclasses.replace(stretches, edges=rough_t)
            wide = self._slight(rough_t)
            stations = look_across(sampler, self.lens, line, one, wide[0], _SEARCH.blur, self.stations)
            axis = measure_axis(stations, wide, THIRD, _SEARCH.blur).line
            t, _ = axis.place(line.plane(rough_t))
        with self._timed("edges"):
            edges = complete_edges(sampler, self.lens, axis, t.tolist(), self._positions)
            if edges is None or not self._coloured(sampler, axis, edges):
                raise refusal
            whole = tuple(np.diff(edges).tolist())
            doubtful = tuple(bool(given) or i not in pair for i, given in enumerate(stretches.doubtful))
            return axis, Stretches(edges, edges, whole, whole, doubtful, stretches.flipped)

    def _coloured(self, sampler: Sampler, axis: Line, edges: np.ndarray) -> bool:
        """Whether more than half of the pixels between ``edges`` [N] have the colours of their bands."""
        t, u = np.arange(math.ceil(edges[0]), math.floor(edges[-1]) + 1.0), np.arange(-1.0, 2.0)
        pixels = axis.pixels(self.lens, t, u)
        band = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(self.table.bands) - 1)
        own = self.table.labels(sampler.nearest(pixels)) == np.array(self.table.bands)[band, None] + 1
        shown = [
            own[part].mean()
            for i in set(band.tolist())
            if (part := sampler.inside(pixels) & (band == i)[:, None]).any()
        ]
        return min(shown, default=0.0) > 0.5

    def _along(
        self, sampler: Sampler, line: Line, stretches: Stretches, before: LinePose | None, *, completed: bool = False
    ) -> Pose:
        """Pose of the catheter whose bands lie on ``line``; raises a Refusal if a measurement or a check fails.

        If the edges contradict each other, and something lies across the tube beside some of them, the border of this
        object may have been taken for an edge: then the one pose is taken that leaves out one of these edges.
        """
        try:
            return self._posed(sampler, line, stretches, before, completed=completed)
        except Refusal as refusal:
            others, measured = [], self.edges_px[-1]
            for crossed in refusal.crossed:
                edges, doubtful = stretches.edges.copy(), list(stretches.doubtful)
                edges[crossed], doubtful[crossed] = np.nan, True
                fewer = dataclasses.replace(stretches, edges=edges, doubtful=tuple(doubtful))
                with suppress(Refusal):
                    pose = self._posed(sampler, line, fewer, before, crossed=crossed)
                    others.append((pose, self.edges_px[-1]))
            self.edges_px[-1] = measured
            if len(others) != 1:
                raise
            pose, self.edges_px[-1] = others[0]
            return pose

    def _posed(
        self,
        sampler: Sampler,
        line: Line,
        stretches: Stretches,
        before: LinePose | None,
        *,
        completed: bool = False,
        crossed: int | None = None,
    ) -> Pose:
        """The same as :meth:`_along`, from the edges of ``stretches``.

        ``completed``: only two edges are known by their colours, so that no other may be missing on the frame.
        ``crossed``: edge that was left out, and must be either measured elsewhere or hidden.
        """
        lens = self.lens
        with self._timed("axis"):
            rough_t = stretches.edges if before else halfway(sampler, lens, line, stretches.edges)
            near = before or self._rough(line, rough_t)
            wide, known = (self._wide(near, line), _CHECK.nearly) if near else (self._slight(rough_t), THIRD)
            stations = look_across(sampler, lens, line, stretches, wide[0], _SEARCH.blur, self.stations)
            axis = width = measure_axis(stations, wide, known, _SEARCH.blur)
            if before is None:
                if stretches.known == 3 and axis.width_sd > _CHECK.vague * axis.width:
                    raise Refusal(Status.INCONSISTENT, "3 edges, and a width too unclear to check them with")
                look = partial(look_across, sampler, lens, line, stretches, plan=self.stations)
                stations, axis, width = measure_width(look, stations, axis, wide, known)
        with self._timed("edges"):
            first = curve = self._bulge(near, axis.line) if near else np.zeros(len(rough_t))
            guess, _ = axis.line.place(line.plane(rough_t))
            edges = measure_edges(sampler, lens, axis, guess - curve, stretches.doubtful, _SEARCH.blur, curve)
        with self._timed("pose"):
            # A change of the bulge shifts an edge by pi / 4 of this change, the mean over the front of a ring. Only a
            # large change makes a second measurement necessary.
            line_pose = self._solved(axis, edges, rough=True)
            for _ in range(2):
                bulge = self._bulge(line_pose, axis.line)
                change, curve = bulge - curve, bulge
                edges = dataclasses.replace(edges, t=edges.t - math.pi / 4 * change)
                if float(np.abs(change).max()) < _SEARCH.bulge_settled:
                    break
                line_pose = self._solved(axis, edges, rough=True)
            plane, wide = axis.line.plane(edges.t), self._wide(line_pose, line)
        with self._timed("axis"):
            # The axis is fitted with the width from pose and radius; the independent width is for the check.
            if before is None or abs(wide[0] - axis.width) > _CHECK.nearly * wide[0]:
                exact = wide, _CHECK.exact
                axis = narrowed(stations, axis, *exact) if near else measure_axis(stations, *exact, axis.blur, axis)
            if edges.coarse:
                axis = fit_coarse_axis(stations, axis, lens.light, wide, _CHECK.exact)
            edges = dataclasses.replace(edges, t=axis.line.place(plane)[0])
        missing = np.isnan(edges.t)
        again = float(np.abs(curve - first).max()) > _SEARCH.bulge_change or abs(edges.blur - edges.expected) > BLURRED
        if again or missing.any():
            with self._timed("edges"):
                # Colours alone may miss an edge on a background of the same hue; the others tell where it must be.
                expected = np.where(missing, self._expected_edges(line_pose, axis.line), edges.t)
                doubtful = tuple((missing | np.array(stretches.doubtful)).tolist())
                edges = measure_edges(sampler, lens, axis, expected, doubtful, edges.blur, curve)
        missing |= np.isnan(edges.t)
        if completed or missing.any():
            edges = self._explained(sampler, axis, edges, missing, completed=completed, crossed=crossed)
        with self._timed("pose"):
            line_pose = self._solved(axis, edges)
            pixels = lens.distort(axis.line.plane(edges.t))
            self.edges_px[-1] = torch.from_numpy(np.stack([pixels.real, pixels.imag], -1))
            self._agreeing(sampler, axis, edges, line_pose)
            pose = self._checked(line_pose, width, edges, sampler.height, cold=before is None)
            if before is None:
                self._confirmed(sampler, axis, edges, line_pose, pose)
            return pose

    def _confirmed(self, sampler: Sampler, axis: Axis, edges: Edges, line_pose: LinePose, pose: Pose) -> None:
        """Refuse a pose of a search of the whole frame that only another object explains."""
        missing = np.isnan(edges.t)
        if missing.any():
            expected = self._expected_edges(line_pose, axis.line)
            lost = missing & ~np.isin(np.arange(len(missing)), edges.outside)
            # A stick with one band of another length shows three edges, too, and nothing hides the fourth.
            if pose.status is Status.UNVERIFIED and not all(
                self._crossed(sampler, axis, edges.t, float(at)) for at in expected[lost]
            ):
                raise self._unexplained(lost)
            if shows_other_colour(sampler, self.lens, axis, edges, expected, self.catheter):
                text = "a band that shows one of its edges has another colour than the catheter's"
                raise Refusal(Status.INCONSISTENT, text)
        if shows_reversed(sampler, self.lens, line_pose, self.catheter):
            text = f"the tube goes on beyond its end on one side only: {_EXCHANGED}"
            raise Refusal(Status.INCONSISTENT, text, final=True)

    def _explained(
        self,
        sampler: Sampler,
        axis: Axis,
        edges: Edges,
        missing: np.ndarray,
        *,
        completed: bool,
        crossed: int | None,
    ) -> Edges:
        """The edges without those that something hides; a Refusal if one is absent for no reason.

        ``missing`` [N] are the edges that were measured where the others put them. One of these that is far less clear
        than the others is something else.
        """
        number = np.arange(len(edges.t))
        clear = math.hypot(float(edges.deviation.min()), _FLOORS.coarse_edge * edges.coarse)
        absent = (edges.deviation > _SEARCH.vague * clear) & ~np.isin(number, edges.outside)
        if not completed:
            absent &= np.isfinite(edges.t) & missing | np.isin(number, edges.absent)
        if crossed is not None:
            absent |= number == crossed
        if not absent.any():
            return edges
        rest = _without(edges, absent)
        if np.isfinite(rest.t).sum() > 2:
            expected = self._expected_edges(self._solved(axis, rest, rough=True), axis.line)
            if crossed is not None and abs(expected[crossed] - edges.t[crossed]) < _NEAR:
                absent[crossed] = False  # measured again, in its own place
                rest = _without(edges, absent)
            if all(self._crossed(sampler, axis, rest.t, float(expected[index])) for index in absent.nonzero()[0]):
                return rest
        raise self._unexplained(absent)

    def _unexplained(self, absent: np.ndarray) -> Refusal:
        """Refusal that names the first of the ``absent`` edges, bool [N]."""
        position = 1e3 * self._positions[int(absent.argmax())]
        text = f"the edge {position:.3g} mm from the tip is not where the others put it, and nothing hides it"
        return Refusal(Status.INCONSISTENT, text)

    def _crossed(self, sampler: Sampler, axis: Axis, t: np.ndarray, at: float) -> bool:
        """Whether something lies across the tube at or beside ``at``.

        The bands between neighbouring edges ``t`` [N] are visible.
        """
        spans = [(a, b) for a, b in itertools.pairwise(t.tolist()) if math.isfinite(b - a)]
        near = at - 2 * _NEAR, at - _NEAR, at, at + _NEAR, at + 2 * _NEAR
        return bool(spans) and any(lies_across(sampler, self.lens, axis, place, spans) for place in near)

    def _agreeing(self, sampler: Sampler, axis: Axis, edges: Edges, line_pose: LinePose) -> None:
        """Refuse edges that disagree with their pose; the Refusal names those beside which something lies across."""
        known = np.isfinite(edges.t).nonzero()[0].tolist()
        freedom = len(known) - 3  # degrees of freedom of positions along the line; the line is fitted separately
        if not line_pose.chi_square > self._chi_square_limits[freedom]:
            return
        crossed = []
        for index in known if freedom else ():
            others = np.where(np.arange(len(edges.t)) == index, np.nan, edges.t)
            if self._crossed(sampler, axis, others, float(edges.t[index])):
                crossed.append(index)
        text = f"edges disagree with any pose: chi-square {line_pose.chi_square:.1f} of {freedom}"
        raise Refusal(Status.INCONSISTENT, text, final=True, crossed=tuple(crossed))

    def _expected_edges(self, line_pose: LinePose, line: Line) -> np.ndarray:
        """Positions [N] in pixels along ``line`` at which a pose puts the centres of the rings of all edges."""
        return np.array([line.along_at(axis_on_plane(line_pose, position)) for position in self._positions])

    def _rough(self, line: Line, rough_t: np.ndarray) -> LinePose | None:
        """Rough pose from edge positions ``rough_t`` [N] in pixels; None if these are too few or not plausible."""
        visible = [(t, s) for t, s in zip(rough_t.tolist(), self._positions, strict=True) if math.isfinite(t)]
        if (count := len(visible)) < 4:
            return None
        t, positions = zip(*visible, strict=True)
        line_pose = pose_on_line(line, t, positions, [1.0] * count, 1.0, 0.01, rough=True)
        wide = width_px(line_pose, self._positions, self.catheter.radius, line)[0] if line_pose else 0.0
        slight = self._slight(rough_t)[0]
        return line_pose if slight / _CHECK.slant < wide < slight * _CHECK.slant else None

    def _slight(self, rough_t: np.ndarray) -> tuple[float, float]:
        """Rough width of the tube's image in pixels, from the length of the bands for a slight tilt; and taper 0."""
        visible = [(s, t) for s, t in zip(self._positions, rough_t.tolist(), strict=True) if math.isfinite(t)]
        (first, a), (last, b) = visible[0], visible[-1]
        return min(max(2 * self.catheter.radius * 1.15 * (b - a) / (last - first), 2.0), _SEARCH.widest), 0.0

    def _bulge(self, line_pose: LinePose, line: Line) -> np.ndarray:
        """Bulge [N] of each ring's front along the line, in pixels."""
        return bulge_px(line_pose, self._positions, self.catheter.radius, line)

    def _wide(self, line_pose: LinePose, line: Line) -> tuple[float, float]:
        """Width of the tube's image in pixels and its taper, from a pose; raises a Refusal if they are impossible."""
        width, taper = width_px(line_pose, self._positions, self.catheter.radius, line)
        if not 1.0 < width < _SEARCH.widest or not abs(taper) < 1:
            raise Refusal(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
        return width, taper

    def _solved(self, axis: Axis, edges: Edges, *, rough: bool = False) -> LinePose:
        """Pose from measured edges, with the error floors; raises a Refusal for fewer than three edges or no pose."""
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
            _FLOORS.defocus * min(soft, smeared),
            _FLOORS.smear * smeared,
        )
        through = [n in (0, last) for n in known]
        along = [
            math.hypot(deviation, floor, outer * _FLOORS.transparency, outer * _FLOORS.texture * texture)
            for deviation, texture, outer in zip(edges.deviation[known], edges.texture[known], through, strict=True)
        ]
        # Shading that is constant along the tube shifts and rotates the line by more than the deviations of its fit.
        # Both deviations, expressed as displacements at the edges, are therefore raised to the larger one.
        middle = sum(t) / len(t)
        spread = math.sqrt(sum((each - middle) ** 2 for each in t) / len(t))
        shift, turn = _FLOORS.stations * axis.offset_sd, _FLOORS.stations * axis.slope_sd
        offset = math.hypot(shift, turn * (middle - axis.centre), _FLOORS.line)
        most = max(offset, turn * spread)
        positions = [self._positions[n] for n in known]
        shared = math.hypot(_FLOORS.shared, _FLOORS.bulge * edges.bulge)
        line_pose = pose_on_line(axis.line, t, positions, along, most, most / max(spread, 1e-9), shared, rough=rough)
        if line_pose is None:
            raise Refusal(Status.INCONSISTENT, "no pose in front of the camera explains the edges")
        return line_pose

    def _read_out(self, line_pose: LinePose, height: int) -> np.ndarray:
        """Covariance [6, 6] of tip and direction from a motion while a rolling shutter reads ``height`` rows."""
        if not self.readout:
            return np.zeros((6, 6))
        tip, direction = (torch.from_numpy(value)[None] for value in (line_pose.tip, line_pose.direction))
        return readout_covariance(self.camera, tip, direction, self.catheter.positions, height, self.readout)[0].numpy()

    def _checked(self, line_pose: LinePose, axis: Axis, edges: Edges, height: int, *, cold: bool) -> Pose:
        """Pose after all checks, in a frame of ``height`` rows.

        ``cold``: there is no previous pose, so that ``axis`` has an independent width.
        """
        visible = edges.t[np.isfinite(edges.t)]
        count = len(visible)
        freedom = count - 3  # degrees of freedom of positions along the line; the line is fitted separately
        middle = float(visible.sum()) / count
        near, taper = self._wide(line_pose, axis.line)
        wide = near + taper * middle
        ratio = float(axis.width_at(middle)) / wide
        most = min(
            0.45, (0.25 if freedom else 0.12) + (0.4 + 2 * axis.width_sd + max(0.0, axis.blur - _SEARCH.blur)) / wide
        )
        if axis.width_sd > (0.2 if freedom else 0.08) * wide:
            raise Refusal(Status.INCONSISTENT, f"{count} edges, and a width too unclear to check them with")
        # A tube that moves perpendicular to its axis by more than its width appears as wide as its path, and its sides
        # have the blur of a box of the tube's width.
        box = wide / math.sqrt(12)  # standard deviation of the box
        expected = math.hypot(edges.blur, box)
        clear = axis.width_sd < _CHECK.path_deviation * axis.width
        moved = clear and 1 < ratio < _CHECK.path and abs(axis.blur / expected - 1) < _CHECK.path_blur
        path = math.hypot(axis.blur, box * ratio)  # determined even where width or blur alone is not
        combined = path / expected
        narrow = cold and path < _CHECK.narrow * math.hypot(min(axis.blur, edges.blur), box)
        if min(axis.blur, edges.blur) > box or (cold and combined > ratio):
            ratio = combined
        if narrow or (abs(ratio - 1) > most and not moved):
            depth = float((line_pose.tip + sum(self._positions) / len(self._positions) * line_pose.direction)[2])
            text = f"{ratio:.2f} times as wide as it should be at {depth:.2f} m"
            raise Refusal(Status.INCONSISTENT, text, final=True)
        # Edges that agree less well than their deviations say are that much less certain (the scale factor of Birge).
        scale = max(1.0, line_pose.chi_square / max(freedom, 1))
        covariance = scale * line_pose.covariance + self._read_out(line_pose, height)
        tip_sd = math.sqrt(float(covariance.diagonal()[:3].sum()))
        if tip_sd > self.most_sd:
            raise Refusal(Status.UNCERTAIN, _uncertain(tip_sd, self.most_sd), final=True)
        status = Status.OK if freedom else Status.UNVERIFIED
        reason = "" if freedom else THREE_EDGES
        tip, direction, covariance = map(torch.from_numpy, (line_pose.tip, line_pose.direction, covariance))
        chi_square, degrees = torch.from_numpy(np.array([line_pose.chi_square, freedom], dtype=np.float64))
        return Pose(tip, direction, covariance, chi_square, degrees, status, reason)

    @contextmanager
    def _timed(self, stage: str):
        began = time.perf_counter()
        try:
            yield
        finally:
            self.times[stage] += time.perf_counter() - began


def _without(edges: Edges, absent: np.ndarray) -> Edges:
    """The edges without those that are ``absent`` [N]."""
    t, deviation = np.where(absent, np.nan, edges.t), np.where(absent, np.inf, edges.deviation)
    return dataclasses.replace(edges, t=t, deviation=deviation)


def _distance(one: Pose, other: Pose) -> float:
    """Distance of the tips in standard deviations, those of both poses together."""
    first, second = ((pose.tip.numpy(force=True), pose.covariance[:3, :3].numpy(force=True)) for pose in (one, other))
    gap = second[0] - first[0]
    return math.sqrt(gap @ np.linalg.solve(first[1] + second[1], gap))


def _uncertain(tip_sd: float, most_sd: float) -> str:
    return f"tip uncertain to {1e3 * tip_sd:.3g} mm, above {1e3 * most_sd:g} mm"


def _chi_square_limits(edges: int) -> list[float]:
    """Largest accepted chi-square for 0 to ``edges`` - 3 degrees of freedom: quantiles, looser ones from 10 on."""
    limits = [float(chdtri(freedom, _SIGNIFICANCE)) for freedom in range(1, min(edges - 2, 10))]
    return [math.inf, *limits, *(freedom + 4 * math.sqrt(2 * freedom) + 6 for freedom in range(10, edges - 2))]
