"""Pose of a catheter from the pixels around its band edges: a differentiable fit of a rendered cylinder to a frame."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
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

    along: int = 10  # pixels to each side of an edge, along the image axis nearer to the tube's direction
    widest: int = 30  # most pixels to each side of the tube's axis, along the other image axis
    beside: float = 3.0  # background beside the tube that counts: more of it helps no more and is less uniform
    degree: int = 4  # degree of the shading across the tube: the blur hides higher ones up to a width of ten pixels
    nodes: int = 12  # nodes of the quadrature over the tube's width
    times: int = 8  # nodes of the quadrature over the time of exposure
    blur: float = 0.75  # blur to begin with, standard deviation: that of a focused camera
    moving: float = 10.0
    stretch: float = 1.2
    wide: float = 0.95
    evidence: float = 150.0
    blur_spread: float = 0.5  # standard deviation of the logarithm of a blur before it is measured
    clear: float = 0.6  # share of the background in the light of a clear tube
    chroma: float = 0.15
    fine: float = 0.65
    smeared: float = 2.0
    margin: float = 8.0
    grain_floor: float = 1.0
    inconsistent: float = 12.0
    moving_floor: float = 0.01
    blur_floor: float = 0.03
    edge_floor: float = 0.012
    outer_floor: float = 0.02
    axis_floor: float = 0.07
    coarse_floor: float = 0.06
    dark: float = 0.01
    step: float = 2.0  # most pixels that a step moves an edge
    reach: float = 6.0  # farthest that an edge may be from where the rough pose shows it
    iterations: int = 20  # most Gauss-Newton steps
    settled: float = 0.1  # step in standard deviations of the result below which a fit ends


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
class _Items:
    """Tensors of which the first axis counts the items of a batch."""

    def take(self, index: Tensor):
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class _Windows(_Items):
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
class _Frame(_Items):
    """Coordinates in which a pose is corrected: middle of the bands, axis, and unit vectors [B, 3].

    ``side`` is perpendicular to axis and line of sight, ``front`` to axis and side, and ``sight`` points at the middle.
    """

    middle: Tensor
    axis: Tensor
    side: Tensor
    front: Tensor
    sight: Tensor


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of B fits of D unknowns, and what each of N windows adds to them.

    Attributes:
        normal, right: [B, D, D] and [B, D].
        blocks, sides: [B, N, D + 2, D + 2] and [B, N, D + 2]; the last two unknowns are the shifts of this window's edge
            along the tube and of its axis across.
        misfit: [B, N] mean squared residual, in levels squared.
        used: [B, N] whether the window counts.
        floor: [B, N, 2] standard deviations of the last two unknowns in metres.
        objective: [B] negative logarithm of the likelihood, up to a constant.
    """

    normal: Tensor
    right: Tensor
    blocks: Tensor
    sides: Tensor
    misfit: Tensor
    used: Tensor
    floor: Tensor
    objective: Tensor


