"""Cramér-Rao bounds on the tip of a catheter in one frame, from all pixels of the bands and from their edges alone."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.simulation.render import render
from holotorch.tracking.simulation.world import World

_STEP = 0.15  # pixels: step of the central differences, which makes derivatives of a blurred edge 0.6 % too small
_MARGIN = 10.0  # pixels: distance from the bands up to which pixels count
_DITHER = 0.6  # levels: noise of rendered frames, which makes the mean of rounded frames unbiased


class Bounds(NamedTuple):
    """Smallest covariances [3, 3] in m^2 of an unbiased estimate of the tip from one synthetic frame."""

    # From all pixels, including the shading, which reveals the slant of the tube if the light is known.
    pixels: Tensor
    # From what trackers use: positions of the band edges along the tube, and of the tube across it. The levels on both
    # sides of an edge are taken as known; estimating them costs a few per cent.
    edges: Tensor


def tip_bounds(world: World, pose: tuple[Tensor, Tensor], frames: int = 2) -> Bounds:
    """Cramér-Rao bounds on the tip in one frame.

    Camera, colours, light and background are known. The five parameters of the pose, the radius and the blur are
    unknown. Only pixels within 10 px of the bands count, so that a visible end of the tube does not contribute. The
    noise is that of the world's look, plus rounding.

    Args:
        world: World with camera, catheter and look; the background is its desk.
        pose: Tip and direction, [3] each.
        frames: Number of renderings that are averaged for each side of a difference. Each derivative is computed twice
            with independent noise, so that their product is an unbiased estimate of the information.

    Source: Fisher information for white Gaussian noise, e.g. Kay (1993) Sec. 3.9, with derivatives of rendered frames.
    """
    catheter, corner, size = world.catheter, *_window(world, pose)
    shift = torch.zeros(3, 3, dtype=torch.float64)
    shift[:2, 2] = torch.tensor(corner, dtype=torch.float64)
    camera = Camera(world.camera.matrix - shift, world.camera.distortion, world.camera.tone)
    background = world.desk()[:, corner[1] : corner[1] + size[0], corner[0] : corner[0] + size[1]].contiguous()
    look = replace(world.look, background=background, noise_dn=_DITHER, jpeg_quality=None)
    near = _near(camera, catheter, pose, size)
    axes = _axes(*pose)
    to_marks, to_edges, per_metre = _slopes(camera, catheter, pose, axes)
    # Steps that move the ends and the middle of the bands by one pixel make the information matrix well conditioned.
    unit_steps = torch.linalg.inv(to_marks)
    generator = torch.Generator().manual_seed(world.seed)
    zero, count = torch.zeros(5, dtype=torch.float64), len(catheter.edges)
    still = torch.zeros(count, dtype=torch.float64)

    def mean(sign: int, moved: Tensor, painted: Tensor, radius: float, blur: float) -> Tensor:
        """Mean levels of the bands' pixels after a step of sign ``sign``; ``painted`` [N] moves edges, in metres."""
        tip, direction = pose[0] + sign * moved[:3], pose[1] + sign * axes @ moved[3:]
        edges = tuple((catheter.positions + sign * painted).tolist())
        tool = replace(catheter, edges=edges, radius=catheter.radius * (1 + sign * radius))
        blurred = replace(look, blur_px=look.blur_px + sign * blur)
        total = torch.zeros(int(near.sum()) * 3, dtype=torch.float64)
        for _ in range(frames):
            frame = render(tool, camera, tip, direction / direction.norm(), size, blurred, generator=generator)
            total += frame[:, near].reshape(-1).double()
        return total / frames

    steps = [(_STEP * unit_steps[:, i], still, 0.0, 0.0) for i in range(5)]
    steps += [(zero, still, _STEP / _half_width(camera, catheter, pose), 0.0), (zero, still, 0.0, 0.1)]
    steps += [(zero, _STEP * shifted, 0.0, 0.0) for shifted in torch.diag(1 / per_metre)]
    halves = []
    for _ in range(2):
        columns = [mean(1, *step) - mean(-1, *step) for step in steps]
        halves.append(torch.stack(columns, -1) / 2)
    product = halves[0].T @ halves[1] / (world.look.noise_dn**2 + 1 / 12)
    information = (product + product.T) / 2
    to_tip = _STEP * unit_steps[:3]
    pixels = torch.linalg.inv(information[:7, :7])[:5, :5]
    # Covariance, in units of these steps, of the two ends across the tube, radius, blur, and the edges along the tube.
    covariance = torch.linalg.inv(information[3:, 3:])
    measured = torch.cat([torch.arange(4, 4 + count), torch.arange(2)])
    lever = torch.zeros(count + 2, 5, dtype=torch.float64)
    lever[:count] = to_edges @ unit_steps
    lever[count:, 3:] = torch.eye(2)
    edges = torch.linalg.inv(lever.T @ torch.linalg.solve(covariance[measured][:, measured], lever))
    return Bounds(to_tip @ pixels @ to_tip.T, to_tip @ edges @ to_tip.T)


