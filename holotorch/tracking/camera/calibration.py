"""Intrinsics of a camera from photographs of a board, with standard deviations."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from holotorch.tracking.camera.boards import View
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.few_views import Estimate, camera_matrix, estimate

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
SURE = 2e-3  # relative deviation of the focal length above which there is a warning: 1 mm for a tip at 0.5 m
_CHECKED = 4  # least number of views for a jackknife and for leaving out bad views
_ADVISED = 10  # number of views below which there is a warning
_SCATTER = 1.0  # pixels: median error of the views above which something is wrong with board, pictures or views
_CELLS = (6, 8)  # rows and columns of the grid of cells that the coverage counts


@dataclass(frozen=True)
class Coverage:
    """Share of the picture and ranges of tilts and distances that the views cover.

    Attributes:
        cells: Share of the cells of a 6 x 8 grid over the picture that contain at least one corner.
        radius: Largest distance of a corner from the middle of the picture, as a share of half its diagonal.
        tilts: Smallest and largest angle between the normal of a board and the axis of the camera, in radians.
        between: Largest angle between two boards, in radians.
        distances: Smallest and largest distance of a board's middle from the camera, in the unit of the boards. A wrong
            size of the squares changes nothing but these.
    """

    cells: float
    radius: float
    tilts: tuple[float, float]
    between: float
    distances: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration.

    Attributes:
        camera: Estimated camera.
        size: (H, W) of the photographs in pixels; the camera is valid for frames of this size.
        deviations: Standard deviation of each of ``PARAMETERS``: the larger of ``formal`` and a jackknife over the
            views. The jackknife includes errors that the corners of a view share, such as those of a corner detector.
            For fewer than 4 views see ``holotorch.tracking.camera.few_views``.
        formal: Standard deviations for independent errors of the corners, by linear propagation.
        rms_px: Root mean square reprojection error of all corners used, in pixels.
        views: Root mean square reprojection error in pixels of each view used, by name.
        left_out: Root mean square reprojection error in pixels of each view left out, by name.
        coverage: Coverage by the views used.
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
    three quarters of the views and at least 4 remain; the same if they spoil the fit to all others, as those of another
    camera do. Fewer than 4 views are supplemented by a prior for
    ordinary cameras, which is not accurate enough for measurements; its uncertainty is part of the deviations.

    Args:
        views: 10 or more views of a flat board with different tilts; see ``holotorch.tracking.camera.boards``. A bend
            of 1 mm over 200 mm causes an error of about 2 % in the focal length. It is the same in all views, so that
            the deviations do not include it.
        size: (H, W) of the photographs in pixels.

    Raises:
        ValueError: No views, parallel boards, views that do not determine the focal length (deviation above 20 %), or
            corners outside the picture. The message says what to do.

    Source: Zhang (2000) as in OpenCV's calibrateCameraExtended; jackknife by Quenouille and Tukey.
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
    chosen, errors, fit = _selected(kept, size)
    left_out = {names[i]: error for i, error in errors.items()}
    kept, names = [kept[i] for i in chosen], [names[i] for i in chosen]
    coverage = _coverage(kept, fit, size)
    if len(kept) >= _CHECKED:
        if coverage.between < math.radians(10):
            raise ValueError(
                _no_single_camera(fit, names)
                or f"all boards are parallel to within {math.degrees(coverage.between):.1f} degrees, which does "
                "not determine the focal length; tilt the board by 20 to 45 degrees to several sides"
            )
        fit = fit._replace(deviations=np.maximum(fit.formal, _jackknife(kept, size, fit)))
    relative = float(max(fit.deviations[:2] / fit.values[:2]))
    if not relative <= 0.2:
        raise ValueError(
            _no_single_camera(fit, names)
            or f"the views determine the focal length only to {100 * relative:.0f} % (one standard deviation); tilt "
            "the board by 20 to 45 degrees to several sides and fill the picture with it"
        )
    camera = _camera(fit, size)
    weights = np.array([len(view.points) for view in kept])
    return Calibration(
        camera,
        (int(height), int(width)),
        dict(zip(PARAMETERS, fit.deviations.tolist(), strict=True)),
        dict(zip(PARAMETERS, fit.formal.tolist(), strict=True)),
        math.sqrt(float((fit.errors**2 * weights).sum() / weights.sum())),
        dict(zip(names, fit.errors.tolist(), strict=True)),
        left_out,
        coverage,
        _warnings(camera, size, relative, coverage, fit.errors),
    )


def _selected(views: Sequence[View], size: tuple[int, int]) -> tuple[list[int], dict[int, float], Estimate]:
    """Indices of the views to use, rms errors in pixels of the others by index, and the fit to the former."""
    kept, left_out = list(range(len(views))), dict[int, float]()
    fit = estimate(views, size) if len(kept) < _CHECKED else _fit(views, size)
    while _may_drop(len(kept), len(views)):
        worst = int(fit.errors.argmax())
        if fit.errors[worst] <= _limit(fit):
            break
        left_out[kept.pop(worst)] = float(fit.errors[worst])
        fit = _fit([views[i] for i in kept], size)
    if len(views) > _CHECKED and np.median(fit.errors) > _SCATTER:
        with suppress(ValueError):  # what remains determines no camera
            return _trimmed(views, size) or (kept, left_out, fit)
    return kept, left_out, fit


def _trimmed(views: Sequence[View], size: tuple[int, int]) -> tuple[list[int], dict[int, float], Estimate] | None:
    """As :func:`_selected`, for views of which some spoil the fit to all others, such as those of another camera.

    The quarter with the largest errors is dropped, one view at a time, and what fits the camera of the others comes
    back. None if the others do not fit one camera either.
    """
    kept = list(range(len(views)))
    fit = _fit(views, size)
    while _may_drop(len(kept), len(views)):
        kept.pop(int(fit.errors.argmax()))
        fit = _fit([views[i] for i in kept], size)
    if np.median(fit.errors) > _SCATTER:
        return None
    errors = dict(enumerate(reprojection(_camera(fit, size), views).tolist()))
    kept = [i for i, error in errors.items() if i in kept or error <= _limit(fit)]
    return kept, {i: error for i, error in errors.items() if i not in kept}, _fit([views[i] for i in kept], size)


def _no_single_camera(fit: Estimate, names: Sequence[str]) -> str:
    """What is wrong with views that scatter too much to be of one camera; empty if they do not."""
    scatter, worst = float(np.median(fit.errors)), int(fit.errors.argmax())
    if scatter <= _SCATTER:
        return ""
    return (
        f"the views fit no single camera: half of them by {scatter:.1f} px or worse, {names[worst]} by "
        f"{fit.errors[worst]:.1f} px; leave out those of another camera, zoom or board, and give the corners of the "
        "whole board: in a part of it, such as 8x5 of 9x6, other corners are detected in each view"
    )


def _may_drop(kept: int, count: int) -> bool:
    """Whether one of the ``kept`` views may be left out, so that three quarters and those that check remain."""
    return kept > _CHECKED and 4 * (kept - 1) >= 3 * count


def _limit(fit: Estimate) -> float:
    """Largest rms error in pixels of a view that agrees with the others."""
    return max(3 * float(np.median(fit.errors)), 0.5)


def _camera(fit: Estimate, size: tuple[int, int]) -> Camera:
    return Camera(torch.from_numpy(camera_matrix(fit.values)), torch.from_numpy(fit.values[4:].copy()), size=size)


def reprojection(camera: Camera, views: Sequence[View]) -> Tensor:
    """Root mean square reprojection errors [n] of views in pixels for a given camera and fitted poses of the boards.

    A large error, even of a single photograph, shows that a calibration is no longer valid. A small one does not prove
    that it is valid, since many cameras give the same image of a board with little tilt.
    """
    matrix, distortion = camera.matrix.detach().cpu().numpy(), camera.distortion.detach().cpu().numpy()
    errors = []
    for view in views:
        points, pixels = view.points.numpy(), view.pixels.numpy()
        _, rotation, translation = cv2.solvePnP(points, pixels, matrix, distortion)
        image = cv2.projectPoints(points, rotation, translation, matrix, distortion)[0].reshape(-1, 2)
        errors.append(math.sqrt(float(((image - pixels) ** 2).sum(-1).mean())))
    return torch.tensor(errors, dtype=torch.float64)


def _fit(views: Sequence[View], size: tuple[int, int], start: np.ndarray | None = None) -> Estimate:
    """Maximum likelihood estimate for independent errors of the corners; ``start`` [9] are approximate values."""
    points = [view.points.numpy().astype(np.float32) for view in views]
    pixels = [view.pixels.numpy().astype(np.float32) for view in views]
    matrix, distortion, flags = np.eye(3), np.zeros(5), 0
    if start is not None:
        matrix, distortion, flags = camera_matrix(start), start[4:].copy(), cv2.CALIB_USE_INTRINSIC_GUESS
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
    normals = Rotation.from_rotvec(np.reshape(rotations, (-1, 3))).as_matrix()[:, :, 2]
    if not (np.isfinite(values).all() and (values[:2] > 0).all() and np.isfinite(errors).all()):
        raise ValueError("the views do not determine a camera: tilt the board by 20 to 45 degrees to several sides")
    deviations = deviations.reshape(-1)[:9]
    return Estimate(values, deviations, deviations, normals, errors.reshape(-1))


def _jackknife(views: Sequence[View], size: tuple[int, int], fit: Estimate) -> np.ndarray:
    """Standard deviations [9] by a jackknife over at most 20 groups of views; infinite if one group is essential."""
    groups = min(len(views), 20)
    values = []
    for group in range(groups):
        rest = [view for i, view in enumerate(views) if i % groups != group]
        try:
            values.append(_fit(rest, size, fit.values).values)
        except ValueError:
            return np.full(len(PARAMETERS), math.inf)
    return np.sqrt((groups - 1) / groups * np.square(np.stack(values) - np.mean(values, 0)).sum(0))


def _coverage(views: Sequence[View], fit: Estimate, size: tuple[int, int]) -> Coverage:
    pixels = torch.cat([view.pixels for view in views]).numpy()
    extent = np.array(size[::-1], dtype=float)
    cells = np.clip((pixels + 0.5) / extent * _CELLS[::-1], 0, np.array(_CELLS[::-1]) - 1).astype(int)
    radius = np.linalg.norm(pixels - (extent - 1) / 2, axis=-1).max() / np.linalg.norm((extent - 1) / 2)
    tilts = np.arccos(np.abs(fit.normals[:, 2]).clip(0, 1))
    crossed = np.linalg.norm(np.cross(fit.normals[:, None], fit.normals[None]), axis=-1)
    between = np.arctan2(crossed, np.abs(fit.normals @ fit.normals.T)).max()
    share = len(np.unique(cells, axis=0)) / math.prod(_CELLS)
    away = [_distance(view, fit) for view in views]
    tilted = float(tilts.min()), float(tilts.max())
    return Coverage(share, float(radius), tilted, float(between), (min(away), max(away)))


def _distance(view: View, fit: Estimate) -> float:
    """Distance of a board's middle from the camera, in the unit of its points."""
    points, pixels = view.points.numpy(), view.pixels.numpy()
    _, rotation, translation = cv2.solvePnP(points, pixels, camera_matrix(fit.values), fit.values[4:])
    middle = Rotation.from_rotvec(rotation[:, 0]).apply(points.mean(0)) + translation[:, 0]
    return float(np.linalg.norm(middle))


