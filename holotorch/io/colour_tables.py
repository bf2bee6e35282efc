"""Colours of monochromatic light: colour-matching functions, matrix to linear sRGB, and white balance."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks

_PRIMARIES = 450e-9, 530e-9, 630e-9  # metres: wavelengths of a picture's blue, green and red, for more than three
# Shares of red, green and blue that each wavelength shows, longest first, for fewer wavelengths than colours.
_SHOWN = {1: ((1 / 3, 1 / 3, 1 / 3),), 2: ((0.5, 0.5, 0.0), (0.0, 0.5, 0.5))}
_LITTLE = 1e-4  # weight of equal powers beside that of the colour, in units of the matching functions


def tristimulus(wavelengths: float | Sequence[float]) -> Tensor:
    """CIE 1931 colour-matching functions (2 degrees) for X, Y and Z at K wavelengths in metres, float64 [3, K].

    The table covers 360 to 830 nm (ValueError outside) in steps of 1 nm; values in between are interpolated by
    Sprague's method, as CIE 167 recommends.
    """
    with np.printoptions():  # importing colour changes how NumPy prints numbers, which ends with this block
        from colour import MSDS_CMFS, SpragueInterpolator

    table = MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    nanometres = np.array(checks.wavelengths(wavelengths)) * 1e9
    first, last = float(table.wavelengths[0]), float(table.wavelengths[-1])
    wrong = nanometres[(nanometres < first) | (nanometres > last)]
    if wrong.size:
        covered = f"the CIE 1931 table covers {first:g} to {last:g} nm"
        raise ValueError(f"wavelength {wrong[0]:g} nm has no colour: {covered}")
    columns = [SpragueInterpolator(table.wavelengths, table.values[:, i])(nanometres) for i in range(3)]
    return torch.from_numpy(np.stack(columns).reshape(3, -1))


def _srgb_from_xyz() -> np.ndarray:
    """Matrix [3, 3] from X, Y and Z to linear sRGB."""
    with np.printoptions():  # as above
        from colour.models import RGB_COLOURSPACE_sRGB

    return np.array(RGB_COLOURSPACE_sRGB.matrix_XYZ_to_RGB)


def srgb_matrix(
    wavelengths: Sequence[float], weights: Sequence[float] | Tensor | None = None, *, white: Tensor | None = None
) -> Tensor:
    """Matrix [3, K] from intensities at ``wavelengths`` to linear sRGB, float64, with one column per wavelength.

    The colours are not adapted to a white point: with equal ``weights``, equal intensities of three sources give the
    colour of their sum, which is not D65. With the weights of :func:`white_balance` they give D65, the white of sRGB.

    Args:
        wavelengths: K wavelengths in metres.
        weights: Power of each wavelength at an intensity of 1; 1 by default. For example the quadrature weights of a
            :class:`~holotorch.optics.light.spectrum.Spectrum`.
        white: Intensities [K] that the matrix maps to a luminance of 1; all ones by default.

    Raises:
        ValueError: Wavelengths outside 360 to 830 nm, weights or a white that are negative or not K numbers, or a white
            whose luminance is 0.
    """
    matching = tristimulus(wavelengths)
    count = matching.shape[1]
    power, white = (
        torch.ones(count).double() if given is None else torch.as_tensor(given, dtype=torch.float64)
        for given in (weights, white)
    )
    for name, values in (("weights", power), ("white", white)):
        if tuple(values.shape) != (count,) or not (values >= 0).all():
            raise ValueError(f"{name} must be {count} nonnegative numbers, one per wavelength, got {values.tolist()}")
    matrix = matching * power
    luminance = matrix[1] @ white
    if luminance <= 0:
        raise ValueError("white has no luminance; it needs a positive intensity and weight at a visible wavelength")
    return torch.from_numpy(_srgb_from_xyz()) @ matrix / luminance


def white_balance(wavelengths: Sequence[float]) -> Tensor:
    """Relative powers of three sources that together have the colour D65, the white of sRGB, float64 [3].

    The largest power is 1. A display with these powers shows equal values of its three channels as neutral grey.
    ValueError unless there are three wavelengths, in metres, that can be mixed to D65.
    """
    matching = tristimulus(wavelengths)
    if matching.shape[1] != 3:
        raise ValueError(f"white balance needs three wavelengths, got {matching.shape[1]}")
    white = torch.from_numpy(np.linalg.inv(_srgb_from_xyz()) @ np.ones(3))
    powers = torch.linalg.solve(matching, white) if torch.linalg.matrix_rank(matching) == 3 else -torch.ones(3)
    if (powers <= 0).any():
        listed = ", ".join(f"{value * 1e9:g}" for value in wavelengths)
        raise ValueError(f"{listed} nm cannot be mixed to the white D65; take one red, one green and one blue source")
    return powers / powers.max()


def _even_balance(wavelengths: Sequence[float]) -> Tensor:
    """Powers of more than three sources that together have the colour D65, as equal as they can be, float64 [K].

    ValueError for wavelengths that cannot be mixed to D65.
    """
    from scipy.optimize import nnls

    matching = tristimulus(wavelengths).numpy()
    white = np.linalg.inv(_srgb_from_xyz()) @ np.ones(3)
    # Nonnegative least squares: the colour first, and among all powers of this colour those of least variance.
    uneven = _LITTLE * (np.eye(len(wavelengths)) - 1 / len(wavelengths))
    powers, _ = nnls(np.concatenate([matching, uneven]), np.concatenate([white, np.zeros(len(wavelengths))]))
    if np.linalg.norm(matching @ powers - white) > 1e-3 * np.linalg.norm(white):
        listed = ", ".join(f"{value * 1e9:g}" for value in wavelengths)
        raise ValueError(f"{listed} nm cannot be mixed to the white D65; take red, green and blue ones too")
    return torch.from_numpy(powers / powers.max())


def colour_shares(wavelengths: Sequence[float]) -> Tensor:
    """Shares of a picture's red, green and blue that each of K wavelengths in metres shows, float64 [K, 3].

    Each row adds up to 1. Three wavelengths show red, green and blue, in the order in which they are given; one shows
    the mean of all. Of two, the longer one shows the mean of red and green and the other one that of green and blue. Of
    more, 630 nm and longer ones show red, 530 nm green, 450 nm and shorter ones blue, and those between a mixture.
    """
    if len(wavelengths) == 3:
        return torch.eye(3, dtype=torch.float64)
    if len(wavelengths) > 3:
        rows = [np.interp(wavelengths, _PRIMARIES, colour) for colour in ((0, 0, 1), (0, 1, 0), (1, 0, 0))]
        return torch.from_numpy(np.stack(rows, 1))
    longest_first = sorted(wavelengths, reverse=True)
    rows = [_SHOWN[len(wavelengths)][longest_first.index(wavelength)] for wavelength in wavelengths]
    return torch.tensor(rows, dtype=torch.float64)


def picture_matrix(wavelengths: Sequence[float]) -> Tensor:
    """Matrix [3, K] from intensities at K wavelengths to the linear sRGB of a picture, float64.

    Equal intensities at three or more wavelengths are neutral grey, with powers as of :func:`white_balance`; those of
    more than three are as equal as they can be. Two wavelengths are shown in their own colours, each as bright as sRGB
    allows and mixed with grey as by ``optics.gamut_map``. A single one is shown in grey, whatever its colour.

    Raises:
        ValueError: No wavelengths, or wavelengths that have no colour or cannot be mixed to white.
    """
    if len(wavelengths) == 1:
        return torch.ones(3, 1, dtype=torch.float64)
    if len(wavelengths) == 3:
        return srgb_matrix(wavelengths, white_balance(wavelengths))
    if len(wavelengths) > 3:
        return srgb_matrix(wavelengths, _even_balance(wavelengths))
    if len(wavelengths) != 2:
        raise ValueError("expected at least one wavelength, got none")
    columns = []
    for wavelength in wavelengths:
        colour = srgb_matrix([wavelength])[:, 0]  # of luminance 1, like grey [1, 1, 1]
        inside = 1 + (colour - 1) / (1 - colour.min().clamp(max=0))
        columns.append(inside / inside.max())
    return torch.stack(columns, 1).clamp(min=0)
