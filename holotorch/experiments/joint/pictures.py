"""Pictures of a joint run: the focal stack of every method, parallax, a sweep of the focus, and the heater phases."""

from pathlib import Path

import torch
from torch import Tensor

from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.joint.methods import Shown
from holotorch.experiments.joint.names import NAMES
from holotorch.experiments.runs import figures
from holotorch.experiments.runs.pictures import in_colour
from holotorch.experiments.runs.saving import Results
from holotorch.io.files import write_bytes
from holotorch.io.images import encode_animation
from holotorch.optics.picture import tone_map

_COLUMNS = 8  # largest number of foci whose pictures stand side by side
SWEEP = 17  # foci of the animated sweep
_SECONDS = 0.12  # seconds for which each of them is shown


def write(
    folder: Path,
    experiment: JointExperiment,
    shown: dict[str, Shown],
    images: dict[str, dict[str, Tensor]],
    files: Results,
) -> None:
    """Write all pictures; ``images`` has the images [C, V, H, W] of each method and set of views.

    Of many foci, pictures of a few that are evenly spaced stand side by side.
    """
    wanted = {"stack": experiment.stack.images, "half": experiment.halves.images}
    peak = (wanted["stack"] * experiment.colours).amax().cpu()
    foci = [f"{focus * 1e3:.4g} mm" for focus in experiment.foci]
    sides = [f"{half}, {focus}" for focus in foci for half in ("left", "right")]
    some = torch.linspace(0, len(foci) - 1, min(len(foci), _COLUMNS)).round().long().tolist()
    ends = [0, 1, len(sides) - 2, len(sides) - 1]
    for name, key, titles, pick in (("stack", "stack", foci, some), ("parallax", "half", sides, ends)):
        rows = {"wanted": wanted[key]} | {NAMES[method]: each[key] for method, each in images.items()}
        pixels = {label: picture(experiment, each, peak)[:, pick] for label, each in rows.items()}
        files.write(write_bytes, folder / f"{name}.png", figures.picture_table(pixels, [titles[i] for i in pick]))
    files.write(write_bytes, folder / "sweep.png", sweep(experiment, shown["joint"], peak))
    phase = shown["joint"].phase
    assert phase is not None
    names = [f"{wavelength * 1e9:.0f} nm, frame 1 of {len(phase)}" for wavelength in experiment.settings.wavelengths]
    drawn = figures.channel_maps(phase[0].cpu(), names, "heater phase (rad)", "viridis")
    files.write(write_bytes, folder / "phase.png", drawn)


def picture(experiment: JointExperiment, images: Tensor, peak: Tensor) -> Tensor:
    """Pictures in 0 .. 1 of images [C, V, H, W], in the colours of the volume, for a screen; grey is [1, V, H, W]."""
    light, wavelengths = (images * experiment.colours).cpu().movedim(1, 0), experiment.settings.wavelengths
    light = light if len(wavelengths) == 1 else in_colour(light.float(), wavelengths)
    return tone_map(light, peak=peak).movedim(0, 1)


def sweep(experiment: JointExperiment, shown: Shown, peak: Tensor) -> bytes:
    """Animated PNG of the focus that moves through the volume and back: what is wanted, and what is shown."""
    near, far = experiment.foci[0], experiment.foci[-1]
    count = SWEEP if far > near else 1
    views = experiment.at_foci(torch.linspace(near, far, count, dtype=torch.float64).tolist())
    with torch.no_grad():
        observed = shown.images(views.operator)
    scale = (observed * views.images).sum((1, 2, 3)) / observed.square().sum((1, 2, 3))
    pair = [picture(experiment, each, peak) for each in (views.images, observed * scale[:, None, None, None])]
    frames = list(torch.cat(pair, -1).unbind(1))
    return encode_animation(frames + frames[-2:0:-1], _SECONDS)
