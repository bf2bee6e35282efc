"""ThesisTracker: the tracking pipeline of Sec. 3.4, stage by stage in kornia."""

import torch
from kornia.color import rgb_to_hsv
from kornia.contrib import connected_components_union_find
from kornia.filters import filter2d, median_blur
from kornia.geometry import fit_line, remap
from kornia.morphology import erosion
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.detection.channels import ChannelOrder
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.pose import closed_form
from holotorch.tracking.pose.status import Pose, Refusal
from holotorch.tracking.thesis import stages
from holotorch.tracking.thesis.stages import Axis, Box, Endpoints, Stopwatch


class ThesisTracker:
    """Pose of a banded catheter in frames of one camera, by the unimproved method of the thesis.

    Stages: undistort the whole frame; threshold hue, saturation and value; erode; fit a line (the axis) to the
    remaining pixels; compute the gradient along it with an oriented Sobel kernel and a median filter; threshold it and
    label connected components. The weighted centroids of the components are the endpoints of the bands. The pose is the
    mean of the closed-form poses of all pairs of neighbouring bands.

    Known failures of the method: it gives a pose for narrow coloured papers in a row, takes the border of an occluder
    for the end of a band, and refuses distant catheters, whose bands the erosion removes, and clutter in the bands'
    colours. The status is OK if all edges were found and UNVERIFIED if some are missing; the pose is not checked in
    either case (``freedom`` is 0). The covariance is propagated from errors of the endpoints of 0.3 px in x and y.

    On a CPU this takes about eight times as long as the same stages in OpenCV, which are the reference for times
    (holotorch.experiments.tracking_benchmark.thesis_opencv). It needs about 0.2 GB per 1080p frame of the batch.

    Args:
        camera: Intrinsics.
        catheter: Catheter to track.
        channels: Order of the frames' channels.

    Attributes:
        times: Seconds of each stage of the last call, by the names of Table 3.1; all frames of the batch together.
        endpoints: For each frame of the last call, the bands' edges (x, y) in pixels of the undistorted frame, in the
            catheter's order, None where not found; an empty list if an earlier stage refused the frame.

    Raises:
        ValueError: Thresholds in hue cannot distinguish the colours.

    Source: Sec. 3.4 and Table 3.1 of the thesis, with its equations 3.5 to 3.12 corrected.
    """

    def __init__(self, camera: Camera, catheter: Catheter, *, channels: ChannelOrder = ChannelOrder.RGB):
        self.camera, self.catheter, self.channels = camera, catheter, channels
        self.times: dict[str, float] = dict.fromkeys(stages.STAGES, 0.0)
        self.endpoints: list[Endpoints] = []
        self._windows = stages.windows(catheter)
        self._pinhole = Camera(camera.matrix.detach(), torch.zeros(5))  # camera of the undistorted frames
        self._map = torch.empty(0, 0, 2)

    @torch.no_grad()
    def __call__(self, frames: Tensor) -> list[Pose]:
        """Pose in metres, or refusal, of each frame of uint8 [B, 3, H, W].

        Raises:
            TypeError, ValueError: ``frames`` is not such a tensor.
        """
        stages.need_frames(frames)
        self.camera.need_size(frames)
        frames = self.channels.to_rgb(frames)
        watch = Stopwatch(torch.cuda.synchronize if frames.is_cuda else None)
        poses: list[Pose | None] = [None] * len(frames)
        self.endpoints = [[] for _ in poses]
        image = self._undistorted(frames)
        watch.lap("Undistort")
        bands = self._segmented(image)
        watch.lap("Color segmentation")
        solid = erosion((bands > 0).to(image.dtype), torch.ones(3, 3, device=image.device)) > 0
        watch.lap("Erosion")
        axes: dict[int, tuple[Axis, Box]] = {}
        for item in range(len(frames)):
            try:
                axes[item] = self._axis(solid[item, 0], bands[item, 0])
            except Refusal as refused:
                poses[item] = Pose.refused(refused.status, refused.reason)
        watch.lap("Get axis")
        if axes:
            gradient, corners = self._gradient(image, axes)
            watch.lap("Gradient")
            binary = (gradient >= stages.LEAST_GRADIENT - 0.5) & self._inside(axes, corners, gradient)
            labels = connected_components_union_find(binary)
            watch.lap("Connected components")
            centroids = _centroids(gradient, labels, corners)
            found = {item: centroids[row] for row, item in enumerate(axes)}
            watch.lap("Weighted centroids")
            for item, (axis, _) in axes.items():
                try:
                    self.endpoints[item] = stages.endpoints(axis, found[item])
                    poses[item] = self._pose(self.endpoints[item], frames.device)
                except Refusal as refused:
                    poses[item] = Pose.refused(refused.status, refused.reason)
            watch.lap("Calculate catheter position")
        self.times = watch.stop()
        return [pose for pose in poses if pose is not None]

    def _undistorted(self, frames: Tensor) -> Tensor:
        """Frames float32, 0 to 1, of the same camera without distortion; black beyond its valid radius."""
        height, width = frames.shape[-2:]
        if self._map.shape[:2] != (height, width) or self._map.device != frames.device:
            y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
            matrix = self.camera.matrix.detach().cpu()
            plane = (torch.stack([x, y], -1) - matrix[:2, 2]) / matrix.diagonal()[:2]
            inside = plane.square().sum(-1, keepdim=True) <= self.camera.valid_radius**2
            pixels = torch.where(inside, self.camera.distort(plane), -100.0)
            self._map = pixels.detach().to(frames.device, torch.float32)
        x, y = self._map.expand(len(frames), -1, -1, -1).unbind(-1)
        return remap(frames.to(torch.float32) / 255, x, y, align_corners=True)

    def _segmented(self, image: Tensor) -> Tensor:
        """Number (from 1) of the band whose colour each pixel has, or 0: uint8 [B, 1, H, W]."""
        hue, saturation, value = rgb_to_hsv(image).split(1, 1)
        hue = torch.rad2deg(hue)
        coloured = (saturation >= self._windows.saturation) & (value >= self._windows.value)
        bands = torch.zeros_like(hue, dtype=torch.uint8)
        for number, middle in enumerate(self._windows.hues, 1):
            near = ((hue - middle + 180).remainder(360) - 180).abs() <= self._windows.reach
            bands[near & coloured] = number
        return bands

    def _axis(self, solid: Tensor, bands: Tensor) -> tuple[Axis, Box]:
        """Line through the pixels [H, W] left by the erosion, except those far from it; and their box."""
        rows, columns = torch.nonzero(solid, as_tuple=True)
        stages.need_pixels(len(rows))
        points, numbers = torch.stack([columns, rows], -1).to(torch.float64), bands[rows, columns]
        near = torch.ones_like(numbers, dtype=torch.bool)
        origin, direction = _line(points)
        for _ in range(stages.AXIS_ROUNDS):
            across = _across(points, origin, direction)
            reach = 2 * across[near].square().mean().sqrt()
            closer = across.abs() <= reach.clamp(min=stages.AXIS_REACH_PX)
            settled = torch.equal(closer, near)
            near = closer
            if settled or int(near.sum()) < stages.LEAST_PIXELS:
                break
            origin, direction = _line(points[near])
        total, points, numbers = len(points), points[near], numbers[near]
        rms = _across(points, origin, direction).square().mean().sqrt()
        stages.need_line(total, len(points), float(rms))
        along = (points - origin) @ direction
        extents: list[tuple[float, float] | None] = []
        for number in range(1, len(self._windows.hues) + 1):
            of_band = along[numbers == number]
            seen = len(of_band) >= stages.LEAST_PIXELS // 5
            extents.append((float(of_band.min()), float(of_band.max())) if seen else None)
        (x, y), (dx, dy) = origin.tolist(), direction.tolist()
        axis = Axis((x, y), (dx, dy), tuple(extents))
        stages.need_order(axis)
        first, last = points.amin(0).long().tolist(), points.amax(0).long().tolist()
        return axis, stages.box(first, last, (solid.shape[1], solid.shape[0]))

    def _gradient(self, image: Tensor, axes: dict[int, tuple[Axis, Box]]) -> tuple[Tensor, list[tuple[int, int]]]:
        """Largest gradient of the three colours along each axis in levels, [n, 1, h, w], and left and top of each crop.

        All crops have the size of the largest box, so that one call filters each with its kernel.
        """
        boxes = [box for _, box in axes.values()]
        height, width = max(box[3] - box[1] for box in boxes), max(box[2] - box[0] for box in boxes)
        limits = image.shape[-1] - width, image.shape[-2] - height
        corners = [(min(box[0], limits[0]), min(box[1], limits[1])) for box in boxes]
        crops = torch.stack(
            [image[item, :, y : y + height, x : x + width] for item, (x, y) in zip(axes, corners, strict=True)]
        )
        kernels = [torch.from_numpy(stages.oriented_sobel(*axis.direction)) for axis, _ in axes.values()]
        change = filter2d(255 * crops, torch.stack(kernels).to(crops)).abs().amax(1, keepdim=True)
        return median_blur(change, stages.MEDIAN), corners

    def _inside(self, axes: dict[int, tuple[Axis, Box]], corners: list[tuple[int, int]], crops: Tensor) -> Tensor:
        """Mask of the pixels of each crop that lie in the box of its frame."""
        inside = torch.zeros_like(crops, dtype=torch.bool)
        for row, ((_, box), (x, y)) in enumerate(zip(axes.values(), corners, strict=True)):
            inside[row, :, box[1] - y : box[3] - y, box[0] - x : box[2] - x] = True
        return inside

    def _pose(self, found: Endpoints, device: torch.device) -> Pose:
        """Mean of the closed-form poses of each pair of neighbouring bands whose three endpoints were found."""
        edges = torch.from_numpy(stages.nudged(found))
        tips, directions = [], []
        for i in stages.triples(found):
            tip, direction = closed_form(edges[:, i : i + 3], self.catheter.positions[i : i + 3], self._pinhole)
            tips.append(tip)
            directions.append(direction)
        direction = torch.nn.functional.normalize(torch.stack(directions).mean(0), dim=-1)
        return stages.answer(found, torch.stack(tips).mean(0).numpy(), direction.numpy(), device)


