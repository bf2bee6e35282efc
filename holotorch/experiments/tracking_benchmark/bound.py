"""How well a tip can be told from a frame at all: Cramér-Rao bounds of the bands' pixels, and of their edges alone."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.simulation.render import render
from holotorch.tracking.simulation.world import World

_STEP = 0.15  # pixels, to either side: the slope of a blurred edge then comes out 0.6 % low
_MARGIN = 10.0  # pixels around the bands; the rest of the tube is not asked
_DITHER = 0.6  # levels of noise, so that rounded frames have the mean of frames that are not


class Bounds(NamedTuple):
    """Least covariances [3, 3] in m^2 that an unbiased estimate of the tip from one synthetic frame can have.

    Attributes:
        pixels: Of all that the pixels tell; who knows the light can tell a slant from how the tube shines.
        edges: Of where the bands' edges lie along the tube, and the tube across it: what trackers look at. The light
            to both sides is known; who must find it, too, stays some per cent above.
    """

    pixels: Tensor
    edges: Tensor


def tip_bounds(world: World, pose: tuple[Tensor, Tensor], frames: int = 2) -> Bounds:
    """How well one frame can tell a tip: by all its pixels, and by the edges of the bands alone.

    Known are camera, colours, light and background; unknown the pose's five numbers, the radius and the blur. What
    counts are the pixels within 10 px of the bands: an end of the tube that happens to be in view does not. Noise is
    that of the world's look, and rounding.

    Args:
        world: Camera, catheter and look; on its desk.
        pose: Tip and direction, [3] each.
        frames: Renderings that are averaged for each side of each slope, twice: the information is made of products
            of two slopes with independent noise, which have no bias.

    Source: information matrix of white Gaussian noise, with slopes from rendered frames, e.g. Kay (1993) Sec. 3.9.
    """
    catheter, corner, size = world.catheter, *_window(world, pose)
    shift = torch.zeros(3, 3, dtype=torch.float64)
    shift[:2, 2] = torch.tensor(corner, dtype=torch.float64)
    camera = Camera(world.camera.matrix - shift, world.camera.distortion, world.camera.tone)
    background = world.desk()[:, corner[1] : corner[1] + size[0], corner[0] : corner[0] + size[1]].contiguous()
    look = replace(world.look, background=background, noise_dn=_DITHER, jpeg_quality=None)
    near = _near(camera, catheter, pose, size)
    axes = _axes(*pose)
    # Steps that move the bands' ends and middle by a pixel each: in them the information is far from singular.
    slopes = torch.linalg.inv(_image_slopes(camera, catheter, pose, axes))
    generator = torch.Generator().manual_seed(world.seed)
    zero, count = torch.zeros(5, dtype=torch.float64), len(catheter.edges)
    still = torch.zeros(count, dtype=torch.float64)

    def mean(way: int, moved: Tensor, painted: Tensor, radius: float, blur: float) -> Tensor:
        """Levels of the bands' pixels, averaged over noise; ``way`` is 1 or -1, edges are ``painted`` metres aside."""
        tip, direction = pose[0] + way * moved[:3], pose[1] + way * axes @ moved[3:]
        edges = tuple((catheter.positions + way * painted).tolist())
        tool = replace(catheter, edges=edges, radius=catheter.radius * (1 + way * radius))
        seen = replace(look, blur_px=look.blur_px + way * blur)
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
    # Of edges along and ends across, in steps; then of the pose that moves them so.
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
    """[3, 2]: two directions at right angles to the tool, the first across the view."""
    across = torch.linalg.cross(tip, direction)
    across = across / across.norm()
    return torch.stack([across, torch.linalg.cross(direction, across)], -1)


def _image_slopes(camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor], axes: Tensor) -> Tensor:
    """[5, 5]: places of both ends (along, across) and the middle (along) in pixels, by tip in metres and two turns."""
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
    """[N, 5] how the edges move along the image in pixels, as :func:`_image_slopes`, and [N] per metre on the tube."""
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
    """Corner (x, y) and size (h, w) of the part of the frame that holds the bands."""
    marks = _marks(world.camera, world.catheter, *pose)
    limits = torch.tensor(world.size[::-1], dtype=torch.float64) - 1
    if not bool(((marks >= 0) & (marks <= limits)).all()):  # NaN is not
        raise ValueError("the bands must lie within the frame")
    low = [max(math.floor(float(value)) - 30, 0) for value in marks.amin(0)]
    high = [
        min(math.ceil(float(value)) + 30, side) for value, side in zip(marks.amax(0), world.size[::-1], strict=True)
    ]
    return (low[0], low[1]), (high[1] - low[1], high[0] - low[0])


def _near(camera: Camera, catheter: Catheter, pose: tuple[Tensor, Tensor], size: tuple[int, int]) -> Tensor:
    """Which pixels [H, W] lie within the margin of the bands."""
    first, _, last = _marks(camera, catheter, *pose)
    along = (last - first) / (last - first).norm()
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    offset = torch.stack([x, y], -1) - first
    t = offset @ along
    u = offset[..., 1] * along[0] - offset[..., 0] * along[1]
    half = catheter.radius * float(camera.matrix[0, 0]) / float(_middle(catheter, pose)[2])
    # The lens bends the line by less than the margin.
    return (t > -_MARGIN) & (t < (last - first).norm() + _MARGIN) & (u.abs() < 1.3 * half + _MARGIN)
