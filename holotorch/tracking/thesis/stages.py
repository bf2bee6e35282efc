"""Parts of the thesis's pipeline besides image processing: thresholds, oriented Sobel kernel, assignment of edges.

``ThesisTracker`` (kornia) and its counterpart in OpenCV share them, so that both refuse the same frames.
"""

import colorsys
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.status import Pose, Refusal, Status

# The rows of Table 3.1, in its order and words. "Gradient" includes the median, "Connected components" the binary
# image; "Other" is the rest of the time of a call.
STAGES: tuple[str, ...] = (
    "Undistort",
    "Color segmentation",
    "Erosion",
    "Get axis",
    "Gradient",
    "Connected components",
    "Weighted centroids",
    "Calculate catheter position",
    "Other",
)

# The thesis gives no numbers for its thresholds; these make its method run on synthetic frames.
HUE_REACH = 15.0  # degrees to either side of a band's hue
LEAST_SATURATION, LEAST_VALUE = 0.55, 0.3  # relative to the least saturation and value of the bands' colours
LEAST_PIXELS = 30  # least number of pixels after the erosion: of the catheter, and a fifth of it for each band
AXIS_ROUNDS = 6  # most rounds of removing pixels far from the line and fitting it again
AXIS_REACH_PX = 3.0  # pixels farther from the axis than this and than twice the rms are left out of the next fit
AXIS_RMS_PX = 4.0  # largest rms distance of the remaining pixels from the axis
AXIS_SHARE = 0.5  # least share of the pixels that must remain
KERNEL_RADIUS, ALONG_PX, ACROSS_PX = 4, 1.2, 1.5
MEDIAN = 3
LEAST_GRADIENT = 25.0  # least difference in levels between the two sides of an edge
MARGIN_PX = 16  # margin around the bands' pixels, for the kernel and the ends removed by the erosion
OFF_AXIS_PX = 3.0
# Largest distance of an edge from the change of colour: pixels plus share of a band.
OFF_BORDER_PX, OFF_BORDER_SHARE = 6.0, 0.1
DEVIATION_PX = 0.3  # assumed standard deviation of an endpoint in x and y
NUDGE_PX = 1e-4  # step of an endpoint for the numerical derivatives of the pose
NO_POSE = "the endpoints are not the image of the bands in front of the camera"
REFUSED_AT = {
    Status.EDGES_UNCLEAR: "Calculate catheter position",
    Status.INCONSISTENT: "Calculate catheter position",
}

Box = tuple[int, int, int, int]  # left, top, right, bottom; the last two are exclusive
Endpoints = list[tuple[float, float] | None]


@dataclass(frozen=True)
class Windows:
    """Thresholds from a catheter's colours: hues (degrees, one per band), tolerance, saturation and value."""

    hues: tuple[float, ...]
    reach: float
    saturation: float
    value: float


def windows(catheter: Catheter) -> Windows:
    """Hue, saturation and value windows around the bands' colours.

    Raises:
        ValueError: A colour is pale or dark, or two hues are less than 20 degrees apart.
    """
    colours = [colorsys.rgb_to_hsv(*(level / 255 for level in colour)) for colour in catheter.colours]
    hues = [360 * hue for hue, _, _ in colours]
    pale = min(range(len(colours)), key=lambda i: colours[i][1])
    if colours[pale][1] < 0.25 or min(value for _, _, value in colours) < 0.1:
        raise ValueError(
            f"the thesis's colour thresholds need bands of saturation 0.25 and value 0.1 at least, got "
            f"{catheter.colours}; use CatheterTracker"
        )
    gaps = [abs((a - b + 180) % 360 - 180) for i, a in enumerate(hues) for b in hues[:i]]
    if min(gaps) < 20:
        raise ValueError(
            f"the thesis's colour thresholds need hues at least 20 degrees apart, got {[round(hue) for hue in hues]}; "
            "use CatheterTracker"
        )
    saturation = LEAST_SATURATION * min(saturation for _, saturation, _ in colours)
    value = LEAST_VALUE * min(value for _, _, value in colours)
    return Windows(tuple(hues), min(HUE_REACH, min(gaps) / 2), saturation, value)


