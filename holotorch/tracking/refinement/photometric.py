"""Pose of a catheter from the pixels around its band edges: a differentiable fit of a rendered cylinder to a frame."""

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.rolling_shutter import READOUT, readout_covariance
from holotorch.tracking.pose.status import THREE_EDGES, Pose, Status
from holotorch.tracking.refinement.tube_light import SHARED, Frame, Items, TubeGeometry, TubeLight, Windows


@dataclass(frozen=True)
class FitPlan:
    """Size of the windows, models of light and errors, limits of the search. Lengths in pixels unless said otherwise.

    The floors are the errors that remain with little noise, measured on seeds 0 to 119 and 240 to 479 of VariedWorld.
    """

    along: int = 8  # pixels to each side of an edge, along the image axis nearer to the tube's direction
    widest: int = 30  # largest number of pixels to each side of the tube's axis, along the other image axis
    beside: float = 3.0  # width of the fitted background beside the tube; more does not help and is less uniform
    margin: float = 8.0  # least distance of an edge from the border of the frame: its window must show both sides
    degree: int = 4  # degree of the shading across the tube: higher ones leave the position across less certain
    density: float = 1.6  # nodes of the quadrature over the tube's width, per pixel of it: 1e-4 of the light at least
    times: int = 8  # nodes of the quadrature over the time of exposure, where the tube moves
    blur: float = 0.75  # blur to begin with, standard deviation: that of a focused camera
    blur_spread: float = 0.5  # standard deviation of the logarithm of a blur before it is measured
    clear: float = 0.6  # share of the background in the light of a clear tube
    dark: float = 0.01  # light, 0 to 1, whose shot noise is as large as the noise of reading the sensor
    fine: float = 0.65  # ratio of fine detail in red minus luma to that in luma below which chroma is coarse
    smeared: float = 2.0  # ratio of the squared residuals of chroma to those of luma above which chroma is coarse
    chroma: float = 0.15  # weight of a level of coarse chroma relative to luma: enough to tell the colours apart
    stretch: float = 1.2  # ratio of the blurs along and across the tube that is tried to find a motion
    stretch_gain: float = 10.0  # gain in log-likelihood by this ratio above which a fit with a motion is tried
    wide: float = 0.95  # blur above which a fit with a motion is tried, too
    motion_gain: float = 150.0  # log-likelihood that a motion must gain; defocus alone gains up to 110
    edge_floor: float = 0.012  # error of an inner edge along the tube: shading and sampling
    outer_floor: float = 0.02  # error of an outer edge along the tube: what shows through the clear tube
    grain_floor: float = 1.0  # error of an outer edge per ratio of the texture behind it to the step at the edge
    axis_floor: float = 0.08  # error of the axis across: shading of higher degree
    coarse_floor: float = 0.06  # additional error of edge and axis where chroma is coarse
    blur_floor: float = 0.03  # additional error of an edge per pixel of blur above ``blur``; 3 times that of the axis
    motion_floor: float = 0.01  # additional error of edge and axis per pixel of motion
    radius_spread: float = 0.02  # standard deviation of the logarithm of the radius: blur and shading at the sides
    readout: float = READOUT  # metres, deviation of the motion while a rolling shutter reads a frame; 0: global
    step: float = 2.0  # largest shift of an edge in one step
    reach: float = 6.0  # largest distance of an edge from its place in the rough pose, so that the window contains it
    unsure: float = 0.3  # deviation of an edge due to noise above which a window shows no edge; 0.5 without one
    inconsistent: float = 12.0  # sum of the squares of shifts over their deviations above which the edges disagree
    iterations: int = 20  # largest number of Gauss-Newton steps
    settled: float = 0.2  # step in standard deviations of the result below which a fit ends


