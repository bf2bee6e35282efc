"""``holotorch calibrate``: a camera's intrinsics from photographs of a board, and a report in plain text."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import torch
from pydantic_core import PydanticCustomError
from torch import Tensor

from holotorch.core.quantities import BOARD_SQUARE
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.settings import metres
from holotorch.experiments.tracking.devices import save_camera
from holotorch.io.images import load_image, with_channels
from holotorch.io.video import PICTURES
from holotorch.tracking.camera.boards import Charuco, Chessboard, View, chessboard_size, describe_board, find_board
from holotorch.tracking.camera.calibration import PARAMETERS, Calibration, calibrate

BOARD = ("chessboard", "9x6", "25mm")
_ADVISED = 3  # photographs at most in which a board of another size is searched
_KINDS = "chessboard 9x6 25mm (inner corners, square) or charuco 5x7 40mm 20mm DICT_6X6_250 (squares, square, marker)"


def calibrate_photographs(
    files: Sequence[Path], out: Path, board: Sequence[str] = BOARD
) -> tuple[Calibration, dict[str, str]]:
    """Calibrate a camera from photographs of a board and write it to ``out``.

    Args:
        files: Photographs, or folders of them, all of one size.
        out: YAML file for the camera; must not exist yet.
        board: Description of the board, in the form that :func:`parse_board` reads.

    Returns:
        The calibration, and the reason for each photograph in which no board was found.

    Raises:
        ConfigError: The photographs cannot be read, differ in size, show no board, or do not determine a camera.
    """
    kind = parse_board(board)
    paths = _listed(files)
    if out.exists() and all(path.exists() for path in paths):  # a missing photograph is named first, below
        raise ConfigError([f"{out} exists already; choose another --out or delete it"])
    mistakes: list[str] = []
    missing: dict[str, str] = {}
    views: list[View] = []
    boardless: list[Tensor] = []
    sizes: dict[str, tuple[int, int]] = {}
    names = Counter(path.name for path in paths)
    for path in paths:
        name = path.name if names[path.name] == 1 else str(path)
        if not path.exists():
            mistakes.append(f"{path}: no such file or folder")
            continue
        try:
            grey = (with_channels(load_image(path), 1)[0] * 255).round().to(torch.uint8)
        except (ValueError, OSError) as error:
            mistakes.append(f"{path}: {getattr(error, 'strerror', None) or error}")
            continue
        sizes[name] = grey.shape[0], grey.shape[1]
        try:
            views.append(find_board(grey, kind, name))
        except ValueError as error:
            missing[name] = str(error)
            boardless = [*boardless, grey][:_ADVISED]
    usual = Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)
    mistakes += [
        f"{name}: {size[1]} x {size[0]} px, the others have {usual[1]} x {usual[0]}; a calibration takes "
        "photographs of one size, not cropped or turned"
        for name, size in sizes.items()
        if size != usual
    ]
    if mistakes:
        raise ConfigError(mistakes)
    try:
        calibration = calibrate(views, usual)
    except ValueError as error:
        used = f"used {len(views)} of {len(paths)} photographs"
        advice = [] if views else _advice(kind, boardless)
        raise ConfigError([f"{used}: {error}", *_joined(missing), *advice]) from None
    out.parent.mkdir(parents=True, exist_ok=True)
    save_camera(out, calibration)
    return calibration, missing


def _advice(asked: Chessboard | Charuco, photographs: Sequence[Tensor]) -> list[str]:
    """A line with the size of the chessboard that photographs, grey uint8 [H, W], show instead of the one asked for."""
    sizes = Counter(size for size in map(chessboard_size, photographs) if size is not None)
    if not isinstance(asked, Chessboard) or not sizes:
        return []
    (larger, smaller), times = sizes.most_common(1)[0]
    differ = times == 1 and len(sizes) > 1  # hidden in part, or no chessboards
    if differ or {larger, smaller} == {asked.columns, asked.rows}:
        return []
    board, side = f"--board chessboard {larger}x{smaller}", f"{1e3 * asked.square:g}mm"
    text = f"the photographs seem to show one of {larger} x {smaller} inner corners"
    return [f"{text}: {board} {side}, if its squares have sides of {side}"]


def parse_board(arguments: Sequence[str]) -> Chessboard | Charuco:
    """Create the board that the words after ``--board`` describe. Raises ConfigError if they describe no board."""
    text, sides = " ".join(" ".join(arguments).split()), r"(\d{1,3})x(\d{1,3})"
    chessboard = re.fullmatch(rf"chessboard {sides} (\S+)", text)
    charuco = re.fullmatch(rf"charuco {sides} (\S+) (\S+) (\S+)", text)
    try:
        if chessboard:
            return Chessboard(int(chessboard[1]), int(chessboard[2]), _side(chessboard[3]))
        if charuco:
            square, marker = _side(charuco[3]), _side(charuco[4])
            return Charuco(int(charuco[1]), int(charuco[2]), square, marker, dictionary=charuco[5])
    except (PydanticCustomError, ValueError) as error:
        raise ConfigError([f"--board: {error}"]) from None
    raise ConfigError([f"--board: expected {_KINDS}, got {' '.join(arguments)!r}"])


def _side(text: str) -> float:
    """A side in metres. ValueError for a number of metres that is a usual side only in millimetres."""
    side = float(metres(text))
    plain = re.fullmatch(r"([\d.]+)m?", text)
    if plain and BOARD_SQUARE.problem(side) and not BOARD_SQUARE.problem(side / 1000):
        raise ValueError(f"{text} means metres: did you mean {plain[1]}mm?")
    return side


def calibration_text(calibration: Calibration, missing: dict[str, str], board: Sequence[str] = BOARD) -> str:
    """Lines of text that ``holotorch calibrate`` prints: camera, board, coverage, views and warnings."""
    matrix, distortion = calibration.camera.matrix, calibration.camera.distortion.tolist()
    values = [matrix[0, 0].item(), matrix[1, 1].item(), matrix[0, 2].item(), matrix[1, 2].item(), *distortion]
    parts = [f"{name} {_rounded(x, calibration.deviations[name])}" for name, x in zip(PARAMETERS, values, strict=True)]
    coverage = calibration.coverage
    between = f", {math.degrees(coverage.between):.0f} deg between boards at most" if len(calibration.views) > 1 else ""
    photographs = len(calibration.views) + len(calibration.left_out) + len(missing)
    low, high = (math.degrees(angle) for angle in coverage.tilts)
    near, away = coverage.distances
    lines = [
        f"Camera     {', '.join(parts[:4])} px, for frames of {calibration.size[1]} x {calibration.size[0]} px",
        f"Distortion {', '.join(parts[4:])}",
        f"Board      {describe_board(parse_board(board))}, rms {calibration.rms_px:.2f} px, "
        f"views: {len(calibration.views)}",
        f"Used       {len(calibration.views)} of {photographs} photographs",
        f"Coverage   {100 * coverage.cells:.0f} % of the picture, {100 * coverage.radius:.0f} % of the way to its "
        f"corners, tilts of {low:.0f} to {high:.0f} deg{between}",
        f"Distance   {near:.2g} to {away:.2g} m from the camera, if the squares are as large as stated",
    ]
    lines += [f"View       {name}: {error:.2f} px" for name, error in calibration.views.items()]
    others = (
        f"px, the others {median(calibration.views.values()):.2f} px (median): another camera or board, or blurred?"
    )
    lines += [f"Left out   {name}: {error:.2f} {others}" for name, error in calibration.left_out.items()]
    lines += [f"Not used   {line}" for line in _joined(missing)]
    lines += [f"Warning    {text}" for text in calibration.warnings]
    return "\n".join(lines)


def _joined(reasons: dict[str, str]) -> list[str]:
    """A line for each reason, with the names of all photographs to which it applies."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return [f"{', '.join(each)}: {reason}" for reason, each in names.items()]


def _rounded(value: float, deviation: float) -> str:
    """Value and deviation as text, both rounded to the second significant digit of the deviation."""
    digits = max(0, 1 - math.floor(math.log10(deviation))) if deviation > 0 else 6
    return f"{value:.{digits}f} +- {deviation:.{digits}f}"


def _listed(files: Sequence[Path]) -> list[Path]:
    """Photographs among the files and in the folders; ConfigError if there are none, or if one is given twice."""
    paths: list[Path] = []
    for path in files:
        inside = sorted(item for item in path.iterdir() if item.suffix.lower() in PICTURES) if path.is_dir() else [path]
        if not inside:
            raise ConfigError([f"{path}: no pictures in this folder ({', '.join(PICTURES)})"])
        paths += inside
    if not paths:
        raise ConfigError(["no photographs given; expected files or folders of them"])
    times_given = Counter(path.resolve() for path in paths)
    if twice := sorted({str(path) for path in paths if times_given[path.resolve()] > 1}):
        # Counting a view twice would lower the stated deviations without adding information.
        raise ConfigError([f"{path}: given twice" for path in twice])
    return paths
