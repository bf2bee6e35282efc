"""A grid that a tip visits: which rest belongs to which point, and the accuracy of Secs. 3.5.2 and 3.5.3."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.measure.config import GRIDS, MeasureSettings
from holotorch.experiments.measure.rests import Rest
from holotorch.tracking.evaluation.protocols import grid_accuracy, planar_accuracy
from holotorch.tracking.pose.alignment import rigid_map

# Costs in the search for the points of the rests, in squared errors of a step of a quarter of the spacing.
_SKIP = 2.0  # a point that was forgotten: a step of two spacings for one would cost 16
_DROP = 3.0  # a rest that is no point, such as a pause of the hand
_DROPPED = 3  # most successive rests that are no points


@dataclass(frozen=True)
class Grid:
    """Points in rows from top to bottom, each row from left to right.

    Attributes:
        rows, columns: Numbers of points.
        spacing: Distance of neighbours in metres.
        reference: Index of the reference point.
    """

    rows: int
    columns: int
    spacing: float
    reference: int

    @classmethod
    def of(cls, settings: MeasureSettings) -> "Grid":
        """The grid of a configuration. ConfigError for a reference that is no point of it."""
        rows, columns, spacing = GRIDS[settings.protocol]
        given = settings.grid
        rows, columns, spacing = given.rows or rows, given.columns or columns, given.spacing or spacing
        row, column = given.reference or (rows // 2 + 1, columns // 2 + 1)
        if row > rows or column > columns:
            point = f"row {row}, column {column}"
            raise ConfigError([f"reference: expected a point of {rows} rows and {columns} columns, got {point}"])
        return cls(rows, columns, spacing, (row - 1) * columns + column - 1)

    def __len__(self) -> int:
        return self.rows * self.columns

    @property
    def points(self) -> Tensor:
        """Coordinates float64 [n, 2] in metres to the right and up, from the upper left point."""
        row, column = torch.arange(len(self)) // self.columns, torch.arange(len(self)) % self.columns
        return self.spacing * torch.stack([column, -row], -1).to(torch.float64)

    @property
    def solid(self) -> Tensor:
        """The same points with a third coordinate 0, [n, 3]."""
        return torch.nn.functional.pad(self.points, (0, 1))

    def name(self, index: int) -> str:
        """Row and column of a point, counted from 1."""
        return f"row {index // self.columns + 1}, column {index % self.columns + 1}"

    def __str__(self) -> str:
        size = f"{self.rows} rows x {self.columns} columns, {1e3 * self.spacing:g} mm apart"
        return f"{size}, reference {self.name(self.reference)}"


@dataclass(frozen=True, eq=False)
class Visited:
    """The points of a grid and the rests at them.

    Attributes:
        rests: The rest at each point, None where there is none.
        tips: [n, 3] in metres; NaN where there is no rest.
        notes: Remarks for the user.
    """

    rests: list[Rest | None]
    tips: Tensor
    notes: list[str]

    @property
    def missing(self) -> list[int]:
        """Indices of the points without a rest."""
        return [i for i, rest in enumerate(self.rests) if rest is None]


def visit(rests: Sequence[Rest], grid: Grid) -> Visited:
    """Find the point of each rest from the distances between successive rests, then check them by a rigid fit.

    Points may be missing, and rests in between may be pauses of the hand. Neither position nor direction of the grid
    is needed. Rests on fewer rows than there are count as the first rows: the hand stopped early.

    Raises:
        ConfigError: There is no rest, or the rests do not lie on such a grid in this order.
    """
    if not rests:
        raise ConfigError(
            [f"no rest found for the {len(grid)} points: hold the tip still at each, or change rest.spread and seconds"]
        )
    tips = torch.tensor([rest.tip for rest in rests], dtype=torch.float64)
    points = _in_order(tips, grid)
    at: list[Rest | None] = [None] * len(grid)
    notes = []
    for rest, point in zip(rests, points, strict=True):
        if point is None:
            notes.append(f"the rest at {rest.start:.1f} s fits no point in this order and is left out")
            continue
        at[point] = rest
        if rest.touches > 1:
            notes.append(f"{grid.name(point)} was touched {rest.touches} times; the last counts")
    tips = torch.full((len(grid), 3), torch.nan, dtype=torch.float64)
    for i, rest in enumerate(at):
        if rest is not None:
            tips[i] = torch.tensor(rest.tip, dtype=torch.float64)
    visited = Visited(at, tips, notes)
    errors = fitted(tips, grid)[1]
    if bool((errors > grid.spacing / 2).any()):
        worst = int(errors.nan_to_num(0).argmax())
        rest = at[worst]
        raise ConfigError(
            [
                f"the {len(rests)} rests do not lie on a grid of {grid}: the one at {rest.start if rest else 0:.1f} s, "
                f"expected at {grid.name(worst)}, is {1e3 * float(errors[worst]):.1f} mm away from it; were the points "
                "touched row by row, each row from left to right, and are rows, columns and spacing right?"
            ]
        )
    return visited


def need_all(visited: Visited, grid: Grid) -> None:
    """Raise ConfigError if points are missing."""
    if missing := visited.missing:
        names = "; ".join(grid.name(i) for i in missing[:5]) + (f"; and {len(missing) - 5} more" if missing[5:] else "")
        count = len(grid) - len(missing)
        text = f"found rests at {count} of {len(grid)} points, missing: {names}"
        raise ConfigError([f"{text}; record again, or evaluate those that are there with --partial"])


def fitted(tips: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Best rigid map [4, 4] from the camera to the grid (right, up, toward), and the errors [n] in metres after it."""
    known = tips.isfinite().all(-1)
    matrix = rigid_map(tips[known], grid.solid[known])
    return matrix, (tips @ matrix[:3, :3].mT + matrix[:3, 3] - grid.solid).norm(dim=-1)


