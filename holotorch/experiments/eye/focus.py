"""A sweep of the eye's focus over a scene: the focus at which each part looks sharpest (thesis Fig. 5.9)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from matplotlib.figure import Figure
from skimage.filters import gaussian
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.eye.config import SweepSettings
from holotorch.experiments.eye.experiment import Observer
from holotorch.experiments.eye.tradeoff import parabola_peak
from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.runs.pictures import in_colour

_BLUR = 6.0  # standard deviation, in rays, of the blurred picture that is subtracted to compare only fine detail
_OPAQUE = 0.5  # opacity above which a ray shows a surface
_LEAST = 100  # least number of rays in a band
_ENDS = (0.02, 0.98)  # quantiles of the depth of the surface at which the first band begins and the last band ends


@dataclass(frozen=True)
class Band:
    """The part of a scene within a range of depths, and the sharpness of its picture at each focus.

    Attributes:
        depth: Mean depth in metres from the hologram.
        spread: Standard deviation of the depth in metres.
        rays: Number of rays that show the band.
        correlation: Correlation between the fine detail of the picture and that of the rendering, for each focus.
        sharpest: Focus in metres with the largest correlation, interpolated between the steps; NaN if the largest
            correlation is at an end of the sweep.
        depth_of_focus: wavelength / ``Observer.detail``^2 in metres, at the middle wavelength.
    """

    depth: float
    spread: float
    rays: int
    correlation: tuple[float, ...]
    sharpest: float
    depth_of_focus: float

    @property
    def row(self) -> dict[str, Any]:
        """A row of the table, in millimetres."""
        return {
            "depth_mm": f"{1e3 * self.depth:.4f}",
            "spread_mm": f"{1e3 * self.spread:.4f}",
            "rays": self.rays,
            "sharpest_mm": f"{1e3 * self.sharpest:.4f}",
            "off_mm": f"{1e3 * (self.sharpest - self.depth):+.4f}",
            "depth_of_focus_mm": f"{1e3 * self.depth_of_focus:.4f}",
        }


@dataclass(frozen=True, eq=False)
class FocusSweep:
    """The result of a sweep.

    Attributes:
        depths: F depths of the focus in metres from the hologram.
        pictures: Intensity at the rays for each focus, [F, C, h, w], mean over the realisations.
        bands: Bands in order of increasing depth.
    """

    depths: tuple[float, ...]
    pictures: Tensor
    bands: tuple[Band, ...]


@dataclass(frozen=True, eq=False)
class Surface:
    """The visible surface of a scene.

    Attributes:
        rendering: Rendering of the scene, [C, h, w].
        opaque: Whether a ray shows the surface, [h, w].
        depth: Depth of the surface along each ray in metres from the hologram, [h, w].
        ends: 2 and 98 % quantiles of the depth of the surface in metres.
    """

    rendering: Tensor
    opaque: Tensor
    depth: Tensor
    ends: tuple[float, float]


def visible_surface(eye: Observer) -> Surface:
    """The visible surface of a scene. ValueError for a scene without a surface, or with a surface at a single depth."""
    rendering, opacity = eye.scene.rendering()
    depth = eye.scene.depth_map()
    opaque = opacity > _OPAQUE
    shown = depth[opaque].sort().values
    if len(shown) < _LEAST:
        few = f"only {len(shown)} rays are {_OPAQUE:.0%} opaque or more"
        raise ValueError(f"a sweep needs a surface: {few}, and at least {_LEAST} are needed")
    low, high = (shown[round(part * (len(shown) - 1))].item() for part in _ENDS)
    if not high > low:
        raise ValueError(f"the whole surface lies at {1e3 * low:.4g} mm: there is nothing to sweep")
    return Surface(rendering, opaque, depth, (low, high))


def focus_sweep(eye: Observer, settings: SweepSettings, surface: Surface | None = None) -> FocusSweep:
    """Compute the observer's view for one focus after another, with one wavelength per colour.

    The visible surface of the scene is divided into bands of depth. The fine detail of each band is correlated with
    that of the rendering, which is sharp everywhere. The correlation is expected to be largest when the eye is focused
    at the depth of the band. Without ``surface``, :func:`visible_surface` is called, which may raise ValueError.
    """
    scene, surface = eye.scene, surface or visible_surface(eye)
    depth, (low, high) = surface.depth, surface.ends
    margin = 0.1 * (high - low)
    focus = torch.linspace(low - margin, high + margin, settings.steps).tolist()
    total = torch.zeros(len(focus), *surface.rendering.shape)
    with tqdm(total=settings.realisations * len(focus), desc="sweeping", unit="picture", dynamic_ncols=True) as bar:
        for k in range(settings.realisations):
            hologram, _ = scene.hologram(eye.settings.seed + k)
            for f, position in enumerate(focus):
                total[f] += eye.image(hologram, None, position)
                bar.update()
    pictures, wavelength = total / settings.realisations, eye.reference_wavelength
    details, reference = _fine_detail(pictures), _fine_detail(surface.rendering[None].float())[0]
    bands = []
    ends = torch.linspace(low, high, settings.bands + 1).tolist()
    for near, far in pairwise(ends):
        part = surface.opaque & (depth >= near) & (depth <= far)
        if int(part.sum()) < _LEAST:
            continue
        mean = depth[part].mean().item()
        correlation = tuple(_correlation(detail[:, part], reference[:, part]) for detail in details)
        spread, depth_of_focus = depth[part].std().item(), wavelength / eye.detail(mean, wavelength) ** 2
        position, inside = parabola_peak(focus, correlation)
        sharpest = position if inside else math.nan
        bands.append(Band(mean, spread, int(part.sum()), correlation, sharpest, depth_of_focus))
    return FocusSweep(tuple(focus), pictures, tuple(bands))


def in_words(sweep: FocusSweep) -> list[str]:
    """A line of text for each band."""
    return [
        f"Focus      the part at {1e3 * band.depth:.3f} mm looks sharpest with the eye focused at "
        f"{1e3 * band.sharpest:.3f} mm (depth of focus {1e3 * band.depth_of_focus:.3f} mm)"
        for band in sweep.bands
    ]


def draw(sweep: FocusSweep, wavelengths: Sequence[float]) -> bytes:
    """PNG: correlation of each band against the focus, and pictures focused on the first, middle and last band."""
    figure = Figure(figsize=(17, 4.6), layout="constrained")
    curves, *views = figure.subplots(1, 4, width_ratios=(1.3, 1, 1, 1))
    positions = [1e3 * depth for depth in sweep.depths]
    for k, band in enumerate(sweep.bands):
        curves.plot(positions, band.correlation, "o-", color=f"C{k}", label=f"part at {1e3 * band.depth:.2f} mm")
        curves.axvline(1e3 * band.depth, color=f"C{k}", linestyle=":")
    curves.set_xlabel("focus of the eye (mm from the hologram); dotted: where each part lies")
    curves.set_ylabel("correlation of fine detail with the rendering")
    curves.grid(alpha=0.3)
    curves.legend(fontsize=8)
    bright = sweep.pictures.flatten().quantile(0.999) if sweep.pictures.numel() < 1 << 24 else sweep.pictures.max() / 3
    count = len(sweep.bands)
    for view, band in zip(views, (sweep.bands[0], sweep.bands[count // 2], sweep.bands[-1]), strict=True):
        nearest = min(range(len(positions)), key=lambda f: abs(sweep.depths[f] - band.depth))
        picture = in_colour((sweep.pictures[nearest] / bright).clamp(0, 1).sqrt(), wavelengths).clamp(0, 1)
        view.imshow(picture.movedim(0, -1).numpy(), interpolation="nearest")
        view.set_title(f"focus {positions[nearest]:.2f} mm", fontsize=10)
        view.set_axis_off()
    return figure_png(figure)


def _fine_detail(pictures: Tensor) -> Tensor:
    """Pictures [F, C, h, w] minus their Gaussian blur."""
    blur: Any = (0, 0, _BLUR, _BLUR)
    return pictures - torch.from_numpy(gaussian(pictures.numpy(), sigma=blur))


def _correlation(first: Tensor, second: Tensor) -> float:
    """Cosine similarity of two tensors."""
    return ((first * second).sum() / (first.norm() * second.norm()).clamp(min=1e-30)).item()