@dataclass(frozen=True, eq=False)
class _Linear:
    """Fit of the linear unknowns of B x N windows with C independent channels of P samples and K unknowns each."""

    design: Tensor  # [B, N, P, K]
    data: Tensor  # [B, N, C, P]
    weight: Tensor  # [B, N, C, P]
    colours: Tensor  # [B, N, 3, K]
    factor: Tensor  # [B, N, C, K, K]
    heavy: Tensor  # [B, N, C, P, K]
    residual: Tensor  # [B, N, C, P]
    mixes: Tensor | None
    misfit: Tensor  # [B, N]
    objective: Tensor  # [B]
    grain: Tensor  # [B, N]


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
        with torch.no_grad():
            pixels = self._pixels(tip, direction)
            windows = self._windows(frames, pixels, tip, direction)
            usable = (self._freedom(windows) > 0).sum(-1) >= 3
            if not bool(usable.all()):
                return self(frames[usable], tip[usable], direction[usable]).scattered(usable)
            coarse = self._coarse(frames, pixels)
            fits = self._fits(windows, tip, direction, coarse)
        trainable = (frames, self.camera.matrix, self.camera.distortion, self.positions, self.radius)
        implicit = torch.is_grad_enabled() and any(one.requires_grad for one in trainable)
        if implicit:
            windows = self._windows(frames, pixels, tip, direction)
        parts = []
        for where, frame, unknown, settled, rough in fits:
            own = windows.take(where)
            if implicit:
                unknown = self._implicit(frame, unknown, own, rough)
            state = self._equations(frame, unknown, own, rough)
            parts.append((where, self._answer(frame, unknown, own, state, settled & self._within(frame, tip[where], direction[where]))))
        return _merged(parts, len(tip))

    def _fits(self, windows: _Windows, tip: Tensor, direction: Tensor, coarse: Tensor):
        """Settled fits, in groups of items that have the same unknowns: (items, frame, unknown, whether settled)."""
        plan = self.plan
        middle = (self.positions[0] + self.positions[-1]) / 2
        frame = _frame(tip + middle * direction, direction)
        unknown = frame.middle.new_zeros(len(tip), 6 + 2 * len(self.positions))
        unknown[:, 5] = math.log(plan.blur)
        frame, unknown, settled = self._settled(frame, unknown, windows, False)
        moving = ~coarse & (self._stretched(frame, unknown, windows) | (unknown[:, 5] > math.log(plan.wide)))
        fits = []
        if bool(moving.any()):
            where = moving.nonzero()[:, 0]
            *found, better = self._moving(frame.take(where), unknown[where], windows.take(where))
            better = better & ~self._smeared(*found[:2], windows.take(where))
            fits.append((where[better], *(part.take(better) for part in found[:1]), *(part[better] for part in found[1:]), False))
            moving = moving.index_put((where,), better)
        coarse = coarse | (~moving & self._smeared(frame, unknown, windows))
        still = ~moving & ~coarse
        fits.append((still.nonzero()[:, 0], frame.take(still), unknown[still], settled[still], False))
        if bool(coarse.any()):
            where = coarse.nonzero()[:, 0]
            fits.append((where, *self._settled(frame.take(where), unknown[where], windows.take(where), True), True))
        return [fit for fit in fits if len(fit[0])]

    def _moving(self, frame: _Frame, unknown: Tensor, windows: _Windows) -> tuple[_Frame, Tensor, Tensor, Tensor]:
        """Fits with a motion during the exposure, and whether each is better than ``unknown``, the fit without."""
        still = self._equations(frame, unknown, windows, False).objective
        count = len(unknown)
        length = (6 * (unknown[:, 5:6].exp() ** 2 - self.plan.blur**2)).clamp(min=0.5).sqrt()
        sharp = torch.full_like(length, math.log(self.plan.blur))
        start = [torch.cat([unknown[:, :5], sharp, sign * length, length, unknown[:, 6:]], 1) for sign in (1.0, -1.0)]
        twice = torch.arange(count, device=unknown.device).repeat(2)
        both, windows = frame.take(twice), windows.take(twice)
        both, found, settled = self._settled(both, torch.cat(start), windows, False)
        objective = self._equations(both, found, windows, False).objective.unflatten(0, (2, count)).nan_to_num(torch.inf)
        best = objective.argmin(0) * count + twice[:count]
        better = objective.amin(0) < still - self.plan.evidence
        return both.take(best), found[best], settled[best], better

    def _within(self, frame: _Frame, tip: Tensor, direction: Tensor) -> Tensor:
        """[B] whether no edge is farther than ``reach`` from where it was in the rough pose."""
        edges = (self.positions - (self.positions[0] + self.positions[-1]) / 2)[:, None].detach()
        before = self.camera.project(tip[:, None] + self.positions[:, None].detach() * direction[:, None])
        after = self.camera.project(frame.middle[:, None] + edges * frame.axis[:, None])
        return ~((after - before).norm(dim=-1) > self.plan.reach).any(-1)

    def _freedom(self, windows: _Windows) -> Tensor:
        """Pixels of each window beyond twice its linear unknowns, [B, N]; above 0 for a window in use."""
        return windows.mask.sum(-1) - 2 * (2 * (self.plan.degree + 1) + 4)

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
        wide = self.radius * camera.matrix[0, 0] / edges.norm(dim=-1) + plan.beside
        wide = (wide * along.norm(dim=-1) / slope[..., 0].abs()).nan_to_num(0.0, 0.0, 0.0)
        across = min(math.ceil(float(wide.max())) if wide.numel() else 1, plan.widest)
        i, j = (torch.arange(-n, n + 1.0, dtype=tip.dtype, device=tip.device) for n in (plan.along, across))
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
        levels = _levels(frames, pixels)
        light = camera.linear(levels).double()
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
        # An edge counts if all of the frame around it is there; a saturated pixel does not.
        clear = (levels < _WHITE).all(2)
        x, y = pixels[:, :, pixels.shape[2] // 2].unbind(-1)
        margin = torch.minimum(torch.minimum(x, width - 1 - x), torch.minimum(y, height - 1 - y))
        within = (margin >= self.plan.margin)[..., None]
        return _Windows(rays.mT.contiguous(), angle, light, (inside & near & clear & within).double())

    def _coarse(self, frames: Tensor, pixels: Tensor) -> Tensor:
        """[B] whether red minus luma has less fine detail than luma around an edge: chroma at half resolution.

        With independent noise in each channel it has 1.4 times as much, and a grey texture adds to luma alone.
        """
        height, width = frames.shape[-2:]
        if min(height, width) < _PATCH:
            return torch.zeros(len(frames), dtype=torch.bool, device=frames.device)
        middle = pixels[:, :, pixels.shape[2] // 2]
        corner = (middle - _PATCH // 2).clamp(min=0).minimum(middle.new_tensor([width - _PATCH, height - _PATCH]))
        i = torch.arange(_PATCH, dtype=pixels.dtype, device=pixels.device)
        square = torch.stack(torch.broadcast_tensors(i, i[:, None]), -1).flatten(0, 1)
        levels = _levels(frames, corner[:, :, None] + square).double().unflatten(-1, (_PATCH, _PATCH))
        luma = (levels * levels.new_tensor(_CODES[0])[:, None, None]).sum(2)
        both = torch.stack([luma, levels[:, :, 0] - luma])
        luma, red = both.diff(n=2, dim=-1).diff(n=2, dim=-2).abs().flatten(-2).median(-1).values
        return (red < self.plan.fine * luma).any(-1)

    def _smeared(self, frame: _Frame, unknown: Tensor, windows: _Windows) -> Tensor:
        """[B] whether chroma fits worse than luma near the edges between bands: JPEG at half resolution of chroma."""
        place, tube = self._model(frame, unknown, windows)
        fitted = (windows.light - self._linear(tube, windows, False).residual).clamp(2e-3, 0.98)
        levels = self.camera.levels(windows.light) - self.camera.levels(fitted)
        square = torch.einsum("ec,bncp->bnep", levels.new_tensor(_CODES), levels).square()
        near = tube.gradient.abs() * _GRADIENT * place.ratio < 2.5 * place.pixels
        weight = windows.mask * (1 - tube.texture) * near
        luma, *chroma = (square * weight[:, :, None])[:, 1:-1].sum((1, 3)).unbind(-1)
        return sum(chroma) / 2 > self.plan.smeared * luma

    def _stretched(self, frame: _Frame, unknown: Tensor, windows: _Windows) -> Tensor:
        """[B] whether another blur along the tube than across it fits better: a motion during the exposure."""
        plan = self.plan
        round_, *others = (
            self._linear(self._model(frame, unknown, windows, stretch)[1], windows, False).objective
            for stretch in (1.0, plan.stretch, 1 / plan.stretch)
        )
        return torch.stack(others).amin(0) < round_ - plan.moving

    def _model(
        self, frame: _Frame, unknown: Tensor, windows: _Windows, stretch: float = 1.0
    ) -> tuple["_Geometry", "_Tube"]:
        """Geometry and light of the tube; ``stretch`` is the ratio of the blurs along the tube and across it."""
        place = _Geometry.of(frame, unknown, windows)
        if stretch != 1:
            place = replace(place, blur=place.blur / math.sqrt(stretch), ratio=place.ratio / stretch)
        edge = (self.positions - (self.positions[0] + self.positions[-1]) / 2)[:, None]
        return place, _Tube.of(place, unknown, self.radius, edge, self.plan)

    def _settled(
        self, frame: _Frame, unknown: Tensor, windows: _Windows, coarse: bool
    ) -> tuple[_Frame, Tensor, Tensor]:
        """Pose and other unknowns after Gauss-Newton steps, and whether the steps have become small.

        Position and direction are always 0 in the returned unknown.
        """
        settled = torch.zeros(len(unknown), dtype=torch.bool, device=unknown.device)
        half = float(self.positions[-1] - self.positions[0]) / 2
        for step in range(self.plan.iterations):
            active = (~settled).nonzero()[:, 0]
            here, own = frame.take(active), windows.take(active)
            state = self._equations(here, unknown[active], own, coarse, blur=step >= 1)
            damping = 1e-3 if step == 0 else 1e-9
            scale = state.normal.diagonal(dim1=-2, dim2=-1).clamp(min=1e-30).rsqrt()
            scaled = state.normal * scale[:, None] * scale[..., None]
            scaled = scaled + damping * torch.eye(scaled.shape[-1]).to(scaled)
            move = scale * torch.linalg.solve_ex(scaled, scale * state.right)[0]
            gain = (move * state.right).sum(-1)
            # Changes that move the edges by about a pixel, for shifts to side, axis and sight and for both turns.
            depth = here.middle.norm(dim=-1, keepdim=True)
            pixel = depth * own.angle.mean((1, 2))[:, None]
            unit = pixel * torch.cat([torch.ones_like(depth), torch.ones_like(depth), depth / half, torch.ones_like(depth) / half, depth / half**2], -1)
            length = (move[:, :5] / unit).abs().amax(-1, keepdim=True)
            move = move * (self.plan.step / length.clamp(min=1e-30)).clamp(max=1.0)
            moved, rest = _moved(here, unknown[active] + move)
            unknown = unknown.index_put((active,), rest)
            frame = _Frame(*(getattr(frame, f.name).index_put((active,), getattr(moved, f.name)) for f in fields(frame)))
            if step >= 1:
                settled = settled.index_put((active,), gain < self.plan.settled**2)
                if bool(settled.all()):
                    break
        return frame, unknown, settled

    def _implicit(self, frame: _Frame, unknown: Tensor, windows: _Windows, coarse: bool) -> Tensor:
        """``unknown`` at the optimum, with its derivative by the pixels, the camera and the catheter."""
        unknown = unknown.detach().requires_grad_()
        right = self._equations(frame, unknown, windows, coarse).right
        rows = [torch.autograd.grad(one.sum(), unknown, retain_graph=True)[0] for one in right.unbind(-1)]
        slope = torch.stack(rows, 1).detach()
        right = self._equations(frame, unknown.detach(), windows, coarse).right
        return unknown.detach() - torch.linalg.solve(slope, right)

    def _equations(
        self, frame: _Frame, unknown: Tensor, windows: _Windows, coarse: bool, blur: bool = True
    ) -> _Equations:
        """Equations of a Gauss-Newton step at ``unknown`` [B, D].

        The unknowns are shifts along side, axis and sight in metres, turns towards side and front in radians, the
        logarithm of the blur and, with D = 8, the motion during the exposure along and across the tube in pixels.
        """
        plan = self.plan
        place, tube = self._model(frame, unknown, windows)
        size = unknown.shape[1] - 2 * len(self.positions)
        fit = self._linear(tube, windows, coarse)
        changes = tube.changes(place, fit.colours, size)  # [B, N, 3, D + 2, P]
        if fit.mixes is not None:
            changes = torch.einsum("bnecp,bncdp->bndep", fit.mixes, changes).flatten(-2)[:, :, None]
        projected = fit.heavy.mT @ changes.mT  # [B, N, C, K, D + 2]
        solved = torch.linalg.solve_triangular(fit.factor, projected, upper=False)
        weighted = changes * fit.weight[..., None, :]
        blocks = (weighted @ changes.mT - solved.mT @ solved).sum(2)
        sides = (weighted @ fit.residual[..., None])[..., 0].sum(2)
        used = self._freedom(windows) > 0
        # Residuals of neighbouring pixels that agree in sign leave more error than the same number of independent ones.
        known = torch.linalg.solve_triangular(fit.factor.mT, solved[..., -2:], upper=True)
        score = changes[..., -2:, :] - (fit.design[:, :, None] @ known).mT
        score = (score * (fit.weight * fit.residual)[..., None, :]).sum(2)  # [B, N, 2, P]
        if coarse:
            score = score.unflatten(-1, (3, -1)).sum(-2)
        trust = used / _correlation(score, 2 * plan.along + 1)
        blocks, sides = blocks * trust[..., None, None], sides * trust[..., None]
        floor = self._floor(place, unknown, fit.grain, coarse)
        normal, right = _assembled(blocks, sides)
        prior, start = torch.zeros_like(unknown), torch.zeros_like(unknown)
        prior[:, 5], start[:, 5] = plan.blur_spread**-2, math.log(plan.blur)
        prior = torch.cat([prior[:, :size], floor.flatten(1) ** -2], 1)
        normal = normal + torch.diag_embed(prior)
        right = right - prior * (unknown - start)
        if not blur:
            keep = torch.ones_like(unknown[0])
            keep[5:size] = 0
            normal = normal * keep * keep[:, None] + torch.diag(1 - keep)
            right = right * keep
        return _Equations(normal, right, blocks, sides, fit.misfit, used, floor, fit.objective)

    def _linear(self, tube: "_Tube", windows: _Windows, coarse: bool) -> "_Linear":
        """Fit of the linear unknowns: first with equal weights, then with weights from the residuals."""
        plan, mask, basis = self.plan, windows.mask, tube.basis
        repeats = 3 if coarse else 1
        equal, texture = (value.repeat(1, 1, repeats) for value in (mask, tube.texture))
        design, data, mixes = basis, windows.light, None
        colours, _, _ = _least_squares(design, data, mask[:, :, None])  # [B, N, C, K]
        for _ in range(2 * coarse):
            design, data, mixes = self._codes(basis, windows.light, colours)
            colours = _least_squares(design, data, equal[:, :, None])[0].unflatten(-1, (3, -1))[:, :, 0]
        fitted = colours.flatten(2)[:, :, None] @ design.mT if coarse else colours @ design.mT
        noise = torch.ones_like(fitted) if coarse else (fitted.clamp(min=0) + plan.dark)
        square = (data - fitted).square()
        relative = square / noise
        freedom = mask.sum(-1) / (mask.sum(-1) - basis.shape[-1]).clamp(min=1)

        def variance(weight: Tensor) -> Tensor:
            mean = (weight[:, :, None] * relative).sum(-1) / weight.sum(-1, keepdim=True).clamp(min=1)
            return mean * freedom[..., None] + rounding

        # Light per level at the mean light of each window and channel; 1 where the samples are levels.
        tone = torch.ones_like(noise[..., 0])
        if not coarse:
            mean = (fitted * mask[:, :, None]).sum(-1) / mask.sum(-1, keepdim=True).clamp(min=1)
            level = self.camera.levels(mean.clamp(2e-3, 0.98)).clamp(4, 250)
            tone = self.camera.linear(level + 0.5) - self.camera.linear(level - 0.5)
        rounding = _ROUNDING * tone**2 / noise.mean(-1)
        own, other = variance(equal * (1 - texture)), variance(equal * texture)  # of the tube, and of what is behind
        # Changes of light across the edge, and of the texture that shows through.
        step = colours[..., plan.degree + 1] - colours[..., 0]
        stripes = (equal * texture)[:, :, None], (equal * (1 - texture))[:, :, None]
        grain, noise_square = ((one * square).sum(-1) / one.sum(-1).clamp(min=1) for one in stripes)
        grain = ((grain - noise_square).sum(-1).clamp(min=0) / step.square().sum(-1).clamp(min=1e-9)).clamp(1e-12, 100).sqrt()
        ratio = (other / own).log().mean(-1, keepdim=True).exp()
        spread = own[..., None] * noise * (1 - texture + texture * ratio)[:, :, None]
        weight = equal[:, :, None] / spread
        colours, factor, heavy = _least_squares(design, data, weight)
        residual = data - colours @ design.mT
        colours = colours if not coarse else colours[:, :, 0].unflatten(-1, (3, -1))
        objective = 0.5 * (equal[:, :, None] * spread.log()).sum((1, 2, 3))
        misfit = (equal[:, :, None] * square).sum(-1) / equal.sum(-1, keepdim=True).clamp(min=1) / tone**2
        return _Linear(design, data, weight, colours, factor, heavy, residual, mixes, misfit.mean(-1), objective, grain)

    def _codes(self, basis: Tensor, light: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Design [B, N, 3 P, 3 K] and data [B, N, 1, 3 P] of luma and chroma, and their derivatives [B, N, 3, 3, P].

        Luma and chroma are sums of levels, which are linearised at the light that ``coefficients`` [B, N, 3, K] give.
        """
        camera = self.camera
        fitted = coefficients @ basis.mT
        level = camera.levels(fitted.clamp(2e-3, 0.98))
        slope = 1 / (camera.linear(level + 0.5) - camera.linear(level - 0.5))
        mix = basis.new_tensor(_CODES) * basis.new_tensor([1.0, self.plan.chroma, self.plan.chroma])[:, None]
        mixes = mix[:, :, None] * slope[:, :, None]  # [B, N, e, c, P]
        data = torch.einsum("bnecp,bncp->bnep", mixes, fitted) + torch.einsum(
            "ec,bncp->bnep", mix, camera.levels(light) - level
        )
        design = torch.einsum("bnecp,bnpk->bnepck", mixes, basis).flatten(4).flatten(2, 3)
        return design, data.flatten(2)[:, :, None], mixes

    def _floor(self, place: "_Geometry", unknown: Tensor, grain: Tensor, coarse: bool) -> Tensor:
        """Standard deviations of the errors of each edge along and across the tube that no noise explains, [B, N, 2]."""
        plan, count = self.plan, len(self.positions)
        outer = torch.tensor([n in (0, count - 1) for n in range(count)], device=unknown.device)
        along = torch.where(outer, plan.outer_floor**2 + (plan.grain_floor * (not coarse) * grain).square(), plan.edge_floor**2)
        across = torch.full_like(along, plan.axis_floor**2)
        if coarse:
            along, across = along + plan.coarse_floor**2, across + plan.coarse_floor**2
        defocus = (plan.blur_floor * (unknown[:, 5:6].exp() - plan.blur).clamp(min=0)).square()
        along, across = along + defocus, across + 9 * defocus
        if unknown.shape[1] - 2 * count > 6:
            motion = (plan.moving_floor * unknown[:, 6:8]).square().sum(-1, keepdim=True)
            along, across = along + motion, across + motion
        scale = torch.stack([place.pixel / place.sine, place.pixel], -1)
        return scale * torch.stack([along, across], -1).sqrt()

    def _answer(
        self, frame: _Frame, unknown: Tensor, windows: _Windows, state: _Equations, settled: Tensor
    ) -> PhotometricPose:
        moved, rest = _moved(frame, unknown)
        middle = (self.positions[0] + self.positions[-1]) / 2
        tip, direction = moved.middle - middle * moved.axis, moved.axis
        zero = torch.zeros_like(frame.side)
        more = [zero] * (unknown.shape[1] - 5)
        rows = (frame.side, frame.axis, frame.sight, -middle * frame.side, -middle * frame.front, *more)
        turns = (zero, zero, zero, frame.side, frame.front, *more)
        lever = torch.cat([torch.stack(rows, -1), torch.stack(turns, -1)], 1)
        covariance = lever @ torch.linalg.inv_ex(state.normal)[0] @ lever.mT
        shift = unknown[:, -2 * len(self.positions) :: 2]
        deviation = (1 / state.blocks[..., -2, -2].clamp(min=1e-30) + state.floor[..., 0] ** 2).sqrt()
        lost = (shift / deviation).square().sum(-1) > self.plan.inconsistent
        settled = settled & ~lost
        lost = torch.where(settled, 0.0, torch.nan)[:, None]
        return PhotometricPose(
            tip + lost, direction + lost, covariance + lost[..., None], rest[:, 5].exp(), state.misfit, shift, deviation, state.used
        )


_GRADIENT = 0.01  # metres along the tube over which a background changes by its coefficient
_ROUNDING = 1 / 12  # levels^2: the noise of rounding to whole levels
_CODES = ((0.299, 0.587, 0.114), (-0.169, -0.331, 0.5), (0.5, -0.419, -0.081))  # Y, Cb, Cr of red, green, blue levels
_WHITE = 254.0  # level from which a pixel may be saturated
_PATCH = 24  # side in pixels of the patches in which the resolution of chroma is estimated


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Where each ray passes the tube: [B, N, P] each.

    Attributes:
        miss: Signed distance between ray and axis.
        along: Position along the axis, from the bands' middle, where the ray is nearest to the axis.
        slant: Change of the visible surface's position along the axis per metre of depth below the axis.
        pixels: Metres across the axis per pixel.
        ratio: Sine of the angle between ray and axis.
        blur: Standard deviation of the blur across the axis, in metres; along it, this over ``ratio``.
        pixel, sine: [B, N] means of ``pixels`` and ``ratio`` over a window.
        derivatives: [B, N, 4, 6, P] of miss, along, slant and log blur by the first six unknowns.
    """

    miss: Tensor
    along: Tensor
    slant: Tensor
    pixels: Tensor
    ratio: Tensor
    blur: Tensor
    pixel: Tensor
    sine: Tensor
    derivatives: Tensor

    @staticmethod
    def of(frame: _Frame, unknown: Tensor, windows: _Windows) -> "_Geometry":
        moved, rest = _moved(frame, unknown)
        middle, axis, side, front, sight = moved.middle, moved.axis, moved.side, moved.front, moved.sight
        cross = torch.linalg.cross
        vectors = (axis, middle, side, front, sight, cross(axis, middle), cross(axis, side), cross(axis, sight))
        vectors = torch.stack([*vectors, cross(side, middle), cross(front, middle)], 1)
        parts = (vectors[:, None] @ windows.rays).unbind(2)
        b, ahead, by_side, by_front, by_sight, missed, miss_side, miss_sight, turn_side, turn_front = parts
        beside, slope, own = (
            (one * other).sum(-1)[:, None, None] for one, other in ((axis, middle), (axis, sight), (front, middle))
        )
        square = 1 - b * b
        sine = square.sqrt()
        per_sine, per_square = 1 / sine, 1 / square
        miss = missed * per_sine
        depth = (ahead - b * beside) * per_square
        along = depth * b - beside
        pixels = depth * windows.angle
        width = rest[:, 5].exp()[:, None, None]
        point = (width**2 + 1 / 12).sqrt()
        zero = torch.zeros_like(b)
        depth_side, depth_sight = by_side * per_square, (by_sight - b * slope) * per_square
        common = (2 * b * depth - beside) * per_square
        turned_side, turned_front = common * by_side, common * by_front - b * own * per_square
        bend = miss * b * per_square
        rows = (
            (miss_side * per_sine, zero, miss_sight * per_sine, turn_side * per_sine + bend * by_side,
             turn_front * per_sine + bend * by_front, zero),
            (b * depth_side, zero - 1, b * depth_sight - slope, turned_side * b + depth * by_side,
             turned_front * b + depth * by_front - own, zero),
            (zero, zero, zero, by_side * per_square * per_sine, by_front * per_square * per_sine, zero),
            (depth_side / depth, zero, depth_sight / depth, turned_side / depth, turned_front / depth,
             zero + (width / point) ** 2),
        )
        derivatives = torch.stack([one for row in rows for one in row], 2).unflatten(2, (4, 6))
        weight = windows.mask + 1e-9
        mean, mean_sine = ((value * weight).sum(-1) / weight.sum(-1) for value in (pixels, sine))
        return _Geometry(miss, along, b * per_sine, pixels, sine, point * pixels, mean, mean_sine, derivatives)


@dataclass(frozen=True, eq=False)
class _Tube:
    """Light of a blurred tube with two bands, before two backgrounds, per unit of its linear coefficients.

    The M nodes of the quadrature over the tube's width and the T over the time of exposure are one axis of M T nodes.
    """

    basis: Tensor  # [B, N, P, K]: shading of the first and of the second band, backgrounds, their gradients
    texture: Tensor  # [B, N, P] share of the light that comes from the background, 0 to 1
    bright: Tensor
    part: Tensor
    rise: Tensor
    z: Tensor
    q: Tensor
    depth: Tensor
    time: Tensor
    shade: Tensor
    falls: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
    gradient: Tensor

    @staticmethod
    def of(place: _Geometry, unknown: Tensor, radius: Tensor, edge: Tensor, plan: FitPlan) -> "_Tube":
        moves = unknown.shape[1] - 2 * len(edge) > 6
        shift = unknown[:, -2 * len(edge) :].unflatten(1, (-1, 2))
        x, share_x = (value.to(unknown) for value in _nodes(plan.nodes))
        t, share_t = (value.to(unknown) / 2 for value in _nodes(plan.times if moves else 1))
        shade = torch.from_numpy(np.polynomial.legendre.legvander(_nodes(plan.nodes)[0].numpy(), plan.degree)).to(x)
        x, time = (value.flatten() for value in torch.broadcast_tensors(x[:, None], t))
        weight = (share_x[:, None] * share_t).flatten()
        shade = shade.repeat_interleave(len(t), 0)
        along = place.along - edge - shift[..., :1]
        gradient = along / _GRADIENT
        miss, along = (place.miss + shift[..., 1:])[..., None], along[..., None]
        per_blur = 1 / place.blur[..., None]
        per_soft = per_blur * place.ratio[..., None]
        depth = radius * (1 - x * x).sqrt()
        path, late = miss, along
        if moves:
            path = miss - (unknown[:, 7, None, None] * place.pixels)[..., None] * time
            late = along - (unknown[:, 6, None, None] * place.pixels / place.ratio)[..., None] * time
        z = (path - radius * x) * per_blur
        bright = (radius * weight / math.sqrt(2 * math.pi)) * torch.exp(-0.5 * z * z) * per_blur
        q = (late - place.slant[..., None] * depth) * per_soft
        part = bright * torch.special.ndtr(q)
        rise = bright * torch.exp(-0.5 * q * q) / math.sqrt(2 * math.pi)
        path = miss if not moves else miss - (unknown[:, 7, None, None] * place.pixels)[..., None] * t
        low, high = (-radius - path) * per_blur, (path - radius) * per_blur
        left, right = ((torch.special.ndtr(side) * share_t).sum(-1) for side in (low, high))
        falls = []
        for side in (low, high):
            fall = torch.exp(-0.5 * side * side) * share_t / math.sqrt(2 * math.pi)
            falls += [fall.sum(-1), (fall * t).sum(-1), (fall * side).sum(-1)]
        sides = torch.stack([left, right, left * gradient, right * gradient], -1)
        basis = torch.cat([(bright - part) @ shade, part @ shade, sides], -1)
        texture = (left + right).clamp(0, 1)
        before, after = (bright - part).sum(-1), part.sum(-1)
        texture = torch.cat(
            [
                (texture[:, :1] + plan.clear * before[:, :1]),
                texture[:, 1:-1],
                (texture[:, -1:] + plan.clear * after[:, -1:]),
            ],
            1,
        )
        return _Tube(basis, texture.clamp(0, 1), bright, part, rise, z, q, depth, time, shade, tuple(falls), gradient)

    def changes(self, place: _Geometry, colours: Tensor, count: int) -> Tensor:
        """Derivatives [B, N, 3, D + 2, P] of the light of ``colours`` [B, N, 3, K] by D = ``count`` and own unknowns."""
        degrees = self.shade.shape[1]
        first = self.shade @ colours[..., :degrees].mT  # [B, N, nodes, 3]
        second = self.shade @ colours[..., degrees : 2 * degrees].mT
        left, right, left_slope, right_slope = colours[..., 2 * degrees :, None].unbind(-2)
        step = second - first
        blur = place.blur[:, :, None]
        soft = blur / place.ratio[:, :, None]
        gradient = self.gradient[:, :, None]
        left, right = left + left_slope * gradient, right + right_slope * gradient
        timed = count > 6
        time = self.time[:, None]
        by_z = self.z * self.bright @ first + self.z * self.part @ step if not timed else None
        if timed:
            both = torch.cat([first, first * time], -1), torch.cat([step, step * time], -1)
            by_z, by_zt = (self.z * self.bright @ both[0] + self.z * self.part @ both[1]).split(3, -1)
            along, along_t = (self.rise @ both[1]).mT.split(3, 2)
        else:
            along = (self.rise @ step).mT
        fall_low, late_low, side_low, fall_high, late_high, side_high = (value[:, :, None] for value in self.falls)
        by_miss = (fall_high * right - fall_low * left - by_z.mT) / blur
        covers = self.basis[..., -4:-2].mT
        by_along = along / soft
        by_edge = by_along
        by_along = by_along + (covers[:, :, :1] * left_slope + covers[:, :, 1:] * right_slope) / _GRADIENT
        by_slant = -(self.rise @ (self.depth[:, None] * step)).mT / soft
        square = self.z * self.z - 1
        by_blur = (square * self.bright @ first + square * self.part @ step - self.rise * self.q @ step).mT
        by_blur = by_blur - side_low * left - side_high * right
        slopes = torch.stack([by_miss, by_along, by_slant, by_blur], 2)  # [B, N, 4, 3, P]
        turn = (slopes[..., None, :] * place.derivatives[:, :, :, None]).sum(2)
        own = torch.stack([-by_along, by_miss], 3)
        if not timed:
            return torch.cat([turn, own], 3)
        pixels = place.pixels[:, :, None]
        motion_along = -pixels / place.ratio[:, :, None] * along_t / soft
        motion_across = -pixels * (late_high * right - late_low * left - by_zt.mT) / blur
        return torch.cat([turn, torch.stack([motion_along, motion_across], 3), own], 3)


def _assembled(blocks: Tensor, sides: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations of all unknowns: those that all windows share, and then two of each window."""
    batch, count, size, _ = blocks.shape
    shared = size - 2
    whole = shared + 2 * count
    normal, right = blocks.new_zeros(batch, whole, whole), sides.new_zeros(batch, whole)
    for n in range(count):
        index = [*range(shared), shared + 2 * n, shared + 2 * n + 1]
        place = torch.zeros(size, whole, dtype=blocks.dtype)
        place[range(size), index] = 1
        place = place.to(blocks)
        normal = normal + place.mT @ blocks[:, n] @ place
        right = right + sides[:, n] @ place
    return normal, right


def _least_squares(design: Tensor, data: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Coefficients [B, N, C, K] of ``data`` [B, N, C, P], Cholesky factor, and weighted design [B, N, C, P, K].

    ``weight`` is [B, N, C or 1, P].
    """
    heavy = design[:, :, None] * weight[..., None]
    gram = heavy.mT @ design[:, :, None]
    ridge = 1e-7 * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] + 1e-12
    gram = gram + ridge * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    factor, _ = torch.linalg.cholesky_ex(gram)  # NaN instead of an error where a fit has diverged
    return torch.cholesky_solve(heavy.mT @ data[..., None], factor)[..., 0], factor, heavy


def _correlation(score: Tensor, rows: int) -> Tensor:
    """Variance of the sum of scores [B, N, 2, P] relative to that of independent ones, [B, N], at least 1.

    Source: Newey and West (1987), with blocks of pixels instead of lags.
    """
    grid = score.flatten(0, 1).unflatten(-1, (rows, -1))
    sums = nn.functional.avg_pool2d(nn.functional.pad(grid, [4] * 4), 5, stride=1) * 25
    excess = sums.square().sum((-2, -1)) / (25 * grid.square().sum((-2, -1))).clamp(min=1e-30)
    return excess.mean(-1).unflatten(0, score.shape[:2]).clamp(min=1.0)


def _levels(frames: Tensor, pixels: Tensor) -> Tensor:
    """Levels [B, N, 3, P] of frames [B, 3, H, W] at pixels (x, y) [B, N, P, 2], clamped to the frame."""
    height, width = frames.shape[-2:]
    x, y = pixels.unbind(-1)
    index = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).long().flatten(1)
    levels = frames.flatten(2).gather(2, index[:, None].expand(-1, 3, -1)).unflatten(2, pixels.shape[1:3]).movedim(1, 2)
    return levels if frames.dtype == torch.uint8 else 255 * levels.double()


def _merged(parts: list[tuple[Tensor, PhotometricPose]], count: int) -> PhotometricPose:
    """Poses of ``count`` items from those of groups of them."""
    if len(parts) == 1 and len(parts[0][0]) == count:
        return parts[0][1]
    order = torch.cat([where for where, _ in parts]).argsort()
    return PhotometricPose(*(torch.cat([getattr(pose, f.name) for _, pose in parts])[order] for f in fields(PhotometricPose)))


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
    """Frame after the shifts and turns of ``unknown`` [B, D], and what is left of it: 0 for the first five."""
    shift = unknown[:, 0:1] * frame.side + unknown[:, 1:2] * frame.axis + unknown[:, 2:3] * frame.sight
    turn = unknown[:, 3:4] * frame.side + unknown[:, 4:5] * frame.front
    blur = unknown[:, 5:6].clamp(math.log(0.25), math.log(8.0))
    rest = torch.cat([torch.zeros_like(unknown[:, :5]), blur, unknown[:, 6:]], -1)
    return _frame(frame.middle + shift, frame.axis + turn), rest


@lru_cache(maxsize=8)
def _nodes(count: int) -> tuple[Tensor, Tensor]:
    """Nodes and weights of the Gauss-Legendre rule on -1 to 1."""
    x, weight = np.polynomial.legendre.leggauss(count)
    return torch.from_numpy(x), torch.from_numpy(weight)
