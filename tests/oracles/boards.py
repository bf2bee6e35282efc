"""Synthetic photographs of calibration boards: each pixel's ray is followed to the board, Brown's distortion undone."""

import cv2
import numpy as np
import scipy.optimize

PRINTED = 40  # samples of the printed board along a square


def chessboard_print(columns, rows):
    """Board of columns x rows inner corners with a white rim: grey samples, and the sample of the first corner."""
    y, x = np.mgrid[: rows + 1, : columns + 1]
    squares = np.where((x + y) % 2, 255.0, 0.0)
    whole = np.pad(np.kron(squares, np.ones((PRINTED, PRINTED))), PRINTED, constant_values=255)
    return whole, np.array([2 * PRINTED - 0.5, 2 * PRINTED - 0.5])


def charuco_print(columns, rows, dictionary, marker_share, legacy=False):
    """ChArUco board by OpenCV's own printing; the sample of its origin, the corner of the first square."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, marker_share, known)
    board.setLegacyPattern(legacy)
    size = columns * PRINTED, rows * PRINTED
    return np.pad(board.generateImage(size).astype(float), PRINTED, constant_values=255), np.full(2, PRINTED - 0.5)


def rotation(vector):
    """Matrix of a rotation vector."""
    return cv2.Rodrigues(np.asarray(vector, dtype=float))[0]


def undistorted(pixels, matrix, distortion):
    """Points on z = 1 of pixels, by fifty fixed-point steps."""
    k1, k2, p1, p2, k3 = distortion
    goal = (pixels - matrix[:2, 2]) / [matrix[0, 0], matrix[1, 1]]
    plane = goal.copy()
    for _ in range(50):
        x, y = plane[..., 0], plane[..., 1]
        r = x * x + y * y
        shift = np.stack([2 * p1 * x * y + p2 * (r + 2 * x * x), p1 * (r + 2 * y * y) + 2 * p2 * x * y], -1)
        plane = (goal - shift) / (1 + r * (k1 + r * (k2 + r * k3)))[..., None]
    return plane


class Camera:
    """A camera that takes photographs of printed boards: 2 x 2 rays a pixel, a lens blur of 0.6 px, noise in levels."""

    def __init__(self, matrix, distortion, shape):
        self.matrix, self.distortion, self.shape = np.asarray(matrix, float), np.asarray(distortion, float), shape
        steps = [(np.arange(2 * n) - 0.5) / 2 for n in shape[::-1]]
        plane = undistorted(np.stack(np.meshgrid(*steps), -1), self.matrix, self.distortion)
        self.rays = np.concatenate([plane, np.ones_like(plane[..., :1])], -1)

    def photograph(self, printed, origin, square, turned, at, noise=1.0, seed=0):
        """uint8 [H, W] of a board with its origin at ``at`` in metres, turned by a rotation vector, on grey."""
        axes = rotation(turned)
        # Point on the board (u, v): u a + v b + at = depth * ray.
        u, v, depth = np.moveaxis(self.rays @ np.linalg.inv(np.column_stack([axes[:, :2], at])).T, -1, 0)
        place = (np.stack([u / depth, v / depth], -1) / square * PRINTED + origin).astype(np.float32)
        seen = cv2.remap(printed.astype(np.float32), place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=110)
        seen = cv2.resize(seen, self.shape[::-1], interpolation=cv2.INTER_AREA)
        seen = cv2.GaussianBlur(seen, (0, 0), 0.6) * 0.8 + 20
        seen += np.random.default_rng(seed).normal(0, noise, seen.shape)
        return np.clip(np.rint(seen), 0, 255).astype(np.uint8)

    def project(self, points):
        """Pixels of points [n, 3], by Brown's formula."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = (points[:, :2] / points[:, 2:]).T
        r = x * x + y * y
        radial = 1 + r * (k1 + r * (k2 + r * k3))
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
            y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
        )
        return np.stack([x, y], -1) * self.matrix[[0, 1], [0, 1]] + self.matrix[:2, 2]


def around(centre, turned, at):
    """Where the board's origin is when the board's point ``centre`` [2] is to be at ``at``."""
    return np.asarray(at) - rotation(turned)[:, :2] @ np.asarray(centre)