@dataclass(frozen=True, eq=False)
class PhotometricPose:
    """Fitted poses of B frames, with the misfit and shift of each of the N edges.

    Attributes:
        tip: [B, 3], in metres; NaN where the fit has not converged.
        direction: [B, 3], unit vectors from the tip to the rear; NaN as well.
        covariance: [B, 6, 6] of tip and direction.
        blur: [B] standard deviation of the point spread, in pixels.
        misfit: [B, N] mean squared residual of each edge's window in squared levels.
        shift: [B, N] of each edge along the tube relative to the fitted pose, in metres.
        shift_sd: [B, N] standard deviation of this shift, if the pose were not fitted to this edge.
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

    def poses(self) -> list[Pose]:
        """Each as a :class:`Pose`: UNVERIFIED from three edges, and refused as INCONSISTENT where it is NaN."""
        freedom = (self.used.sum(-1) - 3).clamp(min=0).double()
        chi_square = torch.where(self.used, self.shift / self.shift_sd, 0.0).square().sum(-1)
        poses = []
        for i, converged in enumerate(self.tip.detach().isfinite().all(-1).tolist()):
            if not converged:
                poses.append(Pose.refused(Status.INCONSISTENT, "the pixels around the edges do not confirm the pose"))
                continue
            status, reason = (Status.OK, "") if freedom[i] > 0 else (Status.UNVERIFIED, THREE_EDGES)
            tip, direction, covariance = self.tip[i], self.direction[i], self.covariance[i]
            poses.append(Pose(tip, direction, covariance, chi_square[i], freedom[i], status, reason))
        return poses

    @staticmethod
    def lost(tip: Tensor, edges: int) -> "PhotometricPose":
        """Poses that are NaN, as many as ``tip`` [B, 3] and on its device, with ``edges`` edges each."""
        shapes = ((3,), (3,), (6, 6), (), (edges,), (edges,), (edges,))
        values = [tip.new_full((len(tip), *shape), torch.nan) for shape in shapes]
        values.append(torch.zeros(len(tip), edges, dtype=torch.bool, device=tip.device))
        return PhotometricPose(*values)

    def scattered(self, where: Tensor) -> "PhotometricPose":
        """These poses at the items of a batch at which ``where`` [B] is true; NaN, or False, at the others."""

        def spread(value: Tensor) -> Tensor:
            empty = torch.nan if value.is_floating_point() else False
            return value.new_full((len(where), *value.shape[1:]), empty).index_put((where,), value)

        return PhotometricPose(*(spread(getattr(self, field.name)) for field in fields(self)))


@dataclass(frozen=True, eq=False)
class _Linear:
    """Fit of the linear unknowns of B x N windows with C independent channels of P samples and K unknowns each.

    Attributes:
        design: [B, N, K, P].
        weight, residual: [B, N, C, P].
        factor: [B, N, C, K, K] Cholesky factor of the normal matrix.
        colours: [B, N, 3, K].
        mixes: [B, N, 3, 3, P] derivatives of the samples of one channel by red, green and blue light, or None.
        misfit: [B, N] mean squared residual in squared levels.
        grain: [B, N] texture behind the tube relative to the step of light at the edge.
        loss: [B] negative log-likelihood, up to a constant.
    """

    design: Tensor
    weight: Tensor
    residual: Tensor
    factor: Tensor
    colours: Tensor
    mixes: Tensor | None
    misfit: Tensor
    grain: Tensor
    loss: Tensor


@dataclass(frozen=True, eq=False)
class _Equations(Items):
    """Normal equations of B fits of D + 2 N unknowns, of which the last are two for each of N windows.

    Attributes:
        normal, right: [B, D + 2 N, D + 2 N] and [B, D + 2 N].
        information: [B, N] of the shift of each edge along the tube.
        floor: [B, N, 2] prior standard deviations of each window's shifts along and across, in metres.
        used, seen: [B, N] whether the window counts, and whether it shows an edge.
        misfit, loss: As in :class:`_Linear`.
    """

    normal: Tensor
    right: Tensor
    information: Tensor
    floor: Tensor
    used: Tensor
    seen: Tensor
    misfit: Tensor
    loss: Tensor


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fits of B frames: unknowns relative to ``frame``, whether they have converged, equations of the last step."""

    frame: Frame
    unknown: Tensor
    converged: Tensor
    state: _Equations

    def take(self, index: Tensor) -> "_Fit":
        return _Fit(self.frame.take(index), self.unknown[index], self.converged[index], self.state.take(index))


