"""Relative speckle: a picture divided by the speckle-free scene (thesis Sec. 6.4.2)."""

import math
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from holotorch.experiments.runs.figures import figure_png
from holotorch.metrics import anisotropy, grain_size, power_spectrum

_RINGS = 24  # number of rings of a radial mean of the spectrum


def relative_speckle(pictures: Tensor, reference: Tensor, minimum: Tensor) -> Tensor:
    """``pictures`` [..., h, w] divided by the speckle-free ``reference``; 1 where that is at most ``minimum``."""
    lit = reference > minimum
    return torch.where(lit, pictures / torch.where(lit, reference, 1), 1)


def grains(speckle: Tensor) -> dict[str, list[Any]]:
    """Medians over the realisations of relative speckle [S, C, h, w], for each of the C colours.

    ``grain_y``, ``grain_x``: full widths of the grains at half of the autocorrelation, in samples of the picture.
    ``anisotropy``: length of the grains divided by their width. None without speckle, or if the grains are too large.
    """
    measured: dict[str, list[Any]] = {"grain_y": [], "grain_x": [], "anisotropy": []}
    for colour in speckle.unbind(1):
        varied = colour[colour.flatten(1).std(-1) > 0]
        sizes = grain_size(varied) if len(varied) else torch.full((1, 2), math.inf)
        ratio = anisotropy(varied).ratio if len(varied) else torch.full((1,), math.inf)
        for name, values in zip(measured, (sizes[:, 0], sizes[:, 1], ratio), strict=True):
            value = float(values.median())
            measured[name].append(value if math.isfinite(value) else None)
    return measured


def radial_spectrum(speckle: Tensor) -> tuple[Tensor, Tensor]:
    """Frequencies [R] in cycles per sample, and the mean power spectrum [R] of speckle [..., h, w] in rings."""
    power = power_spectrum(speckle).flatten(0, -3).mean(0)
    fy, fx = (torch.fft.fftfreq(n, dtype=power.dtype) for n in power.shape)
    radius = torch.hypot(fy[:, None], fx.expand(len(fy), -1))
    edges = torch.linspace(0, 0.5, _RINGS + 1, dtype=power.dtype)
    rings = torch.bucketize(radius, edges) - 1
    inside = (rings >= 0) & (rings < _RINGS)  # frequency 0 has no contrast, and corners lie beyond all rings
    count = torch.zeros(_RINGS, dtype=power.dtype).index_add(0, rings[inside], torch.ones_like(power[inside]))
    total = torch.zeros(_RINGS, dtype=power.dtype).index_add(0, rings[inside], power[inside])
    return (edges[1:] + edges[:-1]) / 2, total / count.clamp_min(1)


def draw(speckle: dict[str, Tensor]) -> bytes:
    """PNG of the radial spectra of relative speckle [S, C, h, w] of each source: one line for all of its colours."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for source, values in speckle.items():
        frequency, power = (curve.tolist() for curve in radial_spectrum(values))
        axes.semilogy(frequency, [max(value, 1e-12) for value in power], ".-", label=source.replace("_", " "))
    axes.set(xlabel="frequency (cycles per sample of the picture)", ylabel="power of the relative speckle")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure_png(figure)