def handheld(count, centre, size=1.0, tilt=0.7, seed=0):
    """Poses (rotation vector, position of the origin) of a board whose point ``centre`` stays in view."""
    generator = np.random.default_rng(seed)
    for _ in range(count):
        turned = generator.uniform(-1, 1, 3) * [tilt, tilt, 0.3]
        at = generator.uniform(-1, 1, 3) * [0.08, 0.05, 0.08] * size + [0, 0, 0.42 * size]
        yield turned, around(centre, turned, at)


def scatter(points, pixels, values, free=False):
    """Squared distances in px^2 that one view keeps: board's pose fitted, and all nine intrinsics too if ``free``.

    ``values`` are fx, fy, cx, cy, k1, k2, p1, p2, k3: the camera, or where the search for the best one starts.
    """
    fx, fy, cx, cy, *distortion = values
    matrix, distortion = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(distortion)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
    if free:
        given = [points.astype(np.float32)], [pixels.astype(np.float32)]
        flags = cv2.CALIB_USE_INTRINSIC_GUESS
        return cv2.calibrateCamera(*given, (640, 480), matrix, distortion, flags=flags, criteria=stop)[0] ** 2 * len(
            points
        )
    _, turned, at = cv2.solvePnP(points, pixels, matrix, distortion)
    turned, at = cv2.solvePnPRefineLM(points, pixels, matrix, distortion, turned, at, stop)
    seen = cv2.projectPoints(points, turned, at, matrix, distortion)[0].reshape(-1, 2)
    return np.square(seen - pixels).sum()


def grid(columns=9, rows=6, square=0.025):
    """Corners [n, 3] of a chessboard."""
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows), [0]), -1).reshape(-1, 3) * square


def bent(points, x, y, xy):
    """Corners of a board bent by second-order bows, as shares of its diagonal at its ends."""
    across = np.linalg.norm(np.ptp(points, axis=0))
    u, v = (2 * (points - points.mean(0)) / across).T[:2]
    return points + np.outer(across * (x * u * u + y * v * v + 2 * xy * u * v), [0, 0, 1])


def most_probable(views, size, start, error):
    """Camera [9] and its deviations: the maximum of corners' and an ordinary camera's probability.

    ``views`` are pairs of corners on the board and in the picture, ``error`` their standard deviation in pixels. No
    derivatives, and the curvature by differences: slow, and independent of OpenCV's.
    """
    height, width = size
    diagonal = np.hypot(height, width)
    mean = [np.log(0.9 * width), 0, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0]
    spread = np.array([0.5, 0.01, 0.05 * diagonal, 0.05 * diagonal, 0.3, 1, 0.005, 0.005, 2])

    def camera(traits):
        f, ratio, cx, cy, *distortion = traits
        matrix = [[np.exp(f + ratio / 2), 0, cx], [0, np.exp(f - ratio / 2), cy], [0, 0, 1]]
        return Camera(matrix, distortion, (2, 2))

    def residuals(unknowns):
        traits = mean + spread * unknowns[:9]
        taken, found = camera(traits), [unknowns[:9]]
        for (points, pixels), (turned, at) in zip(views, unknowns[9:].reshape(-1, 2, 3), strict=True):
            found.append((taken.project(points @ rotation(turned).T + at) - pixels).ravel() / error)
        return np.concatenate(found)

    fx, fy, *rest = start[:9]
    traits = np.array([np.log(fx * fy) / 2, np.log(fx / fy), *rest])
    poses = []
    for points, pixels in views:
        matrix = np.array([[fx, 0, rest[0]], [0, fy, rest[1]], [0, 0, 1.0]])
        _, turned, at = cv2.solvePnP(points, pixels, matrix, np.array(rest[2:]))
        poses += [turned.ravel(), at.ravel()]
    found = scipy.optimize.least_squares(
        residuals, np.concatenate([(traits - mean) / spread, *poses]), "3-point", xtol=1e-14, ftol=1e-14, gtol=1e-12
    )
    taken = camera(mean + spread * found.x[:9])
    fx, fy = taken.matrix[[0, 1], [0, 1]]
    turned = np.eye(9)
    turned[:2, :2] = [[fx, fx / 2], [fy, -fy / 2]]
    turned = turned * spread
    covariance = turned @ np.linalg.inv(found.jac.T @ found.jac)[:9, :9] @ turned.T
    return np.array([fx, fy, *taken.matrix[:2, 2], *taken.distortion]), np.sqrt(np.diag(covariance))
