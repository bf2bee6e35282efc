"""Camera, tool and pose in numpy, from the written formulas and by brute force, without torch and without holotorch."""

import numpy as np

# A camera, and the thesis's tool before it.
MATRIX = np.array([[1400.0, 0, 959.5], [0, 1350, 539.5], [0, 0, 1]])
LENS = np.array([-0.12, 0.05, 1e-3, -5e-4, -0.01])
EDGES = np.array([0.070, 0.108, 0.146, 0.184])
TIP = np.array([-0.1, 0.02, 0.52])
DIRECTION = np.array([0.8986, 0.2747, -0.3420]) / np.linalg.norm([0.8986, 0.2747, -0.3420])


def distorted(x, y, k1, k2, p1, p2, k3):
    """Brown's radial and tangential distortion on the plane z = 1."""
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )


def pixels(points, matrix, distortion):
    """Pixels [..., 2] of points [..., 3] in front of the camera."""
    points = np.asarray(points, float)
    x, y = distorted(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2], *distortion)
    return np.stack([matrix[0][0] * x + matrix[0][2], matrix[1][1] * y + matrix[1][2]], -1)


def front(tip, direction, positions, offset: float | np.ndarray = 0.0):
    """Points [..., N, 3] of the tool, ``offset`` in front of its axis: at right angles to it, in its plane with 0."""
    tip, direction = np.asarray(tip, float), np.asarray(direction, float)
    foot = tip - (tip * direction).sum(-1, keepdims=True) * direction  # the axis' point nearest to the camera
    normal = -foot / np.linalg.norm(foot, axis=-1, keepdims=True)
    on_axis = tip[..., None, :] + np.asarray(positions)[..., :, None] * direction[..., None, :]
    return on_axis + np.asarray(offset)[..., None, None] * normal[..., None, :]


def image(tip, direction, positions, matrix, distortion, offset: float | np.ndarray = 0.0):
    """Pixels [..., N, 2] of the edges."""
    return pixels(front(tip, direction, positions, offset), matrix, distortion)


def unit(angles):
    """Direction of two angles: azimuth in the plane of the image, and tilt out of it."""
    azimuth, tilt = angles[..., 0], angles[..., 1]
    return np.stack([np.cos(azimuth) * np.cos(tilt), np.sin(azimuth) * np.cos(tilt), np.sin(tilt)], -1)


def angles_of(direction):
    return np.stack([np.arctan2(direction[..., 1], direction[..., 0]), np.arcsin(direction[..., 2])], -1)


def cramer_rao(tip, direction, positions, matrix, distortion, sd_px, offset=0.0):
    """Covariance [6, 6] of (tip, direction) that no unbiased estimate can be below, by central differences.

    ``sd_px``: a number, or (along, across) the tool's image.
    """
    start = np.concatenate([tip, angles_of(direction)])

    def slopes(function, step):
        columns = []
        for i in range(5):
            forward, back = start.copy(), start.copy()
            forward[i] += step
            back[i] -= step
            columns.append((function(forward) - function(back)) / (2 * step))
        return np.stack(columns, -1)

    seen = image(tip, direction, positions, matrix, distortion, offset)
    line = seen[-1] - seen[0]
    line = line / np.linalg.norm(line)
    frame = np.array([line, [-line[1], line[0]]])
    deviations = np.broadcast_to(np.asarray(sd_px, float), 2)[:, None]

    def edges(v):
        found = image(v[:3], unit(v[3:]), positions, matrix, distortion, offset)
        return (frame / deviations @ found[..., None])[..., 0].ravel()

    rows = slopes(edges, 1e-6)
    lever = slopes(lambda v: np.concatenate([v[:3], unit(v[3:])]), 1e-6)
    return lever @ np.linalg.inv(rows.T @ rows) @ lever.T


def descend(tip, direction, edges, positions, matrix, distortion, steps=60):
    """Damped Gauss-Newton by numerical slopes on the pixels from a given start: tip, direction, cost."""
    v = np.concatenate([tip, angles_of(direction)])

    def misses(v):
        points = front(v[:3], unit(v[3:]), positions)
        if (points[:, 2] <= 1e-3).any():
            return None
        return (pixels(points, matrix, distortion) - edges).ravel()

    damping, now = 1e-3, misses(v)
    if now is None:
        raise ValueError("the start lies behind the camera")
    for _ in range(steps):
        columns = []
        for i in range(5):
            ahead, back = v.copy(), v.copy()
            ahead[i] += 1e-7
            back[i] -= 1e-7
            one, other = misses(ahead), misses(back)
            if one is None or other is None:
                return v[:3], unit(v[3:]), float(now @ now)
            columns.append((one - other) / 2e-7)
        rows = np.stack(columns, -1)
        normal = rows.T @ rows
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -rows.T @ now)
        new = misses(v + step)
        if new is not None and new @ new < now @ now:
            v, now, damping = v + step, new, damping / 10
        else:
            damping *= 10
    return v[:3], unit(v[3:]), float(now @ now)


def sine_rule(rays, positions, arctan=False, inverted=False):
    """Sec. 3.4.2 of the thesis for three unit rays [3, 3]: the tip; ``arctan`` and ``inverted`` as they are printed.

    Printed: delta by arctan (Eq. 3.7, of equal bands), and the tip at |AB| / |AT| of AB (Eq. 3.12).
    """
    a, b, c = rays
    first, second = positions[1] - positions[0], positions[2] - positions[1]
    p1, p2 = (np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v) for u, v in ((a, b), (b, c)))
    top = first * np.sin(p2) * np.sin(p1 + p2)
    bottom = second * np.sin(p1) - first * np.sin(p2) * np.cos(p1 + p2)
    delta = np.arctan(top / bottom) if arctan else np.arctan2(top, bottom)
    at_a = (first + second) * np.sin(delta) / np.sin(p1 + p2) * a
    at_c = (first + second) * np.sin(p1 + p2 + delta) / np.sin(p1 + p2) * c
    at_b = at_a + first / (first + second) * (at_c - at_a)
    share = first / positions[0] if inverted else positions[0] / first
    return at_a - share * (at_b - at_a)


def scenes(count: int, edges: int, rng: np.random.Generator, directions=None):
    """Positions [edges] of gaps from 4 to 60 mm, tips [count, 3] and directions, all of the tool in front."""
    positions = np.cumsum([rng.uniform(0, 0.1), *rng.uniform(0.004, 0.06, edges - 1)])
    if directions is None:
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    middle = np.stack([rng.uniform(-0.4, 0.4, count), rng.uniform(-0.3, 0.3, count), np.ones(count)], -1)
    middle *= rng.uniform(0.3 + np.ptp(positions), 1.5, (count, 1))
    return positions, middle - positions.mean() * directions, directions
