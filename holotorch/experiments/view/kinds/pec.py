"""The view of a corrected picture: another heat, distance or resolution than the solver assumed, and what it costs."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from holotorch.core.quantities import SIGMA_PX
from holotorch.experiments.panel.source import pec_heaters
from holotorch.experiments.pec.evaluation import observed
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.runs.pictures import in_colour
from holotorch.experiments.view.controls import Choice, Slider, span
from holotorch.experiments.view.viewer import Picture, Shown, Viewer, percent
from holotorch.modulator import PhasedArray, ThermalCrosstalk, quantised

_COLD = 1e-6  # rise relative to the warmest that counts as none
_REMEMBERED = 2  # propagators of the last distances, whose kernels may be large


def stretched(kernel: Tensor, times: float) -> ThermalCrosstalk:
    """Heat whose rise at a distance is that of the ``kernel`` [h, w] at 1 / ``times`` of the distance; 0 beyond it.

    ``times`` is above 0. Between its taps, the logarithm of the kernel is interpolated bilinearly: exact where heat
    falls exponentially. Rises below 1e-6 of the warmest are 0.
    """
    half = [n // 2 for n in kernel.shape]
    y, x = (torch.arange(-(r := math.ceil(n * times)), r + 1, dtype=torch.float64) / times for n in half)
    inside = (y.abs()[:, None] <= half[0]) & (x.abs() <= half[1])
    at = torch.stack(torch.broadcast_tensors(x / max(half[1], 1), y[:, None] / max(half[0], 1)), -1)
    log = kernel.detach().double().clamp(min=_COLD * float(kernel.max())).log()
    rise = grid_sample(log[None, None], at[None], padding_mode="border", align_corners=True)[0, 0].exp()
    return ThermalCrosstalk.from_patch(torch.where(inside & (rise > 2 * _COLD * rise.max()), rise, 0.0).to(kernel))


class PECViewer(Viewer):
    """Pictures of the heater phases of a run of kind ``pec``; see :class:`Viewer`."""

    def __init__(self, folder: Path, experiment: PECExperiment):
        self.title = "Corrected picture of a phased array"
        # A separate array, whose heat changes with a control and is shared by the experiments at all distances.
        self._array = PhasedArray(
            experiment.wavelengths,
            experiment.array.crosstalk,
            reference_response=experiment.array.reference_response,
        )
        self._experiment, self._assumed = replace(experiment, array=self._array), experiment.array.crosstalk
        # The slider stretches a measured kernel, since no Gaussian may represent it.
        given = experiment.settings.modulator.sigma_px
        self._measured, self._sigma = given is None, 1.0 if given is None else given
        self._heaters = pec_heaters(folder, experiment)[:, experiment.lit].to(experiment.device)
        self._target = Picture.of("target", "Target", self._drawn(experiment.image))
        self._at = lru_cache(_REMEMBERED)(self._at_distance)
        # The image at a distance of a single chip is a transform of twice the window.
        factor = 2 if experiment.isolated else 1
        self.transforms = self._heaters.shape[0] * self._heaters.shape[1], *(factor * n for n in experiment.grid.shape)
        self.controls = self._controls()
        self.note = (
            "The heater phases are those of the run; only what is chosen here changes. The brightness of each colour "
            "is that of the target"
            + (" at the best fit." if experiment.scale_free else ".")
            + (" Each distance shows a part of the target." if len(experiment.distances) > 1 else "")
        )

    def _controls(self) -> list[Slider | Choice]:
        settings, distances = self._experiment.settings, self._experiment.distances
        pictures = {"intensity": "the picture", "heaters": "heater phases", "temperature": "temperature of the chip"}
        label, unit, high = "Spread of the heat (sigma)", "px", min(2 * self._sigma + 1, SIGMA_PX.high)
        text = f"How far heat reaches on the real chip; the phases were computed for {self._sigma:g} px."
        if self._measured:
            label, unit, high = "Spread of the heat", "times that of the measured kernel", 2.0
            text = "The measured kernel, stretched: its rise at a distance is that at 1 / spread of the distance."
        controls: list[Slider | Choice] = [
            Choice("picture", "Show", pictures, "intensity", "What the chip forms, its heaters, or how hot it gets."),
            Slider(
                "sigma", label, unit, **span(0.0, high, self._sigma), explanation=text,
            ),
        ]  # fmt: skip
        if distances:
            near, far = 1e3 * min(distances), 1e3 * max(distances)
            low, high = (end + part * abs(end) for end, part in ((near, -0.5), (far, 0.5)))
            listed = ", ".join(f"{1e3 * distance:g}" for distance in distances)
            controls.append(
                Slider(
                    "distance",
                    "Distance of the screen",
                    "mm",
                    **span(low, high, near),
                    explanation=f"From the chip; the picture is meant for {listed} mm.",
                )  # fmt: skip
            )
        bits = {"0": "continuous"} | {str(n): f"{n} bits, {2**n} levels" for n in (1, 2, 3, 4, 5, 6, 8, 10)}
        text = "How finely a heater can be set; the levels are evenly spaced up to its largest phase."
        controls.append(Choice("bits", "Levels of the heaters", bits, "0", text))
        if (frames := settings.frames) > 1:
            options = {"mean": f"mean of all {frames}"} | {str(f): f"frame {f + 1} alone" for f in range(frames)}
            controls.append(Choice("frame", "Frame", options, "mean", "The eye sees the mean of all frames."))
        return controls

    def show(self, values: Mapping[str, Any], coarse: bool, proceed: Callable[[], None]) -> Shown:
        """See :class:`Viewer`."""
        frame = values.get("frame", "mean")
        phase = self._heaters if frame == "mean" else self._heaters[int(frame)][None]
        if values["bits"] != "0":
            phase = quantised(phase.clamp(min=0), int(values["bits"]))
        experiment = self._at(values.get("distance"))
        self._array.crosstalk = self._crosstalk(values["sigma"]).to(phase.device)
        warm = self._array.temperature(self._array.crosstalk(phase))
        numbers = {"hottest pixel": f"{float(warm.max()):.0f} degC above ambient"}
        if values["picture"] != "intensity":
            heaters = values["picture"] == "heaters"
            pictures = self._maps(phase if heaters else warm, "rad" if heaters else "degC")
            return Shown(pictures, numbers)
        picture, scores = observed(experiment, phase)
        names = {"ssim": "SSIM", "psnr": "PSNR"}
        for name in experiment.settings.report.metrics:
            if (value := scores[f"{name}_mean"]) is not None:
                numbers[names[name]] = f"{value:.3f}" if name == "ssim" else f"{value:.1f} dB"
        efficiency = [share for share in scores["efficiency"] if share > 0]
        numbers["light in the picture"] = percent(sum(efficiency) / max(1, len(efficiency)))
        return Shown([Picture.of("shown", "On the screen", self._drawn(picture)), self._target], numbers)

    def _crosstalk(self, spread: float) -> ThermalCrosstalk:
        """Heat of another sigma in pixels, or of a measured kernel whose spread is multiplied by ``spread``."""
        if spread == self._sigma:
            return self._assumed
        if self._measured and spread > 0:
            return stretched(self._assumed.kernel, spread)
        return ThermalCrosstalk(spread)  # all taps, since those of the configuration may be too few

    def _drawn(self, picture: Tensor) -> Tensor:
        """A picture of all colours as it is drawn."""
        wavelengths = self._experiment.settings.wavelengths
        return in_colour(picture, wavelengths) if len(wavelengths) > 1 else picture

    def _at_distance(self, distance: float | None) -> PECExperiment:
        """The experiment with its image at one distance in millimetres; unchanged for that of the configuration."""
        experiment = self._experiment
        meant = [1e3 * distance for distance in experiment.distances]
        if distance is None or meant == [distance]:
            return experiment
        settings = experiment.settings
        light = settings.propagator.model_copy(update={"distance": (1e-3 * distance,)})
        return replace(experiment, settings=settings.model_copy(update={"propagator": light}))

    def _maps(self, values: Tensor, unit: str) -> list[Picture]:
        """A map of each colour of the first frame in ``values`` [F, C, H, W], and its range in words."""
        from matplotlib import colormaps

        pictures = []
        colormap = colormaps["inferno" if unit == "degC" else "viridis"]
        for wavelength, each in zip(self._experiment.wavelengths, values[0].cpu(), strict=True):
            low, high = float(each.min()), float(each.max())
            coloured = torch.from_numpy(colormap(((each - low) / max(high - low, 1e-12)).numpy())[..., :3])
            caption = f"{wavelength * 1e9:.0f} nm: {low:.1f} (dark) to {high:.1f} {unit} (bright)"
            pictures.append(Picture.of(f"{wavelength * 1e9:.0f}", caption, coloured.movedim(-1, 0)))
        return pictures
