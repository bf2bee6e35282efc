"""Light of a blurred tube in windows of pixels around its band edges, and its derivatives, for the photometric fit."""

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Self

import numpy as np
import torch
from torch import Tensor

GRADIENT = 0.01  # metres along the tube over which a background changes by its coefficient
SHARED = 7  # unknowns that all windows of a still frame share: 3 shifts, 2 turns, logarithms of blur and radius


@dataclass(frozen=True, eq=False)
class Items:
    """Tensors of which the first axis counts the items of a batch."""

    def take(self, index: Tensor) -> Self:
        """The items at ``index``."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))

    def put(self, index: Tensor, items: Self) -> Self:
        """These items with others at ``index``."""
        names = [field.name for field in fields(self)]
        return type(self)(*(getattr(self, name).index_put((index,), getattr(items, name)) for name in names))


@dataclass(frozen=True, eq=False)
class Windows(Items):
    """Pixels of B x N windows of P = I x J pixels, I along the tube.

    Attributes:
        rays: [B, N, 3, P] unit vectors.
        angle: [B, N, P] radians per pixel.
        light: [B, N, 3, P].
        mask: [B, N, P] 1 for pixels that count, else 0.
    """

    rays: Tensor
    angle: Tensor
    light: Tensor
    mask: Tensor


@dataclass(frozen=True, eq=False)
class Frame(Items):
    """Coordinates in which a pose is corrected: middle of the bands, axis, and unit vectors [B, 3].

    ``side`` is perpendicular to axis and line of sight, ``front`` to axis and side, and ``sight`` points at the middle.
    """

    middle: Tensor
    axis: Tensor
    side: Tensor
    front: Tensor
    sight: Tensor

    @staticmethod
    def of(middle: Tensor, axis: Tensor) -> "Frame":
        """Frame of the middle of the bands [B, 3] and the direction [B, 3] of the axis."""
        axis = axis / axis.norm(dim=-1, keepdim=True)
        sight = middle / middle.norm(dim=-1, keepdim=True)
        side = torch.linalg.cross(axis, sight)
        side = side / side.norm(dim=-1, keepdim=True)
        return Frame(middle, axis, side, torch.linalg.cross(side, axis), sight)

    def moved(self, unknown: Tensor) -> tuple["Frame", Tensor]:
        """Frame after the shifts and turns of ``unknown`` [B, D], and the new ``unknown``, with 0 for these five."""
        shift = unknown[:, 0:1] * self.side + unknown[:, 1:2] * self.axis + unknown[:, 2:3] * self.sight
        turn = unknown[:, 3:4] * self.side + unknown[:, 4:5] * self.front
        blur = unknown[:, 5:6].clamp(math.log(0.25), math.log(8.0))
        rest = torch.cat([torch.zeros_like(unknown[:, :5]), blur, unknown[:, 6:]], -1)
        return Frame.of(self.middle + shift, self.axis + turn), rest


@dataclass(frozen=True, eq=False)
class TubeGeometry:
    """Where each ray passes the tube: [B, N, P] each.

    Attributes:
        miss: Signed distance between ray and axis.
        along: Position along the axis, from the bands' middle, where the ray is nearest to the axis.
        slant: Change of the visible surface's position along the axis per metre of depth below the axis.
        pixels: Metres across the axis per pixel.
        sine: Sine of the angle between ray and axis.
        blur: Standard deviation of the blur across the axis, in metres; along the axis it is this over ``sine``.
        scale: [B, N, 2] metres per pixel along and across the axis, means over a window.
        derivatives: [B, N, 4, 6, P] of miss, along, slant and log blur by the first six unknowns.
    """

    miss: Tensor
    along: Tensor
    slant: Tensor
    pixels: Tensor
    sine: Tensor
    blur: Tensor
    scale: Tensor
    derivatives: Tensor

    @staticmethod
    def of(frame: Frame, unknown: Tensor, windows: Windows) -> "TubeGeometry":
        """Geometry at ``unknown`` [B, D]: shifts along side, axis and sight, turns to side and front, log blur."""
        moved, rest = frame.moved(unknown)
        middle, axis, side, front, sight = moved.middle, moved.axis, moved.side, moved.front, moved.sight
        cross = torch.linalg.cross
        vectors = (axis, middle, side, front, sight, cross(axis, middle), cross(axis, side), cross(axis, sight))
        vectors = torch.stack([*vectors, cross(side, middle), cross(front, middle)], 1)
        parts = (vectors[:, None] @ windows.rays).unbind(2)
        cosine, ahead, by_side, by_front, by_sight, missed, miss_side, miss_sight, turn_side, turn_front = parts
        beside, slope, own = (
            (one * other).sum(-1)[:, None, None] for one, other in ((axis, middle), (axis, sight), (front, middle))
        )
        square = 1 - cosine * cosine
        sine = square.sqrt()
        per_sine, per_square = 1 / sine, 1 / square
        miss = missed * per_sine
        depth = (ahead - cosine * beside) * per_square
        along = depth * cosine - beside
        pixels = depth * windows.angle
        width = rest[:, 5].exp()[:, None, None]
        point = (width**2 + 1 / 12).sqrt()  # includes the square of a pixel, to second order
        zero = torch.zeros_like(cosine)
        depth_side, depth_sight = by_side * per_square, (by_sight - cosine * slope) * per_square
        common = (2 * cosine * depth - beside) * per_square
        turned_side, turned_front = common * by_side, common * by_front - cosine * own * per_square
        bend, cubed, per_depth = miss * cosine * per_square, per_square * per_sine, 1 / depth
        rows = [miss_side * per_sine, zero, miss_sight * per_sine]
        rows += [turn_side * per_sine + bend * by_side, turn_front * per_sine + bend * by_front, zero]
        rows += [cosine * depth_side, zero - 1, cosine * depth_sight - slope]
        rows += [turned_side * cosine + depth * by_side, turned_front * cosine + depth * by_front - own, zero]
        rows += [zero, zero, zero, by_side * cubed, by_front * cubed, zero]
        rows += [depth_side * per_depth, zero, depth_sight * per_depth, turned_side * per_depth]
        rows += [turned_front * per_depth, zero + (width / point) ** 2]
        weight = windows.mask + 1e-9
        total = weight.sum(-1)
        across, steep = ((value * weight).sum(-1) / total for value in (pixels, sine))
        scale = torch.stack([across / steep, across], -1)
        derivatives = torch.stack(rows, 2).unflatten(2, (4, 6))
        return TubeGeometry(miss, along, cosine * per_sine, pixels, sine, point * pixels, scale, derivatives)


@dataclass(frozen=True, eq=False)
class TubeLight:
    """Light of a blurred tube with two bands in front of two backgrounds, per unit of its K linear coefficients.

    The blur is a Gaussian, and with a motion during the exposure its mean over a line. The quadrature over the tube's
    width has M nodes; with a motion there are T nodes over the time of exposure, and the axis M counts M T nodes.

    Attributes:
        basis: [B, N, K, P] shading of the first and of the second band by Legendre polynomials across the tube, left
            and right background, and the gradients along the tube of both.
        texture: [B, N, P] share of the light that comes from what is behind the tube, 0 to 1.
        beyond: [B, N, P] metres along the tube from the edge.
    """

    basis: Tensor
    texture: Tensor
    beyond: Tensor
    aside: Tensor  # [B, N, 1] shift of each window's axis across
    motion: Tensor  # [B, 1, 1, 1] motion across the tube in pixels, 0 without one
    bright: Tensor  # [B, N, M, P] weight of each node
    second: Tensor  # [B, N, M, P] its part on the second band
    rise: Tensor  # [B, N, M, P] derivative of ``second`` by the position along, times ``blur`` / ``sine``
    across: Tensor  # [B, N, M, P] distances of ray and node across the tube, in units of the blur
    ahead: Tensor  # [B, N, M, P] distances of ray and edge along the tube, in units of the blur
    depth: Tensor  # [B, 1, M, 1] heights of the nodes above the axis in metres
    time: Tensor  # [M] times of the nodes, -0.5 to 0.5
    shade: Tensor  # [M, degrees] polynomials at the nodes
    sides: tuple[tuple[Tensor, Tensor, Tensor], ...]  # of each background: density, its moments by time and distance

    @staticmethod
    def of(
        place: TubeGeometry,
        unknown: Tensor,
        radius: Tensor,
        edge: Tensor,
        *,
        nodes: int,
        times: int,
        degree: int,
        clear: float,
    ) -> "TubeLight":
        """Light at ``unknown`` [B, D + 2 N]: see :meth:`PhotometricFit._equations`; ``edge`` [N] from the middle."""
        x, weight, t, weight_t, shade = (value.to(unknown) for value in _rule(nodes, times, degree))
        still = unknown.shape[1] == SHARED + 2 * len(edge)
        if still:
            t, weight_t = torch.zeros_like(t[:1]), torch.ones_like(t[:1])
        shift = unknown[:, -2 * len(edge) :].unflatten(1, (-1, 2))
        beyond = place.along - edge[:, None] - shift[..., :1]
        miss = place.miss + shift[..., 1:]
        per_blur = 1 / place.blur
        per_soft = per_blur * place.sine
        x, time, weight = (
            value.flatten()[:, None] for value in torch.broadcast_tensors(x[:, None], t, weight[:, None] * weight_t)
        )
        radius = radius * unknown[:, 6, None, None, None].exp()
        depth = radius * (1 - x * x).sqrt()
        path, late, paths = miss[:, :, None], beyond[:, :, None], miss[:, :, None]
        if not still:
            across = unknown[:, 8, None, None] * place.pixels
            along = unknown[:, 7, None, None] * place.pixels / place.sine
            paths = path - across[:, :, None] * t[:, None]
            path, late = path - across[:, :, None] * time, late - along[:, :, None] * time
        far = (path - radius * x) * per_blur[:, :, None]
        bright = torch.exp(-0.5 * far * far) * (radius * weight / math.sqrt(2 * math.pi)) * per_blur[:, :, None]
        ahead = (late - place.slant[:, :, None] * depth) * per_soft[:, :, None]
        second = bright * torch.special.ndtr(ahead)
        rise = bright * torch.exp(-0.5 * ahead * ahead) * (1 / math.sqrt(2 * math.pi))
        shares, sides = [], []
        for distance in ((-radius - paths) * per_blur[:, :, None], (paths - radius) * per_blur[:, :, None]):
            density = torch.exp(-0.5 * distance * distance) * (weight_t[:, None] / math.sqrt(2 * math.pi))
            shares.append((torch.special.ndtr(distance) * weight_t[:, None]).sum(2))
            sides.append((density.sum(2), (density * t[:, None]).sum(2), (density * distance).sum(2)))
        gradient = beyond / GRADIENT
        repeated = shade.repeat_interleave(len(t), 0)
        left, right = shares
        backgrounds = torch.stack([left, right, left * gradient, right * gradient], 2)
        first = bright - second
        basis = torch.cat([repeated.mT @ first, repeated.mT @ second, backgrounds], 2)
        behind = torch.stack([left, right], 0).sum(0)
        seen = torch.zeros_like(behind[:, 1:-1])
        through = torch.cat([first[:, :1].sum(2), seen, second[:, -1:].sum(2)], 1)  # the clear tube beyond the bands
        texture = (behind + clear * through).clamp(0, 1)
        values = (bright, second, rise, far, ahead, depth, time[:, 0], repeated)
        motion = unknown[:, 6 if still else 8, None, None, None] * (not still)
        return TubeLight(basis, texture, beyond, shift[..., 1:], motion, *values, tuple(sides))

    def changes(self, place: TubeGeometry, colours: Tensor, *, still: bool) -> Tensor:
        """Derivatives [B, N, 3, D + 2, P] of the light of ``colours`` [B, N, 3, K].

        They are by the unknowns that all windows share, and by the shifts of the edge along and of the axis across.
        """
        degrees = self.shade.shape[1]
        first = colours[..., :degrees] @ self.shade.mT  # [B, N, 3, M]
        second = colours[..., degrees : 2 * degrees] @ self.shade.mT
        left, right, left_slope, right_slope = colours[..., 2 * degrees :, None].unbind(-2)
        step = second - first
        blur, sine = place.blur[:, :, None], place.sine[:, :, None]
        soft = blur / sine
        gradient = (self.beyond / GRADIENT)[:, :, None]
        left, right = left + left_slope * gradient, right + right_slope * gradient
        far, far_second = self.across * self.bright, self.across * self.second
        (low, low_time, low_far), (high, high_time, high_far) = ((v[:, :, None] for v in side) for side in self.sides)
        by_miss = (high * right - low * left - first @ far - step @ far_second) / blur
        covers = self.basis[:, :, -4:-2]
        slope = (left_slope * covers[:, :, :1] + right_slope * covers[:, :, 1:]) / GRADIENT
        by_along = step @ self.rise / soft + slope
        by_slant = (step * -self.depth.mT) @ self.rise / soft
        by_blur = first @ (self.across * far - self.bright) + step @ (self.across * far_second - self.second)
        by_blur = by_blur - low_far * left - high_far * right
        # Light does not change if radius, miss and blur across change by the same factor.
        by_radius = place.slant[:, :, None] * by_slant - (place.miss + self.aside)[:, :, None] * by_miss - by_blur
        by_blur = by_blur - step @ (self.rise * self.ahead)
        parts = [
            slopes[:, :, :, None] * place.derivatives[:, :, index, None]
            for index, slopes in enumerate((by_miss, by_along))
        ]
        turn = parts[0] + parts[1]
        turn[..., 3:5, :] = turn[..., 3:5, :] + by_slant[:, :, :, None] * place.derivatives[:, :, 2, None, 3:5]
        turn = turn + by_blur[:, :, :, None] * place.derivatives[:, :, 3, None]
        own = [-by_along[:, :, :, None], by_miss[:, :, :, None]]
        if still:
            return torch.cat([turn, by_radius[:, :, :, None], *own], 3)
        first, step = first * self.time, step * self.time
        pixels = place.pixels[:, :, None]
        along = -pixels / sine * (step @ self.rise) / soft
        across = -pixels * (high_time * right - low_time * left - first @ far - step @ far_second) / blur
        by_radius = by_radius - self.motion * across
        rest = [one[:, :, :, None] for one in (by_radius, along, across)]
        return torch.cat([turn, *rest, *own], 3)


@lru_cache(maxsize=8)
def _rule(nodes: int, times: int, degree: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gauss-Legendre nodes and weights on -1 to 1, times and weights on -0.5 to 0.5, and polynomials at the nodes."""
    (x, weight), (t, weight_t) = np.polynomial.legendre.leggauss(nodes), np.polynomial.legendre.leggauss(times)
    shade = np.polynomial.legendre.legvander(x, degree)
    x, weight, t, weight_t, shade = (torch.from_numpy(value) for value in (x, weight, t, weight_t, shade))
    return x, weight, t / 2, weight_t / 2, shade
