"""Corners of chessboards and ChArUco boards in photographs."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import BOARD_SQUARE
from holotorch.tracking.camera.camera import Camera

_DICTIONARIES = {name: getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name.startswith("DICT_")}
_ADVICE_PX = 800  # larger side of the picture in which a board of unknown size is searched
_FEWEST = 8  # least number of corners of a view: 4 determine a homography, the others check it


@dataclass(frozen=True)
class Chessboard:
    """A plain chessboard.

    Attributes:
        columns, rows: Numbers of inner corners, 3 to 100; a board of 10 x 7 squares has 9 x 6.
        square: Side of a square in metres.
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        _check_sides(self, least=3)  # OpenCV finds no smaller boards
        checks.quantity(BOARD_SQUARE, self.square)


@dataclass(frozen=True)
class Charuco:
    """A chessboard with a marker in each white square. It may be partly hidden or outside the picture.

    Attributes:
        columns, rows: Numbers of squares, 4 to 100.
        square, marker: Sides of a square and of a marker in metres.
        dictionary: OpenCV's name of the dictionary of the markers, such as DICT_6X6_250.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str

    def __post_init__(self) -> None:
        _check_sides(self, least=4)
        if not checks.quantity(BOARD_SQUARE, self.marker, "marker") < checks.quantity(BOARD_SQUARE, self.square):
            raise ValueError(f"marker must be smaller than square, {self.square:g} m, got {self.marker:g} m")
        if self.dictionary not in _DICTIONARIES:
            raise ValueError(f"dictionary must be one of {', '.join(_DICTIONARIES)}, got {self.dictionary!r}")
        held = len(cv2.aruco.getPredefinedDictionary(_DICTIONARIES[self.dictionary]).bytesList)
        if held < (needed := self.columns * self.rows // 2):
            raise ValueError(f"the board has {needed} markers, {self.dictionary} only {held}; check the board's size")


@dataclass(frozen=True, eq=False)
class View:
    """Corners of a board in one photograph.

    Attributes:
        points: float64 [n, 3], n >= 8 corners in the frame of the board in metres, z = 0.
        pixels: float64 [n, 2], the images (x, y) of the corners; (0, 0) is the centre of the upper left pixel.
        name: Name of the photograph.
    """

    points: Tensor
    pixels: Tensor
    name: str = ""

    def __post_init__(self) -> None:
        for name, width in (("points", 3), ("pixels", 2)):
            value = torch.as_tensor(getattr(self, name)).to(torch.float64)
            if value.ndim != 2 or value.shape[1] != width:
                raise ValueError(f"{name} must be of shape [n, {width}], got {list(value.shape)}")
            checks.all_finite(name, value)
            object.__setattr__(self, name, value)
        if len(self.points) != len(self.pixels) or len(self.points) < _FEWEST:
            raise ValueError(
                f"a view must have {_FEWEST} corners or more, as many points as pixels, got {len(self.points)} and "
                f"{len(self.pixels)} in {self.name!r}"
            )
        if bool((self.points[:, 2] != 0).any()):
            raise ValueError("points must lie on the board, z = 0")


def find_board(image: Tensor, board: Chessboard | Charuco, name: str = "") -> View:
    """Detect the corners of ``board`` in a photograph, with subpixel accuracy.

    Args:
        image: uint8, grey [H, W] or RGB [3, H, W].
        board: Board to detect. If a chessboard looks the same after half a turn, its first corner is arbitrary; this
            does not influence the estimated intrinsics.
        name: Name of the photograph, for messages.

    Raises:
        TypeError, ValueError: ``image`` has another type or shape, or does not show the board.
    """
    grey = _grey(image)
    corners = _chessboard(grey, board) if isinstance(board, Chessboard) else _charuco(grey, board)
    if corners is None:
        raise ValueError(
            f"no {describe_board(board)} found; is its size right, is it flat, sharp, evenly lit and, with a white "
            "margin, in the picture?"
        )
    return View(*map(torch.from_numpy, corners), name=name)


def chessboard_size(image: Tensor) -> tuple[int, int] | None:
    """Numbers of inner corners, the larger one first, of the chessboard that a photograph shows, for advice.

    The search is a fast one in a reduced picture (Duda and Frese 2018). It finds boards of 4 x 4 inner corners or more,
    and only the visible part of one that is partly hidden; the markers of a ChArUco board often mislead it.

    Args:
        image: uint8, grey [H, W] or RGB [3, H, W].

    Returns:
        The size, or None without a chessboard.

    Raises:
        TypeError, ValueError: ``image`` has another type or shape.
    """
    grey = _grey(image)
    if (scale := _ADVICE_PX / max(grey.shape)) < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    seen, _, squares = cv2.findChessboardCornersSBWithMeta(grey, (4, 4), flags=cv2.CALIB_CB_LARGER)
    if not seen:
        return None
    rows, columns = squares.shape
    return max(rows, columns), min(rows, columns)


def board_rotation(view: View, camera: Camera) -> Tensor:
    """Rotation float64 [3, 3] from the axes of a board to those of the camera that sees it, from all corners.

    Of the two poses in which a flat board looks nearly alike (Collins and Bartoli 2014), the one with the smaller
    error is refined. ValueError if no pose in front of the camera fits.
    """
    points, pixels = view.points.numpy(), view.pixels.numpy()
    matrix, distortion = camera.matrix.detach().cpu().numpy(), camera.distortion.detach().cpu().numpy()
    count, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not count or shifts[0].ravel()[2] <= 0:
        raise ValueError("no pose of the board in front of the camera fits its corners")
    turn, _ = cv2.solvePnPRefineLM(points, pixels, matrix, distortion, turns[0], shifts[0])
    return torch.from_numpy(cv2.Rodrigues(turn)[0])


def describe_board(board: Chessboard | Charuco) -> str:
    """Description of a board for messages."""
    if isinstance(board, Chessboard):
        return f"chessboard of {board.columns} x {board.rows} inner corners"
    return f"ChArUco board of {board.columns} x {board.rows} squares ({board.dictionary})"


def _grey(image: Tensor) -> np.ndarray:
    """Grey levels uint8 [H, W] of a photograph. Raises for another type or shape."""
    if not isinstance(image, Tensor) or image.dtype != torch.uint8:
        raise TypeError(f"image must be a uint8 tensor, got {getattr(image, 'dtype', type(image).__name__)}")
    if not (image.ndim == 2 or (image.ndim == 3 and image.shape[0] == 3)) or min(image.shape[-2:]) < 32:
        raise ValueError(f"image must be [H, W] or [3, H, W] of at least 32 x 32 pixels, got {list(image.shape)}")
    grey = image.cpu().numpy()
    return grey if grey.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(grey.transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)


def _chessboard(grey: np.ndarray, board: Chessboard) -> tuple[np.ndarray, np.ndarray] | None:
    """Points [n, 3] and pixels [n, 2] of all corners, or None."""
    shape = (board.columns, board.rows)
    found, corners = cv2.findChessboardCorners(grey, shape)
    if found:
        # The search window must not contain the next corner. In one of OpenCV's sample photographs, a window of 11 px
        # causes errors of 1.2 px in the corners, and of 3 px in the focal length.
        lattice = corners.reshape(board.rows, board.columns, 2)
        steps = [np.linalg.norm(np.diff(lattice, axis=axis), axis=-1).min() for axis in (0, 1)]
        window = int(np.clip(0.4 * min(steps), 2, 11))
        end = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3  # 50 steps, or a step below 1e-3 pixels
        corners = cv2.cornerSubPix(grey, corners, (window, window), (-1, -1), end)
    else:  # each of the two methods detects some boards that the other one misses
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        found, corners = cv2.findChessboardCornersSB(grey, shape, flags=flags)
    if not found:
        return None
    points = [(x, y, 0.0) for y in range(board.rows) for x in range(board.columns)]
    return board.square * np.array(points), corners.reshape(-1, 2)


def _charuco(grey: np.ndarray, board: Charuco) -> tuple[np.ndarray, np.ndarray] | None:
    """Points [n, 3] and pixels [n, 2] of the visible corners, or None."""
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARIES[board.dictionary])
    # Boards with an even number of rows that were printed by OpenCV before 4.6 begin with a black square.
    for legacy in (False, True) if board.rows % 2 == 0 else (False,):
        pattern = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        pattern.setLegacyPattern(legacy)
        corners, numbers, *_ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
        if numbers is None or len(numbers) < _FEWEST:
            continue
        numbers = np.asarray(numbers, dtype=np.int64).reshape(-1)
        points = np.asarray(pattern.getChessboardCorners(), dtype=np.float64)[numbers]
        # Corners in a single row or column do not determine a homography.
        if np.linalg.matrix_rank(points[:, :2] - points[:, :2].mean(0), tol=1e-9) == 2:
            return points, np.asarray(corners).reshape(-1, 2)
    return None


def _check_sides(board: Chessboard | Charuco, least: int) -> None:
    for name in ("columns", "rows"):
        if checks.whole(name, getattr(board, name), least) > 100:
            raise ValueError(f"{name} must be at most 100, got {getattr(board, name)}")