def _half_width(camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor]) -> float:
    """Half the width of the tube in the image, in pixels, at the middle of the bands."""
    middle = pose[0] + (catheter.edges[0] + catheter.edges[-1]) / 2 * pose[1]
    return catheter.radius * float(camera.matrix[0, 0]) / float(middle[2])


def _marks(camera: Camera, catheter: Catheter, tip: Tensor, direction: Tensor) -> Tensor:
    """Pixels [3, 2] of the first end, the middle and the last end of the bands."""
    first, last = catheter.edges[0], catheter.edges[-1]
    positions = torch.tensor([first, (first + last) / 2, last], dtype=torch.float64)
    return camera.project(tip + positions[:, None] * direction)


def _axes(tip: Tensor, direction: Tensor) -> Tensor:
    """Two directions [3, 2] perpendicular to the tool, the first also perpendicular to the ray to the tip."""
    across = torch.linalg.cross(tip, direction)
    across = across / across.norm()
    return torch.stack([across, torch.linalg.cross(direction, across)], -1)


def _slopes(
    camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor], axes: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of image positions in pixels with respect to the pose and to the edges' positions on the tube.

    Returns three tensors. The first two are derivatives by the tip (metres) and two rotations (radians): [5, 5] of the
    first end, middle and last end of the bands along the tube and of both ends across it, and [N, 5] of the band edges
    along the tube. The third, [N], is the derivative of each edge along the tube by its position on the tube (metres).
    """
    first, _, last = _marks(camera, catheter, *pose)
    along = (last - first) / (last - first).norm()
    across = torch.stack([-along[1], along[0]])

    def image(moved: Tensor, painted: Tensor) -> tuple[Tensor, Tensor]:
        direction = pose[1] + axes @ moved[3:]
        tip, direction = pose[0] + moved[:3], direction / direction.norm()
        first, middle, last = _marks(camera, catheter, tip, direction)
        edges = camera.project(tip + (catheter.positions + painted)[:, None] * direction)
        marks = torch.stack([first @ along, middle @ along, last @ along, first @ across, last @ across])
        return marks, edges @ along

    start = torch.zeros(5, dtype=torch.float64), torch.zeros(len(catheter.edges), dtype=torch.float64)
    (marks, _), (edges, painted) = torch.autograd.functional.jacobian(image, start)
    return marks, edges, painted.diagonal()


def _window(world: World, pose: tuple[Tensor, Tensor]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Corner (x, y) and size (h, w) in pixels of the part of the frame that contains the bands."""
    marks, sides = _marks(world.camera, world.catheter, *pose), world.size[::-1]
    if not bool(((marks >= 0) & (marks <= torch.tensor(sides, dtype=torch.float64) - 1)).all()):  # also false for NaN
        raise ValueError("the bands must lie within the frame")
    left, top = (max(math.floor(low) - 30, 0) for low in marks.amin(0).tolist())
    right, bottom = (min(math.ceil(high) + 30, side) for high, side in zip(marks.amax(0).tolist(), sides, strict=True))
    return (left, top), (bottom - top, right - left)


def _near(camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor], size: tuple[int, int]) -> Tensor:
    """Whether each pixel [H, W] lies on the bands or within ``_MARGIN`` of them."""
    first, _, last = _marks(camera, catheter, *pose)
    along = (last - first) / (last - first).norm()
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    offset = torch.stack([x, y], -1) - first
    t = offset @ along
    u = offset[..., 1] * along[0] - offset[..., 0] * along[1]
    half_width = 1.3 * _half_width(camera, catheter, pose)
    # The distortion of the lens bends the line by less than the margin.
    return (t > -_MARGIN) & (t < (last - first).norm() + _MARGIN) & (u.abs() < half_width + _MARGIN)
