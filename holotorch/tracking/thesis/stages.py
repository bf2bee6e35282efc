"""Parts of the thesis's pipeline that both implementations share: thresholds, Sobel kernel, axis fit and endpoints.

``ThesisTracker`` (kornia) and its counterpart in OpenCV use them, so that both refuse the same frames.
"""

import colorsys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.status import Pose, Refusal, Status

# The rows of Table 3.1, in its order and words. "Gradient" includes the median, "Connected components" the binary
# image; "Other" is the rest of the time of a call.
STAGES: tuple[str, ...] = (
    *("Undistort", "Color segmentation", "Erosion", "Get axis", "Gradient", "Connected components"),
    *("Weighted centroids", "Calculate catheter position", "Other"),
)

# The thesis gives no numbers for its thresholds; with these, its method works on synthetic frames.
HUE_TOLERANCE = 15.0  # degrees: largest difference from a band's hue
LEAST_SATURATION, LEAST_VALUE = 0.55, 0.3  # thresholds as shares of the bands' least saturation and value
LEAST_PIXELS = 30  # least number of pixels of all bands after the erosion; a visible band has at least a fifth of it
AXIS_ROUNDS = 6  # largest number of rounds that remove pixels far from the line and fit it again
AXIS_DISTANCE_PX = 3.0  # pixels farther from the axis than this and than twice the rms are left out of the next fit
AXIS_RMS_PX = 4.0  # largest rms distance of the remaining pixels from the axis
AXIS_SHARE = 0.5  # least share of the pixels that must remain
KERNEL_RADIUS = 4  # half-width of the Sobel kernel in pixels
ALONG_PX, ACROSS_PX = 1.2, 1.5  # standard deviations of the Sobel kernel's Gaussian along and across the axis
MEDIAN = 3  # side of the median filter in pixels
LEAST_GRADIENT = 25.0  # least difference in levels between the two sides of an edge
MARGIN_PX = 16  # margin around the bands' pixels, for the kernel and for what the erosion removed
OFF_AXIS_PX = 3.0  # largest distance of an edge from the axis
# Largest distance of an edge from the border between two colours: pixels, plus a share of the longer band's length.
OFF_BORDER_PX, OFF_BORDER_SHARE = 6.0, 0.1
DEVIATION_PX = 0.3  # assumed standard deviation of an endpoint in x and y
NUDGE_PX = 1e-4  # step of an endpoint for the numerical derivatives of the pose

Box = tuple[int, int, int, int]  # left, top, right, bottom in pixels; the last two are exclusive
Endpoints = list[tuple[float, float] | None]  # pixels (x, y) of each edge of the bands; None if it was not found


@dataclass(frozen=True)
class Windows:
    """Hue of each band and largest difference from it, in degrees; least saturation and value, from 0 to 1."""

    hues: tuple[float, ...]
    tolerance: float
    saturation: float
    value: float


