"""Incoherent images of light sources at several focal distances, in closed form: targets for a hologram."""

from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity
from holotorch.core.fourier import ifft2, real_fft2, real_ifft2
from holotorch.core.grid import Grid
from holotorch.core.operator import Wavelengths
from holotorch.optics.viewing.pupil_views import View, view_kernel, view_padding
from holotorch.scene.layers import SourceLayers


def incoherent_views(layers: SourceLayers, wavelengths: Wavelengths, views: Sequence[View]) -> Tensor:
    """Incoherent images of ``layers`` in each of ``views``, real [C, V, H, W], in closed form.

    The sources do not interfere: I_v = sum_j C_j (*) |h_v,j|^2, where C_j is the light of plane j, |amplitude|^2, and
    h_v,j the field of a point in plane j that is seen through the pupil in focus at another depth. This is the mean of
    the intensities of holograms whose sources have independent random phases; with N of them, the mean differs by a
    relative error of 1 / sqrt(N). Light of a point spreads over the directions of the pupil, so that a smaller pupil
    gives a darker image. The window has no edge here, as if the scene continued with black.

    In all views, the sources occlude each other as in the direction in which they were rendered.

    Args:
        layers: Sources on planes; the pixels of the image are those of the sources.
        wavelengths: In metres, one per channel.
        views: Focal distances and pupils.

    Returns:
        In the dtype of the amplitudes, on their device. The image through a pupil that is wider than half
        the band of the pixels is undersampled.
    """
    wavelengths = checks.wavelengths(wavelengths)
    if len(wavelengths) != layers.channels:
        raise ValueError(f"wavelengths must be one per channel of the layers, {layers.channels}, got {wavelengths}")
    if not views:
        raise ValueError("incoherent_views needs at least one view, got none")
    longest = max(abs(view.focus - depth) for view in views for depth in layers.depths)
    height, width = layers.grid.shape
    padded = view_padding(layers.grid, wavelengths, views, longest)
    wavelength = torch.tensor(wavelengths, dtype=torch.float64)
    sums: list[Tensor | float] = [0.0] * len(views)
    dtype = torch.float32
    for depth, plane in zip(layers.depths, layers.planes(), strict=True):
        light = intensity(plane)
        dtype = light.dtype
        spectrum = real_fft2(light.double(), padded.shape)
        for v, view in enumerate(views):
            sums[v] = sums[v] + spectrum * _spread(padded, wavelength, view, depth - view.focus).to(light.device)
    images = real_ifft2(torch.stack([torch.as_tensor(part) for part in sums], 1), padded.shape)
    return images[..., :height, :width].clamp(min=0).to(dtype)


def _spread(padded: Grid, wavelength: Tensor, view: View, distance: float) -> Tensor:
    """Transform of the intensity of a point that is out of focus by ``distance``, complex128 [C, P, Q // 2 + 1]."""
    return real_fft2(intensity(ifft2(view_kernel(padded, wavelength, view, distance))), padded.shape)
