"""The thesis's tracking pipeline (Sec. 3.4) in OpenCV on the CPU, the baseline of all times in the tracking charts."""

from collections.abc import Sequence

import cv2
import numpy as np
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.status import Pose, Refusal, Status
from holotorch.tracking.thesis import stages
from holotorch.tracking.thesis.stages import Axis, Box, Endpoints, Stopwatch


class ThesisOpenCV:
    """The stages of :class:`~holotorch.tracking.thesis.tracker.ThesisTracker` on 8-bit images, with the same decisions.

    It is written to be a fair baseline: the undistortion maps are in fixed point and are computed once, and filters run
    only within the box around the bands. Frames with the memory layout [H, W, 3], as cameras deliver them, are not
    copied. The attributes ``times`` and ``endpoints`` and the errors are those of ThesisTracker.

    Args:
        camera: Camera of the frames.
        catheter: Catheter to track.
        literal: Undistort each frame by ``cv2.undistort``, which computes its maps again on every call.
    """

    def __init__(self, camera: Camera, catheter: Catheter, *, literal: bool = False):
        self.camera, self.catheter, self.literal = camera, catheter, literal
        self.times: dict[str, float] = dict.fromkeys(stages.STAGES, 0.0)
        self.endpoints: list[Endpoints] = []
        windows = stages.windows(catheter)
        hue = np.arange(256) * 2.0  # OpenCV's unit is 2 degrees
        self._bands = np.zeros(256, dtype=np.uint8)
        for number, middle in enumerate(windows.hues, 1):
            self._bands[np.abs((hue - middle + 180) % 360 - 180) <= windows.tolerance] = number
        self._low = np.ceil([0, 255 * windows.saturation, 255 * windows.value])
        self._matrix = camera.matrix.detach().cpu().numpy()
        self._distortion = camera.distortion.detach().cpu().numpy()
        self._positions = np.array(catheter.edges)
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self._size = (0, 0)

    def __call__(self, frames: Tensor) -> list[Pose]:
        """Pose in metres, or refusal, for each RGB frame of a uint8 tensor [B, 3, H, W] on the CPU.

        Raises:
            TypeError, ValueError: ``frames`` is not such a tensor.
        """
        stages.need_frames(frames)
        if frames.device.type != "cpu":
            raise ValueError(f"OpenCV works in the CPU's memory, got frames on {frames.device}; use frames.cpu()")
        self._prepare((frames.shape[-1], frames.shape[-2]))
        watch = Stopwatch()
        poses, self.endpoints = [], []
        for frame in frames.numpy():
            self.endpoints.append([])
            try:
                poses.append(self._track(frame, watch))
            except Refusal as refused:
                from_endpoints = refused.status in (Status.EDGES_UNCLEAR, Status.INCONSISTENT)
                watch.lap("Calculate catheter position" if from_endpoints else "Get axis")
                poses.append(Pose.refused(refused.status, refused.reason))
        watch.lap("Other")
        self.times = watch.times
        return poses

    def _prepare(self, size: tuple[int, int]) -> None:
        """Compute the undistortion maps for frames of this (width, height), black beyond the valid radius."""
        if size == self._size:
            return
        x, y = cv2.initUndistortRectifyMap(self._matrix, self._distortion, np.eye(3), self._matrix, size, cv2.CV_32FC1)
        across = (np.arange(size[0]) - self._matrix[0, 2]) / self._matrix[0, 0]
        down = (np.arange(size[1]) - self._matrix[1, 2]) / self._matrix[1, 1]
        outside = across[None, :] ** 2 + down[:, None] ** 2 > self.camera.valid_radius**2
        x[outside] = y[outside] = -100
        fixed, fraction = cv2.convertMaps(x.clip(-100, 32000), y.clip(-100, 32000), cv2.CV_16SC2)
        self._maps, self._size = (fixed, fraction), size

    def _track(self, frame: np.ndarray, watch: Stopwatch) -> Pose:
        pixels = frame.transpose(1, 2, 0)
        if not pixels.flags.c_contiguous:
            pixels = cv2.merge(list(frame))
        watch.lap("Other")
        assert self._maps is not None
        if self.literal:
            image = cv2.undistort(pixels, self._matrix, self._distortion)
        else:
            image = cv2.remap(pixels, *self._maps, cv2.INTER_LINEAR)
        watch.lap("Undistort")
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
        coloured = cv2.inRange(hsv, self._low, (180.0, 255.0, 255.0))  # type: ignore[call-overload]
        bands = cv2.LUT(cv2.extractChannel(hsv, 0), self._bands)
        cv2.bitwise_and(bands, coloured, bands)  # the number of the band where ``coloured`` is 255, and 0 elsewhere
        watch.lap("Color segmentation")
        solid = cv2.erode(bands, np.ones((3, 3), dtype=np.uint8))
        watch.lap("Erosion")
        axis, box = self._axis(solid, bands)
        watch.lap("Get axis")
        left, top, right, bottom = box
        crop = image[top:bottom, left:right]
        change = cv2.convertScaleAbs(cv2.filter2D(crop, cv2.CV_16S, stages.oriented_sobel(*axis.direction)))
        red, green, blue = cv2.split(change)
        gradient = cv2.medianBlur(cv2.max(cv2.max(red, green), blue), stages.MEDIAN)
        watch.lap("Gradient")
        binary = cv2.threshold(gradient, stages.LEAST_GRADIENT - 1, 255, cv2.THRESH_BINARY)[1]
        count, labels, _, _ = cv2.connectedComponentsWithStats(binary, connectivity=8)
        watch.lap("Connected components")
        centroids = _centroids(gradient, labels, count, left, top)
        watch.lap("Weighted centroids")
        self.endpoints[-1] = stages.endpoints(axis, centroids)
        pose = self._pose(self.endpoints[-1])
        watch.lap("Calculate catheter position")
        return pose

    def _axis(self, solid: np.ndarray, bands: np.ndarray) -> tuple[Axis, Box]:
        """Line through the pixels [H, W] left by the erosion, except those far from the line, and their box."""
        nonzero = cv2.findNonZero(solid)
        points = np.asarray([] if nonzero is None else nonzero, dtype=np.int32).reshape(-1, 2)
        size = solid.shape[1], solid.shape[0]
        return stages.fit_axis(points, lambda own: bands[own[:, 1], own[:, 0]], len(self._positions) - 1, size, _line)

    def _pose(self, edges: Endpoints) -> Pose:
        """Mean of the closed-form poses of each pair of neighbouring bands whose three endpoints were found."""
        nudged = stages.nudged(edges)
        rays = np.ones((*nudged.shape[:2], 3))
        rays[..., :2] = (nudged - self._matrix[:2, 2]) / self._matrix.diagonal()[:2]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return stages.answer(edges, *_closed_form(rays, self._positions, stages.triples(edges)))


