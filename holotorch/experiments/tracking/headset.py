"""``holotorch calibrate headset``: the place of a camera on a headset from recorded alignments of one tool."""

import csv
import math
from pathlib import Path

import torch
from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking.devices import save_headset
from holotorch.tracking.pose.alignment import HAND_LENGTH, Alignment, headset_from_camera, in_frame, tool_points
from holotorch.tracking.pose.status import Pose, Status

_AXES = ("x", "y", "z")
_PARTS = [
    f"{frame}_{what}_{axis}" for frame in ("camera", "headset") for what in ("tip", "direction") for axis in _AXES
]
COLUMNS = tuple(f"{name}_m" if "_tip_" in name else name for name in _PARTS)  # of a file of alignments
_LETTERS = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}
_SLIPPED = 3.0  # ratio of the residual of an alignment left out to the median of all, above which it probably slipped


def calibrate_headset(path: Path, out: Path, axes: str = "RDF") -> tuple[Alignment, Tensor]:
    """Fit the map from camera to headset to recorded alignments and write it to ``out``.

    Args:
        path: CSV file with ``COLUMNS``, a line per alignment: the tip in metres and the direction from tip to rear of
            the tool, as the camera measured it and as the headset showed the virtual tool that the user put on it.
        out: YAML file for the map; must not exist yet.
        axes: Directions of the headset's axes x, y, z in the file: right or left, up or down, forward or backward, such
            as RUB for WebXR and OpenXR, RUF for Unity. The map is written for RDF, like the camera's axes.

    Returns:
        The alignment, and the points [n, 2, 3] of the tools in the headset's frame.

    Raises:
        ConfigError: The file is not such a table, the alignments do not determine the map, or ``out`` exists.
    """
    turn = axes_matrix(axes)
    if out.exists():
        raise ConfigError([f"{out} exists already; choose another --out or delete it"])
    values = read_alignments(path)
    try:
        camera = tool_points(values[:, 0:3], values[:, 3:6], HAND_LENGTH)
        headset = tool_points(values[:, 6:9] @ turn.mT, values[:, 9:12] @ turn.mT, HAND_LENGTH)
        alignment = headset_from_camera(camera, headset)
    except ValueError as error:
        raise ConfigError([f"{path}: {error}"]) from None
    save_headset(out, alignment)
    return alignment, headset


def read_alignments(path: Path) -> Tensor:
    """Values [n, 12] of ``COLUMNS``, float64. ConfigError names the line that cannot be read."""
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            table = csv.DictReader(stream)
            if missing := [name for name in COLUMNS if name not in (table.fieldnames or ())]:
                raise ConfigError(
                    [f"{path}: not a table of alignments, columns {', '.join(missing[:3])} ... are missing"]
                )
            rows = []
            for row in table:
                try:
                    rows.append([float(row[name]) for name in COLUMNS])
                except (TypeError, ValueError) as error:
                    raise ConfigError([f"{path}:{table.line_num}: cannot be read as an alignment: {error}"]) from None
    except (UnicodeDecodeError, csv.Error):
        raise ConfigError([f"{path}: not a table of alignments: not a text file"]) from None
    except OSError as error:
        raise ConfigError([f"{path}: {error.strerror or error}"]) from None
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 12)


def axes_matrix(axes: str) -> Tensor:
    """Matrix [3, 3] from coordinates along ``axes`` to RDF; ConfigError unless they are three different directions."""
    letters = [_LETTERS.get(letter) for letter in axes.upper()]
    known = [letter for letter in letters if letter is not None]
    if len(axes) != 3 or sorted(axis for axis, _ in known) != [0, 1, 2]:
        expected = "one of R L, one of U D and one of F B, such as RDF, RUB (WebXR) or RUF (Unity)"
        raise ConfigError([f"--axes: expected {expected}, got {axes!r}"])
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    for column, (axis, sign) in enumerate(known):
        matrix[axis, column] = sign
    return matrix


def alignment_text(alignment: Alignment, headset: Tensor) -> str:
    """Quality of an alignment, in words: residuals, prediction of new poses, and what to do about it."""
    left_out = alignment.leave_one_out
    expected = float(_tip_deviation(alignment, headset))
    lines = [
        f"Alignments {len(left_out)}, residuals {1e3 * float(alignment.residuals.square().mean().sqrt()):.2f} mm (rms)",
        f"Tip        expected within {1e3 * expected:.2f} mm (standard deviation, in the middle of the alignments)",
    ]
    for number, (residual, other) in enumerate(zip(alignment.residuals.tolist(), left_out.tolist(), strict=True), 1):
        without = (
            f"{1e3 * other:.2f} mm from the others" if math.isfinite(other) else "the others alone determine nothing"
        )
        lines.append(f"Alignment  {number}: {1e3 * residual:.2f} mm; {without}")
    finite = left_out[left_out.isfinite()]
    if len(finite) > 3 and float(finite.max()) > _SLIPPED * float(finite.median()):
        worst = int(torch.where(left_out.isfinite(), left_out, 0.0).argmax()) + 1
        lines.append(f"Warning    alignment {worst} does not fit the others; repeat it")
    if len(left_out) < 6:
        lines.append(f"Warning    only {len(left_out)} alignments; six or more, 45 degrees apart, halve the error")
    return "\n".join(lines)


def _tip_deviation(alignment: Alignment, headset: Tensor) -> Tensor:
    """Standard deviation of a tip in the middle of the alignments, in metres."""
    zero = torch.zeros((), dtype=torch.float64)
    middle, along = headset[:, 0].mean(0).detach(), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    pose = Pose(middle, along, torch.zeros(6, 6, dtype=torch.float64), zero, zero, Status.OK)
    return in_frame(pose, torch.eye(4, dtype=torch.float64), alignment.covariance).tip_sd