def _warnings(
    camera: Camera, size: tuple[int, int], relative: float, coverage: Coverage, errors: np.ndarray
) -> tuple[str, ...]:
    """Warnings that apply, for the relative deviation of the focal length and the rms errors of the views."""
    count, scatter, (height, width) = len(errors), float(np.median(errors)), size
    corners = torch.tensor([[0.0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=torch.float64)
    warnings = {
        f"Too few views to check one another ({count}): the rest is assumed as for ordinary cameras, "
        f"too inaccurate for measurements. Take {_ADVISED} or more.": count < _CHECKED,
        f"Only {count} views: take {_ADVISED} or more.": _CHECKED <= count < _ADVISED,
        f"The focal length is known to {100 * relative:.1f} % only: at 0.5 m that may move a tip by "
        f"{500 * relative:.1f} mm. Take more views, tilted by 20 to 45 degrees to several sides.": relative > SURE,
        f"Corners in {100 * coverage.cells:.0f} % of the picture: move the board to all parts of it.": (
            coverage.cells < 0.6
        ),
        f"No corner beyond {100 * coverage.radius:.0f} % of the way to the picture's corners: the distortion there is "
        "a guess.": coverage.radius < 0.8,
        f"The boards differ by {math.degrees(coverage.between):.0f} degrees at most: tilt the board more, to several "
        "sides.": count > 1 and coverage.between < math.radians(25),
        f"The corners scatter by {scatter:.1f} px: is the board flat, the picture sharp?": scatter > _SCATTER,
        "The fitted distortion cannot be inverted in the picture's corners: no poses there. Take views with the board "
        "there.": bool(camera.undistort(corners).isnan().any()),
    }
    return tuple(text for text, applies in warnings.items() if applies)