def _line(points: Tensor) -> tuple[Tensor, Tensor]:
    """Point [2] and unit direction [2] of the line with the least squared distances."""
    line = fit_line(points[None])
    return line.origin[0], line.direction[0]


def _across(points: Tensor, origin: Tensor, direction: Tensor) -> Tensor:
    offset = points - origin
    return offset[:, 1] * direction[0] - offset[:, 0] * direction[1]


def _centroids(gradient: Tensor, labels: Tensor, corners: list[tuple[int, int]]) -> list[list[tuple[float, float]]]:
    """Weighted centroids (x, y), in pixels of the frame, of the components in each crop [n, 1, h, w]."""
    crop, _, rows, columns = torch.nonzero(labels, as_tuple=True)
    spots: list[list[tuple[float, float]]] = [[] for _ in corners]
    if not len(crop):
        return spots
    kinds, kind = torch.unique(labels[labels > 0], return_inverse=True)
    weights = gradient[labels > 0].to(torch.float64)
    sums = weights.new_zeros(4, len(kinds))
    for row, value in zip(sums, (weights, weights * columns, weights * rows), strict=False):
        row.index_add_(0, kind, value)
    sums[3].index_copy_(0, kind, crop.to(sums))  # every pixel of a component is in the same crop
    for weight, x, y, owner in sums.T.tolist():
        left, top = corners[int(owner)]
        spots[int(owner)].append((x / weight + left, y / weight + top))
    return spots