def directions(tips: Tensor, grid: Grid, board: Tensor) -> tuple[Tensor, Tensor]:
    """Directions right and up [3] of the grid in the camera's frame, of the axes of a board on the same sheet.

    A chessboard may look the same after a turn. Of its directions, those nearest to the grid that was touched are
    taken.

    Args:
        tips: [n, 3] tips at the points of the grid in metres; NaN where there is none.
        grid: The grid.
        board: Rotation [3, 3] from the board's axes to the camera's.
    """
    rotation = fitted(tips, grid)[0][:3, :3]  # its rows are the grid's axes in the camera's frame
    axes = torch.cat([board[:, :2].mT, -board[:, :2].mT])
    right = axes[int((axes @ rotation[0]).argmax())]
    up = axes[int((axes @ rotation[1]).argmax())]
    return right, up


def accuracy(visited: Visited, grid: Grid, board: Tensor | None) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Errors of the visited points: a summary in mm, and a row of the table of points for each.

    Raises:
        ConfigError: The reference point, or every other one, is missing.
    """
    try:
        result = grid_accuracy(visited.tips, grid.solid, grid.reference)
    except ValueError as error:
        where = f"{grid.name(grid.reference)}"
        raise ConfigError([f"reference {where}: {error}; name another point with --reference ROW,COLUMN"]) from None
    summary: dict[str, Any] = {"points": result.answered, "missing": [grid.name(i) for i in visited.missing]}
    summary["acc_mm"] = 1e3 * result.acc
    if math.isfinite(result.rigid[0]):
        summary |= dict(zip(("median_mm", "p95_mm", "largest_mm"), (1e3 * x for x in result.rigid), strict=True))
    offsets = visited.tips - visited.tips[grid.reference]
    designed = grid.points - grid.points[grid.reference]
    plane = torch.full_like(designed, torch.nan)
    if board is not None:
        right, up = directions(visited.tips, grid, board)
        planar = planar_accuracy(visited.tips, grid.points, right, up, grid.reference)
        summary |= {"in_plane_mm": 1e3 * planar.in_plane, "in_space_mm": 1e3 * planar.in_space}
        plane = offsets @ torch.stack([right, up], -1) - designed
    distance, (_, rigid) = offsets.norm(dim=-1) - designed.norm(dim=-1), fitted(visited.tips, grid)
    rows = []
    for i, rest in enumerate(visited.rests):
        row: dict[str, Any] = {"row": i // grid.columns + 1, "column": i % grid.columns + 1}
        row |= dict(zip(("x_m", "y_m", "z_m"), rest.tip if rest else ("", "", ""), strict=True))
        row |= {"sd_mm": 1e3 * rest.sd, "frames": rest.frames} if rest else {"sd_mm": "", "frames": 0}
        row |= {"start_s": rest.start, "end_s": rest.end} if rest else {"start_s": "", "end_s": ""}
        row |= {"distance_error_mm": _cell(distance[i]), "rigid_error_mm": _cell(rigid[i])}
        row |= {"right_error_mm": _cell(plane[i, 0]), "up_error_mm": _cell(plane[i, 1])}
        rows.append(row)
    return summary, rows


def _cell(metres: Tensor) -> float | str:
    """Millimetres, or an empty cell for NaN."""
    return 1e3 * float(metres) if bool(metres.isfinite()) else ""


def _in_order(tips: Tensor, grid: Grid) -> list[int | None]:
    """Index of the point of each rest [k, 3], increasing; None for a rest that is no point (shortest path)."""
    points, count = grid.points, len(tips)
    index = torch.arange(len(grid))
    apart = (points[:, None] - points[None]).norm(dim=-1)  # [from, to]
    skipped = _SKIP * (index[None] - index[:, None] - 1).double()
    skipped[index[None] <= index[:, None]] = torch.inf
    best: list[Tensor] = []  # least cost of the rests up to i if i is at each point
    before: list[list[tuple[int, int] | None]] = []  # rest and point before, for each point of rest i
    for i in range(count):
        costs = _SKIP * index.double() + _DROP * i
        came: list[tuple[int, int] | None] = [None] * len(grid)
        for j in range(max(0, i - 1 - _DROPPED), i):
            step = (apart - (tips[i] - tips[j]).norm()) / (grid.spacing / 4)
            total = best[j][:, None] + step.square() + skipped + _DROP * (i - j - 1)
            least, start = total.min(0)
            better = least < costs
            came = [(j, s) if b else c for b, s, c in zip(better.tolist(), start.tolist(), came, strict=True)]
            costs = torch.where(better, least, costs)
        best.append(costs)
        before.append(came)
    # A whole row at the beginning or at the end may be missing, which looks the same: it is taken to be the last one.
    ends = torch.stack([costs + 0.99 * _SKIP * (len(grid) - 1 - index) for costs in best])
    ends += _DROP * (count - 1 - torch.arange(count).double())[:, None]
    chosen: list[int | None] = [None] * count
    at: tuple[int, int] | None = divmod(int(ends.argmin()), len(grid))
    while at is not None:
        chosen[at[0]] = at[1]
        at = before[at[0]][at[1]]
    return chosen
