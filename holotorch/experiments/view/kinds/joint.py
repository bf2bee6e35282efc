"""The view of a volume on a hot chip: any focus and pupil, all frames or one, beside what an eye is to see."""

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from holotorch.correction.problem import best_scale
from holotorch.experiments.joint.evaluation import errors
from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.joint.methods import show
from holotorch.experiments.joint.pictures import picture
from holotorch.experiments.panel.source import joint_heaters
from holotorch.experiments.view.controls import Choice
from holotorch.experiments.view.kinds.pupil import view_controls, view_of
from holotorch.experiments.view.kinds.refocus import Refocuser
from holotorch.experiments.view.viewer import Picture, Shown, Viewer, percent
from holotorch.optics import View


class JointViewer(Viewer):
    """Pictures of the heater phases of a run of kind ``joint``; see :class:`Viewer`."""

    def __init__(self, folder: Path, experiment: JointExperiment):
        self.title = "Volume on a hot chip" + (" (synthetic)" if experiment.scene.synthetic else "")
        self._experiment = experiment
        near, far = experiment.foci[0], experiment.foci[-1]
        # The run itself has padded its transforms for the farthest depth.
        foci = max(near / 2, near - max(0.25 * (far - near), 0.05 * near)), far
        wavelengths, frames = experiment.settings.wavelengths, experiment.settings.frames
        shown = show(experiment, joint_heaters(folder, experiment.settings).to(experiment.device))
        self._refocuser = Refocuser(shown.fields, experiment.grid, wavelengths, far)
        self.transforms = frames * len(wavelengths), *self._refocuser.padded.shape
        options = {"mean": f"mean of all {frames}"} | {str(f): f"frame {f + 1} alone" for f in range(frames)}
        middle = experiment.foci[len(experiment.foci) // 2]
        self.controls = [
            *view_controls(experiment.grid, wavelengths, foci, middle, experiment.radius),
            Choice("frame", "Frame", options, "mean", "The eye sees the mean of all frames."),
        ]
        self.note = (
            f"Corrected for a pupil of {self.controls[1].value:.3g} deg and for {len(experiment.foci)} depths from "
            f"{1e3 * near:.4g} to {1e3 * far:.4g} mm. Wanted is the light of the volume without speckle. The "
            "brightness of each colour is that which fits these depths best."
        )

    def show(self, values: Mapping[str, Any], coarse: bool, proceed: Callable[[], None]) -> Shown:
        """See :class:`Viewer`. While a control moves, only what is shown follows."""
        view, frame = view_of(values), values["frame"]
        image = self._refocuser.intensity(view, frame=None if frame == "mean" else int(frame))
        image = (image * self._scale)[:, None]
        numbers = {"light in the pupil": percent(sum(shares := self._refocuser.share()) / len(shares))}
        pictures = [Picture.of("shown", f"Seen at {values['focus']:.4g} mm", self._coloured(image))]
        if coarse:
            return Shown(pictures, numbers, coarse=True)
        proceed()
        targets = self._experiment.views([view]).images
        scores = errors(image, targets)
        numbers |= {"SSIM": f"{scores['ssim']:.3f}", "PSNR": f"{scores['psnr']:.1f} dB"}
        numbers["contrast of speckle"] = f"{scores['contrast']:.3f}"
        pictures.append(Picture.of("wanted", "Wanted", self._coloured(targets)))
        return Shown(pictures, numbers)

    @cached_property
    def _scale(self) -> Tensor:
        """Factor of each colour that fits the pictures at the corrected foci best, [C, 1, 1]."""
        experiment = self._experiment
        views = [View(focus, experiment.radius) for focus in experiment.foci]
        observed = torch.stack([self._refocuser.intensity(view) for view in views], 1)
        return best_scale(observed, experiment.stack.images, -3)[:, None, None]

    @cached_property
    def _peak(self) -> Tensor:
        return (self._experiment.stack.images * self._experiment.colours).amax().cpu()

    def _coloured(self, images: Tensor) -> Tensor:
        """Picture [C, H, W] of images [C, 1, H, W] in the colours of the volume."""
        return picture(self._experiment, images, self._peak)[:, 0]
