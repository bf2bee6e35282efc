"""Where a volume looks sharp against where the eye is focused: a sweep of the accommodation (thesis Fig. 5.9)."""

from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.figure import Figure
from skimage.filters import gaussian
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.eye.config import SweepSettings
from holotorch.experiments.eye.experiment import Observer
from holotorch.experiments.runs.pictures import figure_png

_DETAIL = 6.0  # rays, standard deviation of the blur that is taken off: what is finer than it tells the focus
_SEEN = 0.5  # opacity of a ray above which it shows a surface
_LEAST = 100  # rays of a band
_ENDS = (0.02, 0.98)  # share of the rays nearer than the first band's beginning and the last one's end


@dataclass(frozen=True)
class Band:
    """What lies within a range of depths, and how much like its rendering it looks at each focus.

    Attributes:
        depth: Mean, in metres from the hologram.
        spread: Standard deviation of the depths, in metres.
        rays: How many show it.
        likeness: Correlation of its fine detail with the rendering's, one for each focus of the sweep.
        sharpest: Focus at which that is greatest, between the steps, in metres; NaN where it is at an end of them.
        depth_of_focus: wavelength / aperture^2 of the middle colour, in metres.
    """

    depth: float
    spread: float
    rays: int
    likeness: tuple[float, ...]
    sharpest: float
    depth_of_focus: float

    @property
    def row(self) -> dict[str, Any]:
        """For a table, in millimetres."""
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
    """Focus depths in metres, mean pictures [F, 3, h, w] on the rays, and the bands of depth, near ones first."""

    depths: tuple[float, ...]
    pictures: Tensor
    bands: tuple[Band, ...]


@dataclass(frozen=True, eq=False)
class Surface:
    """The visible surface of a scene.

    Attributes:
        rendering: [3, h, w].
        opaque: Rays that show it, [h, w].
        depth: Where they do, in metres from the hologram, [h, w].
        ends: Depths at which it begins and ends, but for the outermost rays.
    """

    rendering: Tensor
    opaque: Tensor
    depth: Tensor
    ends: tuple[float, float]


def visible_surface(eye: Observer) -> Surface:
    """The surface that a sweep needs; ValueError for a scene without one, or with one at a single depth."""
    sampler = eye.scene.sampler()
    with torch.no_grad():
        rendering, opacity = (part.cpu() for part in sampler.render(eye.scene.volume))
        depth = sampler.depth_map(eye.scene.volume).cpu()
    opaque = opacity > _SEEN
    shown = depth[opaque].sort().values
    if len(shown) < _LEAST:
        raise ValueError(f"a sweep needs a surface: {len(shown)} of the rays are {_SEEN:.0%} opaque, not {_LEAST}")
    low, high = (shown[round(part * (len(shown) - 1))].item() for part in _ENDS)
    if not high > low:
        raise ValueError(f"the whole surface lies at {1e3 * low:.4g} mm: there is nothing to sweep")
    return Surface(rendering, opaque, depth, (low, high))


