"""Performance of a tracker: stability, accuracy over grids, false poses, and coverage of its covariances.

Tips are floating tensors [n, 3] in metres, one row per frame in the order of time. A row of NaN is a refused frame.
Sections and equations are those of the thesis. All functions raise TypeError or ValueError for arguments of another
type or shape than described, and if too few frames have a pose.
"""

import math
from collections import Counter
from collections.abc import Iterable
from enum import IntEnum
from typing import NamedTuple

import torch
from scipy.special import chdtri
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import TOOL_DEVIATION
from holotorch.tracking.pose.alignment import rigid_map


class Stability(NamedTuple):
    """Stability of the tip of a catheter at rest.

    Attributes:
        s_rms: Root mean square change in metres from one frame to the next, Eq. 3.13; insensitive to drift. For white
            noise it is sqrt(2) ``sd``; drift increases ``sd``, and flicker increases ``s_rms``.
        sd: Root mean square distance from the mean tip in metres, with n - 1 degrees of freedom.
        differences: Number of pairs of consecutive frames that both have a pose.
        answered: Number of frames with a pose.
    """

    s_rms: float
    sd: float
    differences: int
    answered: int


class GridAccuracy(NamedTuple):
    """Errors in metres at the points of a grid; NaN where an error is not defined.

    Attributes:
        acc: Acc_f of Sec. 3.5.3: mean absolute difference between measured and designed distances to the reference
            point. It is insensitive to a constant bias and to errors perpendicular to the direction of the reference.
        absolute: Median, 95th percentile and maximum of the distances from the true tips; NaN without true tips.
        rigid: The same statistics after the best rigid alignment of the measured points with the grid.
        answered, refused: Numbers of points with and without a pose.
    """

    acc: float
    absolute: tuple[float, float, float]
    rigid: tuple[float, float, float]
    answered: int
    refused: int


class PlanarAccuracy(NamedTuple):
    """Mean errors in metres over a planar grid, relative to its reference point, Sec. 3.5.2.

    Attributes:
        in_plane: Mean distance in the plane of the grid, as in Fig. 3.10.
        in_space: Mean distance including the error along the normal of the plane.
        answered, refused: Numbers of points with and without a pose, except for the reference.
    """

    in_plane: float
    in_space: float
    answered: int
    refused: int


class WrongPoses(NamedTuple):
    """Numbers of false and wrong poses.

    Attributes:
        false: Poses in frames without a catheter.
        empty: Frames without a catheter.
        wrong: Poses with an error above the limit, in frames with a catheter.
        present: Frames with a catheter.
        refused: Frames with a catheter but without a pose.
    """

    false: int
    empty: int
    wrong: int
    present: int
    refused: int


def s_rms(tips: Tensor) -> Stability:
    """Stability of unfiltered tips [n, 3] of a catheter at rest, by Eq. 3.13 without differences to refused frames."""
    tips = _rows("tips", tips)
    known = _has_pose(tips)
    changes = tips.diff(dim=0)[known[1:] & known[:-1]]
    if not len(changes):
        raise ValueError(f"no two neighbouring frames of {len(tips)} were answered; stability needs at least two")
    spread = (tips[known] - tips[known].mean(0)).square().sum() / (int(known.sum()) - 1)
    root = changes.square().sum(-1).mean().sqrt()
    return Stability(float(root), float(spread.sqrt()), len(changes), int(known.sum()))


def grid_accuracy(found: Tensor, grid: Tensor, reference: int, truth: Tensor | None = None) -> GridAccuracy:
    """Accuracy of tips at the points of a grid, such as one face of Sec. 3.5.3.

    Departure from Sec. 3.5.3, which divides ``acc`` by the number of all 64 points: the reference, whose error is zero
    by construction, is not counted.

    Args:
        found: [n, 3] measured tips in metres, in the camera's frame; NaN where refused.
        grid: [n, 3] designed points in metres, in any frame.
        reference: Index of the reference point, which must have a pose.
        truth: [n, 3] true tips in the camera's frame, if they are known.
    """
    found, grid = _rows("found", found), _rows("grid", grid, like=found)
    checks.all_finite("grid", grid)
    others, known = _others(found, reference)
    designed = (grid - grid[reference]).norm(dim=-1)
    measured = (found - found[reference]).norm(dim=-1)
    acc = (designed - measured).abs()[others]
    absolute = rigid = (math.nan, math.nan, math.nan)
    if truth is not None:
        truth = _rows("truth", truth, like=found)
        checks.all_finite("truth", truth)
        absolute = _statistics((found - truth)[known].norm(dim=-1))
    if int(known.sum()) >= 3:  # fewer points do not determine the alignment
        fitted = rigid_map(found[known], grid[known])
        rigid = _statistics((found[known] @ fitted[:3, :3].mT + fitted[:3, 3] - grid[known]).norm(dim=-1))
    count = int(known.sum())
    return GridAccuracy(float(acc.mean()), absolute, rigid, count, len(found) - count)


