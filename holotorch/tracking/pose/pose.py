"""Pose of a catheter from the images of its band edges: five unknowns, with covariance and gradients."""

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import EDGE_DEVIATION, TOOL_OFFSET, TOOL_POSITION, Quantity
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.status import Pose, Status

_SAME_POINT = 1e-9  # on the plane z = 1, or in radians: points that are closer to each other count as one point


def solve_pose(
    edges_px: Tensor,
    positions_m: Tensor,
    camera: Camera,
    *,
    along_px: float | Tensor = 0.1,
    across_px: float | Tensor = 0.1,
    seen: Tensor | None = None,
    offset: float | Tensor = 0.0,
) -> Pose:
    """Pose of a straight tool from the images of points at known distances from its tip, such as band edges.

    Levenberg-Marquardt steps from a linear solution (the null vector of ``u_i x (A + s_i d) = 0``) minimise the
    reprojection error in five unknowns. Three visible points determine a pose that nothing verifies; its status is
    UNVERIFIED. The pose is differentiable, twice, with respect to all tensors by the implicit function theorem.

    Args:
        edges_px: [B, N, 2] pixels (x, y) of the points; NaN for a point that is not visible.
        positions_m: [N] distances from the tip in metres, all different, in any order.
        camera: Camera whose distortion is removed from the pixels.
        along_px: Standard deviation of a point along the tool's image, in pixels; a number or [B, N].
        across_px: Standard deviation across the tool's image, like ``along_px``.
        seen: [B, N] bool; False excludes a point.
        offset: Distance of the points from the axis towards the camera, in metres; a number or [B].

    Returns:
        Poses [B] in float64. A pose that cannot be computed is NaN, and its status gives the reason.

    Raises:
        TypeError, ValueError: Wrong shapes or types, fewer than three positions, equal positions, deviations <= 0.

    Source: the problem of Sec. 3.4.2 of the thesis; :func:`closed_form` implements its Eqs. 3.8 to 3.11.
    """
    pixels, positions = _checked(edges_px, positions_m)
    batch, count = pixels.shape[:2]
    plane = camera.undistort(pixels)
    visible = torch.isfinite(pixels.detach()).all(-1)
    if seen is not None:
        seen = torch.as_tensor(seen, device=visible.device)
        if seen.shape != visible.shape or seen.dtype != torch.bool:
            raise ValueError(f"seen must be bool of shape [{batch}, {count}], got {seen.dtype}, {list(seen.shape)}")
        visible = visible & seen
    known = visible & torch.isfinite(plane.detach()).all(-1)
    offset = _expanded("offset", TOOL_OFFSET, offset, pixels, 1)
    along_px = _expanded("along_px", EDGE_DEVIATION, along_px, pixels, 2)
    across_px = _expanded("across_px", EDGE_DEVIATION, across_px, pixels, 2)
    plane, pixels = (torch.where(known[..., None], value, 0.0) for value in (plane, pixels))
    weights = edge_weights(pixels, plane, known, torch.stack([along_px, across_px], -1), camera)
    middle = (positions * known).sum(-1) / known.sum(-1).clamp(min=1)
    edges = plane, positions - middle[:, None], weights, offset
    with torch.no_grad():
        point, along, coincide = _start(*edges[:2], known)
        point, along, converged = _refine(point, along, edges)
        basis = tangent_basis(along)
        _, jacobian = _residuals(point, along, basis, edges)
    if torch.is_grad_enabled() and any(value.requires_grad for value in edges):
        change = _implicit(point, along, basis, edges)
        point, along = point + change[:, :3], tilted(along, basis, change[:, 3:])
    residuals = _residuals(point, along, basis, edges)[0]
    tip = point - middle[:, None] * along
    covariance, singular = _covariance(jacobian, middle, basis)
    statuses = _statuses(visible, known, coincide | singular | ~converged, point)
    refused = torch.tensor([not status.answered for status in statuses], dtype=torch.bool, device=tip.device)
    return Pose(
        torch.where(refused[:, None], torch.nan, tip),
        torch.where(refused[:, None], torch.nan, along),
        torch.where(refused[:, None, None], torch.nan, covariance),
        torch.where(refused, torch.nan, residuals.square().sum(-1)),
        (2 * known.sum(-1) - 5).clamp(min=0).to(tip.dtype),
        statuses,
    )