def _line(points: np.ndarray) -> Axis:
    """Line with the least sum of squared distances from points [n, 2]."""
    dx, dy, x, y = cv2.fitLine(points, cv2.DIST_L2, 0, 0.01, 0.01).ravel().tolist()
    return Axis((x, y), (dx, dy))


def _centroids(gradient: np.ndarray, labels: np.ndarray, count: int, left: int, top: int) -> list[tuple[float, float]]:
    """Centres (x, y) in the frame of the labelled components, weighted by the gradient."""
    rows, columns = np.nonzero(labels)
    weights = gradient[rows, columns].astype(np.float64)
    kind = labels[rows, columns]
    sums, x, y = (np.bincount(kind, values, count)[1:] for values in (weights, weights * columns, weights * rows))
    return list(zip((x / sums + left).tolist(), (y / sums + top).tolist(), strict=True))


def _closed_form(rays: np.ndarray, positions: np.ndarray, starts: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Mean tip and direction [B, 3] over the triples of edges that begin at ``starts``, from unit rays [B, N, 3].

    Applies the sine rule to the triangles formed by the camera and each band (corrected Eqs. 3.5 to 3.12); bands may
    have any length. This repeats :func:`holotorch.tracking.pose.pose.closed_form` in NumPy, so that the timed
    baseline does not use PyTorch.
    """
    tips, directions = [], []
    for i in starts:
        a, b, c = rays[:, i], rays[:, i + 1], rays[:, i + 2]
        first, second = positions[i + 1] - positions[i], positions[i + 2] - positions[i + 1]
        p1, p2 = _angle(a, b), _angle(b, c)
        both = p1 + p2
        sine = np.sin(both)
        delta = np.arctan2(first * np.sin(p2) * sine, second * np.sin(p1) - first * np.sin(p2) * np.cos(both))
        scale = (first + second) / sine
        front, rear = (scale * np.sin(delta))[:, None] * a, (scale * np.sin(both + delta))[:, None] * c
        direction = (rear - front) / np.linalg.norm(rear - front, axis=-1, keepdims=True)
        tips.append(front - positions[i] * direction)
        directions.append(direction)
    direction = np.mean(directions, 0)
    return np.mean(tips, 0), direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))
