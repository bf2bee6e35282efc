"""Writing of the pictures of a run."""

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from holotorch.io.colour_tables import picture_matrix
from holotorch.io.files import write_bytes
from holotorch.io.images import encode_png
from holotorch.optics.picture import gamut_map, linear_srgb


def in_colour(picture: Tensor, wavelengths: Sequence[float]) -> Tensor:
    """Picture [..., 3, H, W] of channels [..., C, H, W] at C wavelengths.

    Three channels are red, green and blue as they are; others are shown as by ``colour_tables.picture_matrix``, of
    more than three within the gamut of sRGB.
    """
    if len(wavelengths) == 3:
        return picture
    mixed = linear_srgb(picture, picture_matrix(wavelengths))
    return gamut_map(mixed) if len(wavelengths) > 3 else mixed


def save_picture(path: Path, picture: Tensor) -> None:
    """Write a picture [C, H, W] of values from 0 to 1 as PNG, clipped; ``path`` has no suffix."""
    write_bytes(path.with_name(f"{path.name}.png"), encode_png(picture))