def windows(catheter: Catheter) -> Windows:
    """Thresholds in hue, saturation and value for the bands' colours.

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
    return Windows(tuple(hues), min(HUE_TOLERANCE, min(gaps) / 2), saturation, value)


def oriented_sobel(x: float, y: float) -> np.ndarray:
    """Derivative along the unit vector (x, y), smoothed more across it than along: float32 [9, 9], for correlation.

    The largest response to a step of one level along (x, y) is one level. Source: K_Laxis of Sec. 3.4.3. The thesis
    does not give its weights; here they are Gaussian.
    """
    steps = np.arange(-KERNEL_RADIUS, KERNEL_RADIUS + 1, dtype=np.float64)
    along = x * steps[None, :] + y * steps[:, None]
    across = x * steps[:, None] - y * steps[None, :]
    kernel = along * np.exp(-0.5 * ((along / ALONG_PX) ** 2 + (across / ACROSS_PX) ** 2))
    return (kernel / kernel[kernel > 0].sum()).astype(np.float32)


@dataclass(frozen=True)
class Axis:
    """Fitted line in pixels of the undistorted frame: a point and a unit direction, (x, y) each.

    ``extents`` holds the first and last position along the line of each band's pixels, None if they are too few.
    """

    origin: tuple[float, float]
    direction: tuple[float, float]
    extents: tuple[tuple[float, float] | None, ...] = ()

    def along(self, x: Any, y: Any) -> Any:
        """Positions of pixels (numbers, arrays or tensors) along the axis, from its origin."""
        return (x - self.origin[0]) * self.direction[0] + (y - self.origin[1]) * self.direction[1]

    def across(self, x: Any, y: Any) -> Any:
        """Signed distances of pixels (numbers, arrays or tensors) from the axis."""
        return (y - self.origin[1]) * self.direction[0] - (x - self.origin[0]) * self.direction[1]


def need_frames(frames: Tensor) -> None:
    """Raise TypeError or ValueError unless ``frames`` is uint8 [B, 3, H, W] with H, W >= 32."""
    if not isinstance(frames, Tensor) or frames.dtype != torch.uint8:
        raise TypeError(f"frames must be a tensor of uint8, got {getattr(frames, 'dtype', type(frames))}")
    if frames.ndim != 4 or frames.shape[1] != 3 or not len(frames) or min(frames.shape[-2:]) < 32:
        raise ValueError(f"frames must be [B, 3, H, W] with B >= 1 and H, W >= 32, got {list(frames.shape)}")


def fit_axis(
    points: Any, number: Callable[[Any], Any], bands: int, size: tuple[int, int], line: Callable[[Any], Axis]
) -> tuple[Axis, Box]:
    """Fit a line to the pixels that the erosion left, without outliers.

    Args:
        points: Pixels (x, y), an array or tensor [n, 2].
        number: Function that gives the numbers [n] of the bands of pixels [n, 2], from 1.
        bands: Number of bands of the catheter.
        size: Width and height of the frame in pixels.
        line: Function that fits a line to points, with the least sum of squared distances.

    Returns:
        The line, and the box around the pixels near it with its margin.

    Raises:
        Refusal: Too few pixels, or no line; no two neighbouring bands visible, or bands in another order.
    """
    if len(points) < LEAST_PIXELS:
        reason = f"{len(points)} pixels have a band's colour after the erosion, not {LEAST_PIXELS}"
        raise Refusal(Status.NO_CATHETER, reason)
    axis, near, kept = line(points), None, points
    for _ in range(AXIS_ROUNDS):
        distances = abs(axis.across(points[:, 0], points[:, 1]))
        closer = distances <= max(AXIS_DISTANCE_PX, 2 * _rms(distances if near is None else distances[near]))
        settled = bool((closer if near is None else closer == near).all())
        near, kept = closer, points[closer]
        if settled or len(kept) < LEAST_PIXELS:
            break
        axis = line(kept)
    x, y = kept[:, 0], kept[:, 1]
    rms = _rms(axis.across(x, y))
    if len(kept) < max(LEAST_PIXELS, AXIS_SHARE * len(points)) or not rms <= AXIS_RMS_PX:
        counted = f"{len(kept)} of {len(points)} near the axis, {rms:.1f} px rms"
        raise Refusal(Status.NO_AXIS, f"the pixels of the bands' colours are no line: {counted}")
    along, numbers = axis.along(x, y), number(kept)
    of_bands = [along[numbers == i] for i in range(1, bands + 1)]
    extents = [(float(own.min()), float(own.max())) if len(own) >= LEAST_PIXELS // 5 else None for own in of_bands]
    _need_order(extents)
    left, top = (max(int(values.min()) - MARGIN_PX, 0) for values in (x, y))
    right, bottom = (min(int(values.max()) + MARGIN_PX + 1, side) for values, side in zip((x, y), size, strict=True))
    return replace(axis, extents=tuple(extents)), (left, top, right, bottom)


def _rms(values: Any) -> float:
    return float((values**2).mean()) ** 0.5


def _need_order(extents: Sequence[tuple[float, float] | None]) -> None:
    """Raise a Refusal unless two neighbouring bands are visible and all visible bands have the catheter's order."""
    visible = [(i, extent[0] + extent[1]) for i, extent in enumerate(extents) if extent is not None]
    names = ", ".join(str(i + 1) for i, _ in visible) or "none"
    if not any(b[0] == a[0] + 1 for a, b in pairwise(visible)):
        raise Refusal(Status.BANDS_MISSING, f"two neighbouring bands are needed, of {len(extents)} seen: {names}")
    if len({b[1] > a[1] for a, b in pairwise(visible)}) == 2:
        raise Refusal(Status.BANDS_MISSING, "the colours along the axis are not in the catheter's order")


