"""Photographs of calibration boards, the blur and noise measured in them, and the catheter rendered into them.

The background is real; the catheter is synthetic. Blur is measured at the edges of a board's squares, noise in smooth
patches, and the colour of the light on white squares.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.special import gammainc, gammaincinv
from torch import Tensor

from holotorch.tracking.camera.boards import Chessboard, View, find_board
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.numpy_lens import Lens
from holotorch.tracking.camera.strips import Sampler
from holotorch.tracking.detection.fits import fit_edges
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.simulation.ray_camera import Light, Shot, insert
from holotorch.tracking.simulation.varied import tip_deviation
from holotorch.tracking.simulation.world import Case

_PATCH = 8  # side of the patches whose noise is measured, in pixels
_SMOOTH = 0.3  # fraction of the patches of a brightness that count as smooth
_NEAR, _FAR = 0.16, 0.3  # metres: distances of the middle of the bands, for cameras of 640 x 480 pixels
_VAGUE = 1e-3  # metres: largest standard deviation of the tip, for edges with errors of 0.05 pixels


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph of a calibration board.

    Attributes:
        name: Name of the file.
        frame: uint8 [3, H, W], RGB; all channels are equal in a grey photograph.
        camera: Its camera.
        board: Corners of the board in it, or None if they cannot be detected.
        encoded: The file's bytes if it is a JPEG file, else None.
    """

    name: str
    frame: Tensor
    camera: Camera
    board: View | None
    encoded: bytes | None = None

    @property
    def grey(self) -> bool:
        """Whether the photograph has no colours."""
        return bool((self.frame == self.frame[:1]).all())

    @property
    def light(self) -> np.ndarray:
        """Linear light float32 [H, W, 3]."""
        return self.camera.linear(self.frame).float().numpy().transpose(1, 2, 0)


@dataclass(frozen=True)
class Pixels:
    """Blur, noise and white of a photograph, in linear light of 0 to 1.

    Attributes:
        blur_px: Median standard deviation of the lens's blur at the edges of the board's squares in pixels, NaN without
            a board.
        shot_noise, read_noise: The noise's variance is shot_noise * light + read_noise^2.
        white: Light of the board's white squares; the brightest hundredth of the photograph without a board.
    """

    blur_px: float
    shot_noise: float
    read_noise: float
    white: tuple[float, float, float]


def published_camera(files: Sequence[Path]) -> Camera:
    """Camera from text files of its matrix and distortion, or from a file of OpenCV."""
    if files[0].suffix == ".txt":
        matrix, distortion = (np.loadtxt(file) for file in files)
    else:
        storage = cv2.FileStorage(str(files[0]), cv2.FILE_STORAGE_READ)
        matrix, distortion = (storage.getNode(f"{key}").mat() for key in ("camera_matrix", "distortion_coefficients"))
    return Camera(torch.from_numpy(matrix), torch.from_numpy(distortion.reshape(-1)))


def drawn_photograph(
    blur_px: float = 0.8, shot_noise: float = 3e-4, read_noise: float = 4e-3, seed: int = 0
) -> Photograph:
    """A synthetic photograph of a chessboard with known blur and noise, for use without real photographs."""
    rng, (height, width) = np.random.default_rng(seed), (480, 640)
    matrix = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(matrix, torch.zeros(5, dtype=torch.float64))
    fine = 4  # samples per pixel along each axis, whose mean is a pixel
    y, x = (np.mgrid[: height * fine, : width * fine] + 0.5) / fine - 0.5
    turn = math.radians(12)
    across = ((x - 320) * math.cos(turn) + (y - 240) * math.sin(turn)) / 40
    down = ((y - 240) * math.cos(turn) - (x - 320) * math.sin(turn)) / 40
    on = (np.abs(across) < 5) & (np.abs(down) < 3.5)
    black = on & ((np.floor(across) + np.floor(down + 0.5)) % 2 == 0)
    light = np.where(black, 0.05, 0.7)[..., None] * np.array([1.0, 0.95, 0.85])
    light = cv2.GaussianBlur(light, (0, 0), blur_px * fine)
    light = light.reshape(height, fine, width, fine, 3).mean((1, 3))
    light += rng.standard_normal(light.shape) * np.sqrt(shot_noise * light + read_noise**2)
    levels = camera.levels(torch.from_numpy(light)).add(0.5).clamp(0, 255).to(torch.uint8)
    frame = levels.permute(2, 0, 1).contiguous()
    return Photograph("drawn board (synthetic)", frame, camera, find_board(frame, Chessboard(9, 6, 0.01)))


