"""Pose of a catheter from the pixels around its band edges: a differentiable fit of a rendered cylinder to a frame."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter


@dataclass(frozen=True)
class FitPlan:
    """Size of the windows, and the model of their light. Lengths in pixels unless said otherwise."""

    along: int = 12  # pixels to each side of an edge, along the image axis nearer to the tube's direction
    across: int = 9  # pixels to each side of the tube's axis, along the other image axis
    beside: float = 2.5  # background beside the tube that counts: more of it helps no more and is less uniform
    degree: int = 6  # degree of the shading across the tube: the blur hides higher ones up to a width of ten pixels
    nodes: int = 12  # nodes of the quadrature over the tube's width
    blur: float = 0.75  # blur to begin with, standard deviation: that of a focused camera
    blur_spread: float = 0.5  # standard deviation of the logarithm of a blur before it is measured
    edge_floor: float = 0.03  # error of an edge that does not shrink with the noise: texture, shading, sampling
    iterations: int = 12  # most Gauss-Newton steps
    settled: float = 3e-3  # steps below this share of a parameter's scale end the fit


@dataclass(frozen=True, eq=False)
class PhotometricPose:
    """Fitted poses of B frames, with what each of the N edges says about them.

    Attributes:
        tip, direction: [B, 3], in metres; unit vectors from the tip to the rear.
        covariance: [B, 6, 6] of tip and direction.
        blur: [B] standard deviation of the point spread, in pixels.
        misfit: [B, N] mean squared residual of each edge's window relative to noise of one level.
        shift: [B, N] of each edge along the tube relative to the fitted pose, in metres, if it alone were free.
        shift_sd: [B, N] its standard deviation.
        used: [B, N] whether the edge's window is on the frame.
    """

    tip: Tensor
    direction: Tensor
    covariance: Tensor
    blur: Tensor
    misfit: Tensor
    shift: Tensor
    shift_sd: Tensor
    used: Tensor

    def scattered(self, where: Tensor) -> "PhotometricPose":
        """These poses at the items of a batch at which ``where`` [B] is true; NaN, or False, at the others."""

        def spread(value: Tensor) -> Tensor:
            empty = torch.nan if value.is_floating_point() else False
            return value.new_full((len(where), *value.shape[1:]), empty).index_put((where,), value)

        return PhotometricPose(*(spread(getattr(self, field.name)) for field in fields(self)))


@dataclass(frozen=True, eq=False)
class _Windows:
    """Pixels of B x N windows of P pixels: unit rays [B, N, P, 3], radians per pixel, light [B, N, 3, P], mask."""

    rays: Tensor
    angle: Tensor
    light: Tensor
    mask: Tensor


@dataclass(frozen=True, eq=False)
class _Frame:
    """Coordinates in which a pose is corrected: middle of the bands, axis, and unit vectors [B, 3].

    ``side`` is perpendicular to axis and line of sight, ``front`` to axis and side, and ``sight`` points at the middle.
    """

    middle: Tensor
    axis: Tensor
    side: Tensor
    front: Tensor
    sight: Tensor


class PhotometricFit(nn.Module):
    """Refines poses by fitting the light of the pixels around each band edge.

    Each pixel near an edge is modelled as the light of a cylinder with two bands, blurred by a Gaussian, before two
    backgrounds. Position, direction and blur are found by Gauss-Newton steps with an analytic Jacobian; all colours and
    the shading across the tube are linear and are eliminated in each step (variable projection). The cylinder is exact
    in the space of rays, so that the rings' curvature and the lens's distortion need no correction, and pixels are used
    as they are, without interpolation.

    The result is differentiable with respect to the frames, the camera and the catheter, by the implicit function
    theorem at the optimum.

    The model has one blur in all directions and full resolution of the colours: motion of more than about a pixel,
    chroma at half resolution (4:2:0) and textures as fine as the tube bias the pose by more than its covariance says.
    ``misfit`` is high where the light does not fit.

    Args:
        camera: Intrinsics and tone curve.
        catheter: Geometry; colours are not used.
        plan: Size of windows and model.
        learnable: Whether the positions of the edges and the radius are parameters instead of buffers.

    Source: Golub and Pereyra (1973) for variable projection, in Kaufman's (1975) approximation.
    """

    positions: Tensor
    radius: Tensor

    def __init__(self, camera: Camera, catheter: Catheter, *, plan: FitPlan | None = None, learnable: bool = False):
        super().__init__()
        self.camera, self.plan = camera, plan or FitPlan()
        for name, value in (
            ("positions", catheter.positions),
            ("radius", torch.tensor(catheter.radius, dtype=torch.float64)),
        ):
            if learnable:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    def forward(self, frames: Tensor, tip: Tensor, direction: Tensor) -> PhotometricPose:
        """Fit poses near those given; NaN where fewer than three windows are on the frame, or where the fit diverges.

        Args:
            frames: uint8 [B, 3, H, W], or floating with levels from 0 to 1; RGB.
            tip: [B, 3] rough tips in metres, right to a few pixels.
            direction: [B, 3] rough unit vectors from the tip to the rear.

        Raises:
            TypeError, ValueError: Another shape or dtype, a value that is not finite, or a direction that is not a unit
                vector.
        """
        _check(frames, tip, direction)
        tip, direction = tip.detach().double(), direction.detach().double()
        middle = (self.positions[0] + self.positions[-1]).detach() / 2
        with torch.no_grad():
            pixels = self._pixels(tip, direction)
            windows = self._windows(frames, pixels, tip, direction)
            usable = (self._freedom(windows) > 0).sum(-1) >= 3
        if not bool(usable.all()):
            return self(frames[usable], tip[usable], direction[usable]).scattered(usable)
        with torch.no_grad():
            frame = _frame(tip + middle * direction, direction)
            unknown = torch.zeros(len(tip), 6, dtype=torch.float64, device=tip.device)
            unknown[:, 5] = math.log(self.plan.blur)
            frame, unknown = self._settled(frame, unknown, windows)
        trainable = (frames, self.camera.matrix, self.camera.distortion, self.positions, self.radius)
        if torch.is_grad_enabled() and any(one.requires_grad for one in trainable):
            windows = self._windows(frames, pixels, tip, direction)
            unknown = self._implicit(frame, unknown, windows)
        normal, _, parts = self._equations(frame, unknown, windows)
        return self._answer(frame, unknown, windows, normal, parts)

    def _freedom(self, windows: _Windows) -> Tensor:
        """Samples of each window beyond its linear unknowns and 20 pixels more, [B, N]; above 0 for a window in use."""
        return 3 * (windows.mask.sum(-1) - 2 * (self.plan.degree + 1) - 4) - 60

    def _pixels(self, tip: Tensor, direction: Tensor) -> Tensor:
        """Pixels (x, y) [B, N, P, 2] around each edge: columns or rows of pixels that follow the tube."""
        plan, camera = self.plan, self.camera
        edges = tip[:, None] + self.positions[:, None] * direction[:, None]
        ends = edges[:, :, None] + 1e-3 * direction[:, None, None] * edges.new_tensor([[-1.0], [1.0]])
        centre, ends = camera.project(edges), camera.project(ends)
        along = ends[..., 1, :] - ends[..., 0, :]
        steep = along[..., 1].abs() > along[..., 0].abs()
        # The image axis nearer to the tube's direction comes first.
        order = torch.stack([steep, ~steep], -1).long()
        first, slope = centre.gather(-1, order), along.gather(-1, order)
        i, j = (torch.arange(-n, n + 1.0, dtype=tip.dtype, device=tip.device) for n in (plan.along, plan.across))
        main = first[..., :1].round() + i
        other = (first[..., 1:] + (main - first[..., :1]) * slope[..., 1:] / slope[..., :1]).round()
        pixels = torch.stack(torch.broadcast_tensors(main[..., None], other[..., None] + j), -1).flatten(2, 3)
        return pixels.gather(-1, order[:, :, None].expand_as(pixels)).nan_to_num(-1.0)

    def _windows(self, frames: Tensor, pixels: Tensor, tip: Tensor, direction: Tensor) -> _Windows:
        """Rays and light of the pixels; those near the tube at the rough pose count."""
        camera = self.camera
        height, width = frames.shape[-2:]
        x, y = pixels.unbind(-1)
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        index = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).long().flatten(1)
        levels = frames.flatten(2).gather(2, index[:, None].expand(-1, 3, -1)).unflatten(2, pixels.shape[1:3])
        light = camera.linear(levels if frames.dtype == torch.uint8 else 255 * levels.double()).double().movedim(1, 2)
        plane = camera.undistort(pixels)
        rays = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        length = rays.norm(dim=-1)
        rays = rays / length[..., None]
        with torch.no_grad():
            # Radians per pixel, the geometric mean of both directions.
            angle = torch.linalg.det(camera.slopes(plane)).abs().rsqrt() / length**1.5
            across = torch.linalg.cross(rays, direction[:, None, None].expand_as(rays))
            miss = (across * tip[:, None, None]).sum(-1) / across.norm(dim=-1)
            depth = (tip[:, None] + self.positions[:, None] * direction[:, None]).norm(dim=-1)[..., None]
            near = miss.abs() < self.radius + self.plan.beside * depth * angle
        return _Windows(rays, angle, light, (inside & near).double())

    def _settled(self, frame: _Frame, unknown: Tensor, windows: _Windows) -> tuple[_Frame, Tensor]:
        """Pose and blur after Gauss-Newton steps. Position and direction are always 0 in the returned unknown."""
        for step in range(self.plan.iterations):
            normal, right, _ = self._equations(frame, unknown, windows, blur=step >= 2)
            damping = 1e-3 if step == 0 else 1e-9
            scale = normal.diagonal(dim1=-2, dim2=-1).clamp(min=1e-30).rsqrt()
            scaled = normal * scale[:, None] * scale[..., None] + damping * torch.eye(6).to(normal)
            move = scale * torch.linalg.solve_ex(scaled, scale * right)[0]
            frame, unknown = _moved(frame, unknown + move)
            largest = (move / _SCALES.to(move)).abs().nan_to_num(0.0)
            if step >= 3 and bool((largest < self.plan.settled).all()):
                break
        return frame, unknown

    def _implicit(self, frame: _Frame, unknown: Tensor, windows: _Windows) -> Tensor:
        """``unknown`` at the optimum, with its derivative by the pixels, the camera and the catheter."""
        unknown = unknown.detach().requires_grad_()
        _, right, _ = self._equations(frame, unknown, windows)
        rows = [torch.autograd.grad(right[:, i].sum(), unknown, retain_graph=True)[0] for i in range(6)]
        slope = torch.stack(rows, 1).detach()
        _, right, _ = self._equations(frame, unknown.detach(), windows)
        return unknown.detach() - torch.linalg.solve(slope, right)

    def _equations(
        self, frame: _Frame, unknown: Tensor, windows: _Windows, blur: bool = True
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Normal matrix [B, 6, 6], right side [B, 6] and parts for the answer, at ``unknown`` [B, 6].

        The unknowns are shifts along side, axis and sight in metres, turns towards side and front in radians, and the
        logarithm of the blur.
        """
        plan, radius = self.plan, self.radius
        place = _Geometry.of(frame, unknown, windows, radius)
        x, weight = (value.to(unknown.device) for value in _nodes(plan.nodes))
        edge = (self.positions - (self.positions[0] + self.positions[-1]) / 2)[:, None]
        wide = place.blur  # metres across, per unit of the Gaussian
        z = (place.miss[..., None] - radius * x) / wide[..., None]
        bright = (radius * weight / math.sqrt(2 * math.pi)) * torch.exp(-0.5 * z * z) / wide[..., None]  # [B, N, P, M]
        depth = radius * (1 - x * x).sqrt()
        q = (place.along[..., None] - place.slant[..., None] * depth - edge[..., None]) / place.soft[..., None]
        share = torch.special.ndtr(q)
        shade = torch.from_numpy(np.polynomial.legendre.legvander(_nodes(plan.nodes)[0].numpy(), plan.degree)).to(x)
        low, high = (-radius - place.miss) / wide, (place.miss - radius) / wide
        left, right_ = torch.special.ndtr(low)[..., None], torch.special.ndtr(high)[..., None]
        gradient = ((place.along - edge) / _GRADIENT)[..., None]  # of each background along the tube
        second = bright * share
        basis = torch.cat(
            [(bright - second) @ shade, second @ shade, left, right_, left * gradient, right_ * gradient], -1
        )  # [B, N, P, K]
        coefficients, fitted, weights, solve = self._linear(basis, windows)
        residual = windows.light - fitted  # [B, N, 3, P]
        count = shade.shape[1]
        first_c, second_c = coefficients[..., :count] @ shade.T, coefficients[..., count : 2 * count] @ shade.T
        sides = coefficients[..., 2 * count :]  # [B, N, 3, 4]
        slopes = _slopes(
            bright, share, z, q, depth, place, wide, first_c, second_c, sides, low, high, gradient[..., 0]
        )  # by miss, along, slant, log blur
        turn = torch.einsum("gbncp,bnpgk->bncpk", slopes, place.derivatives)  # [B, N, 3, P, 6]
        own = torch.stack([-slopes[1], slopes[0]], -1)  # moves of this window's edge along, and of its axis across
        changes = torch.cat([turn, own], -1)
        changes = changes - torch.einsum("bnpk,bnckl->bncpl", basis, solve(changes))
        weighted = weights[..., None] * changes
        blocks = torch.einsum("bncpk,bncpl->bnkl", weighted, changes)
        sides_ = torch.einsum("bncpk,bncp->bnk", weighted, residual)
        freedom = self._freedom(windows)
        misfit = (weights * residual * residual).sum((-2, -1)) / (freedom + 60).clamp(min=1)
        used = freedom > 0
        median = torch.where(used, misfit, torch.nan).nanmedian(-1, keepdim=True).values
        trust = used / torch.maximum(misfit, 0.5 * median).clamp(min=_ROUNDING)
        blocks, sides_ = blocks * trust[..., None, None], sides_ * trust[..., None]
        # Each window's edge and axis are off by a little that no noise explains: marginalised with its prior.
        floor = torch.stack([place.pixel / place.sine, place.pixel], -1) * plan.edge_floor
        inner = blocks[..., 6:, 6:] + torch.diag_embed(floor**-2)
        cross = torch.linalg.solve(inner, blocks[..., 6:, :6])
        normal = (blocks[..., :6, :6] - blocks[..., :6, 6:] @ cross).sum(1)
        right = (sides_[..., :6] - (cross.mT @ sides_[..., 6:, None])[..., 0]).sum(1)
        prior = unknown.new_zeros(6)
        prior[5] = plan.blur_spread**-2
        normal = normal + torch.diag(prior)
        right = right - prior * (unknown - unknown.new_tensor([0, 0, 0, 0, 0, math.log(plan.blur)]))
        if not blur:
            keep = unknown.new_tensor([1.0, 1, 1, 1, 1, 0])
            normal = normal * keep * keep[:, None] + torch.diag(1 - keep)
            right = right * keep
        return normal, right, (blocks, sides_, misfit, used, floor)

    def _linear(self, basis: Tensor, windows: _Windows) -> tuple[Tensor, Tensor, Tensor, Callable[[Tensor], Tensor]]:
        """Coefficients [B, N, 3, K] of the light, fitted light, weights [B, N, 3, P], and a solver for projections."""
        camera = self.camera

        def weights_of(light: Tensor) -> Tensor:
            level = camera.levels(light.clamp(2e-3, 0.98)).clamp(4, 250)
            return windows.mask[:, :, None] / (camera.linear(level + 0.5) - camera.linear(level - 0.5)) ** 2

        def solver(weights: Tensor):
            heavy = basis[:, :, None] * weights[..., None]
            gram = heavy.mT @ basis[:, :, None]
            ridge = 1e-7 * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] + 1e-12
            gram = gram + ridge * torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
            factor, _ = torch.linalg.cholesky_ex(gram)  # NaN instead of an error where a fit has diverged
            return lambda values: torch.cholesky_solve(heavy.mT @ values, factor)

        solve = solver(weights_of(windows.light.clamp(2e-2)))
        fitted = (basis[:, :, None] @ solve(windows.light[..., None]))[..., 0]
        weights = weights_of(fitted)
        solve = solver(weights)
        coefficients = solve(windows.light[..., None])
        return coefficients[..., 0], (basis[:, :, None] @ coefficients)[..., 0], weights, solve

    def _answer(
        self, frame: _Frame, unknown: Tensor, windows: _Windows, normal: Tensor, parts: tuple[Tensor, ...]
    ) -> PhotometricPose:
        blocks, sides, misfit, used, floor = parts
        moved, rest = _moved(frame, unknown)
        middle = (self.positions[0] + self.positions[-1]) / 2
        tip, direction = _pose(moved, middle)
        zero = torch.zeros_like(frame.side)
        rows = (frame.side, frame.axis, frame.sight, -middle * frame.side, -middle * frame.front, zero)
        turns = (zero, zero, zero, frame.side, frame.front, zero)
        lever = torch.cat([torch.stack(rows, -1), torch.stack(turns, -1)], 1)
        covariance = lever @ torch.linalg.inv_ex(normal)[0] @ lever.mT
        information = blocks[..., 6, 6]
        shift = sides[..., 6] / information.clamp(min=1e-30)
        deviation = (1 / information.clamp(min=1e-30) + floor[..., 0] ** 2).sqrt()
        return PhotometricPose(tip, direction, covariance, rest[:, 5].exp(), misfit, shift, deviation, used)


