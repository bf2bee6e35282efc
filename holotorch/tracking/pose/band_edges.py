"""Positions of a catheter's band edges from many frames, by a joint fit of poses and positions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.alignment import SAME_DIRECTION, widest_angle
from holotorch.tracking.pose.pose import edge_weights, solve_pose, tangent_basis, tilted

_FEWEST = 5  # least number of frames
_State = tuple[Tensor, Tensor, Tensor]  # tips [F, 3], directions [F, 3], positions of the edges [N]


@dataclass(frozen=True, eq=False)
class BandEdges:
    """Measured positions of the band edges.

    Attributes:
        positions: float64 [N] in metres from the tip.
        covariance: [N, N] in m^2, zero for known distances; multiplied by chi_square / freedom if above 1. It
            includes no errors that are the same in all frames, such as the shift of an edge by a highlight.
        chi_square: Sum of the squared residuals, each divided by its variance.
        freedom: Degrees of freedom of ``chi_square``.
        pivot: [3] position of a resting tip in the camera's frame; None where the tip moved.
    """

    positions: Tensor
    covariance: Tensor
    chi_square: float
    freedom: int
    pivot: Tensor | None

    @property
    def deviations(self) -> Tensor:
        """Standard deviation of each position in metres, [N]."""
        return self.covariance.diagonal().clamp(min=0).sqrt()


def fit_band_edges(
    edges_px: Tensor,
    positions_m: Tensor,
    camera: Camera,
    known: Sequence[int | tuple[int, int]],
    *,
    resting_tip: bool = False,
    along_px: float = 0.1,
    across_px: float = 0.1,
    offset: float = 0.0,
) -> BandEdges:
    """Fit the positions of the edges together with the pose of every frame.

    Frames of a freely moving straight tool determine the positions s only up to a shift, a scale and a projective
    stretch s -> s / (1 + e s), so that three independent distances must be known, whatever the number of frames. If the
    catheter is tilted about a resting tip, one known distance suffices.

    Args:
        edges_px: [F, N, 2] pixels (x, y) of the edges in F >= 5 frames, all visible.
        positions_m: [N] nominal distances from the tip in metres, increasing.
        camera: Camera that took the frames.
        known: Nominal distances that are exact: i for edge i and the tip, (i, j) for two edges.
        resting_tip: Whether the tip was in the same place in all frames.
        along_px: Standard deviation of an edge along the tool's image, in pixels.
        across_px: Standard deviation of an edge across the tool's image, in pixels.
        offset: Distance of the edges from the axis towards the camera, in metres.

    Raises:
        TypeError, ValueError: Wrong shapes or types, too few known distances, fewer than 5 frames, parallel directions,
            or positions with a deviation above 0.5 mm. The message says what to do.

    Source: bundle adjustment (Triggs et al. 2000), with the poses eliminated by the Schur complement.
    """
    pixels, start = _checked(edges_px, positions_m)
    free = _constraints(known, start, resting_tip)
    poses = solve_pose(pixels, start, camera, along_px=along_px, across_px=across_px, offset=offset)
    lost = [i for i, tip in enumerate(poses.tip) if not bool(torch.isfinite(tip).all())]
    if lost:
        raise ValueError(f"no pose found in the frames {lost[:10]}: leave them out, or correct the nominal positions")
    if (spread := widest_angle(poses.direction)) < SAME_DIRECTION:
        raise ValueError(
            f"the catheter is parallel to itself within {math.degrees(spread):.1f} degrees in all frames, so that "
            "every frame has the same faults; tilt it towards the camera and away from it by 20 to 45 degrees"
        )
    plane = camera.undistort(pixels).detach()
    visible = torch.ones_like(plane[..., 0], dtype=torch.bool)
    deviations = plane.new_tensor([along_px, across_px]).expand_as(plane)
    weights = edge_weights(pixels, plane, visible, deviations, camera).detach()
    problem = _Problem(plane, weights, free, resting_tip, offset)
    tip = poses.tip.mean(0).expand_as(poses.tip) if resting_tip else poses.tip
    state, chi_square, information = problem.solve((tip.detach(), poses.direction.detach(), start))
    freedom = 2 * plane.shape[0] * plane.shape[1] - problem.unknowns
    size = information.diagonal().clamp(min=1e-300).rsqrt()
    factor, failed = torch.linalg.cholesky_ex(size[:, None] * information * size)
    shared = torch.cholesky_inverse(factor) * size[:, None] * size
    covariance = free @ shared[: free.shape[1], : free.shape[1]] @ free.mT * max(1.0, chi_square / max(freedom, 1))
    deviations = covariance.diagonal().clamp(min=0).sqrt()
    if bool(failed) or not bool((deviations <= 5e-4).all()):  # half a millimetre: a ruler is more accurate
        worst = "" if bool(failed) else f" (edge {int(deviations.argmax())} to {1e3 * float(deviations.max()):.1f} mm)"
        raise ValueError(
            f"the frames do not determine the positions{worst}: take more of them, nearer to the camera, tilted toward "
            "it and away from it by 20 to 45 degrees"
        )
    tip, _, positions = state
    return BandEdges(positions, covariance, chi_square, freedom, tip[0] if resting_tip else None)


class _Problem:
    """Least squares over F frames, each with 2 unknowns for the direction and 3 for a tip that moves (``per_frame``).

    The other m unknowns, the free positions and a resting tip, are the same in all frames (``shared``).
    """

    def __init__(self, plane: Tensor, weights: Tensor, free: Tensor, resting: bool, offset: float):
        self.plane, self.weights, self.free = plane, weights, free
        self.resting, self.offset = resting, offset
        self.per_frame = 2 if resting else 5
        self.shared = free.shape[1] + (3 if resting else 0)
        self.unknowns = len(plane) * self.per_frame + self.shared

    def residuals(self, state: _State) -> Tensor:
        """Residuals [F, 2 N] in standard deviations."""
        tip, along, positions = state
        forward = (tip * along).sum(-1, keepdim=True)
        toward = torch.nn.functional.normalize(forward * along - tip, dim=-1)  # from the axis to the camera
        points = (tip + self.offset * toward)[:, None] + positions[..., None] * along[:, None]
        errors = points[..., :2] / points[..., 2:] - self.plane
        return (self.weights @ errors[..., None])[..., 0].flatten(1)

    def step(self, state: _State, per_frame: Tensor, shared: Tensor) -> _State:
        """The state after steps ``per_frame`` [F, 2 or 5] and ``shared`` [..., m] of the unknowns."""
        tip, along, positions = state
        count = self.free.shape[1]
        positions = positions + shared[..., :count] @ self.free.mT
        tip = tip + (shared[..., count:] if self.resting else per_frame[:, 2:])
        return tip, tilted(along, tangent_basis(along), per_frame[:, :2]), positions

    def jacobians(self, state: _State) -> tuple[Tensor, Tensor]:
        """Derivatives [F, 2 N, 2 or 5] and [F, 2 N, m] of the residuals by the unknowns."""
        frames = len(self.plane)

        def stepped(step: Tensor) -> Tensor:
            per_frame, shared = step[: self.per_frame].expand(frames, -1), step[self.per_frame :].expand(frames, -1)
            return self.residuals(self.step(state, per_frame, shared))

        both = torch.func.jacfwd(stepped)(self.plane.new_zeros(self.per_frame + self.shared))
        return both[..., : self.per_frame], both[..., self.per_frame :]

    def solve(self, state: _State) -> tuple[_State, float, Tensor]:
        """Levenberg-Marquardt: the state, its chi-square, and the information [m, m] on the shared unknowns."""
        damping, cost = 1e-6, float(self.residuals(state).square().sum())
        per_frame, shared = self.jacobians(state)
        for _ in range(60):
            residuals = self.residuals(state)[..., None]
            # The blocks of the normal equations, damped, and the Schur complement of the block of each frame.
            block, mixed = per_frame.mT @ per_frame, per_frame.mT @ shared
            block = block + damping * torch.diag_embed(block.diagonal(dim1=-2, dim2=-1))
            total = (shared.mT @ shared).sum(0)
            total = total + damping * torch.diag(total.diagonal())
            solved = torch.linalg.solve(block, torch.cat([mixed, per_frame.mT @ residuals], -1))
            complement = total - (mixed.mT @ solved[..., :-1]).sum(0)
            gradient = (shared.mT @ residuals).sum(0) - (mixed.mT @ solved[..., -1:]).sum(0)
            shared_step = -torch.linalg.lstsq(complement, gradient, driver="gelsd").solution
            frame_step = -(solved[..., -1:] + solved[..., :-1] @ shared_step)
            trial = self.step(state, frame_step[..., 0], shared_step[:, 0])
            trial_cost = float(self.residuals(trial).square().sum())
            if not trial_cost <= cost or bool((trial[0][:, 2] <= 0).any()):
                damping = max(10 * damping, 1e-9)
                if damping > 1e6:
                    break
                continue
            converged = cost - trial_cost <= 1e-12 * (1 + trial_cost)
            state, cost, damping = trial, trial_cost, damping / 10
            per_frame, shared = self.jacobians(state)
            if converged:
                break
        block, mixed = per_frame.mT @ per_frame, per_frame.mT @ shared
        return state, cost, (shared.mT @ shared - mixed.mT @ torch.linalg.solve(block, mixed)).sum(0)


def _checked(edges_px: Tensor, positions_m: Tensor) -> tuple[Tensor, Tensor]:
    checks.real("edges_px", edges_px)
    if edges_px.ndim != 3 or edges_px.shape[2] != 2 or edges_px.shape[1] < 3:
        raise ValueError(f"edges_px must be of shape [F, N, 2] with N >= 3 edges, got {list(edges_px.shape)}")
    checks.all_finite("edges_px", edges_px)
    positions = torch.as_tensor(positions_m).to(edges_px.device, torch.float64)
    if positions.shape != edges_px.shape[1:2]:
        raise ValueError(f"positions_m must be of shape [{edges_px.shape[1]}], got {list(positions.shape)}")
    checks.all_finite("positions_m", positions)
    if not bool((positions.diff() > 0).all()):
        raise ValueError(f"positions_m must rise, got {positions.tolist()}")
    if len(edges_px) < _FEWEST:
        raise ValueError(f"at least {_FEWEST} frames are needed, in different poses, got {len(edges_px)}")
    return edges_px.detach().to(torch.float64), positions.detach()


def _constraints(known: Sequence[int | tuple[int, int]], positions: Tensor, resting: bool) -> Tensor:
    """Basis [N, n] of the changes of the positions that keep the known distances."""
    count = len(positions)
    rows = positions.new_zeros(len(known), count)  # the distances are rows @ positions
    for row, entry in zip(rows, known, strict=True):
        ends = entry if isinstance(entry, tuple) else (entry,)
        fitting = len(ends) in (1, 2) and len(set(ends)) == len(ends)
        if not fitting or not all(isinstance(i, int) and 0 <= i < count for i in ends):
            raise ValueError(f"known must hold edges 0 to {count - 1} or pairs of different ones, got {entry!r}")
        row[ends[-1]] = 1.0
        if len(ends) == 2:
            row[ends[0]] = -1.0
    # Changes of positions s that the images do not determine: 1, s and s^2; for a resting tip only s.
    scaled = (2 * positions - positions[0] - positions[-1]) / (positions[-1] - positions[0])
    moving = torch.stack([torch.ones_like(scaled), scaled, scaled.square()], -1)
    undetermined = positions[:, None] / positions[-1] if resting else moving
    if len(known) == 0 or int(torch.linalg.matrix_rank(rows @ undetermined, rtol=0.02)) < undetermined.shape[1]:
        raise ValueError(
            f"one known distance is needed beside a resting tip, got known={list(known)}"
            if resting
            else "views of a moving tip determine the edges only up to shift, scale and projective stretch: three "
            f"independent distances, one of them from the tip, must be known (a band in the middle of another distance "
            f"adds nothing to it), got known={list(known)}; or let the tip rest in one place, tilt the catheter around "
            "it and say resting_tip=True (--resting)"
        )
    _, values, vectors = torch.linalg.svd(rows)
    rank = int((values > 1e-9).sum())
    if rank == count:
        raise ValueError("all positions are known, so none is left to be fitted; name fewer in known")
    return vectors[rank:].mT
