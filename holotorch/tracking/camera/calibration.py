"""Intrinsics of a camera from photographs of a board, with standard deviations from a jackknife over the views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.tracking.camera.boards import View
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.few_views import estimate

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
SURE = 2e-3  # relative deviation of the focal length above which a warning follows: it moves a tip at 0.5 m by 1 mm
_CHECKED = 4  # least number of views for a jackknife and for leaving out bad views
_ADVISED = 10  # number of views below which a warning follows
_SAME_TILT = math.radians(10)  # least angle between boards: nearly parallel boards do not determine the focal length
_WORST = 0.2  # relative deviation of the focal length above which the views do not determine it
_GROUPS = 20  # most groups of views of the jackknife
_CELLS = (6, 8)  # rows and columns of the parts of the picture that the coverage counts


@dataclass(frozen=True)
class Coverage:
    """Share of the picture and range of tilts that the views cover.

    Attributes:
        cells: Share of the 6 x 8 parts of the picture that contain at least one corner.
        radius: Largest distance of a corner from the middle, as a share of half the picture's diagonal.
        tilts: Smallest and largest angle between the boards' normals and the axis of the camera, in radians.
        between: Largest angle between two boards, in radians.
    """

    cells: float
    radius: float
    tilts: tuple[float, float]
    between: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration.

    Attributes:
        camera: Estimated camera.
        size: (H, W) of the photographs in pixels; the camera is valid for frames of this size.
        deviations: Standard deviation of each of ``PARAMETERS``: the larger one of that by linear propagation of the
            scatter of the corners (OpenCV) and that by a jackknife over the views. The former assumes independent
            errors of the corners, but bent boards and corner detectors cause correlated ones. For fewer than 4 views
            see ``holotorch.tracking.camera.few_views``.
        formal: Standard deviations for independent errors of the corners, for comparison.
        rms_px: Root mean square reprojection error of all corners used, in pixels.
        views: Root mean square error in pixels of each view used, by name.
        left_out: The same for the views left out: those above 3 times the median and above 0.5 px.
        coverage: Coverage of the views used.
        warnings: Recommendations, one or two sentences each.
    """

    camera: Camera
    size: tuple[int, int]
    deviations: dict[str, float]
    formal: dict[str, float]
    rms_px: float
    views: dict[str, float]
    left_out: dict[str, float]
    coverage: Coverage
    warnings: tuple[str, ...]