_GRADIENT = 0.01  # metres along the tube over which a background changes by its coefficient
_ROUNDING = 1 / 12  # levels^2: the noise of rounding to whole levels, below which no residual is trusted
# Typical size of each unknown: shifts in metres, turns in radians, logarithm of the blur.
_SCALES = torch.tensor([1e-4, 1e-4, 1e-3, 1e-3, 1e-2, 0.3], dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Where each ray passes the tube: [B, N, P] each.

    Attributes:
        miss: Signed distance between ray and axis.
        along: Position along the axis, from the bands' middle, where the ray is nearest to the axis.
        slant: Change of the visible surface's position along the axis per metre of depth below the axis.
        blur, soft: Standard deviation of the blur across and along the axis, in metres.
        pixel: [B, N] metres across the axis per pixel, mean over a window.
        sine: [B, N] sine of the angle between rays and axis, mean over a window.
        derivatives: [B, N, P, 4, 6] of miss, along, slant and log blur by the six unknowns.
    """

    miss: Tensor
    along: Tensor
    slant: Tensor
    blur: Tensor
    soft: Tensor
    pixel: Tensor
    sine: Tensor
    derivatives: Tensor

    @staticmethod
    def of(frame: _Frame, unknown: Tensor, windows: _Windows, radius: Tensor) -> "_Geometry":
        moved, rest = _moved(frame, unknown)
        ray = windows.rays
        middle, axis = moved.middle[:, None, None], moved.axis[:, None, None]
        b = (ray * axis).sum(-1)
        square = 1 - b * b
        sine = square.sqrt()
        normal = torch.linalg.cross(ray, axis.expand_as(ray)) / sine[..., None]
        miss = (normal * middle).sum(-1)
        ahead, beside = (ray * middle).sum(-1), (axis * middle).sum(-1)
        depth = (ahead - b * beside) / square
        along = depth * b - beside
        pixel = depth * windows.angle
        point = (rest[:, 5].exp() ** 2 + 1 / 12).sqrt()[:, None, None]
        blur = point * pixel
        # Derivatives by a shift of the middle along side, axis and sight, and by turns of the axis to side and front.
        shifts = torch.stack([moved.side, moved.axis, moved.sight], -1)[:, None, None]  # [B, 1, 1, 3, 3]
        turns = torch.stack([moved.side, moved.front], -1)[:, None, None]
        by_depth = (ray - b[..., None] * axis) / square[..., None]
        along_slope = b[..., None] * by_depth - axis
        db = (ray[..., None] * turns).sum(-2)  # [B, N, P, 2]
        beyond = torch.linalg.cross(middle.expand_as(ray), ray)
        miss_turn = (beyond[..., None] * turns).sum(-2) / sine[..., None] + (miss * b / square)[..., None] * db
        own = (middle[..., None] * turns).sum(-2)
        depth_turn = (2 * b[..., None] * db * depth[..., None] - db * beside[..., None] - b[..., None] * own) / square[
            ..., None
        ]
        along_turn = depth_turn * b[..., None] + depth[..., None] * db - own

        def shifted(slope: Tensor) -> Tensor:
            return (slope[..., None] * shifts).sum(-2)

        zero = torch.zeros_like(b)[..., None]
        log_blur = (rest[:, 5].exp() ** 2)[:, None, None, None] / (point**2)[..., None] + zero
        rows = [
            torch.cat([shifted(normal), miss_turn, zero], -1),
            torch.cat([shifted(along_slope), along_turn, zero], -1),
            torch.cat([zero, zero, zero, db / (sine**3)[..., None], zero], -1),
            torch.cat([shifted(by_depth) / depth[..., None], depth_turn / depth[..., None], log_blur], -1),
        ]
        mean = (pixel * windows.mask).sum(-1) / windows.mask.sum(-1).clamp(min=1)
        mean_sine = (sine * windows.mask).sum(-1) / windows.mask.sum(-1).clamp(min=1)
        mean = torch.where(mean > 0, mean, pixel.mean(-1))
        mean_sine = torch.where(mean_sine > 0, mean_sine, sine.mean(-1))
        return _Geometry(miss, along, b / sine, blur, blur / sine, mean, mean_sine, torch.stack(rows, -2))


def _slopes(bright, share, z, q, depth, place, wide, first, second, sides, low, high, gradient) -> Tensor:
    """Derivatives [4, B, N, 3, P] of the fitted light by miss, along, slant and log blur."""
    density = torch.exp(-0.5 * q * q) / math.sqrt(2 * math.pi)
    step = (second - first).mT  # [B, N, M, 3]
    part, rise = bright * share, bright * density

    def tube(factor: Tensor) -> Tensor:
        return ((bright * factor - part * factor) @ first.mT + (part * factor) @ second.mT).mT

    soft = place.soft[:, :, None]
    across = wide[:, :, None]
    by_along = (rise @ step).mT / soft
    by_slant = ((rise * -depth) @ step).mT / soft
    by_miss = -tube(z) / across
    by_blur = tube(z * z - 1) - ((rise * q) @ step).mT
    falls = [torch.exp(-0.5 * side * side) / math.sqrt(2 * math.pi) for side in (low, high)]
    left = sides[..., 0:1] + sides[..., 2:3] * gradient[:, :, None]
    right = sides[..., 1:2] + sides[..., 3:4] * gradient[:, :, None]
    by_miss = by_miss + (falls[1][:, :, None] * right - falls[0][:, :, None] * left) / across
    by_blur = by_blur - (low * falls[0])[:, :, None] * left - (high * falls[1])[:, :, None] * right
    covers = (
        torch.special.ndtr(low)[:, :, None] * sides[..., 2:3] + torch.special.ndtr(high)[:, :, None] * sides[..., 3:4]
    )
    return torch.stack([by_miss, by_along + covers / _GRADIENT, by_slant, by_blur])


def _check(frames: Tensor, tip: Tensor, direction: Tensor) -> None:
    if frames.dtype != torch.uint8 and not frames.is_floating_point():
        raise TypeError(f"frames must be uint8, or floating from 0 to 1, got {frames.dtype}")
    if frames.ndim != 4 or frames.shape[1] != 3:
        raise ValueError(f"frames must be [B, 3, H, W], got {list(frames.shape)}")
    for name, value in (("frames", frames), ("tip", tip), ("direction", direction)):
        if value.is_floating_point():
            checks.all_finite(name, value)
    for name, value in (("tip", tip), ("direction", direction)):
        if value.shape != (len(frames), 3) or not value.is_floating_point():
            raise ValueError(f"{name} must be floating, [B, 3] = [{len(frames)}, 3], got {list(value.shape)}")
    if bool(((direction.detach().norm(dim=-1) - 1).abs() > 1e-4).any()):
        raise ValueError("direction must be unit vectors; divide each by its length")


def _frame(middle: Tensor, axis: Tensor) -> _Frame:
    axis = axis / axis.norm(dim=-1, keepdim=True)
    sight = middle / middle.norm(dim=-1, keepdim=True)
    side = torch.linalg.cross(axis, sight)
    side = side / side.norm(dim=-1, keepdim=True)
    return _Frame(middle, axis, side, torch.linalg.cross(side, axis), sight)


def _moved(frame: _Frame, unknown: Tensor) -> tuple[_Frame, Tensor]:
    """Frame after the shifts and turns of ``unknown`` [B, 6], and what is left of it: 0 except for the blur."""
    shift = unknown[:, 0:1] * frame.side + unknown[:, 1:2] * frame.axis + unknown[:, 2:3] * frame.sight
    turn = unknown[:, 3:4] * frame.side + unknown[:, 4:5] * frame.front
    rest = torch.cat([torch.zeros_like(unknown[:, :5]), unknown[:, 5:].clamp(math.log(0.25), math.log(8.0))], -1)
    return _frame(frame.middle + shift, frame.axis + turn), rest


def _pose(frame: _Frame, middle: Tensor) -> tuple[Tensor, Tensor]:
    return frame.middle - middle * frame.axis, frame.axis


@lru_cache(maxsize=8)
def _nodes(count: int) -> tuple[Tensor, Tensor]:
    """Nodes and weights of the Gauss-Legendre rule on -1 to 1."""
    x, weight = np.polynomial.legendre.leggauss(count)
    return torch.from_numpy(x), torch.from_numpy(weight)
