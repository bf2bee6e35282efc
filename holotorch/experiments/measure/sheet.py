"""The sheet of the protocol grid2d: a grid and a chessboard to print, and the directions of the sheet in a frame."""

from collections.abc import Iterable
from pathlib import Path

from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.measure.grid import Grid
from holotorch.experiments.tracking.calibrate import parse_board
from holotorch.io.files import write_text
from holotorch.tracking import Camera
from holotorch.tracking.camera.boards import Charuco, Chessboard, board_rotation, find_board

_PAGE = (297.0, 210.0)  # mm: A4, landscape
_MARGIN, _GAP = 15.0, 18.0  # mm: to the paper's edges, which printers leave white, and between grid and chessboard
_BELOW = 25.0  # mm: for the scale bar and its words
_BAR = 100.0  # mm


def chessboard(text: str) -> Chessboard:
    """The chessboard of a configuration. ConfigError for another board or an invalid one."""
    board = parse_board(text.split())
    if isinstance(board, Charuco):
        raise ConfigError([f"grid.board: expected a chessboard, as the sheet shows one, got {text!r}"])
    return board


def write_sheet(path: Path, grid: Grid, board: Chessboard) -> None:
    """Write a sheet in true millimetres as an SVG of A4 landscape: grid, chessboard, and a bar to check the printer.

    Raises:
        ConfigError: The file exists already or is no SVG, or the sheet has no room for the grid and the board.
    """
    if path.suffix.lower() != ".svg":
        raise ConfigError([f"--print: expected a file that ends in .svg, got {path}"])
    if path.exists():
        raise ConfigError([f"{path} exists already; choose another name or delete it"])
    step, side = 1e3 * grid.spacing, 1e3 * board.square
    size = (grid.columns - 1) * step, (grid.rows - 1) * step
    squares = board.columns + 1, board.rows + 1
    wide = 2 * _MARGIN + size[0] + _GAP + squares[0] * side
    high = 2 * _MARGIN + _BELOW + max(size[1], squares[1] * side)
    if wide > _PAGE[0] + 1e-6 or high > _PAGE[1] + 1e-6:
        raise ConfigError(
            [
                f"grid and chessboard need {wide:.0f} x {high:.0f} mm with their margins, and A4 has {_PAGE[0]:.0f} x "
                f"{_PAGE[1]:.0f} mm: choose fewer points, a smaller spacing or smaller squares"
            ]
        )
    left = _MARGIN + size[0] + _GAP
    lines = [
        f'<line x1="{_MARGIN:g}" y1="{y:g}" x2="{_MARGIN + size[0]:g}" y2="{y:g}"/>'
        for y in (_MARGIN + step * i for i in range(grid.rows))
    ]
    lines += [
        f'<line x1="{x:g}" y1="{_MARGIN:g}" x2="{x:g}" y2="{_MARGIN + size[1]:g}"/>'
        for x in (_MARGIN + step * i for i in range(grid.columns))
    ]
    row, column = divmod(grid.reference, grid.columns)
    dark = [
        f'<rect x="{left + side * x:g}" y="{_MARGIN + side * y:g}" width="{side:g}" height="{side:g}"/>'
        for y in range(squares[1])
        for x in range(squares[0])
        if (x + y) % 2 == 0
    ]
    bar = _PAGE[1] - _MARGIN - 12
    text = (
        f"Print at 100 %: this bar must be {_BAR:g} mm long. Points: {grid}. "
        f"Board: {board.columns}x{board.rows} inner corners, {side:g} mm. Start at the upper left."
    )
    middle = f'cx="{_MARGIN + column * step:g}" cy="{_MARGIN + row * step:g}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_PAGE[0]:g}mm" height="{_PAGE[1]:g}mm" '
        f'viewBox="0 0 {_PAGE[0]:g} {_PAGE[1]:g}">',
        f'<rect width="{_PAGE[0]:g}" height="{_PAGE[1]:g}" fill="white"/>',
        '<g id="grid" stroke="black" stroke-width="0.15" stroke-linecap="square">',
        *lines,
        "</g>",
        f'<circle id="reference" {middle} r="1.5" fill="none" stroke="black" stroke-width="0.15"/>',
        '<g id="chessboard" fill="black">',
        *dark,
        "</g>",
        f'<path id="bar" d="M{_MARGIN:g} {bar - 2:g}v4m0 -2h{_BAR:g}m0 -2v4" fill="none" stroke="black" '
        'stroke-width="0.3"/>',
        f'<text x="{_MARGIN:g}" y="{bar + 8:g}" font-family="sans-serif" font-size="3.5">{text}</text>',
        "</svg>",
    ]
    write_text(path, "\n".join(parts) + "\n")


def sheet_rotation(frames: Iterable[Tensor], board: Chessboard, camera: Camera) -> Tensor | None:
    """Rotation [3, 3] from the axes of a board (right, down, away) to the camera's; None if no frame shows the board.

    Args:
        frames: uint8 [3, H, W] each; the first that shows the board counts.
        board: The chessboard on the sheet.
        camera: The camera that took the frames.
    """
    for frame in frames:
        try:
            return board_rotation(find_board(frame, board), camera)
        except ValueError:
            continue
    return None
