"""Writing of the pictures of a run."""

from pathlib import Path

from torch import Tensor

from holotorch.io.files import write_bytes
from holotorch.io.images import encode_png


def save_picture(path: Path, picture: Tensor) -> None:
    """Write a picture [C, H, W] of values from 0 to 1 as PNG, clipped; ``path`` has no suffix."""
    write_bytes(path.with_name(f"{path.name}.png"), encode_png(picture))
