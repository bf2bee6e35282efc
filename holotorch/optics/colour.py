"""Intensities of several wavelengths to linear sRGB, and into its gamut."""

import torch
from torch import Tensor

from holotorch.core import checks

_LUMINANCE = (0.2126390058715103, 0.7151686787677559, 0.0721923153607337)  # of linear sRGB, IEC 61966-2-1


def linear_srgb(intensity: Tensor, matrix: Tensor) -> Tensor:
    """One matrix product: linear sRGB [..., 3, H, W] of ``intensity`` [..., K, H, W], with ``matrix`` [3, K].

    ``io.colour_tables.srgb_matrix`` makes the matrix from wavelengths. Differentiable. Pure colours lie outside sRGB
    and come out with negative components, to be brought in by :func:`desaturated`; nothing is clipped here.

    Raises:
        ValueError: Shapes that do not match.
    """
    checks.real("intensity", intensity)
    checks.real("matrix", matrix)
    if intensity.ndim < 3 or tuple(matrix.shape) != (3, intensity.shape[-3]):
        raise ValueError(
            f"intensity [..., K, H, W] needs a matrix [3, K], got {tuple(intensity.shape)} and {tuple(matrix.shape)}"
        )
    return torch.einsum("ck,...khw->...chw", matrix.to(intensity), intensity)


def desaturated(colour: Tensor) -> Tensor:
    """Bring linear sRGB [..., 3, H, W] into its gamut: mixed with the grey of its own luminance until none is negative.

    The gamut rule of the library. It keeps luminance, and the hue in the chromaticity diagram, where clipping changes
    both: pure 455 nm would turn 3.2 times as bright. Values above 1 are left for the exposure. Black where the
    luminance is not positive. Differentiable but on the gamut's border.
    """
    checks.real("colour", colour)
    if colour.ndim < 3 or colour.shape[-3] != 3:
        raise ValueError(f"colour must be linear red, green, blue, [..., 3, H, W], got {tuple(colour.shape)}")
    share = colour.new_tensor(_LUMINANCE)[:, None, None]
    grey = (colour * share).sum(-3, keepdim=True)
    least = colour.amin(-3, keepdim=True)
    outside = least < 0
    mix = torch.where(outside, grey / torch.where(outside, grey - least, 1.0), 1.0)
    return torch.where(grey > 0, (grey + (colour - grey) * mix).clamp_min(0), 0.0)
