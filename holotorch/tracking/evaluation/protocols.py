"""Performance of a tracker: stability, accuracy over grids, false poses, and coverage of its covariances.

Tips are float64 [n, 3] in metres, one row per frame in the order of time. A row of NaN is a refused frame.
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

_UNKNOWN = (math.nan, math.nan, math.nan)


class Stability(NamedTuple):
    """Stability of the tip of a catheter at rest.

    Attributes:
        s_rms: Eq. 3.13 in metres: root mean square change from one frame to the next; insensitive to drift.
        sd: Root mean square distance from the mean tip in metres, over all three axes, with n - 1 degrees of freedom.
            White noise gives s_rms = sqrt(2) sd; drift gives a larger sd, flicker a larger s_rms.
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
            point. It is insensitive to a constant bias and to errors perpendicular to the line to the reference point.
        absolute: Median, 95th percentile and maximum of the distance from the true tip; NaN without ground truth.
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
        answered, refused: Numbers of points with and without a pose, not counting the reference.
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
    """Stability of unfiltered tips [n, 3] of a catheter at rest. Differences across refused frames do not count.

    Raises:
        TypeError, ValueError: ``tips`` is no floating tensor [n, 3], or no two consecutive frames have a pose.

    Source: Eq. 3.13. With no refusals there are n - 1 differences, as printed.
    """
    tips = _rows("tips", tips)
    known = _answered(tips)
    changes = tips.diff(dim=0)[known[1:] & known[:-1]]
    if not len(changes):
        raise ValueError(f"no two neighbouring frames of {len(tips)} were answered; stability needs at least two")
    spread = (tips[known] - tips[known].mean(0)).square().sum() / (int(known.sum()) - 1)
    root = changes.square().sum(-1).mean().sqrt()
    return Stability(float(root), float(spread.sqrt()), len(changes), int(known.sum()))


def grid_accuracy(found: Tensor, grid: Tensor, reference: int, truth: Tensor | None = None) -> GridAccuracy:
    """Accuracy of tips ``found`` [n, 3] at the points of a ``grid`` [n, 3], one face of Sec. 3.5.3.

    Args:
        found: Measured tips in metres, in the camera's frame; NaN where refused.
        grid: Designed points in metres, in any frame.
        reference: Index of the reference point.
        truth: True tips [n, 3] in the camera's frame, where they are known, as for synthetic frames.

    Raises:
        TypeError, ValueError: Shapes that differ, a reference that is no point or was refused, or a grid with NaN.

    Source: Sec. 3.5.3. The printed mean divides by all 64 points, although the error of the reference is zero by
    construction. This function divides by the number of the other points with a pose, 63 for a full face.
    """
    found, grid = _rows("found", found), _rows("grid", grid, like=found)
    checks.all_finite("grid", grid)
    others, known = _others(found, reference)
    designed = (grid - grid[reference]).norm(dim=-1)
    measured = (found - found[reference]).norm(dim=-1)
    acc = (designed - measured).abs()[others]
    absolute = rigid = _UNKNOWN
    if truth is not None:
        truth = _rows("truth", truth, like=found)
        checks.all_finite("truth", truth)
        absolute = _summed((found - truth)[known].norm(dim=-1))
    if int(known.sum()) >= 3:  # fewer points always fit
        fitted = rigid_map(found[known], grid[known])
        rigid = _summed((found[known] @ fitted[:3, :3].mT + fitted[:3, 3] - grid[known]).norm(dim=-1))
    count = int(known.sum())
    return GridAccuracy(float(acc.mean()), absolute, rigid, count, len(found) - count)


def planar_accuracy(found: Tensor, grid: Tensor, right: Tensor, up: Tensor, reference: int) -> PlanarAccuracy:
    """Mean errors of tips ``found`` [n, 3] at the intersections ``grid`` [n, 2] of a printed grid, Sec. 3.5.2.

    Args:
        found: Measured tips in metres, in the camera's frame; NaN where refused.
        grid: Intersections in metres along ``right`` and ``up``.
        right: Direction [3] of the grid's first axis in the camera's frame, as a marker under the sheet gives it.
        up: Direction [3] of its second axis, perpendicular to the first to within one degree.
        reference: Index of the intersection that all positions are relative to.

    Raises:
        TypeError, ValueError: As :func:`grid_accuracy`, or directions that are not perpendicular.
    """
    found, grid = _rows("found", found), _rows("grid", grid, axes=2)
    if len(found) != len(grid):
        raise ValueError(f"found and grid must have a row for each point, got {len(found)} and {len(grid)}")
    checks.all_finite("grid", grid)
    axes = torch.stack([_direction("right", right), _direction("up", up)]).to(found.device)
    if abs(float(axes[0] @ axes[1])) > math.sin(math.radians(1)):
        raise ValueError(f"right and up must be at right angles, their cosine is {float(axes[0] @ axes[1]):.3g}")
    others, known = _others(found, reference)
    wanted = grid - grid[reference]
    moved = found - found[reference]
    flat = (moved @ axes.T - wanted)[others].norm(dim=-1).mean()
    space = (moved - wanted @ axes)[others].norm(dim=-1).mean()
    return PlanarAccuracy(float(flat), float(space), int(others.sum()), len(found) - int(known.sum()))