class PhotometricFit(nn.Module):
    """Refines poses by fitting the light of the pixels around each band edge.

    Each pixel is modelled as the light of a cylinder with two bands, blurred by a Gaussian, in front of two
    backgrounds. Position, direction and blur are found by Gauss-Newton steps with an analytic Jacobian; all colours and
    the shading across the tube are linear and are eliminated in each step (variable projection). The cylinder is exact
    in the space of rays, so that the rings' curvature and the lens's distortion need no correction, and pixels are used
    as they are, without interpolation. Each window may shift by errors that noise does not explain.

    The noise is estimated from the residuals for each channel, separately for the tube and the background, with
    correlations of neighbouring pixels. Where chroma has a lower resolution than luma (4:2:0 video, JPEG), luma
    is fitted. Where different blurs along and across the tube fit better, a uniform motion during the exposure is
    tried. A rolling shutter cannot be distinguished from another pose: state ``readout`` in the plan.

    The result is differentiable with respect to the frames, the camera and the catheter, by the implicit function
    theorem at the optimum. Only first derivatives are those of the optimum.

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
        """Fit poses near those given.

        Poses are NaN where fewer than three windows are on the frame or show an edge, where the fit does not converge
        or ends far from the given pose, and where the edges disagree.

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
            if not bool(usable.any()):
                return PhotometricPose.lost(tip, len(self.positions))
            if not bool(usable.all()):
                return self(frames[usable], tip[usable], direction[usable]).scattered(usable)
            start = Frame.of(tip + self._middle() * direction, direction)
            groups = self._fits(start, windows, self._coarse(frames, pixels))
        trainable = (frames, self.camera.matrix, self.camera.distortion, self.positions, self.radius)
        implicit = torch.is_grad_enabled() and any(one.requires_grad for one in trainable)
        if implicit:
            windows = self._windows(frames, pixels, tip, direction)
        poses = []
        for where, fit, coarse in groups:
            unknown, state = fit.unknown, fit.state
            if implicit:
                own = windows.take(where)
                unknown = self._implicit(fit.frame, unknown, own, coarse)
                state = self._equations(fit.frame, unknown, own, coarse)
            known = fit.converged & self._within(fit.frame, start.take(where))
            poses.append(self._answer(fit.frame, unknown, state, known, frames.shape[-2]))
        order = torch.cat([where for where, _, _ in groups]).argsort()
        return _joined(poses, order)

    def _middle(self) -> Tensor:
        return (self.positions[0] + self.positions[-1]) / 2

    def _fits(self, start: Frame, windows: Windows, coarse: Tensor) -> list[tuple[Tensor, _Fit, bool]]:
        """Fits in groups with the same model: items of the batch, fits, and whether their chroma is coarse."""
        plan = self.plan
        unknown = start.middle.new_zeros(len(start.middle), SHARED + 2 * len(self.positions))
        unknown[:, 5] = math.log(plan.blur)
        fit = self._settled(start, unknown, windows)
        blurred = ~coarse & (self._stretched(fit, windows) | (fit.unknown[:, 5] > math.log(plan.wide)))
        where = blurred.nonzero()[:, 0]
        groups, moves = [], torch.zeros_like(coarse)
        if len(where):
            moving, own = self._moving(fit.take(where), windows.take(where)), windows.take(where)
            better = (moving.state.loss < fit.state.loss[where] - plan.motion_gain) & ~self._smeared(moving, own)
            moves = moves.index_put((where,), better)
            groups.append((where[better], moving.take(better), False))
        coarse = coarse | (~moves & self._smeared(fit, windows))
        still = (~moves & ~coarse).nonzero()[:, 0]
        groups.append((still, fit.take(still), False))
        where = coarse.nonzero()[:, 0]
        if len(where):
            rough = fit.take(where)
            groups.append((where, self._settled(rough.frame, rough.unknown, windows.take(where), coarse=True), True))
        return [group for group in groups if len(group[0])]

    def _moving(self, fit: _Fit, windows: Windows) -> _Fit:
        """The best fits with a motion during the exposure, from two starts: along either diagonal of tube and width."""
        count, unknown = len(fit.unknown), fit.unknown
        # The variance of a uniform motion is a twelfth of its square; it has two components of the same length.
        length = (6 * (unknown[:, 5:6].exp() ** 2 - self.plan.blur**2)).clamp(min=0.5).sqrt()
        sharp = torch.full_like(length, math.log(self.plan.blur))
        starts = [
            torch.cat([unknown[:, :5], sharp, unknown[:, 6:7], sign * length, length, unknown[:, 7:]], 1)
            for sign in (1.0, -1.0)
        ]
        twice = torch.arange(count, device=unknown.device).repeat(2)
        both = self._settled(fit.frame.take(twice), torch.cat(starts), windows.take(twice))
        best = both.state.loss.nan_to_num(torch.inf).unflatten(0, (2, count)).argmin(0)
        return both.take(best * count + twice[:count])

    def _stretched(self, fit: _Fit, windows: Windows) -> Tensor:
        """[B] whether different blurs along and across the tube fit better: a motion during the exposure."""
        count, twice = len(fit.unknown), torch.arange(len(fit.unknown), device=fit.unknown.device).repeat(2)
        stretch = fit.unknown.new_full((2 * count, 1, 1), self.plan.stretch)
        stretch[count:] = 1 / self.plan.stretch
        windows = windows.take(twice)
        _, tube = self._model(fit.frame.take(twice), fit.unknown[twice], windows, stretch)
        losses = self._linear(tube, windows, False).loss.unflatten(0, (2, count))
        return losses.amin(0) < fit.state.loss - self.plan.stretch_gain

    def _smeared(self, fit: _Fit, windows: Windows) -> Tensor:
        """[B] whether chroma fits worse than luma near the edges between bands: JPEG at half resolution of chroma."""
        place, tube = self._model(fit.frame, fit.unknown, windows)
        fitted = (windows.light - self._linear(tube, windows, False).residual).clamp(*_LIGHT)
        levels = self.camera.levels(windows.light) - self.camera.levels(fitted)
        square = torch.einsum("ec,bncp->bnep", levels.new_tensor(_CODES), levels).square()
        near = tube.beyond.abs() * place.sine < 2.5 * place.pixels
        weight = windows.mask * (1 - tube.texture) * near
        luma, blue, red = (square * weight[:, :, None])[:, 1:-1].sum((1, 3)).unbind(-1)
        return (blue + red) / 2 > self.plan.smeared * luma

    def _model(
        self, frame: Frame, unknown: Tensor, windows: Windows, stretch: Tensor | None = None
    ) -> tuple[TubeGeometry, TubeLight]:
        """Geometry and light of the tube; ``stretch`` [B, 1, 1] is the ratio of the blurs along the tube and across."""
        plan = self.plan
        place = TubeGeometry.of(frame, unknown, windows)
        if stretch is not None:
            place = replace(place, blur=place.blur / stretch.sqrt(), sine=place.sine / stretch)
        edge = self.positions - self._middle()
        width = float((2 * self.radius / place.scale[..., 1]).detach().nan_to_num(0.0).max())
        nodes = math.ceil(plan.density * min(max(width, 5.0), 2.0 * plan.widest))
        light = TubeLight.of(
            place, unknown, self.radius, edge, nodes=nodes, times=plan.times, degree=plan.degree, clear=plan.clear
        )
        return place, light

    def _within(self, frame: Frame, start: Frame) -> Tensor:
        """[B] whether no edge is farther than ``reach`` from its position in the rough pose."""
        edges = (self.positions - self._middle())[:, None].detach()
        before, after = (self.camera.project(one.middle[:, None] + edges * one.axis[:, None]) for one in (start, frame))
        return ~((after - before).norm(dim=-1) > self.plan.reach).any(-1)

    def _freedom(self, windows: Windows) -> Tensor:
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

    def _windows(self, frames: Tensor, pixels: Tensor, tip: Tensor, direction: Tensor) -> Windows:
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
        # An edge is used if its surroundings are on the frame. Saturated pixels are not used.
        clear = (levels < _WHITE).all(2)
        x, y = pixels[:, :, pixels.shape[2] // 2].unbind(-1)
        margin = torch.minimum(torch.minimum(x, width - 1 - x), torch.minimum(y, height - 1 - y))
        within = (margin >= self.plan.margin)[..., None]
        return Windows(rays.mT.contiguous(), angle, light, (inside & near & clear & within).double())

    def _coarse(self, frames: Tensor, pixels: Tensor) -> Tensor:
        """[B] whether red minus luma has less fine detail than luma around an edge: chroma at half resolution.

        With independent noise in each channel, red minus luma has 1.4 times as much; grey texture adds to luma alone.
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

    def _settled(self, frame: Frame, unknown: Tensor, windows: Windows, *, coarse: bool = False) -> _Fit:
        """Fits after Gauss-Newton steps. Position and direction are always 0 in the returned unknowns."""
        plan = self.plan
        converged = torch.zeros(len(unknown), dtype=torch.bool, device=unknown.device)
        states: _Equations | None = None
        half = self.positions[-1] - self._middle()
        for step in range(plan.iterations):
            active = (~converged).nonzero()[:, 0]
            here, own = frame.take(active), windows.take(active)
            state = self._equations(here, unknown[active], own, coarse, blur=step >= 1)
            damping = 1e-3 if step == 0 else 1e-9
            scale = state.normal.diagonal(dim1=-2, dim2=-1).clamp(min=1e-30).rsqrt()
            scaled = state.normal * scale[:, None] * scale[..., None]
            scaled = scaled + damping * torch.eye(scaled.shape[-1]).to(scaled)
            move = scale * torch.linalg.solve_ex(scaled, scale * state.right)[0]
            gain = (move * state.right).sum(-1)
            # Changes that move the edges by about a pixel: shifts to side, axis and sight, turns to side and front.
            depth = here.middle.norm(dim=-1)
            one = torch.ones_like(depth)
            unit = torch.stack([one, one, depth / half, one / half, depth / half**2], -1)
            unit = unit * (depth * own.angle.mean((1, 2)))[:, None]
            length = (move[:, :5] / unit).abs().amax(-1, keepdim=True)
            move = move * (plan.step / length.clamp(min=1e-30)).clamp(max=1.0)
            moved, rest = here.moved(unknown[active] + move)
            frame, unknown = frame.put(active, moved), unknown.index_put((active,), rest)
            states = state if states is None else states.put(active, state)
            if step >= 1:
                converged = converged.index_put((active,), gain < plan.settled**2)
                if bool(converged.all()):
                    break
        assert states is not None
        return _Fit(frame, unknown, converged, states)

    def _implicit(self, frame: Frame, unknown: Tensor, windows: Windows, coarse: bool) -> Tensor:
        """``unknown`` at the optimum, with its derivative by the pixels, the camera and the catheter."""
        unknown = unknown.detach().requires_grad_()
        right = self._equations(frame, unknown, windows, coarse).right
        rows = [torch.autograd.grad(one.sum(), unknown, retain_graph=True)[0] for one in right.unbind(-1)]
        slope = torch.stack(rows, 1).detach()
        right = self._equations(frame, unknown.detach(), windows, coarse).right
        return unknown.detach() - torch.linalg.solve_ex(slope, right)[0]

    def _equations(
        self, frame: Frame, unknown: Tensor, windows: Windows, coarse: bool, blur: bool = True
    ) -> _Equations:
        """Equations of a Gauss-Newton step at ``unknown`` [B, D + 2 N].

        The unknowns are shifts along side, axis and sight in metres, turns towards side and front in radians, the
        logarithms of the blur and of the radius and, with D = 9, the motion during the exposure along and across the
        tube in pixels; and the shifts of each window's edge along and of its axis across, in metres.
        """
        plan, count = self.plan, len(self.positions)
        size = unknown.shape[1] - 2 * count
        place, tube = self._model(frame, unknown, windows)
        fit = self._linear(tube, windows, coarse)
        changes = tube.changes(place, fit.colours, still=size == SHARED)  # [B, N, 3, D + 2, P]
        if fit.mixes is not None:
            changes = torch.einsum("bnecp,bncdp->bndep", fit.mixes, changes).flatten(-2)[:, :, None]
        weighted = changes * fit.weight[..., None, :]
        projected = (weighted.flatten(2, 3) @ fit.design.mT).unflatten(2, changes.shape[2:4]).mT  # [B, N, C, K, D + 2]
        solved = torch.linalg.solve_triangular(fit.factor, projected, upper=False)
        blocks = (weighted @ changes.mT - solved.mT @ solved).sum(2)
        sides = (weighted @ fit.residual[..., None])[..., 0].sum(2)
        used = self._freedom(windows) > 0
        # Residuals of neighbouring pixels that agree in sign leave more error than the same number of independent ones.
        known = torch.linalg.solve_triangular(fit.factor.mT, solved[..., -2:], upper=True)
        score = changes[..., -2:, :] - (known.mT.flatten(2, 3) @ fit.design).unflatten(2, (-1, 2))
        score = (score * (fit.weight * fit.residual)[..., None, :]).sum(2)  # [B, N, 2, P]
        if coarse:
            score = score.unflatten(-1, (3, -1)).sum(-2)
        trust = used / _correlation(score, 2 * plan.along + 1)
        blocks, sides = blocks * trust[..., None, None], sides * trust[..., None]
        floor = self._floor(place, unknown, fit.grain, coarse)
        normal, right = _assembled(blocks, sides)
        prior, start = torch.zeros_like(unknown), torch.zeros_like(unknown)
        prior[:, 5], start[:, 5] = plan.blur_spread**-2, math.log(plan.blur)
        prior[:, 6] = plan.radius_spread**-2
        prior = torch.cat([prior[:, :size], floor.flatten(1) ** -2], 1)
        normal = normal + torch.diag_embed(prior)
        right = right - prior * (unknown - start)
        if not blur:
            keep = torch.ones_like(unknown[0])
            keep[5] = keep[SHARED:size] = 0
            normal, right = normal * keep * keep[:, None] + torch.diag(1 - keep), right * keep
        information = blocks[..., -2, -2]
        seen = information.sqrt() * place.scale[..., 0] * plan.unsure > 1
        return _Equations(normal, right, information, floor, used, seen, fit.misfit, fit.loss)

    def _linear(self, tube: TubeLight, windows: Windows, coarse: bool) -> _Linear:
        """Fit of the linear unknowns: first with equal weights, then with weights from the residuals."""
        plan, mask, basis = self.plan, windows.mask, tube.basis
        equal, texture = (value.repeat(1, 1, 3) if coarse else value for value in (mask, tube.texture))
        design, data, mixes = basis, windows.light, None
        colours = _least_squares(design, data, mask[:, :, None])[0]  # [B, N, 3, K]
        for _ in range(2 * coarse):
            design, data, mixes = self._codes(basis, windows.light, colours)
            colours = _least_squares(design, data, equal[:, :, None])[0].unflatten(-1, (3, -1))[:, :, 0]
        fitted = colours.flatten(2)[:, :, None] @ design if coarse else colours @ design
        square = (data - fitted).square()
        # Variance of the noise, up to a factor, and light per level; both 1 where the samples are levels.
        noise, tone = torch.ones_like(fitted), torch.ones_like(fitted[..., 0])
        if not coarse:
            noise = fitted.clamp(min=0) + plan.dark
            mean = (fitted * mask[:, :, None]).sum(-1) / mask.sum(-1, keepdim=True).clamp(min=1)
            level = self.camera.levels(mean.clamp(*_LIGHT))
            tone = self.camera.linear(level + 0.5) - self.camera.linear(level - 0.5)
        parts = (equal * (1 - texture))[:, :, None], (equal * texture)[:, :, None]  # the tube, and what is behind it
        amounts = [part.sum(-1).clamp(min=1) for part in parts]
        freedom = (mask.sum(-1) / (mask.sum(-1) - basis.shape[2]).clamp(min=1))[..., None]
        relative, rounding = square / noise, _ROUNDING * tone**2 / noise.mean(-1)
        own, other = (
            freedom * (part * relative).sum(-1) / amount + rounding for part, amount in zip(parts, amounts, strict=True)
        )
        ratio = (other / own).log().mean(-1)[..., None, None].exp()
        variance = own[..., None] * noise * (1 - texture + texture * ratio.squeeze(-1))[:, :, None]
        step = (colours[..., plan.degree + 1] - colours[..., 0]).square().sum(-1)
        tube_square, grain = (
            ((part * square).sum(-1) / amount).sum(-1) for part, amount in zip(parts, amounts, strict=True)
        )
        grain = ((grain - tube_square).clamp(min=0) / step.clamp(min=1e-9)).clamp(1e-12, 100.0).sqrt()
        weight = equal[:, :, None] / variance
        solution, factor = _least_squares(design, data, weight)
        residual = data - solution @ design
        colours = solution[:, :, 0].unflatten(-1, (3, -1)) if coarse else solution
        loss = 0.5 * (equal[:, :, None] * variance.log()).sum((1, 2, 3))
        misfit = ((equal[:, :, None] * square).sum(-1) / equal.sum(-1, keepdim=True).clamp(min=1) / tone**2).mean(-1)
        return _Linear(design, weight, residual, factor, colours, mixes, misfit, grain, loss)

    def _codes(self, basis: Tensor, light: Tensor, colours: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Design [B, N, 3 K, 3 P] and data [B, N, 1, 3 P] of luma and chroma, and their derivatives [B, N, 3, 3, P].

        Luma and chroma are sums of levels, which are linearised at the light that ``colours`` [B, N, 3, K] give.
        """
        camera = self.camera
        fitted = colours @ basis
        level = camera.levels(fitted.clamp(*_LIGHT))
        slope = 1 / (camera.linear(level + 0.5) - camera.linear(level - 0.5))
        mix = basis.new_tensor(_CODES) * basis.new_tensor([[1.0], [self.plan.chroma], [self.plan.chroma]])
        mixes = mix[:, :, None] * slope[:, :, None]  # [B, N, e, c, P]
        data = (mixes * fitted[:, :, None]).sum(3) + mix @ (camera.levels(light) - level)
        design = torch.einsum("bnecp,bnkp->bnckep", mixes, basis).flatten(4).flatten(2, 3)
        return design, data.flatten(2)[:, :, None], mixes

    def _floor(self, place: TubeGeometry, unknown: Tensor, grain: Tensor, coarse: bool) -> Tensor:
        """Standard deviations [B, N, 2], in metres along and across the tube, of errors that noise does not explain."""
        plan, count = self.plan, len(self.positions)
        outer = torch.tensor([n in (0, count - 1) for n in range(count)], device=unknown.device)
        texture = torch.zeros_like(grain) if coarse else (plan.grain_floor * grain).square()
        along = torch.where(outer, plan.outer_floor**2 + texture, plan.edge_floor**2)
        across = torch.full_like(along, plan.axis_floor**2)
        more = (plan.blur_floor * (unknown[:, 5:6].exp() - plan.blur).clamp(min=0)).square()
        along, across = along + more, across + 9 * more
        if unknown.shape[1] > SHARED + 2 * count:
            more = (plan.motion_floor * unknown[:, 7:9]).square().sum(-1, keepdim=True)
            along, across = along + more, across + more
        if coarse:
            along, across = along + plan.coarse_floor**2, across + plan.coarse_floor**2
        return place.scale * torch.stack([along, across], -1).sqrt()

    def _answer(
        self, frame: Frame, unknown: Tensor, state: _Equations, converged: Tensor, height: int
    ) -> PhotometricPose:
        """Poses; NaN for those that have not converged or whose edges disagree."""
        moved, rest = frame.moved(unknown)
        middle = self._middle()
        tip, direction = moved.middle - middle * moved.axis, moved.axis
        zero = torch.zeros_like(frame.side)
        more = [zero] * (unknown.shape[1] - 5)
        rows = (frame.side, frame.axis, frame.sight, -middle * frame.side, -middle * frame.front, *more)
        turns = (zero, zero, zero, frame.side, frame.front, *more)
        lever = torch.cat([torch.stack(rows, -1), torch.stack(turns, -1)], 1)
        covariance = lever @ torch.linalg.inv_ex(state.normal)[0] @ lever.mT
        if self.plan.readout:
            more = (self.positions, height, self.plan.readout)
            covariance = covariance + readout_covariance(self.camera, tip, direction, *more)
        shift = unknown[:, -2 * len(self.positions) :: 2]
        deviation = (1 / state.information.clamp(min=1e-30) + state.floor[..., 0] ** 2).sqrt()
        converged = converged & (state.seen.sum(-1) >= 3)
        converged = converged & ((shift / deviation).square().sum(-1) < self.plan.inconsistent)
        lost = torch.where(converged, 0.0, torch.nan)[:, None]
        pose = (tip + lost, direction + lost, covariance + lost[..., None])
        return PhotometricPose(*pose, rest[:, 5].exp(), state.misfit, shift, deviation, state.used)


_LIGHT = (2e-3, 0.98)  # light between which a tone curve is not clipped
_ROUNDING = 1 / 12  # levels^2: the noise of rounding to whole levels
_CODES = ((0.299, 0.587, 0.114), (-0.169, -0.331, 0.5), (0.5, -0.419, -0.081))  # Y, Cb, Cr of levels (ITU-R BT.601)
_WHITE = 254.0  # level from which a pixel may be saturated
_PATCH = 24  # side in pixels of the patches in which the resolution of chroma is estimated


def _assembled(blocks: Tensor, sides: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations of all unknowns: those that all windows share, and then two of each window."""
    batch, count, size, _ = blocks.shape
    shared = size - 2
    select = blocks.new_zeros(count, size, shared + 2 * count)
    select[:, range(shared), range(shared)] = 1
    for n in range(count):
        select[n, [-2, -1], [shared + 2 * n, shared + 2 * n + 1]] = 1
    normal = (select.mT @ blocks @ select).sum(1)
    return normal, (sides[:, :, None] @ select)[:, :, 0].sum(1)


def _least_squares(design: Tensor, data: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients [B, N, C, K] of ``data`` [B, N, C, P], and Cholesky factor [B, N, C or 1, K, K].

    ``design`` is [B, N, K, P] and ``weight`` [B, N, C or 1, P].
    """
    heavy = design[:, :, None] * weight[..., None, :]
    gram = (heavy.flatten(2, 3) @ design.mT).unflatten(2, heavy.shape[2:4])
    ridge = 1e-7 * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] + 1e-12
    gram = gram + ridge * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    factor, _ = torch.linalg.cholesky_ex(gram)  # NaN instead of an error where a fit has diverged
    if heavy.shape[2] == 1:
        return torch.cholesky_solve(heavy[:, :, 0] @ data.mT, factor[:, :, 0]).mT, factor
    right = ((weight * data) @ design.mT)[..., None]
    return torch.cholesky_solve(right, factor)[..., 0], factor


def _correlation(score: Tensor, rows: int) -> Tensor:
    """Variance of the sum of scores [B, N, 2, P] relative to that of independent ones, [B, N], at least 1.

    Source: Newey and West (1987), with squares of 5 x 5 pixels, which is a triangular weight of lags up to 4.
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


def _joined(poses: list[PhotometricPose], order: Tensor) -> PhotometricPose:
    """Poses of groups of items in one batch, in another ``order``."""
    names = [field.name for field in fields(PhotometricPose)]
    return PhotometricPose(*(torch.cat([getattr(pose, name) for pose in poses])[order] for name in names))


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