def oriented_sobel(x: float, y: float) -> np.ndarray:
    """Derivative along the unit vector (x, y), smoothed more across it than along: float32 [9, 9], for correlation.

    The largest response to a step of one level along (x, y) is one level. Source: K_Laxis of Sec. 3.4.3, which does not
    give the weights; here they are Gaussian.
    """
    steps = np.arange(-KERNEL_RADIUS, KERNEL_RADIUS + 1, dtype=np.float64)
    along = x * steps[None, :] + y * steps[:, None]
    across = x * steps[:, None] - y * steps[None, :]
    kernel = along * np.exp(-0.5 * ((along / ALONG_PX) ** 2 + (across / ACROSS_PX) ** 2))
    return (kernel / kernel[kernel > 0].sum()).astype(np.float32)


@dataclass(frozen=True)
class Axis:
    """Fitted line in pixels of the undistorted frame, and the range of each band's pixels along it."""

    origin: tuple[float, float]
    direction: tuple[float, float]
    extents: tuple[tuple[float, float] | None, ...]  # first and last position; None: too few pixels

    def along(self, x: float, y: float) -> float:
        """Position of a pixel along the axis, from its origin."""
        return (x - self.origin[0]) * self.direction[0] + (y - self.origin[1]) * self.direction[1]

    def across(self, x: float, y: float) -> float:
        """Signed distance of a pixel from the axis."""
        return (y - self.origin[1]) * self.direction[0] - (x - self.origin[0]) * self.direction[1]


def need_frames(frames: Tensor) -> None:
    """Raise TypeError or ValueError unless ``frames`` is uint8 [B, 3, H, W] with H, W >= 32."""
    if not isinstance(frames, Tensor) or frames.dtype != torch.uint8:
        raise TypeError(f"frames must be a tensor of uint8, got {getattr(frames, 'dtype', type(frames))}")
    if frames.ndim != 4 or frames.shape[1] != 3 or not len(frames) or min(frames.shape[-2:]) < 32:
        raise ValueError(f"frames must be [B, 3, H, W] with B >= 1 and H, W >= 32, got {list(frames.shape)}")


def missing_edges(names: Sequence[str]) -> str:
    """Reason stated with a pose for which these edges were not found; "" for none."""
    return f"edges not found, pose from the others: {', '.join(names)}" if names else ""


def need_pixels(count: int) -> None:
    """Raise a Refusal if too few pixels have a band's colour to fit a line."""
    if count < LEAST_PIXELS:
        raise Refusal(Status.NO_CATHETER, f"{count} pixels have a band's colour after the erosion, not {LEAST_PIXELS}")


def need_line(count: int, kept: int, rms_px: float) -> None:
    """Raise a Refusal if the pixels form no line: ``kept`` of ``count`` are near the axis, ``rms_px`` from it."""
    if kept < max(LEAST_PIXELS, AXIS_SHARE * count) or not rms_px <= AXIS_RMS_PX:
        raise Refusal(
            Status.NO_AXIS,
            f"the pixels of the bands' colours are no line: {kept} of {count} near the axis, {rms_px:.1f} px rms",
        )


def need_order(axis: Axis) -> None:
    """Raise a Refusal unless two neighbouring bands are visible and all visible bands have the catheter's order."""
    seen = [(i, extent[0] + extent[1]) for i, extent in enumerate(axis.extents) if extent is not None]
    names = ", ".join(str(i + 1) for i, _ in seen) or "none"
    if not any(b[0] == a[0] + 1 for a, b in zip(seen, seen[1:], strict=False)):
        raise Refusal(Status.BANDS_MISSING, f"two neighbouring bands are needed, of {len(axis.extents)} seen: {names}")
    if len({b[1] > a[1] for a, b in zip(seen, seen[1:], strict=False)}) == 2:
        raise Refusal(Status.BANDS_MISSING, "the colours along the axis are not in the catheter's order")