def chi_square_quantile(level: float) -> float:
    """Quantile ``level``, 0 < level < 1, of the chi-square distribution with 3 degrees of freedom."""
    if not 0 < checks.finite("level", level) < 1:
        raise ValueError(f"level must be between 0 and 1, got {level!r}")
    return float(chdtri(3, 1 - level))


def coverage(tips: Tensor, covariance: Tensor, truth: Tensor, level: float = 0.95) -> tuple[float, int]:
    """Share of poses whose confidence ellipsoid of ``level`` contains the true tip, and the number of poses.

    Args:
        tips: [n, 3] in metres; NaN where refused.
        covariance: [n, 3, 3] covariances of the tips in m^2.
        truth: [n, 3] in metres.
        level: Confidence level; correct covariances give a share close to it.

    Raises:
        TypeError, ValueError: Shapes that differ, no answered frame, NaN truth or a covariance that is not positive.
    """
    tips, truth = _rows("tips", tips), _rows("truth", truth, like=tips)
    if covariance.shape != (len(tips), 3, 3):
        raise ValueError(f"covariance must be of shape [{len(tips)}, 3, 3], got {list(covariance.shape)}")
    known = _answered(tips)
    if not bool(known.any()):
        raise ValueError(f"none of {len(tips)} frames was answered, so that there is nothing to cover")
    checks.all_finite("truth of answered frames", truth[known])
    root, failed = torch.linalg.cholesky_ex(covariance[known].to(torch.float64))
    bad = (failed > 0) | ~root.isfinite().all(-1).all(-1)
    if bool(bad.any()):
        raise ValueError(f"{int(bad.sum())} covariances are not positive definite; each answer needs one that is")
    error = (tips - truth)[known, :, None]
    distance = torch.linalg.solve_triangular(root, error, upper=False).square().sum((-2, -1))
    inside = distance <= chi_square_quantile(level)
    return float(inside.double().mean()), int(known.sum())


def counts(statuses: Iterable[IntEnum]) -> dict[str, int]:
    """Number of frames of each status that occurs, by name, in the order of the enumeration."""
    numbers = Counter(statuses)
    return {status.name: numbers[status] for status in sorted(numbers)}


def wrong_poses(tips: Tensor, truth: Tensor, limit: float = 5e-3) -> WrongPoses:
    """Count false and wrong poses.

    Args:
        tips: [n, 3] in metres; NaN where refused.
        truth: [n, 3] in metres; NaN where the frame shows no catheter.
        limit: Largest error in metres of a correct pose.
    """
    tips, truth = _rows("tips", tips), _rows("truth", truth, like=tips)
    checks.quantity(TOOL_DEVIATION, limit, "limit")
    known, present = _answered(tips), _answered(truth)
    wrong = (tips - truth).norm(dim=-1) > limit  # NaN compares as not above
    return WrongPoses(
        false=int((known & ~present).sum()),
        empty=int((~present).sum()),
        wrong=int((wrong & known & present).sum()),
        present=int(present.sum()),
        refused=int((~known & present).sum()),
    )


def _others(found: Tensor, reference: int) -> tuple[Tensor, Tensor]:
    """Two masks [n] of the points with a pose: the first excludes the reference, the second includes it."""
    checks.whole("reference", reference, 0)
    if reference >= len(found):
        raise ValueError(f"reference must be one of {len(found)} points, got {reference}")
    known = _answered(found)
    if not bool(known[reference]):
        raise ValueError(f"the reference point {reference} was refused; choose another or record it again")
    others = known.clone()
    others[reference] = False
    if not bool(others.any()):
        raise ValueError(f"of {len(found)} points only the reference was answered; accuracy needs another")
    return others, known


def _summed(errors: Tensor) -> tuple[float, float, float]:
    return float(errors.quantile(0.5)), float(errors.quantile(0.95)), float(errors.max())


def _answered(tips: Tensor) -> Tensor:
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