def planar_accuracy(found: Tensor, grid: Tensor, right: Tensor, up: Tensor, reference: int) -> PlanarAccuracy:
    """Distances of tips from the intersections of a printed grid, Sec. 3.5.2.

    Args:
        found: [n, 3] measured tips in metres, in the camera's frame; NaN where refused.
        grid: [n, 2] coordinates of the intersections in metres along ``right`` and ``up``.
        right: [3] direction of the grid's first axis in the camera's frame.
        up: [3] direction of its second axis, perpendicular to the first to within one degree.
        reference: Index of the intersection to which all positions are relative.
    """
    found, grid = _rows("found", found), _rows("grid", grid, like=found, axes=2)
    checks.all_finite("grid", grid)
    axes = torch.stack([_direction("right", right), _direction("up", up)]).to(found.device)
    if abs(float(axes[0] @ axes[1])) > math.sin(math.radians(1)):
        raise ValueError(f"right and up must be at right angles, their cosine is {float(axes[0] @ axes[1]):.3g}")
    others, known = _others(found, reference)
    designed, measured = grid - grid[reference], found - found[reference]
    in_plane = (measured @ axes.T - designed)[others].norm(dim=-1).mean()
    in_space = (measured - designed @ axes)[others].norm(dim=-1).mean()
    return PlanarAccuracy(float(in_plane), float(in_space), int(others.sum()), len(found) - int(known.sum()))


def chi_square_quantile(level: float) -> float:
    """Quantile ``level``, 0 < level < 1, of the chi-square distribution with 3 degrees of freedom."""
    if not 0 < checks.finite("level", level) < 1:
        raise ValueError(f"level must be between 0 and 1, got {level!r}")
    return float(chdtri(3, 1 - level))


def coverage(tips: Tensor, covariance: Tensor, truth: Tensor, level: float = 0.95) -> tuple[float, int]:
    """Share of poses whose confidence ellipsoid contains the true tip, and the number of poses.

    Args:
        tips: [n, 3] in metres; NaN where refused.
        covariance: [n, 3, 3] covariances of the tips in m^2, positive definite where there is a pose.
        truth: [n, 3] true tips in metres.
        level: Confidence level, which is the expected share for correct covariances.
    """
    tips, truth = _rows("tips", tips), _rows("truth", truth, like=tips)
    if covariance.shape != (len(tips), 3, 3):
        raise ValueError(f"covariance must be of shape [{len(tips)}, 3, 3], got {list(covariance.shape)}")
    known = _has_pose(tips)
    if not bool(known.any()):
        raise ValueError(f"none of {len(tips)} frames was answered, so that there is nothing to cover")
    checks.all_finite("truth of answered frames", truth[known])
    root, failed = torch.linalg.cholesky_ex(covariance[known].to(torch.float64))
    bad = (failed > 0) | ~root.isfinite().flatten(1).all(-1)
    if bool(bad.any()):
        raise ValueError(f"{int(bad.sum())} covariances are not positive definite; each answer needs one that is")
    error = (tips - truth)[known, :, None]
    distance = torch.linalg.solve_triangular(root, error, upper=False).square().sum((-2, -1))
    inside = distance <= chi_square_quantile(level)
    return float(inside.double().mean()), int(known.sum())


def counts(statuses: Iterable[IntEnum]) -> dict[str, int]:
    """Number of frames of each status that occurs, by its name, in the order of the enumeration."""
    numbers = Counter(statuses)
    return {status.name: numbers[status] for status in sorted(numbers)}


def wrong_poses(tips: Tensor, truth: Tensor, limit: float = 5e-3) -> WrongPoses:
    """Count false and wrong poses, the latter with errors of ``tips`` [n, 3] above ``limit`` in metres.

    ``truth`` [n, 3] are the true tips, NaN for frames without a catheter.
    """
    tips, truth = _rows("tips", tips), _rows("truth", truth, like=tips)
    checks.quantity(TOOL_DEVIATION, limit, "limit")
    known, present = _has_pose(tips), _has_pose(truth)
    wrong = (tips - truth).norm(dim=-1) > limit  # False for NaN
    return WrongPoses(
        false=int((known & ~present).sum()),
        empty=int((~present).sum()),
        wrong=int((wrong & known & present).sum()),
        present=int(present.sum()),
        refused=int((~known & present).sum()),
    )


def _others(found: Tensor, reference: int) -> tuple[Tensor, Tensor]:
    """Masks [n] of the points with a pose: without the reference, and with it."""
    checks.whole("reference", reference, 0)
    if reference >= len(found):
        raise ValueError(f"reference must be one of {len(found)} points, got {reference}")
    known = _has_pose(found)
    if not bool(known[reference]):
        raise ValueError(f"the reference point {reference} was refused; choose another or record it again")
    others = known.clone()
    others[reference] = False
    if not bool(others.any()):
        raise ValueError(f"of {len(found)} points only the reference was answered; accuracy needs another")
    return others, known


def _statistics(errors: Tensor) -> tuple[float, float, float]:
    """Median, 95th percentile and maximum."""
    return float(errors.quantile(0.5)), float(errors.quantile(0.95)), float(errors.max())


def _has_pose(tips: Tensor) -> Tensor:
    return tips.isfinite().all(-1)


def _direction(name: str, value: Tensor) -> Tensor:
    value = torch.as_tensor(value).to(torch.float64)
    if value.shape != (3,) or not bool(value.isfinite().all()) or not float(value.norm()):
        raise ValueError(f"{name} must be a direction of three finite numbers, got {value.tolist()}")
    return value / value.norm()


def _rows(name: str, value: Tensor, *, like: Tensor | None = None, axes: int = 3) -> Tensor:
    checks.real(name, value)
    if value.ndim != 2 or value.shape[1] != axes or not len(value):
        raise ValueError(f"{name} must be of shape [n, {axes}], n >= 1, in metres, got {list(value.shape)}")
    if like is not None and len(value) != len(like):
        raise ValueError(f"{name} must have a row for each of {len(like)}, got {len(value)}")
    return value.to(torch.float64)
