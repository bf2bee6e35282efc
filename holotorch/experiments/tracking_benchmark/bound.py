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

_STEP = 0.15  # pixels: step of the central differences; derivatives of a blurred edge are 0.6 % too small
_MARGIN = 10.0  # pixels: distance from the bands up to which pixels count
_DITHER = 0.6  # levels: noise of rendered frames, which makes the mean of rounded frames unbiased


class Bounds(NamedTuple):
    """Smallest covariances [3, 3] in m^2 of an unbiased estimate of the tip from one synthetic frame.

    Attributes:
        pixels: Bound from all pixels. It includes the shading, from which the slant follows if the light is known.
        edges: Bound from the positions of the band edges along the tube and of the tube across it, which trackers use.
            The light on both sides of an edge is taken as known; estimating it costs a few per cent.
    """

    pixels: Tensor
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
    # Steps that move the ends and the middle of the bands by one pixel make the information well conditioned.
    slopes = torch.linalg.inv(_image_slopes(camera, catheter, pose, axes))
    generator = torch.Generator().manual_seed(world.seed)
    zero, count = torch.zeros(5, dtype=torch.float64), len(catheter.edges)
    still = torch.zeros(count, dtype=torch.float64)

    def mean(sign: int, moved: Tensor, painted: Tensor, radius: float, blur: float) -> Tensor:
        """Mean levels of the bands' pixels after a step of sign ``sign``; ``painted`` [N] moves edges, in metres."""
        tip, direction = pose[0] + sign * moved[:3], pose[1] + sign * axes @ moved[3:]
        edges = tuple((catheter.positions + sign * painted).tolist())
        tool = replace(catheter, edges=edges, radius=catheter.radius * (1 + sign * radius))
        seen = replace(look, blur_px=look.blur_px + sign * blur)
        total = torch.zeros(int(near.sum()) * 3, dtype=torch.float64)
        for _ in range(frames):
            frame = render(tool, camera, tip, direction / direction.norm(), size, seen, generator=generator)
            total += frame[:, near].reshape(-1).double()
        return total / frames

    wide = catheter.radius * float(camera.matrix[0, 0]) / float(_middle(catheter, pose)[2])
    to_edges, per_metre = _edge_slopes(camera, catheter, pose, axes)
    steps = [(_STEP * slopes[:, i], still, 0.0, 0.0) for i in range(5)]
    steps += [(zero, still, _STEP / wide, 0.0), (zero, still, 0.0, 0.1)]
    steps += [(zero, _STEP * shifted, 0.0, 0.0) for shifted in torch.diag(1 / per_metre)]
    halves = []
    for _ in range(2):
        columns = [mean(1, *step) - mean(-1, *step) for step in steps]
        halves.append(torch.stack(columns, -1) / 2)
    product = halves[0].T @ halves[1] / (world.look.noise_dn**2 + 1 / 12)
    information = (product + product.T) / 2
    moves = _STEP * slopes[:3]
    whole = torch.linalg.inv(information[:7, :7])[:5, :5]
    # Covariance, in units of these steps, of the edges along the tube and of its two ends across it; then of the pose.
    some = torch.linalg.inv(information[3:, 3:])
    seen = torch.cat([torch.arange(4, 4 + count), torch.arange(2)])
    lever = torch.zeros(count + 2, 5, dtype=torch.float64)
    lever[:count] = to_edges @ slopes
    lever[count:, 3:] = torch.eye(2)
    edges = torch.linalg.inv(lever.T @ torch.linalg.solve(some[seen][:, seen], lever))
    return Bounds(moves @ whole @ moves.T, moves @ edges @ moves.T)


def _middle(catheter: Catheter, pose: tuple[Tensor, Tensor]) -> Tensor:
    return pose[0] + (catheter.edges[0] + catheter.edges[-1]) / 2 * pose[1]


