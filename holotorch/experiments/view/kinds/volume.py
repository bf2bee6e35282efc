"""The view of the hologram of a volume: refocused, through a pupil, in another light, and turned."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from holotorch.core.grid import Grid
from holotorch.correction.problem import best_scale
from holotorch.experiments.panel.source import run_array, volume_hologram
from holotorch.experiments.runs.pictures import in_colour
from holotorch.experiments.view.controls import Choice, Slider, span
from holotorch.experiments.view.kinds.pupil import view_controls, view_of
from holotorch.experiments.view.kinds.refocus import Refocuser
from holotorch.experiments.view.kinds.turning import coarser, turned, turning_controls
from holotorch.experiments.view.viewer import Picture, Shown, Viewer, percent
from holotorch.experiments.volume.evaluation import pooled
from holotorch.experiments.volume.experiment import VolumeExperiment
from holotorch.metrics import SSIM_WINDOW, psnr, ssim

_SHIFT = 20.0  # nm: largest shift of the wavelengths of the light
_COARSE, _FINE = 128, 512  # pixels: largest side of the holograms of a turned volume


@dataclass(frozen=True)
class Scene:
    """A hologram and the rendering of its volume.

    Attributes:
        refocusers: Its colours, one by one.
        rendering: A channel for each wavelength, [C, h, w].
        stride: Pixels of the hologram for each ray of the rendering.
        scale: Factor by which all lengths are smaller than those of the run.
    """

    refocusers: list[Refocuser]
    rendering: Tensor
    stride: int
    scale: int


class VolumeViewer(Viewer):
    """Pictures of the hologram of a run of kind ``volume``; see :class:`Viewer`."""

    def __init__(self, folder: Path, experiment: VolumeExperiment):
        self.title = "Hologram of a volume" + (" (synthetic)" if experiment.synthetic else "")
        self._experiment = experiment
        extent = torch.tensor(experiment.volume.extent, dtype=torch.float64)
        half = experiment.width * float(extent.norm() / extent.max()) / 2  # of the volume in any direction
        middle, ends = experiment.distance, (min(experiment.depths), max(experiment.depths))
        self._foci = min(max(middle / 10, middle - half), ends[0]), max(middle + half, ends[1])
        wavelengths = experiment.settings.wavelengths
        shape = (len(wavelengths), *experiment.rays.shape)
        rendering = run_array(folder / "arrays" / "rendering.npy", shape, "(C, h, w)", "float32")
        self._stored = self._scene(volume_hologram(folder, experiment.settings), rendering, experiment, 1)
        self.transforms = len(wavelengths), *self._stored.refocusers[0].padded.shape
        self._turned: dict[int, tuple[tuple[float, float], Scene]] = {}  # the last orientation by the divisor
        every = {1: f"{wavelengths[0] * 1e9:.0f} nm", 2: "both", 3: "all three"}.get(
            len(wavelengths), f"all {len(wavelengths)}"
        )
        several = enumerate(wavelengths) if len(wavelengths) > 1 else ()
        names = {f"{c}": f"{w * 1e9:.0f} nm only" for c, w in several}
        self.controls = [
            *view_controls(experiment.grid, wavelengths, self._foci, middle),
            Choice("colour", "Colours", {"all": every} | names, "all", "The lasers that are on."),
            Slider(
                "shift", "Wavelength off by", "nm", **span(-_SHIFT, _SHIFT, 0.0, 80),
                explanation="The same hologram in light of another wavelength is in focus at another depth.",
            ),
            *turning_controls(experiment),
        ]  # fmt: skip
        seeds = experiment.settings.report.seeds
        one = f", one of the run's {seeds} realisations of the phases," if seeds > 1 else ""
        self.note = (
            f"The stored hologram{one} is propagated exactly. Each colour is scaled to fit the rendering best, and "
            "averaged over the pixels of each ray. A turned volume has a new hologram of at most "
            f"{_FINE} pixels a side, and one of {_COARSE} while it moves."
        )

    def show(self, values: Mapping[str, Any], coarse: bool, proceed: Callable[[], None]) -> Shown:
        """See :class:`Viewer`."""
        scene, reduced = self._scene_at((values["azimuth"], values["elevation"]), coarse, proceed)
        wavelengths = self._experiment.settings.wavelengths
        colours = range(len(wavelengths)) if values["colour"] == "all" else [int(values["colour"])]
        rendering, on = scene.rendering[list(colours)], [wavelengths[c] for c in colours]
        view = view_of(values, scene.scale)
        images, shares = [], []
        for c in colours:
            light = [wavelengths[c] + 1e-9 * values["shift"]]
            images.append(pooled(scene.refocusers[c].intensity(view, light)[0], scene.stride).cpu())
            shares += scene.refocusers[c].share()
        formed = torch.stack(images)
        picture = (formed * best_scale(formed, rendering)[:, None, None]).clamp(0, 1)
        numbers = _scores(picture, rendering.clamp(0, 1)) | {
            "light in the pupil": percent(sum(shares) / len(shares)),
            "hologram": "{} x {} px".format(*scene.refocusers[0].grid.shape),
        }
        caption = f"Hologram in focus at {values['focus']:.4g} mm"
        shown = Picture.of("shown", caption, in_colour(picture, on))
        pictures = [shown, Picture.of("rendering", "Direct volume rendering", in_colour(rendering, on))]
        return Shown(pictures, numbers, reduced)

    def _scene_at(self, angles: tuple[float, float], coarse: bool, proceed: Callable[[], None]) -> tuple[Scene, bool]:
        """The scene at an orientation in degrees, and whether it is smaller than at rest."""
        settings = self._experiment.settings
        if angles == (settings.view.azimuth_deg, settings.view.elevation_deg):
            return self._stored, False
        divisor = fine = coarser(settings, _FINE)
        if coarse and (fine not in self._turned or self._turned[fine][0] != angles):
            divisor = coarser(settings, _COARSE)
        if divisor not in self._turned or self._turned[divisor][0] != angles:
            self._turned.pop(divisor, None)  # its memory is needed
            experiment = turned(self._experiment, *angles, divisor)
            rendering = experiment.rendering()[0]
            hologram, _ = experiment.hologram(advance=proceed)
            self._turned[divisor] = angles, self._scene(hologram, rendering, experiment, divisor)
        return self._turned[divisor][1], divisor > fine

    def _scene(self, hologram: Tensor, rendering: Tensor, experiment: VolumeExperiment, divisor: int) -> Scene:
        longest = self._foci[1] / divisor
        wavelengths, fields = experiment.settings.wavelengths, hologram.to(experiment.device)
        grid = Grid(experiment.grid.shape, experiment.grid.pitch)
        refocusers = [Refocuser(fields[None, c : c + 1], grid, [w], longest) for c, w in enumerate(wavelengths)]
        return Scene(refocusers, rendering, experiment.stride, divisor)


def _scores(picture: Tensor, reference: Tensor) -> dict[str, str]:
    """SSIM and PSNR of pictures [C, h, w] with values from 0 to 1, mean over the colours."""
    numbers = {}
    if min(reference.shape[-2:]) >= SSIM_WINDOW:
        numbers["SSIM to the rendering"] = f"{ssim(picture, reference, data_range=1.0).mean().item():.3f}"
    decibels = psnr(picture, reference, data_range=1.0).mean().item()
    return numbers | ({"PSNR": f"{decibels:.1f} dB"} if math.isfinite(decibels) else {})