def focus_sweep(eye: Observer, settings: SweepSettings, surface: Surface | None = None) -> FocusSweep:
    """Look at an observer's scene with the eye focused at one depth after another, in light of one wavelength each.

    The scene's visible surface is cut into bands of depth. Of each band the fine detail of the picture is correlated
    with that of the volume's rendering, which has no focus: an eye that accommodates rightly sees a band best when it
    is focused at it.

    ``surface``: of :func:`visible_surface`, which is called without it, and raises what it does.
    """
    scene, surface = eye.scene, surface or visible_surface(eye)
    rendering, seen, depth, (low, high) = surface.rendering, surface.opaque, surface.depth, surface.ends
    room = 0.1 * (high - low)
    focus = torch.linspace(low - room, high + room, settings.steps).tolist()
    total = torch.zeros(len(focus), *rendering.shape)
    with tqdm(total=settings.realisations * len(focus), desc="sweeping", unit="picture", dynamic_ncols=True) as bar:
        for k in range(settings.realisations):
            hologram, _ = scene.hologram(eye.settings.seed + k)
            for f, place in enumerate(focus):
                total[f] += eye.seen(hologram, None, place)
                bar.update()
    pictures, wave = total / settings.realisations, eye.reference_wavelength
    fine, wanted = _detail(pictures), _detail(rendering[None].float())[0]
    bands = []
    ends = torch.linspace(low, high, settings.bands + 1).tolist()
    for near, far in zip(ends, ends[1:], strict=False):
        part = seen & (depth >= near) & (depth <= far)
        if int(part.sum()) < _LEAST:
            continue
        mean = depth[part].mean().item()
        likeness = tuple(_likeness(picture[:, part], wanted[:, part]) for picture in fine)
        spread, deep = depth[part].std().item(), wave / eye.detail(mean, wave) ** 2
        bands.append(Band(mean, spread, int(part.sum()), likeness, _peak(focus, likeness), deep))
    return FocusSweep(tuple(focus), pictures, tuple(bands))


def in_words(sweep: FocusSweep) -> list[str]:
    """A line for each band."""
    return [
        f"Focus      what lies at {1e3 * band.depth:.3f} mm looks sharpest with the eye at {1e3 * band.sharpest:.3f} "
        f"mm (depth of focus {1e3 * band.depth_of_focus:.3f} mm)"
        for band in sweep.bands
    ]


def draw(sweep: FocusSweep) -> bytes:
    """PNG of the likeness of each band against the focus, and of the first, middle and last band in focus."""
    figure = Figure(figsize=(17, 4.6), layout="constrained")
    curves, *views = figure.subplots(1, 4, width_ratios=(1.3, 1, 1, 1))
    places = [1e3 * depth for depth in sweep.depths]
    for k, band in enumerate(sweep.bands):
        curves.plot(places, band.likeness, "o-", color=f"C{k}", label=f"what lies at {1e3 * band.depth:.2f} mm")
        curves.axvline(1e3 * band.depth, color=f"C{k}", linestyle=":")
    curves.set_xlabel("focus of the eye (mm from the hologram); dotted: where each part lies")
    curves.set_ylabel("correlation of fine detail with the rendering")
    curves.grid(alpha=0.3)
    curves.legend(fontsize=8)
    bright = sweep.pictures.flatten().quantile(0.999) if sweep.pictures.numel() < 1 << 24 else sweep.pictures.max() / 3
    count = len(sweep.bands)
    for view, band in zip(views, (sweep.bands[0], sweep.bands[count // 2], sweep.bands[-1]), strict=True):
        nearest = min(range(len(places)), key=lambda f: abs(sweep.depths[f] - band.depth))
        picture = (sweep.pictures[nearest] / bright).clamp(0, 1).sqrt()
        view.imshow(picture.movedim(0, -1).numpy(), interpolation="nearest")
        view.set_title(f"focus {places[nearest]:.2f} mm", fontsize=10)
        view.set_axis_off()
    return figure_png(figure)


def _detail(pictures: Tensor) -> Tensor:
    """Pictures [F, 3, h, w] less their blur."""
    blur: Any = (0, 0, _DETAIL, _DETAIL)
    return pictures - torch.from_numpy(gaussian(pictures.numpy(), sigma=blur))


def _likeness(first: Tensor, second: Tensor) -> float:
    return ((first * second).sum() / (first.norm() * second.norm()).clamp(min=1e-30)).item()


def _peak(places: list[float], values: tuple[float, ...]) -> float:
    """Of the parabola through the greatest value and its neighbours."""
    at = max(range(len(values)), key=values.__getitem__)
    if at in (0, len(values) - 1):
        return float("nan")
    before, best, after = values[at - 1 : at + 2]
    return places[at] + 0.5 * (places[1] - places[0]) * (before - after) / (before - 2 * best + after)
