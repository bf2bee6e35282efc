"""Intrinsics from one to three views of a board: what so few leave open is closed by what ordinary cameras are like."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from holotorch.tracking.camera.boards import View

# Deviations of cameras before any photograph. Wide enough for phones, webcams and machine vision, not for fisheyes.
_FOCAL = math.log(0.9), 0.5  # logarithm of focal length over the longer side: fields of view of 37 to 85 degrees
_SQUARE = 0.01  # pixels are square
_CENTRED = 0.05  # of the diagonal
_DISTORTION = (0.3, 1.0, 0.005, 0.005, 2.0)  # k1, k2, p1, p2, k3
_TRAITS = ("focal length", "fx / fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_STRANGE = 3.0  # deviations from an ordinary camera, with which completing by one makes no sense
_STARTS = (0.5, 0.7, 0.9, 1.3, 2.0)  # focal lengths over the longer side: one view may have several minima
# Neighbouring corners err alike (boards bend, corner finders see one light), so that they tell less than as many
# independent ones: each of OpenCV's 13 sample photographs contradicts the camera that the other 12 give by 1.2 to 4.2
# times its corners' scatter, 2.9 in the median.
_ALIKE = 3.0
_SHARPEST = 0.02  # pixels; no corner is found to better
_STEPS = 200  # of a fit; photographs take 30, of boards that bend 80
_ROUNDS = 4  # of fitting and of estimating the scatter


class Estimate(NamedTuple):
    """Intrinsics as fx, fy, cx, cy, k1, k2, p1, p2, k3, and how sure they are.

    Attributes:
        values: [9].
        deviations: [9], with corners that err alike.
        formal: [9], with corners that err independently.
        normals: [n, 3] of the boards.
        errors: [n], rms of the views in pixels.
    """

    values: np.ndarray
    deviations: np.ndarray
    formal: np.ndarray
    normals: np.ndarray
    errors: np.ndarray


def estimate(views: Sequence[View], size: tuple[int, int]) -> Estimate:
    """Most probable intrinsics given views of a board, (H, W) of the photographs, and what ordinary cameras are like.

    Deviations are those of the posterior, linear about its maximum. A board seen from the front says next to nothing of
    the focal length: its deviation stays above 30 %.

    Raises:
        ValueError: The views determine no poses of the board, or contradict the notion of an ordinary camera.

    Source: maximum a posteriori by Gauss-Newton (trust region, SciPy) on OpenCV's projection and its derivatives.
    """
    problem = _Problem(views, *_prior(size))
    try:
        fit = problem.fit(problem.starts(size), 0.5)
        for _ in range(_ROUNDS - 1):
            fit = problem.fit([fit.unknowns], fit.scatter)
    except (cv2.error, np.linalg.LinAlgError):
        raise ValueError("the views do not determine a camera: are these the board's corners?") from None
    strain = problem.prior @ (fit.unknowns[:9] - problem.mean)
    worst = int(np.abs(strain).argmax())
    if abs(strain[worst]) > _STRANGE:
        raise ValueError(
            f"so few views are completed by what ordinary cameras are like, and these contradict it: {_TRAITS[worst]} "
            f"by {abs(strain[worst]):.1f} deviations; is the board's shape right, the photograph not cropped, the lens "
            "no fisheye? If so, take 10 or more, which determine any camera"
        )
    values = _values(fit.unknowns)
    scale = np.concatenate([values[:2], np.ones(7)])
    missed = np.split(fit.missed, np.cumsum([len(view.points) for view in views])[:-1])
    turns = fit.unknowns[9:].reshape(-1, 6)[:, :3]
    return Estimate(
        values,
        scale * fit.deviations,
        scale * fit.formal,
        np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns]),
        np.array([math.sqrt(np.square(part).sum(-1).mean()) for part in missed]),
    )


class _Fit(NamedTuple):
    unknowns: np.ndarray  # log fx, log fy, cx, cy, k1, k2, p1, p2, k3, then six numbers of each view's pose
    deviations: np.ndarray  # [9]
    formal: np.ndarray  # [9]
    missed: np.ndarray  # [corners, 2] in pixels
    scatter: float  # of a coordinate, in pixels


class _Problem(NamedTuple):
    views: Sequence[View]
    prior: np.ndarray  # [9, 9]: rows turn the camera about its mean into deviations
    mean: np.ndarray  # [9]

    def starts(self, size: tuple[int, int]) -> list[np.ndarray]:
        """Unknowns of ordinary cameras of several focal lengths."""
        found = []
        for share in _STARTS:
            values = np.concatenate([2 * [share * max(size)], self.mean[2:]])
            poses = [
                cv2.solvePnP(view.points.numpy(), view.pixels.numpy(), _matrix(values), None)[1:] for view in self.views
            ]
            found.append(
                np.concatenate([np.log(values[:2]), values[2:], *(part.ravel() for pose in poses for part in pose)])
            )
        return found

    def fit(self, starts: Sequence[np.ndarray], scatter: float) -> _Fit:
        """The best of the minima from ``starts``, given the corners' scatter, and the scatter that it leaves."""
        error = _ALIKE * scatter
        fits = [
            # SciPy's default for the derivatives is a word, and its type is taken from that.
            least_squares(self.residuals, start, self.slopes, x_scale="jac", max_nfev=_STEPS, args=(error,))  # pyright: ignore[reportArgumentType]
            for start in starts
        ]
        best = min(fits, key=lambda fit: fit.cost)
        if best.status < 1:
            raise np.linalg.LinAlgError("no minimum found")
        corners = best.jac[9:]
        normal, belief = corners.T @ corners, np.zeros((best.x.size, best.x.size))
        belief[:9, :9] = self.prior.T @ self.prior
        covariance, formal = np.linalg.inv(normal + belief), np.linalg.inv(_ALIKE**2 * normal + belief)
        determined = np.trace(covariance @ normal)  # parameters that the corners fix; the prior has the others
        missed = error * best.fun[9:]
        left = math.sqrt(missed @ missed / (missed.size - determined))
        deviations, formal = (np.sqrt(np.diag(part)[:9]) for part in (covariance, formal))
        return _Fit(best.x, deviations, formal, missed.reshape(-1, 2), max(left, _SHARPEST))

    def residuals(self, unknowns: np.ndarray, error: float) -> np.ndarray:
        """In deviations: of the camera from ``mean``, then of all corners."""
        found = [self.prior @ (unknowns[:9] - self.mean)]
        found += [(seen - view.pixels.numpy()).ravel() / error for view, seen, _ in self._seen(unknowns)]
        return np.concatenate(found)

    def slopes(self, unknowns: np.ndarray, error: float) -> np.ndarray:
        """Derivatives of ``residuals``."""
        found = [np.pad(self.prior, ((0, 0), (0, unknowns.size - 9)))]
        for i, (_, seen, slopes) in enumerate(self._seen(unknowns)):
            rows = np.zeros((seen.size, unknowns.size))
            rows[:, :9] = slopes[:, 6:15]
            rows[:, :2] *= np.exp(unknowns[:2])
            rows[:, 9 + 6 * i : 15 + 6 * i] = slopes[:, :6]
            found.append(rows / error)
        return np.concatenate(found)

    def _seen(self, unknowns: np.ndarray) -> Iterator[tuple[View, np.ndarray, np.ndarray]]:
        values = _values(unknowns)
        for view, (turned, at) in zip(self.views, unknowns[9:].reshape(-1, 2, 3), strict=True):
            seen, slopes = cv2.projectPoints(view.points.numpy(), turned, at, _matrix(values), values[4:])
            yield view, seen.reshape(-1, 2), slopes


def _prior(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Rows [9, 9] that turn (log fx, log fy, cx, ..., k3) about their mean [9] into deviations."""
    height, width = size
    centred = _CENTRED * math.hypot(width, height)
    rows = np.diag(1 / np.array([1.0, 1, centred, centred, *_DISTORTION]))
    rows[:2, :2] = [[0.5 / _FOCAL[1], 0.5 / _FOCAL[1]], [1 / _SQUARE, -1 / _SQUARE]]
    focal = math.log(max(size)) + _FOCAL[0]
    return rows, np.array([focal, focal, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0])


def _values(unknowns: np.ndarray) -> np.ndarray:
    return np.concatenate([np.exp(unknowns[:2]), unknowns[2:9]])


def _matrix(values: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = values[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