def _marks(camera: Camera, catheter: Catheter, tip: Tensor, direction: Tensor) -> Tensor:
    """Pixels [3, 2] of the bands' two ends and their middle."""
    first, last = catheter.edges[0], catheter.edges[-1]
    places = torch.tensor([first, (first + last) / 2, last], dtype=torch.float64)
    return camera.project(tip + places[:, None] * direction)


def _axes(tip: Tensor, direction: Tensor) -> Tensor:
    """[3, 2] two directions perpendicular to the tool, the first also perpendicular to the ray to the tip."""
    across = torch.linalg.cross(tip, direction)
    across = across / across.norm()
    return torch.stack([across, torch.linalg.cross(direction, across)], -1)


def _image_slopes(camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor], axes: Tensor) -> Tensor:
    """[5, 5] derivatives of the image of both ends (along, across) and the middle (along), by tip and two rotations."""
    marks = _marks(camera, catheter, *pose)
    along = (marks[2] - marks[0]) / (marks[2] - marks[0]).norm()
    across = torch.stack([-along[1], along[0]])

    def places(moved: Tensor) -> Tensor:
        direction = pose[1] + axes @ moved[3:]
        first, middle, last = _marks(camera, catheter, pose[0] + moved[:3], direction / direction.norm())
        return torch.stack([first @ along, middle @ along, last @ along, first @ across, last @ across])

    slopes = torch.autograd.functional.jacobian(places, torch.zeros(5, dtype=torch.float64))
    assert isinstance(slopes, Tensor)
    return slopes


def _edge_slopes(
    camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor], axes: Tensor
) -> tuple[Tensor, Tensor]:
    """Derivatives of the edges' positions along the tube in the image, in pixels.

    They are [N, 5] with respect to the tip and two rotations, as in :func:`_image_slopes`, and [N] with respect to the
    edges' positions on the tube in metres.
    """
    first, _, last = _marks(camera, catheter, *pose)
    along = (last - first) / (last - first).norm()

    def places(moved: Tensor, painted: Tensor) -> Tensor:
        direction = pose[1] + axes @ moved[3:]
        at = (catheter.positions + painted)[:, None] * (direction / direction.norm())
        return camera.project(pose[0] + moved[:3] + at) @ along

    start = torch.zeros(5, dtype=torch.float64), torch.zeros(len(catheter.edges), dtype=torch.float64)
    moved, painted = torch.autograd.functional.jacobian(places, start)
    return moved, painted.diagonal()


def _window(world: World, pose: tuple[Tensor, Tensor]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Corner (x, y) and size (h, w) of the part of the frame that contains the bands."""
    marks = _marks(world.camera, world.catheter, *pose)
    limits = torch.tensor(world.size[::-1], dtype=torch.float64) - 1
    if not bool(((marks >= 0) & (marks <= limits)).all()):  # also false for NaN
        raise ValueError("the bands must lie within the frame")
    low = [max(math.floor(float(value)) - 30, 0) for value in marks.amin(0)]
    high = [
        min(math.ceil(float(value)) + 30, side) for value, side in zip(marks.amax(0), world.size[::-1], strict=True)
    ]
    return (low[0], low[1]), (high[1] - low[1], high[0] - low[0])


def _near(camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor], size: tuple[int, int]) -> Tensor:
    """Whether pixels [H, W] lie on the bands or within ``_MARGIN`` of them."""
    first, _, last = _marks(camera, catheter, *pose)
    along = (last - first) / (last - first).norm()
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    offset = torch.stack([x, y], -1) - first
    t = offset @ along
    u = offset[..., 1] * along[0] - offset[..., 0] * along[1]
    half = catheter.radius * float(camera.matrix[0, 0]) / float(_middle(catheter, pose)[2])
    # The distortion of the lens bends the line by less than the margin.
    return (t > -_MARGIN) & (t < (last - first).norm() + _MARGIN) & (u.abs() < 1.3 * half + _MARGIN)
