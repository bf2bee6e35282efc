"""Pictures as tensors: loading of files and bundled photographs, resizing, channels, and PNG encoding."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.io.bundled import BUNDLED_IMAGES, no_such_picture
from holotorch.io.formats.decoding import check_exr, decode
from holotorch.metrics.quality import SSIM_WINDOW

_MEMORY = 56  # bytes per pixel in load_image: three float64 values (24), a copy of them (24) and the decoded pixel (8)
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of red, green and blue, ITU-R BT.709


def load_image(source: str | Path) -> Tensor:
    """Load a bundled photograph by name, or a PNG, JPEG, TIFF or EXR file by path.

    Returns:
        float64 [C, H, W] in [0, 1], C = 3 (red, green, blue) or 1 (grey). 8 and 16 bit integers are divided by 255 and
        65535. The sRGB tone curve is not removed: like the thesis, this function takes pixel values as intensities.
        Other types are divided by their maximum if that exceeds 1. Transparent pixels are composited over black.

    Raises:
        ValueError: The picture does not exist, cannot be decoded, exceeds the memory limit of
            :mod:`holotorch.io.formats.limits`, has a side of less than 11 px (the window of
            :func:`~holotorch.metrics.ssim`), contains NaN, infinity or negative values, or is black throughout.
    """
    path = Path(source)
    if str(source) in BUNDLED_IMAGES:
        import skimage.data

        pixels = getattr(skimage.data, str(source))()
    elif not path.is_file():
        raise ValueError(no_such_picture(str(path)))
    else:
        pixels = _exr_pixels(path) if path.suffix.lower() == ".exr" else _decode(path)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.shape[-1] in (2, 4):  # the last channel is the opacity
        values = _unit_range(pixels[..., :-1]) * _unit_range(pixels[..., -1:])
    else:
        values = _unit_range(pixels)
    return _checked(torch.from_numpy(values).permute(2, 0, 1), str(source))


def fit_image(image: Tensor, shape: tuple[int, int], fit: str = "crop") -> Tensor:
    """Resize ``image`` [C, h, w] with values in [0, 1] to ``shape`` (H, W); one of that size is returned unchanged.

    First :func:`frame_image` gives the picture the aspect ratio of ``shape``, as ``fit`` states. Antialiased bilinear
    interpolation follows, which creates no negative values.
    """
    if tuple(image.shape[-2:]) == tuple(shape):
        return image
    framed = frame_image(image, shape[1] / shape[0], fit)
    resampled = torch.nn.functional.interpolate(framed[None], size=shape, mode="bilinear", antialias=True)[0]
    return resampled.clamp(0, 1)


def frame_image(image: Tensor, aspect: float, fit: str = "crop") -> Tensor:
    """Change the aspect ratio (width / height) of ``image`` [C, h, w] without resampling.

    ``fit="crop"`` crops the longer side symmetrically; ``fit="pad"`` pads the shorter side with black.
    """
    if fit not in ("crop", "pad"):
        raise ValueError(f"fit must be 'crop' or 'pad', got {fit!r}")
    height, width = image.shape[-2:]
    choose = min if fit == "crop" else max
    size = max(1, choose(height, round(width / aspect))), max(1, choose(width, round(height * aspect)))
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    # Negative padding crops the image.
    return torch.nn.functional.pad(image, (left, size[1] - width - left, top, size[0] - height - top))


def with_channels(image: Tensor, channels: int) -> Tensor:
    """Convert ``image`` [1 or 3, H, W] to ``channels``: one channel is the BT.709 luminance; grey is repeated."""
    if image.shape[0] == channels:
        return image
    if channels == 1:
        return (image * image.new_tensor(_LUMINANCE)[:, None, None]).sum(0, keepdim=True)
    if image.shape[0] == 1:
        return image.expand(channels, -1, -1)
    raise ValueError(f"cannot show a picture of {image.shape[0]} channels on {channels} wavelengths; use 1 or 3")


def encode_png(image: Tensor) -> bytes:
    """8-bit PNG of ``image`` [C, H, W], C = 1 or 3; values are clipped to [0, 1] and rounded."""
    import cv2

    checks.all_finite("image", image)
    pixels = (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    ok, data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))
    if not ok:
        raise ValueError(f"could not encode a picture of shape {tuple(image.shape)} as PNG")
    return data.tobytes()


def encode_animation(images: Sequence[Tensor], seconds: float) -> bytes:
    """Animated PNG of ``images`` [C, H, W], C = 1 or 3, shown for ``seconds`` each; values as in :func:`encode_png`."""
    from PIL import Image

    frames = [Image.open(io.BytesIO(encode_png(image.expand(3, -1, -1)))) for image in images]
    buffer = io.BytesIO()
    options = {"append_images": frames[1:], "duration": 1e3 * seconds, "loop": 0}
    frames[0].save(buffer, format="PNG", save_all=True, **options)
    return buffer.getvalue()


def read_exr(path: Path, *, memory: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the header of an EXR file and its channels, a mapping from names to arrays [H, W].

    Arguments and errors are those of :func:`check_exr`.
    """
    import OpenEXR

    check_exr(path, memory=memory)
    try:
        file = OpenEXR.File(str(path), separate_channels=True)
        return file.header(), {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # the library raises bare RuntimeError and others
        raise ValueError(f"{path} is not a readable EXR file: {error}") from None


def _decode(path: Path) -> np.ndarray:
    import cv2

    data = path.read_bytes()
    # OpenCV applies the orientation tag of a JPEG only in colour mode.
    flags = cv2.IMREAD_COLOR if data.startswith(b"\xff\xd8") else cv2.IMREAD_UNCHANGED
    pixels = decode(path, flags, data=data, memory=_MEMORY)
    if pixels.ndim == 3 and pixels.shape[2] >= 3:
        pixels = np.concatenate([pixels[..., 2::-1], pixels[..., 3:]], axis=2)
    return pixels


def _exr_pixels(path: Path) -> np.ndarray:
    _, channels = read_exr(path, memory=_MEMORY)
    names = next((names for names in ("RGB", "Y") if channels.keys() >= {*names}), None)
    if names is None:
        raise ValueError(f"{path} must have channels R, G, B or Y, got {', '.join(sorted(channels))}")
    if "RY" in channels:
        raise ValueError(f"{path} stores colour as luminance and colour differences; convert it to R, G, B")
    names += "A" if "A" in channels else ""
    return np.stack([channels[name] for name in names], axis=-1)


def _unit_range(pixels: np.ndarray) -> np.ndarray:
    """Pixels as float64, divided by 255 or 65535 if they are 8 or 16 bit integers, else by their maximum if above 1."""
    values = pixels.astype(np.float64)
    peak = np.iinfo(pixels.dtype).max if pixels.dtype in (np.uint8, np.uint16) else values.max()
    if np.isfinite(peak) and peak > 1:
        values /= peak
    return values


def _checked(image: Tensor, source: str) -> Tensor:
    try:
        checks.all_finite(f"picture {source}", image)
    except ValueError as error:
        raise ValueError(f"{error}; repair the picture, whose elements are [channel, row, column]") from None
    if image.min() < 0:
        raise ValueError(f"picture {source} holds negative intensities, down to {image.min().item():g}; clip it first")
    height, width = image.shape[-2:]
    if min(height, width) < SSIM_WINDOW:
        window = f"{SSIM_WINDOW} x {SSIM_WINDOW} px window of the image metric SSIM"
        raise ValueError(f"picture {source} is {height} x {width} px, less than the {window}; use a larger one")
    if image.max() == 0:
        raise ValueError(f"picture {source} is black throughout; use another picture")
    return image.contiguous()
