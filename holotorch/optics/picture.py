"""Images from intensities at several wavelengths: linear sRGB, gamut mapping, equal power, tone mapping."""

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.deprecation import renamed
from holotorch.core.precision import at_least_single

# Luminance of the primaries of linear sRGB (IEC 61966-2-1), the Y row of the matrix to CIE XYZ.
_LUMINANCE = (0.2126390058715103, 0.7151686787677559, 0.0721923153607337)
GAMMA = 0.5  # exponent of thesis Eq. 5.16


def linear_srgb(intensity: Tensor, matrix: Tensor) -> Tensor:
    """Linear sRGB [..., 3, H, W] of ``intensity`` [..., K, H, W]: the product with ``matrix`` [3, K].

    ``io.colour_tables.srgb_matrix`` computes the matrix from wavelengths. Spectral colours lie outside the gamut of
    sRGB and have negative components, which :func:`gamut_map` removes. Raises ValueError for shapes that do not match.
    """
    checks.real("intensity", intensity)
    checks.real("matrix", matrix)
    if intensity.ndim < 3 or tuple(matrix.shape) != (3, intensity.shape[-3]):
        raise ValueError(
            f"intensity [..., K, H, W] needs a matrix [3, K], got {tuple(intensity.shape)} and {tuple(matrix.shape)}"
        )
    return torch.einsum("ck,...khw->...chw", matrix.to(intensity), intensity)


def gamut_map(colour: Tensor) -> Tensor:
    """Map linear sRGB [..., 3, H, W] into the gamut: mix in grey of equal luminance until no component is negative.

    This keeps the luminance and the hue in the chromaticity diagram. Clipping would change both: light of 455 nm would
    become 3.2 times as bright. Values above 1 are kept. The result is black where the luminance is not positive.
    """
    checks.real("colour", colour)
    if colour.ndim < 3 or colour.shape[-3] != 3:
        raise ValueError(f"colour must be linear red, green, blue, [..., 3, H, W], got {tuple(colour.shape)}")
    grey = (colour * colour.new_tensor(_LUMINANCE)[:, None, None]).sum(-3, keepdim=True)
    least = colour.amin(-3, keepdim=True)
    outside = least < 0
    mix = torch.where(outside, grey / torch.where(outside, grey - least, 1.0), 1.0)
    return torch.where(grey > 0, (grey + (colour - grey) * mix).clamp_min(0), 0.0)


def equal_power(intensity: Tensor, reference: Tensor) -> Tensor:
    """Scale each channel of ``intensity`` [..., C, H, W] to the total of the same channel of ``reference``.

    Images under different sources are compared at equal power, because the power that may enter the eye is limited
    (text below Eq. 5.16). Black channels stay black. ``reference`` may have another H and W if it covers the
    same extent, since the means are made equal. Raises ValueError if the leading axes differ.
    """
    for name, part in (("intensity", intensity), ("reference", reference)):
        checks.real(name, part)
        if part.ndim < 2:
            raise ValueError(f"{name} must be [..., H, W], got {tuple(part.shape)}")
    if intensity.shape[:-2] != reference.shape[:-2]:
        raise ValueError(f"channels must match, got {tuple(intensity.shape)} and {tuple(reference.shape)}")
    mean, target = (at_least_single(part).mean((-2, -1), keepdim=True) for part in (intensity, reference))
    black = mean == 0
    return intensity * torch.where(black, 0.0, target / torch.where(black, 1.0, mean)).to(intensity.dtype)


def tone_map(intensity: Tensor, *, peak: Tensor | None = None, gamma: float = GAMMA) -> Tensor:
    """Image (intensity / peak)^gamma in 0..1, Eq. 5.16. Values above the peak become 1; a black image stays black.

    Args:
        intensity: Real [..., C, H, W]; values below 0 count as 0.
        peak: Intensity that becomes 1, which broadcasts against ``intensity``. By default the largest value of each
            image over C, H and W; Eq. 5.16 is printed for one channel, and one peak per channel would change colours.
            Pass the same peak for images that are to be compared.
        gamma: Exponent, above 0.

    Returns:
        Same shape and dtype. The gradient where the intensity is 0 is 0 instead of infinite.
    """
    checks.real("intensity", intensity)
    if intensity.ndim < 3:
        raise ValueError(f"intensity must be [..., C, H, W], got {tuple(intensity.shape)}")
    gamma = checks.positive("gamma", gamma)
    peak = intensity.amax((-3, -2, -1), keepdim=True) if peak is None else peak
    lit = (intensity > 0) & (peak > 0)
    relative = torch.where(lit, intensity, 1.0) / torch.where(peak > 0, peak, 1.0)
    return torch.where(lit, relative.clamp(max=1).pow(gamma), 0.0)


__getattr__ = renamed(__name__, {"exposed": "tone_map", "desaturated": "gamut_map"})
