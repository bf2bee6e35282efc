"""Intrinsics from one to three views of a board, which do not suffice without a prior of ordinary cameras."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from holotorch.tracking.camera.boards import View

_TRAITS = ("focal length", "fx / fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")  # in the order of the prior
# Factor on the scatter of the corners, whose errors are correlated (bent boards, uneven light): each of OpenCV's 13
# sample photographs deviates from the camera of the other 12 by 1.2 to 4.2 times its scatter, with a median of 2.9.
_CORRELATION = 3.0


class Estimate(NamedTuple):
    """Estimated intrinsics.

    Attributes:
        values: [9] fx, fy, cx, cy, k1, k2, p1, p2, k3.
        deviations: [9] standard deviations for correlated errors of the corners.
        formal: [9] standard deviations for independent errors of the corners.
        normals: [n, 3] normals of the boards in the frame of the camera.
        errors: [n] root mean square reprojection errors of the views in pixels.
    """

    values: np.ndarray
    deviations: np.ndarray
    formal: np.ndarray
    normals: np.ndarray
    errors: np.ndarray


def estimate(views: Sequence[View], size: tuple[int, int]) -> Estimate:
    """Maximum a posteriori intrinsics from views of a board in photographs of ``size`` (H, W).

    The deviations are those of the posterior, linearised at its maximum. A frontal view of a board does not determine
    the focal length, whose deviation is then above 30 %.

    Raises:
        ValueError: The views do not determine the poses of the board, or contradict the prior.

    Source: Gauss-Newton steps in a trust region (SciPy) on OpenCV's projection and its derivatives.
    """
    problem = _Problem(views, *_prior(size))
    try:
        fit = problem.fit(problem.starts(size), 0.5)
        for _ in range(3):  # the scatter of the corners is unknown at first
            fit = problem.fit([fit.unknowns], fit.scatter)
    except (cv2.error, np.linalg.LinAlgError):
        raise ValueError("the views do not determine a camera: are these the board's corners?") from None
    contradiction = np.abs(problem.whitening @ (fit.unknowns[:9] - problem.mean))
    worst = int(contradiction.argmax())
    if contradiction[worst] > 3:
        raise ValueError(
            f"so few views are fitted with a prior for ordinary cameras, which they contradict: {_TRAITS[worst]} "
            f"by {contradiction[worst]:.1f} deviations; is the board's shape right, the photograph not cropped, the "
            "lens no fisheye? If so, take 10 or more, which determine any camera"
        )
    values = _values(fit.unknowns)
    scale = np.concatenate([values[:2], np.ones(7)])
    normals = Rotation.from_rotvec(fit.unknowns[9:].reshape(-1, 6)[:, :3]).as_matrix()[:, :, 2]
    errors = np.split(fit.errors, np.cumsum([len(view.points) for view in views])[:-1])
    rms = np.array([math.sqrt(np.square(part).sum(-1).mean()) for part in errors])
    return Estimate(values, scale * fit.deviations, scale * fit.formal, normals, rms)


def camera_matrix(values: np.ndarray) -> np.ndarray:
    """Matrix [3, 3] of a camera from values that begin with fx, fy, cx, cy."""
    fx, fy, cx, cy = values[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


class _Fit(NamedTuple):
    unknowns: np.ndarray  # log fx, log fy, cx, cy, k1, k2, p1, p2, k3, then rotation and translation of each view
    deviations: np.ndarray  # [9] of the first unknowns, for correlated errors of the corners
    formal: np.ndarray  # [9] of the first unknowns, for independent errors of the corners
    errors: np.ndarray  # [corners, 2] reprojection errors in pixels
    scatter: float  # standard deviation of an error in pixels


class _Problem(NamedTuple):
    views: Sequence[View]
    whitening: np.ndarray  # [9, 9]: (intrinsics - mean) times this matrix have unit covariance under the prior
    mean: np.ndarray  # [9] prior mean of the first unknowns

    def starts(self, size: tuple[int, int]) -> list[np.ndarray]:
        """Initial unknowns for several focal lengths, since the fit of a single view may have several minima."""
        starts = []
        for focal in (0.5, 0.7, 0.9, 1.3, 2.0):  # in longer sides of the picture
            values = np.concatenate([2 * [focal * max(size)], self.mean[2:]])
            matrix = camera_matrix(values)
            poses = [cv2.solvePnP(view.points.numpy(), view.pixels.numpy(), matrix, None)[1:] for view in self.views]
            starts.append(np.concatenate([np.log(values[:2]), values[2:], np.ravel(poses)]))
        return starts

    def fit(self, starts: Sequence[np.ndarray], scatter: float) -> _Fit:
        """Best of the minima from ``starts``, for a given scatter of the corners in pixels."""
        error = _CORRELATION * scatter
        fits = [
            # SciPy's default for the derivatives is a string, and pyright infers the type of the argument from it.
            least_squares(self.residuals, start, self.jacobian, x_scale="jac", max_nfev=200, args=(error,))  # pyright: ignore[reportArgumentType]
            for start in starts
        ]
        best = min(fits, key=lambda fit: fit.cost)
        if best.status < 1:
            raise np.linalg.LinAlgError("no minimum found")
        corners = best.jac[9:]
        normal, prior = corners.T @ corners, np.zeros((best.x.size, best.x.size))
        prior[:9, :9] = self.whitening.T @ self.whitening
        covariance, formal = np.linalg.inv(normal + prior), np.linalg.inv(_CORRELATION**2 * normal + prior)
        determined = np.trace(covariance @ normal)  # effective number of unknowns that the corners determine
        errors = error * best.fun[9:]
        scatter = max(math.sqrt(errors @ errors / (errors.size - determined)), 0.02)
        deviations, formal = (np.sqrt(np.diag(part)[:9]) for part in (covariance, formal))
        return _Fit(best.x, deviations, formal, errors.reshape(-1, 2), scatter)

    def residuals(self, unknowns: np.ndarray, error: float) -> np.ndarray:
        """Residuals of the prior [9] and of all corners, in standard deviations; ``error`` is that of a corner."""
        parts = [self.whitening @ (unknowns[:9] - self.mean)]
        parts += [(image - view.pixels.numpy()).ravel() / error for view, image, _ in self._project(unknowns)]
        return np.concatenate(parts)

    def jacobian(self, unknowns: np.ndarray, error: float) -> np.ndarray:
        """Derivatives of ``residuals`` with respect to the unknowns."""
        blocks = [np.pad(self.whitening, ((0, 0), (0, unknowns.size - 9)))]
        for i, (_, image, slopes) in enumerate(self._project(unknowns)):
            rows = np.zeros((image.size, unknowns.size))
            rows[:, :9] = slopes[:, 6:15]
            rows[:, :2] *= np.exp(unknowns[:2])
            rows[:, 9 + 6 * i : 15 + 6 * i] = slopes[:, :6]
            blocks.append(rows / error)
        return np.concatenate(blocks)

    def _project(self, unknowns: np.ndarray) -> Iterator[tuple[View, np.ndarray, np.ndarray]]:
        """Each view with the images [n, 2] of its corners and their derivatives as by OpenCV."""
        values = _values(unknowns)
        matrix = camera_matrix(values)
        for view, (rotation, translation) in zip(self.views, unknowns[9:].reshape(-1, 2, 3), strict=True):
            image, slopes = cv2.projectPoints(view.points.numpy(), rotation, translation, matrix, values[4:])
            yield view, image.reshape(-1, 2), slopes


def _prior(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Whitening matrix [9, 9] and mean [9] of log fx, log fy, cx, cy, k1, k2, p1, p2, k3 for all but fisheye lenses."""
    height, width = size
    centre_sd, focal_sd, ratio_sd = 0.05 * math.hypot(width, height), 0.5, 0.01  # pixels, ln(fx), ln(fx / fy)
    rows = np.diag(1 / np.array([1.0, 1, centre_sd, centre_sd, 0.3, 1.0, 0.005, 0.005, 2.0]))
    rows[:2, :2] = [[0.5 / focal_sd, 0.5 / focal_sd], [1 / ratio_sd, -1 / ratio_sd]]
    focal = math.log(max(size)) + math.log(0.9)  # a field of view of 58 degrees, 37 to 85 within one deviation
    return rows, np.array([focal, focal, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0])


def _values(unknowns: np.ndarray) -> np.ndarray:
    return np.concatenate([np.exp(unknowns[:2]), unknowns[2:9]])
