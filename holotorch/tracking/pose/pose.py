"""Pose of a catheter from the images of its band edges: five unknowns, with covariance and gradients."""

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import EDGE_DEVIATION, TOOL_OFFSET, TOOL_POSITION, Quantity
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.status import Pose, Status

_STEPS = 30  # most Levenberg-Marquardt steps; a pose takes about five
_LEAST = 1e-9  # on the plane z = 1, or in radians: points that are closer to each other count as one point


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
    """Pose of a straight tool from the images of points at known distances from its tip.

    A linear solution (the null vector of ``u_i x (A + s_i d) = 0``) is the start of Levenberg-Marquardt steps that
    minimise the reprojection error in five unknowns. Three visible points determine a pose, which is unique in front of
    the camera, but leave no redundancy: its status is UNVERIFIED. The pose is differentiable with respect to all
    arguments by the implicit function theorem.

    Args:
        edges_px: [B, N, 2] pixels (x, y); NaN for an edge that is not visible.
        positions_m: [N] distances from the tip in metres, all different, in any order.
        camera: Camera whose distortion is removed from the pixels.
        along_px: Standard deviation of an edge along the tool's image, in pixels; a number or [B, N].
        across_px: Standard deviation of an edge across the tool's image, in pixels; a number or [B, N].
        seen: [B, N] bool; False excludes an edge.
        offset: Distance of the points from the axis toward the camera, in metres; a number or [B].

    Returns:
        Poses [B] in float64. A pose that cannot be computed is NaN, and its status gives the reason.

    Raises:
        TypeError, ValueError: Wrong shapes or types, fewer than three positions, equal ones, deviations <= 0.

    Source: the problem of Sec. 3.4.2 of the thesis; :func:`closed_form` implements its Eqs. 3.8 to 3.11.
    """
    pixels, positions = _checked(edges_px, positions_m)
    batch, count = pixels.shape[:2]
    plane = camera.undistort(pixels)
    given = torch.isfinite(pixels.detach()).all(-1)
    if seen is not None:
        seen = torch.as_tensor(seen, device=given.device)
        if seen.shape != given.shape or seen.dtype != torch.bool:
            raise ValueError(f"seen must be bool of shape [{batch}, {count}], got {seen.dtype}, {list(seen.shape)}")
        given = given & seen
    known = given & torch.isfinite(plane.detach()).all(-1)
    shift = _expanded("offset", TOOL_OFFSET, offset, pixels, 1)
    deviations = [
        _expanded(name, EDGE_DEVIATION, v, pixels, 2) for name, v in (("along_px", along_px), ("across_px", across_px))
    ]
    plane = torch.where(known[..., None], plane, 0.0)
    weights = edge_weights(
        torch.where(known[..., None], pixels, 0.0), plane, known, torch.stack(deviations, -1), camera
    )
    with torch.no_grad():
        middle = (positions * known).sum(-1) / known.sum(-1).clamp(min=1)
        place = positions - middle[:, None]
        point, along, flat = _start(plane, place, known)
        point, along, settled = _refine(point, along, plane, place, weights, shift)
        basis = _basis(along)
        _, slopes = _residuals(point, along, basis, plane, place, weights, shift)
    values = (plane, positions, weights, shift)
    if torch.is_grad_enabled() and any(value.requires_grad for value in values):
        middle = (positions * known).sum(-1) / known.sum(-1).clamp(min=1)  # again, now with gradient
        place = positions - middle[:, None]
        change = _implicit(point, along, basis, plane, place, weights, shift)
        point = point + change[:, :3]
        along = _turned(along, basis, change[:, 3:])
    residuals = _residuals(point, along, basis, plane, place, weights, shift)[0]
    tip = point - middle[:, None] * along
    covariance, singular = _covariance(slopes, middle, basis)
    codes = _codes(given, known, flat | singular | ~settled, point)
    lost = torch.tensor([not code.answered for code in codes], dtype=torch.bool, device=tip.device)
    return Pose(
        torch.where(lost[:, None], torch.nan, tip),
        torch.where(lost[:, None], torch.nan, along),
        torch.where(lost[:, None, None], torch.nan, covariance),
        torch.where(lost, torch.nan, residuals.square().sum(-1)),
        (2 * known.sum(-1) - 5).clamp(min=0).to(tip.dtype),
        codes,
    )