def endpoints(axis: Axis, centroids: Sequence[tuple[float, float]]) -> Endpoints:
    """Centroid of each edge of the bands, in the catheter's order; None where there is none.

    The expected position of an edge is halfway between the pixels of the two bands beside it, or at the end of the
    pixels of one band if the other is missing. The nearest centroid within a tolerance is taken.

    Raises:
        Refusal: No two neighbouring bands have all three edges.
    """
    extents = axis.extents
    middles = [sum(extent) for extent in extents if extent is not None]
    forward = int(middles[-1] > middles[0])
    spots = [(axis.along(*spot), spot) for spot in centroids if abs(axis.across(*spot)) <= OFF_AXIS_PX]
    found: Endpoints = []
    for before, after in zip((None, *extents), (*extents, None), strict=True):
        ends = [extent[side] for extent, side in ((before, forward), (after, 1 - forward)) if extent is not None]
        found.append(None)
        if ends and spots:
            place = sum(ends) / len(ends)
            longest = max(extent[1] - extent[0] for extent in (before, after) if extent is not None)
            apart, spot = min((abs(at - place), spot) for at, spot in spots)
            if apart <= OFF_BORDER_PX + OFF_BORDER_SHARE * longest:
                found[-1] = spot
    if not triples(found):
        names = ", ".join(str(i + 1) for i, spot in enumerate(found) if spot is not None) or "none"
        raise Refusal(Status.EDGES_UNCLEAR, f"three neighbouring edges of the bands are needed, found: {names}")
    return found


def triples(found: Endpoints) -> list[int]:
    """Indices of the first edge of each pair of neighbouring bands whose three endpoints were found."""
    return [i for i in range(len(found) - 2) if None not in found[i : i + 3]]


def box(first: Sequence[int], last: Sequence[int], size: tuple[int, int]) -> Box:
    """Box around the pixels from ``first`` (x, y) to ``last`` with its margin, within a frame of ``size`` (W, H)."""
    left, top = (max(low - MARGIN_PX, 0) for low in first)
    right, bottom = (min(high + MARGIN_PX + 1, side) for high, side in zip(last, size, strict=True))
    return left, top, right, bottom


def nudged(found: Endpoints) -> np.ndarray:
    """Endpoints float64 [1 + 2 n, n, 2], NaN for None: unchanged, then with each number changed by ``NUDGE_PX``."""
    edges = np.array([spot or (np.nan, np.nan) for spot in found])
    nudges = np.concatenate([np.zeros((1, edges.size)), NUDGE_PX * np.eye(edges.size)])
    return edges + nudges.reshape(-1, *edges.shape)


def answer(found: Endpoints, tip: np.ndarray, direction: np.ndarray, device: torch.device | None = None) -> Pose:
    """Pose from the tips and directions [1 + 2 n, 3] of :func:`nudged` endpoints; raises a Refusal if invalid."""
    both = np.concatenate([tip, direction], -1)
    slopes = (both[1:] - both[0]).T / NUDGE_PX
    covariance = DEVIATION_PX**2 * slopes @ slopes.T
    if not np.isfinite(covariance).all() or not np.isfinite(both).all() or tip[0, 2] <= 0:
        raise Refusal(Status.INCONSISTENT, NO_POSE)
    missing = [str(edge + 1) for edge, spot in enumerate(found) if spot is None]
    zero = torch.zeros((), dtype=torch.float64, device=device)
    return Pose(
        tip=torch.from_numpy(tip[0].copy()).to(device),
        direction=torch.from_numpy(direction[0].copy()).to(device),
        covariance=torch.from_numpy(covariance).to(device),
        chi_square=zero,
        freedom=zero,
        status=Status.UNVERIFIED if missing else Status.OK,
        reason=missing_edges(missing),
    )


class Stopwatch:
    """Seconds of each stage of one call, by name; ``wait`` is called before each reading of the clock."""

    def __init__(self, wait: Callable[[], None] | None = None):
        self.times: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        self._wait = wait
        self._start = self._last = self._now()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = self._now()
        self.times[stage] += now - self._last
        self._last = now

    def stop(self) -> dict[str, float]:
        """Seconds of each stage; "Other" is the rest of the call."""
        self.times["Other"] = 0.0
        self.times["Other"] = max(0.0, self._now() - self._start - math.fsum(self.times.values()))
        return self.times

    def _now(self) -> float:
        if self._wait is not None:
            self._wait()
        return time.perf_counter()