def calibrate(views: Sequence[View], size: tuple[int, int]) -> Calibration:
    """Estimate focal lengths, principal point and five distortion coefficients from views of a board.

    Views with an rms error above 3 times the median and above 0.5 px are left out, the worst one first, as long as
    three quarters of the views and at least 4 remain. Fewer than 4 views are completed by a prior of ordinary cameras
    (square pixels, central principal point, moderate distortion, no fisheye), whose uncertainty is part of the
    deviations. Such a calibration is a start, but not accurate enough for measurements.

    Args:
        views: 10 or more views of a flat board with different tilts; see ``holotorch.tracking.camera.boards``. A bend
            of the board is the same in all views, so that no deviation includes it: a bend of 1 mm over 200 mm causes
            an error of about 2 % in the focal length.
        size: (H, W) of the photographs in pixels.

    Raises:
        ValueError: No views, parallel boards, views that do not determine the focal length (deviation above 20 %), or
            corners outside the picture. The message says what to do.

    Source: Zhang (2000) as in OpenCV's calibrateCameraExtended; jackknife by Quenouille and Tukey, over up to 20 groups
    of views.
    """
    height, width = size
    kept = list(views)
    if not kept:
        raise ValueError(f"a calibration needs photographs that show the board, better {_ADVISED} or more, got none")
    for view in kept:
        low, high = view.pixels.amin(0), view.pixels.amax(0)
        if low.min() < -0.5 or high[0] > width - 0.5 or high[1] > height - 0.5:
            raise ValueError(f"corners must lie within {width} x {height} px, but {view.name!r} has others")
    names = [view.name or f"view {i}" for i, view in enumerate(kept)]
    left_out: dict[str, float] = {}
    if len(kept) < _CHECKED:
        values, spread, formal, normals, errors = estimate(kept, size)
        fit = _Fit(values, formal, normals, errors)
        coverage = _coverage(kept, fit, size)
    else:
        fit = _fit(kept, size)
        while len(kept) > _CHECKED and 4 * (len(kept) - 1) >= 3 * len(views):
            worst = int(fit.errors.argmax())
            if fit.errors[worst] <= max(3 * float(np.median(fit.errors)), 0.5):
                break
            left_out[names.pop(worst)] = float(fit.errors[worst])
            kept.pop(worst)
            fit = _fit(kept, size)
        coverage = _coverage(kept, fit, size)
        _check_tilts(coverage)
        spread = np.maximum(fit.deviations, _jackknife(kept, size, fit))
    relative = float(max(spread[:2] / fit.values[:2]))
    if not relative <= _WORST:
        raise ValueError(
            f"the views leave the focal length open to {100 * relative:.0f} % (one standard deviation); tilt the board "
            "by 20 to 45 degrees to several sides and fill the picture with it"
        )
    camera = replace(fit.camera, size=size)
    weights = np.array([len(view.points) for view in kept])
    return Calibration(
        camera,
        (int(height), int(width)),
        dict(zip(PARAMETERS, spread.tolist(), strict=True)),
        dict(zip(PARAMETERS, fit.deviations.tolist(), strict=True)),
        math.sqrt(float((fit.errors**2 * weights).sum() / weights.sum())),
        dict(zip(names, fit.errors.tolist(), strict=True)),
        left_out,
        coverage,
        tuple(_warnings(camera, size, len(kept), relative, coverage, fit.errors)),
    )