def closed_form(edges_px: Tensor, positions_m: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pose from the three edges of two neighbouring bands by the sine rule, the method of the thesis.

    For more than three edges, the result is the mean over all triples of neighbouring edges.

    Args:
        edges_px: [B, N, 2] pixels (x, y).
        positions_m: [N] distances from the tip in metres, increasing.
        camera: Camera whose distortion is removed from the pixels.

    Returns:
        Tip [B, 3] in metres and direction [B, 3]; NaN where rays coincide or an edge is NaN.

    Raises:
        ValueError: Wrong shapes or types, fewer than three positions, equal positions.

    Source: Eqs. 3.3 to 3.12 of the thesis, with these departures. Angles are computed by atan2. Bands may have any
    length. There is no quadratic equation, whose double root for a tool parallel to the image loses half of the digits.
    Eq. 3.12 uses |AT| / |AB|, which is printed inverted.
    """
    pixels, positions = _checked(edges_px, positions_m)
    plane = camera.undistort(pixels)
    rays = torch.nn.functional.normalize(torch.cat([plane, torch.ones_like(plane[..., :1])], -1), dim=-1)
    tips, directions = [], []
    for i in range(pixels.shape[1] - 2):
        a, b, c = rays[:, i], rays[:, i + 1], rays[:, i + 2]
        first, second = positions[i + 1] - positions[i], positions[i + 2] - positions[i + 1]
        p1, p2 = (torch.where(angle > _LEAST, angle, torch.nan) for angle in (_angle(a, b), _angle(b, c)))
        both, length = p1 + p2, first + second
        delta = torch.atan2(
            first * torch.sin(p2) * torch.sin(both), second * torch.sin(p1) - first * torch.sin(p2) * torch.cos(both)
        )
        front = (length * torch.sin(delta) / torch.sin(both))[:, None] * a
        rear = (length * torch.sin(both + delta) / torch.sin(both))[:, None] * c
        direction = torch.nn.functional.normalize(rear - front, dim=-1)
        tips.append(front - positions[i] * direction)
        directions.append(direction)
    return torch.stack(tips).mean(0), torch.nn.functional.normalize(torch.stack(directions).mean(0), dim=-1)


def _covariance(slopes: Tensor, middle: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """[B, 6, 6] covariance of tip and direction, and which [B] are singular.

    ``slopes`` [B, 2 N, 5] are derivatives by the middle point and two rotations about ``basis`` [B, 3, 2]; the middle
    point lies ``middle`` [B] metres from the tip.
    """
    inverse, singular = torch.linalg.inv_ex(slopes.mT @ slopes)
    lever = slopes.new_zeros(len(slopes), 6, 5)
    lever[:, :3, :3] = torch.eye(3, dtype=slopes.dtype)
    lever[:, :3, 3:] = -middle[:, None, None] * basis
    lever[:, 3:, 3:] = basis
    return lever @ inverse @ lever.mT, singular != 0


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
    tensor = torch.as_tensor(value).to(like.device, torch.float64)
    checks.quantities(kind, tensor, name)
    shape = like.shape[:axes]
    if tensor.ndim > axes or any(n not in (1, want) for n, want in zip(tensor.shape[::-1], shape[::-1], strict=False)):
        raise ValueError(f"{name} must be a number or of shape {list(shape)}, got {list(tensor.shape)}")
    return tensor.expand(shape)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def edge_weights(pixels: Tensor, plane: Tensor, known: Tensor, deviations: Tensor, camera: Camera) -> Tensor:
    """[B, N, 2, 2] maps from residuals on the plane z = 1 to (along, across) in units of ``deviations`` [B, N, 2]."""
    share = known[..., None].to(pixels.dtype)
    x, y = ((pixels - pixels.sum(1, True) / share.sum(1, True).clamp(min=1)) * share).unbind(-1)
    # The principal axis of the edges lies at half the angle of their second moment.
    even, odd = (x * x - y * y).sum(-1), 2 * (x * y).sum(-1)
    angle = torch.atan2(odd, torch.where((even == 0) & (odd == 0), 1.0, even)) / 2
    cos, sin = angle.cos(), angle.sin()
    frame = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)[:, None]
    return (share / deviations)[..., None] * (frame @ camera.slopes(plane))


def _start(plane: Tensor, place: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Linear start: middle point [B, 3], direction [B, 3], and which [B] have none because all edges coincide."""
    share = known.to(plane.dtype)
    count = share.sum(-1, keepdim=True).clamp(min=1)
    centre = (plane * share[..., None]).sum(1) / count
    offsets = (plane - centre[:, None]) * share[..., None]
    extent = offsets.square().sum((-2, -1)).div(count[:, 0]).sqrt()
    flat = extent <= _LEAST * (1 + centre.norm(dim=-1))
    size = torch.where(flat, 1.0, extent)
    reach = (place * share).square().sum(-1).div(count[:, 0]).sqrt().clamp(min=1e-12)
    u, s = offsets / size[:, None, None], place * share / reach[:, None]
    # Rows of u_z (A + s d)_xy - u_xy (A + s d)_z, in coordinates that are centred and scaled.
    rows = torch.zeros(*plane.shape, 6, dtype=plane.dtype, device=plane.device)
    for axis in range(2):
        rows[..., axis, axis] = share
        rows[..., axis, 3 + axis] = s
        rows[..., axis, 2] = -u[..., axis]
        rows[..., axis, 5] = -u[..., axis] * s
    null = torch.linalg.svd(rows.flatten(1, 2), full_matrices=True).Vh[:, -1]
    point, along = null[:, :3], null[:, 3:]

    def restored(v: Tensor) -> Tensor:
        return torch.cat([size[:, None] * v[:, :2] + centre * v[:, 2:], v[:, 2:]], -1)

    point, along = restored(point), restored(along) / reach[:, None]
    length = along.norm(dim=-1, keepdim=True)
    point, along = point / length, along / length
    sign = torch.where(point[:, 2:] < 0, -1.0, 1.0)
    return (point * sign).nan_to_num(1.0, 1.0, 1.0), (along * sign).nan_to_num(0.5, 0.5, 0.5), flat


def _basis(along: Tensor) -> Tensor:
    """[B, 3, 2] two unit vectors perpendicular to ``along`` and to each other."""
    helper = torch.nn.functional.one_hot(along.abs().argmin(-1), 3).to(along.dtype)
    first = torch.nn.functional.normalize(torch.linalg.cross(along, helper), dim=-1)
    return torch.stack([first, torch.linalg.cross(along, first)], -1)


def _turned(along: Tensor, basis: Tensor, angles: Tensor) -> Tensor:
    return torch.nn.functional.normalize(along + (basis @ angles[..., None])[..., 0], dim=-1)


def _residuals(point, along, basis, plane, place, weights, shift) -> tuple[Tensor, Tensor]:
    """Weighted residuals [B, 2 N] and their derivatives [B, 2 N, 5] by the point and two rotations of the direction."""
    identity = torch.eye(3, dtype=point.dtype, device=point.device)
    forward = (point * along).sum(-1, keepdim=True)
    toward = forward * along - point  # from the axis to the camera, perpendicular to it
    distance = toward.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    normal = toward / distance
    where = (point + shift[:, None] * normal)[:, None] + place[..., None] * along[:, None]
    depth = where[..., 2:].clamp(min=1e-9)
    image = where[..., :2] / depth
    residuals = (weights @ (image - plane)[..., None])[..., 0].flatten(1)
    # Derivatives of the image by the point in space, then of this point by the unknowns.
    to_image = torch.cat([identity[:2, :2].expand(*image.shape, 2), -image[..., None]], -1) / depth[..., None]
    turn = (identity - normal[:, :, None] * normal[:, None]) * (shift[:, None] / distance)[..., None]
    moved = identity - turn @ (identity - along[:, :, None] * along[:, None])
    tilted = turn @ ((point[:, None] @ basis) * along[..., None] + forward[..., None] * basis)
    in_space = torch.cat(
        [
            moved[:, None].expand(*place.shape, 3, 3),
            place[..., None, None] * basis[:, None] + tilted[:, None],
        ],
        -1,
    )
    return residuals, (weights @ to_image @ in_space).flatten(1, 2)


def _refine(point, along, plane, place, weights, shift) -> tuple[Tensor, Tensor, Tensor]:
    """Levenberg-Marquardt to rounding error: point, direction, and which [B] converged."""
    damping = torch.full_like(point[:, 0], 1e-6)
    settled = torch.zeros_like(damping, dtype=torch.bool)
    basis = _basis(along)
    residuals, slopes = _residuals(point, along, basis, plane, place, weights, shift)
    cost = residuals.square().sum(-1)
    rounding = 1e-14 * weights.abs().sum((1, 2, 3))  # rounding error of the residuals
    # Converged: a step below 1e-9 standard deviations or the rounding error. Convergence is quadratic.
    least = rounding.clamp(min=1e-9).square()
    for _ in range(_STEPS):
        normal = slopes.mT @ slopes
        size = normal.diagonal(dim1=-2, dim2=-1)
        damped = normal + torch.diag_embed(damping[:, None] * size + 1e-300)
        factor, failed = torch.linalg.cholesky_ex(damped)
        step = -torch.cholesky_solve(slopes.mT @ residuals[..., None], factor)[..., 0].nan_to_num(0.0, 0.0, 0.0)
        step = torch.where((failed != 0)[:, None], 0.0, step)
        new_point, new_along = point + step[:, :3], _turned(along, basis, step[:, 3:])
        new_basis = _basis(new_along)
        new_residuals, new_slopes = _residuals(new_point, new_along, new_basis, plane, place, weights, shift)
        new_cost = new_residuals.square().sum(-1)
        behind = (new_point[:, 2:] + place * new_along[:, 2:] <= 0).any(-1)
        better = (new_cost.sqrt() <= cost.sqrt() + rounding) & ~behind
        settled |= ((slopes @ step[..., None]).square().sum((-2, -1)) <= least) & (failed == 0) & (damping < 1)
        damping = torch.where(better, damping * 0.1, damping * 10).clamp(1e-16, 1e8)
        point, along = torch.where(better[:, None], new_point, point), torch.where(better[:, None], new_along, along)
        basis = torch.where(better[:, None, None], new_basis, basis)
        residuals = torch.where(better[:, None], new_residuals, residuals)
        slopes = torch.where(better[:, None, None], new_slopes, slopes)
        cost = torch.where(better, new_cost, cost)
        if bool(settled.all()):
            break
    return point, along, settled


def _implicit(point, along, basis, plane, place, weights, shift) -> Tensor:
    """A Newton step [B, 5] at the optimum: its value is zero, its gradient that of the optimum by the inputs."""
    unknown = torch.zeros(len(point), 5, dtype=point.dtype, device=point.device, requires_grad=True)
    at = point + unknown[:, :3], _turned(along, basis, unknown[:, 3:])
    cost = 0.5 * _residuals(*at, basis, plane, place, weights, shift)[0].square().sum()
    slope = torch.autograd.grad(cost, unknown, create_graph=True)[0]
    rows = [torch.autograd.grad(slope[:, i].sum(), unknown, retain_graph=True)[0] for i in range(5)]
    inverse = torch.linalg.inv_ex(torch.stack(rows, 1)).inverse.detach()
    # A pose that cannot be computed has no derivative, and must not make that of shared inputs NaN.
    inverse = torch.where(torch.isfinite(inverse).all(-1).all(-1)[:, None, None], inverse, 0.0)
    return -(inverse @ slope[..., None])[..., 0]


def _codes(given: Tensor, known: Tensor, failed: Tensor, point: Tensor) -> tuple[Status, ...]:
    codes = []
    for want, have, bad, depth in zip(
        given.sum(-1).tolist(), known.sum(-1).tolist(), failed.tolist(), point[:, 2].tolist(), strict=True
    ):
        if have >= 3:
            valid = not bad and depth > 0
            codes.append(Status.INCONSISTENT if not valid else Status.OK if have > 3 else Status.UNVERIFIED)
        else:
            codes.append(Status.OUTSIDE_CAMERA if want >= 3 else Status.BANDS_MISSING)
    return tuple(codes)
