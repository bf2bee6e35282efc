"""Intrinsics from one to three views of a board, with a prior of ordinary cameras for what these do not determine."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from holotorch.tracking.camera.boards import View

# The prior is wide enough for phones, webcams and machine vision, but not for fisheye lenses.
_FOCAL = math.log(0.9), 0.5  # mean and sd of ln(focal length / longer side): fields of view of 37 to 85 degrees
_SQUARE = 0.01  # sd of ln(fx / fy): pixels are nearly square
_CENTRED = 0.05  # sd of the principal point about the middle of the picture, in diagonals
_DISTORTION = (0.3, 1.0, 0.005, 0.005, 2.0)  # sd of k1, k2, p1, p2, k3 about 0
_TRAITS = ("focal length", "fx / fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_STRANGE = 3.0  # deviation from the prior, in standard deviations, above which the prior does not apply
_STARTS = (0.5, 0.7, 0.9, 1.3, 2.0)  # focal lengths / longer side to start from: one view may have several minima
# Factor on the scatter of corners, since errors of neighbouring corners are correlated (bent boards, uneven light).
# Each of OpenCV's 13 sample photographs deviates from the camera by the other 12 by 1.2 to 4.2 times the scatter of
# its corners, with a median of 2.9.
_CORRELATION = 3.0
_SHARPEST = 0.02  # pixels: least scatter of corners
_STEPS = 200  # most steps of a fit; photographs take 30, those of bent boards 80
_ROUNDS = 4  # alternations between fitting and estimating the scatter


class Estimate(NamedTuple):
    """Estimated intrinsics fx, fy, cx, cy, k1, k2, p1, p2, k3.

    Attributes:
        values: [9] estimates.
        deviations: [9] standard deviations for correlated errors of the corners.
        formal: [9] standard deviations for independent errors of the corners.
        normals: [n, 3] normals of the boards.
        errors: [n] root mean square errors of the views in pixels.
    """

    values: np.ndarray
    deviations: np.ndarray
    formal: np.ndarray
    normals: np.ndarray
    errors: np.ndarray


def estimate(views: Sequence[View], size: tuple[int, int]) -> Estimate:
    """Maximum a posteriori intrinsics from views of a board in photographs of (H, W), with a prior of ordinary cameras.

    The deviations are those of the posterior, linearised at its maximum. A frontal view of a board does not determine
    the focal length, whose deviation then stays above 30 %.

    Raises:
        ValueError: The views do not determine the poses of the board, or contradict the prior.

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
    rotations = fit.unknowns[9:].reshape(-1, 6)[:, :3]
    return Estimate(
        values,
        scale * fit.deviations,
        scale * fit.formal,
        np.stack([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations]),
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
    prior: np.ndarray  # [9, 9]: whitens the intrinsics about their mean
    mean: np.ndarray  # [9]

    def starts(self, size: tuple[int, int]) -> list[np.ndarray]:
        """Unknowns of ordinary cameras with several focal lengths, to start from."""
        unknowns = []
        for share in _STARTS:
            values = np.concatenate([2 * [share * max(size)], self.mean[2:]])
            poses = [
                cv2.solvePnP(view.points.numpy(), view.pixels.numpy(), _matrix(values), None)[1:] for view in self.views
            ]
            unknowns.append(
                np.concatenate([np.log(values[:2]), values[2:], *(part.ravel() for pose in poses for part in pose)])
            )
        return unknowns

    def fit(self, starts: Sequence[np.ndarray], scatter: float) -> _Fit:
        """Best of the minima from ``starts`` for a given scatter of the corners, with an estimate of this scatter."""
        error = _CORRELATION * scatter
        fits = [
            # SciPy's default for the derivatives is a string, and pyright infers the type of the argument from it.
            least_squares(self.residuals, start, self.slopes, x_scale="jac", max_nfev=_STEPS, args=(error,))  # pyright: ignore[reportArgumentType]
            for start in starts
        ]
        best = min(fits, key=lambda fit: fit.cost)
        if best.status < 1:
            raise np.linalg.LinAlgError("no minimum found")
        corners = best.jac[9:]
        normal, belief = corners.T @ corners, np.zeros((best.x.size, best.x.size))
        belief[:9, :9] = self.prior.T @ self.prior
        covariance, formal = np.linalg.inv(normal + belief), np.linalg.inv(_CORRELATION**2 * normal + belief)
        determined = np.trace(covariance @ normal)  # number of parameters that the corners determine, not the prior
        missed = error * best.fun[9:]
        left = math.sqrt(missed @ missed / (missed.size - determined))
        deviations, formal = (np.sqrt(np.diag(part)[:9]) for part in (covariance, formal))
        return _Fit(best.x, deviations, formal, missed.reshape(-1, 2), max(left, _SHARPEST))

    def residuals(self, unknowns: np.ndarray, error: float) -> np.ndarray:
        """Residuals in standard deviations: of the intrinsics from ``mean``, then of all corners."""
        parts = [self.prior @ (unknowns[:9] - self.mean)]
        parts += [(image - view.pixels.numpy()).ravel() / error for view, image, _ in self._project(unknowns)]
        return np.concatenate(parts)

    def slopes(self, unknowns: np.ndarray, error: float) -> np.ndarray:
        """Derivatives of ``residuals``."""
        blocks = [np.pad(self.prior, ((0, 0), (0, unknowns.size - 9)))]
        for i, (_, image, slopes) in enumerate(self._project(unknowns)):
            rows = np.zeros((image.size, unknowns.size))
            rows[:, :9] = slopes[:, 6:15]
            rows[:, :2] *= np.exp(unknowns[:2])
            rows[:, 9 + 6 * i : 15 + 6 * i] = slopes[:, :6]
            blocks.append(rows / error)
        return np.concatenate(blocks)

    def _project(self, unknowns: np.ndarray) -> Iterator[tuple[View, np.ndarray, np.ndarray]]:
        values = _values(unknowns)
        for view, (rotation, translation) in zip(self.views, unknowns[9:].reshape(-1, 2, 3), strict=True):
            image, slopes = cv2.projectPoints(view.points.numpy(), rotation, translation, _matrix(values), values[4:])
            yield view, image.reshape(-1, 2), slopes


def _prior(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Matrix [9, 9] that whitens (log fx, log fy, cx, ..., k3) about their mean [9], and this mean."""
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