def reprojection(camera: Camera, views: Sequence[View]) -> Tensor:
    """Root mean square reprojection errors [n] of views in pixels for a given camera, with fitted poses of the boards.

    A large error shows that an earlier calibration no longer holds; one photograph suffices. A small error alone does
    not prove the camera right: many cameras give the same image of a board with little tilt.
    """
    matrix, distortion = camera.matrix.detach().cpu().numpy(), camera.distortion.detach().cpu().numpy()
    errors = []
    for view in views:
        points, pixels = view.points.numpy(), view.pixels.numpy()
        _, rotation, translation = cv2.solvePnP(points, pixels, matrix, distortion)
        image = cv2.projectPoints(points, rotation, translation, matrix, distortion)[0].reshape(-1, 2)
        errors.append(math.sqrt(float(((image - pixels) ** 2).sum(-1).mean())))
    return torch.tensor(errors, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class _Fit:
    values: np.ndarray  # [9], as PARAMETERS
    deviations: np.ndarray  # [9]
    normals: np.ndarray  # [n, 3] of the boards
    errors: np.ndarray  # [n], rms in pixels

    @property
    def camera(self) -> Camera:
        fx, fy, cx, cy = self.values[:4].tolist()
        matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        return Camera(matrix, torch.from_numpy(self.values[4:].copy()))


def _fit(views: Sequence[View], size: tuple[int, int], start: _Fit | None = None) -> _Fit:
    points = [view.points.numpy().astype(np.float32) for view in views]
    pixels = [view.pixels.numpy().astype(np.float32) for view in views]
    matrix, distortion, flags = np.eye(3), np.zeros(5), 0
    if start is not None:
        matrix, distortion = start.camera.matrix.numpy(), start.values[4:].copy()
        flags = cv2.CALIB_USE_INTRINSIC_GUESS
    try:
        _, matrix, distortion, rotations, _, deviations, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size[::-1], matrix, distortion, flags=flags
        )
    except cv2.error:
        raise ValueError(
            "the views do not determine a camera: they are too much alike; tilt the board by 20 to 45 degrees to "
            "several sides"
        ) from None
    values = np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]], distortion.reshape(-1)[:5]])
    normals = np.stack([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    if not (np.isfinite(values).all() and (values[:2] > 0).all() and np.isfinite(errors).all()):
        raise ValueError("the views do not determine a camera: tilt the board by 20 to 45 degrees to several sides")
    return _Fit(values, deviations.reshape(-1)[:9], normals, errors.reshape(-1))


def _jackknife(views: Sequence[View], size: tuple[int, int], whole: _Fit) -> np.ndarray:
    groups = min(len(views), _GROUPS)
    values = []
    for group in range(groups):
        rest = [view for i, view in enumerate(views) if i % groups != group]
        try:
            values.append(_fit(rest, size, whole).values)
        except ValueError:  # without this group, the views do not determine a camera
            return np.full(len(PARAMETERS), math.inf)
    return np.sqrt((groups - 1) / groups * np.square(np.stack(values) - np.mean(values, 0)).sum(0))


def _coverage(views: Sequence[View], fit: _Fit, size: tuple[int, int]) -> Coverage:
    pixels = torch.cat([view.pixels for view in views]).numpy()
    extent = np.array(size[::-1], dtype=float)
    cells = np.clip((pixels + 0.5) / extent * _CELLS[::-1], 0, np.array(_CELLS[::-1]) - 1).astype(int)
    radius = np.linalg.norm(pixels - (extent - 1) / 2, axis=-1).max() / np.linalg.norm((extent - 1) / 2)
    along = np.abs(fit.normals[:, 2]).clip(0, 1)
    tilts = np.arccos(along)
    crossed = np.linalg.norm(np.cross(fit.normals[:, None], fit.normals[None]), axis=-1)
    between = np.arctan2(crossed, np.abs(fit.normals @ fit.normals.T)).max()
    share = len(np.unique(cells, axis=0)) / math.prod(_CELLS)
    return Coverage(share, float(radius), (float(tilts.min()), float(tilts.max())), float(between))


def _check_tilts(coverage: Coverage) -> None:
    if coverage.between < _SAME_TILT:
        raise ValueError(
            f"all boards are parallel to within {math.degrees(coverage.between):.1f} degrees, which leaves the focal "
            "length open; tilt the board by 20 to 45 degrees to several sides"
        )


def _warnings(
    camera: Camera, size: tuple[int, int], count: int, relative: float, coverage: Coverage, errors: np.ndarray
) -> list[str]:
    warnings = []
    if count < _CHECKED:
        warnings.append(
            f"Too few views to check one another ({count}): what is open is taken from ordinary cameras, which is a "
            f"start and no measurement. Take {_ADVISED} or more."
        )
    elif count < _ADVISED:
        warnings.append(f"Only {count} views: take {_ADVISED} or more.")
    if relative > SURE:
        warnings.append(
            f"The focal length is known to {100 * relative:.1f} % only: at 0.5 m that may move a tip by "
            f"{500 * relative:.1f} mm. Take more views, tilted by 20 to 45 degrees to several sides."
        )
    if coverage.cells < 0.6:
        warnings.append(f"Corners in {100 * coverage.cells:.0f} % of the picture: move the board to all parts of it.")
    if coverage.radius < 0.8:
        warnings.append(
            f"No corner beyond {100 * coverage.radius:.0f} % of the way to the picture's corners: the distortion there "
            "is a guess."
        )
    if count > 1 and coverage.between < math.radians(25):
        warnings.append(
            f"The boards differ by {math.degrees(coverage.between):.0f} degrees at most: tilt the board more, to "
            "several sides."
        )
    if float(np.median(errors)) > 1:
        warnings.append(
            f"The corners scatter by {float(np.median(errors)):.1f} px: is the board flat, the picture sharp?"
        )
    height, width = size
    corners = torch.tensor([[0.0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=torch.float64)
    if bool(camera.undistort(corners).isnan().any()):
        warnings.append("The fitted distortion cannot be inverted in the picture's corners: no answers from there.")
    return warnings