def measure(photograph: Photograph) -> Pixels:
    """Blur, noise and white of a photograph."""
    light = photograph.light
    shot_noise, read_noise = _noise(light)
    blur, white = math.nan, np.quantile(light.reshape(-1, 3), 0.99, axis=0)
    if photograph.board is not None:
        pairs = _neighbours(photograph.board)
        blur = _blur(photograph, pairs)
        # Two squares meet at the middle of the line between two corners: the brighter one is white.
        (start, end), reach = pairs, 0.25
        beside = (start + end) / 2 + 1j * (end - start) * reach * np.array([[-1.0], [1.0]])
        seen = light[np.rint(beside.imag).astype(int), np.rint(beside.real).astype(int)]  # [2, n, 3]
        brighter = seen.sum(-1).argmax(0)
        white = np.median(seen[brighter, np.arange(seen.shape[1])], axis=0)
    red, green, blue = white.tolist()
    return Pixels(blur, shot_noise, read_noise, (red, green, blue))


def _neighbours(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Neighbouring corners of a board in its photograph, as complex numbers x + i y [n]: starts and ends of edges."""
    points, pixels = (
        value.numpy() @ np.array([1.0, 1j] + [0] * (value.shape[1] - 2)) for value in (view.points, view.pixels)
    )
    apart = np.abs(points[:, None] - points)
    step = np.min(apart[apart > 1e-9])
    one, other = np.nonzero(np.triu(np.abs(apart - step) < 0.01 * step))
    return pixels[one], pixels[other]


def _blur(photograph: Photograph, pairs: tuple[np.ndarray, np.ndarray]) -> float:
    """Median standard deviation of the edges between neighbouring corners, in pixels."""
    start, end = pairs
    along = (end - start) / np.abs(end - start)
    # A window of half a square to each side, which must not reach the next square.
    half = int(min(8, 0.4 * np.median(np.abs(end - start))))
    t, u = np.arange(-half, half + 1.0), np.linspace(0.3, 0.7, 9)
    middle = start[:, None] + (end - start)[:, None] * u
    places = middle[:, None] + 1j * along[:, None, None] * t[:, None]  # [n, T, U]
    sampler = Sampler(photograph.frame, Lens(photograph.camera).light)
    light = sampler(places).transpose(1, 2, 3, 0)
    fit = fit_edges(light, np.ones_like(light), 1.0)
    clear = np.isfinite(fit.deviation)
    # Interpolation adds a sixth of a pixel^2, and the area of a pixel a twelfth.
    spread = np.sqrt(np.maximum(np.square(fit.blur[clear]) - 1 / 6 - 1 / 12, 0.0))
    return float(np.median(spread)) if len(spread) else math.nan


def _noise(light: np.ndarray) -> tuple[float, float]:
    """Shot noise and read noise: the variance in smooth patches beyond a quadratic surface, over their brightness."""
    height, width = (side - side % _PATCH for side in light.shape[:2])
    rows, columns = height // _PATCH, width // _PATCH
    patches = (
        light[:height, :width].reshape(rows, _PATCH, columns, _PATCH, 3).transpose(0, 2, 4, 1, 3).reshape(-1, _PATCH**2)
    )
    x, y = np.meshgrid(np.linspace(-1, 1, _PATCH), np.linspace(-1, 1, _PATCH))
    surface = np.linalg.qr(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1).reshape(-1, 6))[0]
    left = patches - patches @ surface @ surface.T
    variance, mean = np.square(left).sum(1) / (_PATCH**2 - 6), patches.mean(1)
    used = (patches.max(1) < 0.97) & (mean > 0.01)
    variance, mean = variance[used], mean[used]
    levels, sums = [], []
    order = np.argsort(mean)
    for part in np.array_split(order, max(1, min(12, len(order) // 100))):
        smooth = np.sort(variance[part])[: max(1, int(_SMOOTH * len(part)))]
        # By chance, the smallest variances of equally noisy patches are below the mean, by a known factor.
        levels.append(mean[part].mean())
        sums.append(smooth.mean() / _share_of_mean(_SMOOTH))
    design = np.stack([np.array(levels), np.ones(len(levels))], -1) / np.array(sums)[:, None]
    shot, read = np.maximum(np.linalg.lstsq(design, np.ones(len(levels)), rcond=None)[0], 0.0)
    return float(shot), math.sqrt(read)


def _share_of_mean(share: float) -> float:
    """Mean of the smallest ``share`` of the variances of equally noisy patches, relative to the mean of all."""
    half = (_PATCH**2 - 6) / 2
    return float(gammainc(half + 1, gammaincinv(half, share)) / share)


def rendered(photograph: Photograph, pixels: Pixels, seed: int) -> Case:
    """The photograph with the catheter in front of the board, at the pose of a seed."""
    rng = np.random.default_rng([seed, *photograph.name.encode()])
    camera, (height, width) = photograph.camera, photograph.frame.shape[-2:]
    middle = (THESIS.edges[0] + THESIS.edges[-1]) / 2
    ends = np.array([THESIS.edges[0] - 0.01, THESIS.edges[-1] + 0.01])
    for _ in range(2000):
        tilt, roll = math.radians(rng.uniform(-20, 45)), rng.uniform(0, 2 * math.pi)
        direction = np.array([math.cos(tilt) * math.cos(roll), math.cos(tilt) * math.sin(roll), -math.sin(tilt)])
        pixel = torch.tensor(rng.uniform(0.2, 0.8, 2) * (width, height))
        tip = rng.uniform(_NEAR, _FAR) * np.append(camera.undistort(pixel).numpy(), 1.0) - middle * direction
        image = camera.project(torch.from_numpy(tip + ends[:, None] * direction)).numpy()
        inside = np.isfinite(image).all() and (image > 12).all() and (image < np.array([width, height]) - 12).all()
        if inside and tip[2] > 0.05 and tip_deviation(camera, THESIS, tip, direction) < _VAGUE:
            break
    else:
        raise ValueError(f"no pose shows all bands in {photograph.name} of {width} x {height} px")
    white, towards = np.array(pixels.white), np.array([-0.3, -0.5, -0.8])
    towards /= np.linalg.norm(towards)
    tone, ambient = 0.65 * white / -towards[2], 0.4 * white
    blur = pixels.blur_px if math.isfinite(pixels.blur_px) else 0.8
    shot = Shot(
        camera,
        photograph.light,
        THESIS,
        tip,
        direction,
        (Light(tuple(towards), tuple(tone)),),
        ambient=tuple(ambient),
        blur_px=max(blur, 0.4),
        shot_noise=pixels.shot_noise,
        read_noise=pixels.read_noise,
    )
    return Case(
        photograph.name,
        lambda: _as_saved(insert(shot, seed), photograph),
        torch.from_numpy(tip),
        torch.from_numpy(direction),
        True,
        "",
    )


def _as_saved(frame: Tensor, photograph: Photograph) -> Tensor:
    """The frame after JPEG compression of about the quality of its photograph."""
    if photograph.encoded is None:
        return frame
    # The first entry of the first quantisation table behind its marker is 16 at quality 50 (Annex K of ITU-T T.81).
    first = photograph.encoded[photograph.encoded.index(b"\xff\xdb") + 5]
    quality = round(5000 * 16 / (100 * first) if first > 16 else 100 - 50 * first / 16)
    image = np.ascontiguousarray(frame.numpy().transpose(1, 2, 0)[..., ::-1])
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    levels = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
    return torch.from_numpy(levels[..., ::-1].transpose(2, 0, 1).copy())