def closed_form(edges_px: Tensor, positions_m: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pose from the three edges of two neighbouring bands by the sine rule, the method of the thesis.

    ``edges_px`` [B, N, 2] are the pixels (x, y) of N >= 3 edges, ``positions_m`` [N] their distances from the tip in
    metres, increasing. The result is the mean over all triples of neighbours. Raises ValueError for other shapes.

    Returns:
        Tip [B, 3] in metres and direction [B, 3]; NaN where edges coincide or are NaN.

    Source: Eqs. 3.3 to 3.12 of the thesis, except that angles are computed by atan2, bands may have different lengths,
    and no quadratic equation loses digits for a tool parallel to the image. Eq. 3.12 prints |AT| / |AB| inverted.
    """
    pixels, positions = _checked(edges_px, positions_m)
    plane = camera.undistort(pixels)
    rays = torch.nn.functional.normalize(torch.cat([plane, torch.ones_like(plane[..., :1])], -1), dim=-1)
    a, b = rays[:, :-1], rays[:, 1:]
    angles = torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))
    angles = torch.where(angles > _SAME_POINT, angles, torch.nan)
    # All triples of neighbouring edges at once, with axes [B, N - 2].
    p1, p2 = angles[:, :-1], angles[:, 1:]
    first, second = positions[1:-1] - positions[:-2], positions[2:] - positions[1:-1]
    both, length = p1 + p2, first + second
    delta = torch.atan2(
        first * torch.sin(p2) * torch.sin(both), second * torch.sin(p1) - first * torch.sin(p2) * torch.cos(both)
    )
    front = (length * torch.sin(delta) / torch.sin(both))[..., None] * rays[:, :-2]
    rear = (length * torch.sin(both + delta) / torch.sin(both))[..., None] * rays[:, 2:]
    directions = torch.nn.functional.normalize(rear - front, dim=-1)
    tips = front - positions[:-2, None] * directions
    return tips.mean(1), torch.nn.functional.normalize(directions.mean(1), dim=-1)


def _covariance(jacobian: Tensor, middle: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Covariance [B, 6, 6] of tip and direction, and which [B] are singular; ``middle`` [B] is metres from the tip."""
    inverse, singular = torch.linalg.inv_ex(jacobian.mT @ jacobian)
    pose = jacobian.new_zeros(len(jacobian), 6, 5)  # derivatives of tip and direction with respect to the unknowns
    pose[:, :3, :3] = torch.eye(3, dtype=jacobian.dtype)
    pose[:, :3, 3:] = -middle[:, None, None] * basis
    pose[:, 3:, 3:] = basis
    return pose @ inverse @ pose.mT, singular != 0


def _checked(edges_px: Tensor, positions_m: Tensor) -> tuple[Tensor, Tensor]:
    positions = torch.as_tensor(positions_m)
    if edges_px.ndim != 3 or edges_px.shape[-1] != 2 or not edges_px.is_floating_point():
        raise ValueError(f"edges_px must be floating, of shape [B, N, 2], got {edges_px.dtype}, {list(edges_px.shape)}")
    if positions.shape != (edges_px.shape[1],):
        raise ValueError(f"positions_m must be of shape [{edges_px.shape[1]}], got {list(positions.shape)}")
    if len(positions) < 3:
        raise ValueError(f"a pose takes at least three edges, got {len(positions)}")
    checks.quantities(TOOL_POSITION, positions, "positions_m")
    positions = positions.to(edges_px.device, torch.float64)
    if bool((positions.detach().sort().values.diff() <= 0).any()):
        raise ValueError(f"positions_m must all differ, got {positions.tolist()}")
    return edges_px.to(torch.float64), positions


def _expanded(name: str, kind: Quantity, value: float | Tensor, like: Tensor, axes: int) -> Tensor:
    tensor, shape = torch.as_tensor(value).to(like.device, torch.float64), like.shape[:axes]
    checks.quantities(kind, tensor, name)
    try:
        return tensor.expand(shape)
    except RuntimeError:
        raise ValueError(f"{name} must be a number or of shape {list(shape)}, got {list(tensor.shape)}") from None


def edge_weights(pixels: Tensor, plane: Tensor, known: Tensor, deviations: Tensor, camera: Camera) -> Tensor:
    """Matrices [B, N, 2, 2] from errors on the plane z = 1 to (along, across) in units of ``deviations`` [B, N, 2]."""
    mask = known[..., None].to(pixels.dtype)
    x, y = ((pixels - pixels.sum(1, True) / mask.sum(1, True).clamp(min=1)) * mask).unbind(-1)
    # The principal axis of the edges, at half the angle of their second moment.
    even, odd = (x * x - y * y).sum(-1), 2 * (x * y).sum(-1)
    angle = torch.atan2(odd, torch.where((even == 0) & (odd == 0), 1.0, even)) / 2
    cos, sin = angle.cos(), angle.sin()
    frame = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)[:, None]
    return (mask / deviations)[..., None] * (frame @ camera.slopes(plane))


