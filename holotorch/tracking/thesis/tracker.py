"""ThesisTracker: the tracking pipeline of Sec. 3.4, stage by stage in kornia."""

from collections.abc import Sequence

import torch
from kornia.color import rgb_to_hsv
from kornia.contrib import connected_components_union_find
from kornia.filters import filter2d, median_blur
from kornia.geometry import fit_line, remap
from kornia.morphology import erosion
from torch import Tensor
from torch.nn.functional import normalize

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

    Known failures of the method: it gives a pose for narrow coloured papers in a row, and takes the border of an
    occluder for the end of a band. It refuses frames with clutter in the bands' colours, and distant catheters, whose
    bands the erosion removes. The status is OK if all edges were found and UNVERIFIED if some are missing; the pose is
    not checked in either case (``freedom`` is 0). The covariance is propagated from errors of the endpoints of 0.3 px
    in x and y.

    On a CPU this tracker takes about eight times as long as the same stages in OpenCV, which are the reference for
    times (holotorch.experiments.tracking_benchmark.thesis_opencv). It needs about 0.2 GB per 1080p frame of the batch.

    Args:
        camera: Intrinsics.
        catheter: Catheter to track.
        channels: Order of the frames' channels.

    Attributes:
        times: Seconds of each stage of the last call, by the names of Table 3.1; all frames of the batch together.
        endpoints: For each frame of the last call, the edges of the bands (x, y) in pixels of the undistorted frame, in
            the catheter's order. An edge that was not found is None; an earlier refusal leaves an empty list.

    Raises:
        ValueError: Thresholds in hue cannot distinguish the colours of the catheter.

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
    def __call__(self, frames: Tensor, previous: Sequence[Pose] | None = None) -> list[Pose]:
        """Pose in metres, or refusal, of each frame of uint8 [B, 3, H, W]; ``previous`` poses are not used.

        Raises:
            TypeError, ValueError: ``frames`` is not such a tensor.
        """
        stages.need_frames(frames)
        self.camera.need_size(frames)
        frames = self.channels.to_rgb(frames)
        watch = Stopwatch(torch.cuda.synchronize) if frames.is_cuda else Stopwatch()
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
            labels = connected_components_union_find(gradient >= stages.LEAST_GRADIENT - 0.5)
            watch.lap("Connected components")
            centroids = _centroids(gradient, labels, corners)
            watch.lap("Weighted centroids")
            for (item, (axis, _)), spots in zip(axes.items(), centroids, strict=True):
                try:
                    self.endpoints[item] = stages.endpoints(axis, spots)
                    poses[item] = self._pose(self.endpoints[item], frames.device)
                except Refusal as refused:
                    poses[item] = Pose.refused(refused.status, refused.reason)
            watch.lap("Calculate catheter position")
        watch.lap("Other")
        self.times = watch.times
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
        """Number (from 1) of the band whose colour a pixel has, or 0: uint8 [B, 1, H, W]."""
        hue, saturation, value = rgb_to_hsv(image).split(1, 1)
        hue = torch.rad2deg(hue)
        coloured = (saturation >= self._windows.saturation) & (value >= self._windows.value)
        bands = torch.zeros_like(hue, dtype=torch.uint8)
        for number, middle in enumerate(self._windows.hues, 1):
            similar = ((hue - middle + 180).remainder(360) - 180).abs() <= self._windows.tolerance
            bands[similar & coloured] = number
        return bands

    def _axis(self, solid: Tensor, bands: Tensor) -> tuple[Axis, Box]:
        """Line through the pixels [H, W] left by the erosion, except those far from the line, and their box."""
        rows, columns = torch.nonzero(solid, as_tuple=True)
        points, size = torch.stack([columns, rows], -1).to(torch.float64), (solid.shape[1], solid.shape[0])

        def number(own: Tensor) -> Tensor:
            columns, rows = own.long().unbind(-1)
            return bands[rows, columns]

        return stages.fit_axis(points, number, len(self._windows.hues), size, _line)

    def _gradient(self, image: Tensor, axes: dict[int, tuple[Axis, Box]]) -> tuple[Tensor, list[tuple[int, int]]]:
        """Largest gradient of the three colours along each axis within its box, and the corners of the crops.

        All crops have the size of the largest box, so that one call filters all of them. Returns the gradient in levels
        [n, 1, h, w], 0 outside the boxes, and left and top of each crop in pixels.
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
        smooth = median_blur(change, stages.MEDIAN)
        gradient = torch.zeros_like(smooth)
        for row, (box, (x, y)) in enumerate(zip(boxes, corners, strict=True)):
            inside = row, 0, slice(box[1] - y, box[3] - y), slice(box[0] - x, box[2] - x)
            gradient[inside] = smooth[inside]
        return gradient, corners

    def _pose(self, edges: Endpoints, device: torch.device) -> Pose:
        """Mean of the closed-form poses of each pair of neighbouring bands whose three endpoints were found."""
        nudged = torch.from_numpy(stages.nudged(edges))
        triples = [slice(i, i + 3) for i in stages.triples(edges)]
        poses = [closed_form(nudged[:, triple], self.catheter.positions[triple], self._pinhole) for triple in triples]
        tip, direction = (torch.stack(parts).mean(0) for parts in zip(*poses, strict=True))
        return stages.answer(edges, tip.numpy(), normalize(direction, dim=-1).numpy(), device)


def _line(points: Tensor) -> Axis:
    """Line with the least sum of squared distances from points [n, 2]."""
    line = fit_line(points[None])
    (x, y), (dx, dy) = line.origin[0].tolist(), line.direction[0].tolist()
    return Axis((x, y), (dx, dy))


def _centroids(gradient: Tensor, labels: Tensor, corners: list[tuple[int, int]]) -> list[list[tuple[float, float]]]:
    """Centroids (x, y) in pixels of the frame of the components in each crop [n, 1, h, w], weighted by the gradient."""
    crop, _, rows, columns = torch.nonzero(labels, as_tuple=True)
    component = torch.unique(labels[labels > 0], return_inverse=True)[1]
    weights = gradient[labels > 0].to(torch.float64)
    sums, x, y = (torch.bincount(component, values) for values in (weights, weights * columns, weights * rows))
    crops = torch.zeros(len(sums), dtype=torch.int64, device=crop.device).scatter_(0, component, crop)
    centroids: list[list[tuple[float, float]]] = [[] for _ in corners]
    for i, *centroid in zip(crops.tolist(), (x / sums).tolist(), (y / sums).tolist(), strict=True):
        centroids[i].append((centroid[0] + corners[i][0], centroid[1] + corners[i][1]))
    return centroids