def endpoints(axis: Axis, centroids: Sequence[tuple[float, float]]) -> Endpoints:
    """Centroid of each edge of the bands, in the catheter's order; None for an edge without a centroid.

    The expected position of an edge is halfway between the pixels of the two bands beside it, or at the end of the
    pixels of one band if the other is missing. The nearest centroid within a tolerance is taken.

    Raises:
        Refusal: No two neighbouring bands have all three edges.
    """
    extents = axis.extents
    middles = [sum(extent) for extent in extents if extent is not None]
    forward = int(middles[-1] > middles[0])
    spots = [(axis.along(*spot), spot) for spot in centroids if abs(axis.across(*spot)) <= OFF_AXIS_PX]
    edges: Endpoints = []
    for before, after in zip((None, *extents), (*extents, None), strict=True):
        ends = [extent[side] for extent, side in ((before, forward), (after, 1 - forward)) if extent is not None]
        edges.append(None)
        if ends and spots:
            expected = sum(ends) / len(ends)
            longest = max(extent[1] - extent[0] for extent in (before, after) if extent is not None)
            distance, spot = min((abs(position - expected), spot) for position, spot in spots)
            if distance <= OFF_BORDER_PX + OFF_BORDER_SHARE * longest:
                edges[-1] = spot
    if not triples(edges):
        names = ", ".join(str(i + 1) for i, edge in enumerate(edges) if edge is not None) or "none"
        raise Refusal(Status.EDGES_UNCLEAR, f"three neighbouring edges of the bands are needed, found: {names}")
    return edges


def triples(edges: Endpoints) -> list[int]:
    """Indices of the first edge of each pair of neighbouring bands whose three endpoints were found."""
    return [i for i in range(len(edges) - 2) if None not in edges[i : i + 3]]


def nudged(edges: Endpoints) -> np.ndarray:
    """Endpoints float64 [1 + 2 n, n, 2], NaN for None: unchanged, then with each number changed by ``NUDGE_PX``."""
    pixels = np.array([edge or (np.nan, np.nan) for edge in edges])
    nudges = np.concatenate([np.zeros((1, pixels.size)), NUDGE_PX * np.eye(pixels.size)])
    return pixels + nudges.reshape(-1, *pixels.shape)


def answer(edges: Endpoints, tip: np.ndarray, direction: np.ndarray, device: torch.device | None = None) -> Pose:
    """Pose from the tips and directions [1 + 2 n, 3] of :func:`nudged` endpoints; raises a Refusal if invalid."""
    both = np.concatenate([tip, direction], -1)
    slopes = (both[1:] - both[0]).T / NUDGE_PX
    covariance = DEVIATION_PX**2 * slopes @ slopes.T
    if not np.isfinite(covariance).all() or not np.isfinite(both).all() or tip[0, 2] <= 0:
        raise Refusal(Status.INCONSISTENT, "the endpoints are not the image of the bands in front of the camera")
    missing = ", ".join(str(i + 1) for i, edge in enumerate(edges) if edge is None)
    status = Status.UNVERIFIED if missing else Status.OK
    reason = f"edges not found, pose from the others: {missing}" if missing else ""
    tensor = partial(torch.tensor, dtype=torch.float64, device=device)
    return Pose(tensor(tip[0]), tensor(direction[0]), tensor(covariance), tensor(0), tensor(0), status, reason)


class Stopwatch:
    """Seconds of each stage of one call, by name; ``wait``, such as a GPU synchronisation, precedes each reading."""

    def __init__(self, wait: Callable[[], None] = lambda: None):
        self.times: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        self._wait = wait
        wait()
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        self._wait()
        now = time.perf_counter()
        self.times[stage] += now - self._last
        self._last = now