def _start(plane: Tensor, relative: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Linear solution: middle point [B, 3] and direction [B, 3], and which [B] have none because all edges coincide."""
    mask = known.to(plane.dtype)
    count = mask.sum(-1, keepdim=True).clamp(min=1)
    centre = (plane * mask[..., None]).sum(1) / count
    offsets = (plane - centre[:, None]) * mask[..., None]
    extent = offsets.square().sum((-2, -1)).div(count[:, 0]).sqrt()
    coincide = extent <= _SAME_POINT * (1 + centre.norm(dim=-1))
    size = torch.where(coincide, 1.0, extent)
    length = (relative * mask).square().sum(-1).div(count[:, 0]).sqrt().clamp(min=1e-12)
    u, s = offsets / size[:, None, None], relative * mask / length[:, None]
    # Rows of u_z (A + s d)_xy - u_xy (A + s d)_z, in coordinates that are centred and scaled.
    rows = torch.zeros(*plane.shape, 6, dtype=plane.dtype, device=plane.device)
    for axis in range(2):
        rows[..., axis, axis] = mask
        rows[..., axis, 3 + axis] = s
        rows[..., axis, 2] = -u[..., axis]
        rows[..., axis, 5] = -u[..., axis] * s
    null = torch.linalg.svd(rows.flatten(1, 2), full_matrices=True).Vh[:, -1].unflatten(-1, (2, 3))
    xy, z = null.split([2, 1], -1)
    point, along = torch.cat([size[:, None, None] * xy + centre[:, None] * z, z], -1).unbind(1)
    along = along / length[:, None]
    norm = along.norm(dim=-1, keepdim=True)
    point, along = point / norm, along / norm
    sign = torch.where(point[:, 2:] < 0, -1.0, 1.0)
    return (point * sign).nan_to_num(1.0, 1.0, 1.0), (along * sign).nan_to_num(0.5, 0.5, 0.5), coincide


def tangent_basis(along: Tensor) -> Tensor:
    """Two unit vectors [B, 3, 2] perpendicular to unit vectors ``along`` [B, 3] and to each other."""
    helper = torch.nn.functional.one_hot(along.abs().argmin(-1), 3).to(along.dtype)
    first = torch.nn.functional.normalize(torch.linalg.cross(along, helper), dim=-1)
    return torch.stack([first, torch.linalg.cross(along, first)], -1)


def tilted(along: Tensor, basis: Tensor, angles: Tensor) -> Tensor:
    """Unit vectors ``along`` [B, 3] tilted towards the vectors of ``basis`` [B, 3, 2] by small ``angles`` [B, 2]."""
    return torch.nn.functional.normalize(along + (basis @ angles[..., None])[..., 0], dim=-1)


def _residuals(point: Tensor, along: Tensor, basis: Tensor, edges: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Weighted residuals [B, 2 N] and their derivatives [B, 2 N, 5] by the middle point and two tilts of the direction.

    ``edges`` are images on the plane z = 1 [B, N, 2], distances from the middle point [B, N], weights and offsets [B].
    """
    plane, relative, weights, offset = edges
    identity = torch.eye(3, dtype=point.dtype, device=point.device)
    forward = (point * along).sum(-1, keepdim=True)
    toward = forward * along - point  # from the axis to the camera, perpendicular to it
    distance = toward.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    normal = toward / distance
    where = (point + offset[:, None] * normal)[:, None] + relative[..., None] * along[:, None]
    depth = where[..., 2:].clamp(min=1e-9)
    image = where[..., :2] / depth
    residuals = (weights @ (image - plane)[..., None])[..., 0].flatten(1)
    # Derivatives of the image by the point in space, then of this point by the unknowns.
    to_image = torch.cat([identity[:2, :2].expand(*image.shape, 2), -image[..., None]], -1) / depth[..., None]
    turn = (identity - normal[:, :, None] * normal[:, None]) * (offset[:, None] / distance)[..., None]
    by_point = identity - turn @ (identity - along[:, :, None] * along[:, None])
    by_tilt = turn @ ((point[:, None] @ basis) * along[..., None] + forward[..., None] * basis)
    by_tilt = relative[..., None, None] * basis[:, None] + by_tilt[:, None]
    in_space = torch.cat([by_point[:, None].expand(*relative.shape, 3, 3), by_tilt], -1)
    return residuals, (weights @ to_image @ in_space).flatten(1, 2)


def _refine(point: Tensor, along: Tensor, edges: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Levenberg-Marquardt to rounding error: middle point, direction, and which [B] converged."""

    def evaluate(point: Tensor, along: Tensor) -> tuple[Tensor, ...]:
        basis = tangent_basis(along)
        residuals, jacobian = _residuals(point, along, basis, edges)
        return point, along, basis, residuals, jacobian, residuals.square().sum(-1)

    _, relative, weights, _ = edges
    damping = torch.full_like(point[:, 0], 1e-6)
    converged = torch.zeros_like(damping, dtype=torch.bool)
    rounding = 1e-14 * weights.abs().sum((1, 2, 3))  # rounding error of the residuals
    least = rounding.clamp(min=1e-9).square()  # squared change of the residuals below which a step ends the iteration
    state = evaluate(point, along)
    for _ in range(30):  # most poses converge in about five
        point, along, basis, residuals, jacobian, cost = state
        normal = jacobian.mT @ jacobian
        damped = normal + torch.diag_embed(damping[:, None] * normal.diagonal(dim1=-2, dim2=-1) + 1e-300)
        factor, failed = torch.linalg.cholesky_ex(damped)
        step = -torch.cholesky_solve(jacobian.mT @ residuals[..., None], factor)[..., 0].nan_to_num(0.0, 0.0, 0.0)
        step = torch.where((failed != 0)[:, None], 0.0, step)
        trial = evaluate(point + step[:, :3], tilted(along, basis, step[:, 3:]))
        behind = (trial[0][:, 2:] + relative * trial[1][:, 2:] <= 0).any(-1)
        better = (trial[-1].sqrt() <= cost.sqrt() + rounding) & ~behind
        converged |= ((jacobian @ step[..., None]).square().sum((-2, -1)) <= least) & (failed == 0) & (damping < 1)
        damping = torch.where(better, damping * 0.1, damping * 10).clamp(1e-16, 1e8)
        state = tuple(
            torch.where(better.view(-1, *(1,) * (old.ndim - 1)), new, old)
            for new, old in zip(trial, state, strict=True)
        )
        if bool(converged.all()):
            break
    return state[0], state[1], converged


def _implicit(point: Tensor, along: Tensor, basis: Tensor, edges: tuple[Tensor, ...]) -> Tensor:
    """Newton steps [B, 5] at the optimum: zero, with the derivatives of the optimum with respect to the inputs.

    With a constant matrix of second derivatives, the first step has the first derivatives, and the second step the
    second ones, too.
    """

    def slope(unknown: Tensor, some: Tensor | slice) -> Tensor:
        at = point[some] + unknown[:, :3], tilted(along[some], basis[some], unknown[:, 3:])
        cost = 0.5 * _residuals(*at, basis[some], tuple(each[some] for each in edges))[0].square().sum()
        return torch.autograd.grad(cost, unknown, create_graph=True)[0]

    unknown = torch.zeros(len(point), 5, dtype=point.dtype, device=point.device, requires_grad=True)
    first = slope(unknown, slice(None))
    rows = [torch.autograd.grad(first[:, i].sum(), unknown, retain_graph=True)[0] for i in range(5)]
    inverse = torch.linalg.inv_ex(torch.stack(rows, 1)).inverse.detach()
    # A pose that cannot be computed has no derivative, and must not make that of shared inputs NaN.
    known = torch.isfinite(inverse).flatten(1).all(-1)
    inverse = torch.where(known[:, None, None], inverse, 0.0)
    change = -(inverse @ first[..., None])[..., 0]
    some = known.nonzero()[:, 0]
    again = inverse[some] @ slope(change[some], some)[..., None]
    return change.index_add(0, some, -again[..., 0])


def _statuses(visible: Tensor, known: Tensor, failed: Tensor, point: Tensor) -> tuple[Status, ...]:
    """Status of each pose; ``visible`` edges that are not ``known`` lie outside the camera's valid radius."""

    def status(visible: int, known: int, failed: bool, depth: float) -> Status:
        if known < 3:
            return Status.OUTSIDE_CAMERA if visible >= 3 else Status.BANDS_MISSING
        if failed or not depth > 0:
            return Status.INCONSISTENT
        return Status.OK if known > 3 else Status.UNVERIFIED

    columns = visible.sum(-1), known.sum(-1), failed, point[:, 2]
    return tuple(map(status, *(column.tolist() for column in columns)))
