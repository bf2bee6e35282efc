"""PanelPhases: the phases that a panel must show for the result of a run, and the picture that they form."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.joint.config import JointSettings
from holotorch.experiments.joint.experiment import build as build_joint
from holotorch.experiments.joint.methods import Shown
from holotorch.experiments.pec.config import PECSettings
from holotorch.experiments.pec.experiment import PECExperiment, build
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs.record import kind_of, runs_inside
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.hologram import double_phase, encoding_loss, error_diffused, kinoform, refocused
from holotorch.io.files import read_json

ENCODINGS: dict[str, Callable[[Tensor], Tensor]] = {
    "double_phase": double_phase,
    "kinoform": kinoform,
    "error_diffusion": error_diffused,
}


_AFTER_SPREADING = (
    "phase after the heat has spread, modulo 2 pi, for a liquid-crystal panel; for the heaters of a thermal chip use "
    "holotorch export-heaters, or arrays/phase.npy, [F, C, H, W] in rad before spreading and not modulo 2 pi"
)
_FAR_END = (
    "phases that form the volume behind the panel, where the end that was rendered (view.front=far) is the hidden one: "
    "its depth is inverted for an observer in front of the panel, for whom view.front=near is right"
)


@dataclass(frozen=True)
class PanelPhases:
    """Phases for a panel, and the picture that they form.

    Attributes:
        phase: Phases in rad, not wrapped, float32 [F, C, H, W].
        wavelengths: Wavelengths of the C colours in metres.
        grid: Pixels of the hologram.
        encoding: Name of the encoding of a complex field as phases; "phase" if the run computed phases.
        picture: Function from fields [F, C, H, W] to the intensity [C, ...] of the picture that they form, the mean
            over the F frames.
        losses: Relative squared error of the picture by name of the encoding, for ``encoding`` and the kinoform,
            without an aperture, one value per colour; empty if the run computed phases.
        content: What a user of the phases must know, or an empty text.
    """

    phase: Tensor
    wavelengths: tuple[float, ...]
    grid: Grid
    encoding: str
    picture: Callable[[Tensor], Tensor]
    losses: dict[str, list[float]] = field(default_factory=dict)
    content: str = ""


def load_panel_phases(folder: Path, encoding: str | None = None) -> PanelPhases:
    """Phases of a run of kind ``pec``, ``joint`` or ``volume``, from its folder; ConfigError for any other folder."""
    if not (folder / "config.yaml").is_file():
        command = "holotorch export-slm {} --slm FILE"
        inside = runs_inside(folder, command, lambda run: kind_of(run) in ("pec", "joint", "volume"))
        raise ConfigError([f"{folder} holds no run: config.yaml is not there{inside}"])
    if encoding is not None and encoding not in ENCODINGS:
        raise ConfigError([f"expected one of {', '.join(ENCODINGS)} as the encoding, got {encoding!r}"])
    settings = load_config(folder / "config.yaml")
    if not isinstance(settings, PECSettings | VolumeSettings | JointSettings):
        kinds = "only runs of kind pec, volume and joint have a hologram"
        raise ConfigError([f"{folder} holds a {settings.experiment}; {kinds}"])
    if not isinstance(settings, VolumeSettings) and encoding is not None:
        raise ConfigError([f"{folder} holds phases already, which need no encoding; leave out --encoding"])
    try:
        if isinstance(settings, PECSettings):
            return _from_pec(folder, settings)
        if isinstance(settings, JointSettings):
            return _from_joint(folder, settings)
        return _from_volume(folder, settings, encoding or "double_phase")
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError([f"{folder}: {error}"]) from error


def pec_heaters(folder: Path, experiment: PECExperiment) -> Tensor:
    """Heater phases of a run of kind ``pec``, float32 [F, all colours, H, W]. ValueError if they cannot be read."""
    settings = experiment.settings
    shape = (settings.frames, len(settings.wavelengths), *settings.grid.shape)
    heaters = run_array(folder / "arrays" / "phase.npy", shape, "(F, C, H, W)", "float32")
    checks.all_finite("phase", heaters)
    _check_axes(folder, experiment, heaters)
    return heaters


def joint_heaters(folder: Path, settings: JointSettings) -> Tensor:
    """Heater phases of a run of kind ``joint``, float32 [F, C, H, W]. ValueError if they cannot be read."""
    shape = (settings.frames, len(settings.wavelengths), *settings.display.shape)
    heaters = run_array(folder / "arrays" / "phase.npy", shape, "(F, C, H, W)", "float32")
    checks.all_finite("phase", heaters)
    return heaters


def volume_hologram(folder: Path, settings: VolumeSettings) -> Tensor:
    """Field of a run of kind ``volume``, complex64 [C, H, W]. ValueError if it cannot be read."""
    height, width = (size // settings.scale for size in settings.hologram.shape)
    shape = (len(settings.wavelengths), height, width)
    hologram = run_array(folder / "arrays" / "hologram.npy", shape, "(C, H, W)", "complex64")
    checks.all_finite("hologram", torch.view_as_real(hologram))
    return hologram


def _from_pec(folder: Path, settings: PECSettings) -> PanelPhases:
    experiment = build(settings)
    heaters = pec_heaters(folder, experiment)
    phase = experiment.array.crosstalk(heaters[:, experiment.lit].double()).float()

    def picture(fields: Tensor) -> Tensor:
        formed = [intensity(experiment.propagator(field.to(experiment.device))) for field in fields]
        return experiment.picture_in(torch.stack(formed).mean(0)).cpu()

    return PanelPhases(phase, experiment.wavelengths, experiment.grid, "phase", picture, content=_AFTER_SPREADING)


def _from_joint(folder: Path, settings: JointSettings) -> PanelPhases:
    experiment = build_joint(settings)
    heaters = joint_heaters(folder, settings)
    middle = len(experiment.foci) // 2

    def picture(fields: Tensor) -> Tensor:
        return Shown(fields.to(experiment.device)).images(experiment.stack.operator)[:, middle].cpu()

    phase = experiment.heat(heaters.double().to(experiment.device)).float().cpu()
    return PanelPhases(phase, settings.wavelengths, experiment.grid, "phase", picture, content=_AFTER_SPREADING)


def _from_volume(folder: Path, settings: VolumeSettings, encoding: str) -> PanelPhases:
    hologram = volume_hologram(folder, settings)
    grid = Grid((hologram.shape[-2], hologram.shape[-1]), settings.hologram.pitch)
    # The losses contain fourth powers of the field, which may overflow float32. The scale is a power of two, so exact.
    hologram = hologram * 2.0 ** -torch.frexp(hologram.abs().amax()).exponent.double().item()
    depth = _depth(folder, settings)

    def propagator(colour: int) -> Callable[[Tensor], Tensor]:
        return lambda light: refocused(light, grid, settings.wavelengths[colour], depth, tolerance=3e-3)

    def picture(fields: Tensor) -> Tensor:
        return torch.stack([intensity(propagator(c)(fields[:, c])).mean(0) for c in range(fields.shape[1])])

    phase = torch.stack([ENCODINGS[encoding](field) for field in hologram])
    losses = {
        name: [encoding_loss(hologram[c], phases[c], propagator(c)).item() for c in range(len(hologram))]
        for name, phases in ((encoding, phase), ("kinoform", kinoform(hologram)))
    }
    content = _FAR_END if settings.view.front == "far" else ""
    return PanelPhases(phase[None], settings.wavelengths, grid, encoding, picture, losses, content)


def _check_axes(folder: Path, experiment: PECExperiment, heaters: Tensor) -> None:
    """Raise ValueError if the first two axes of phase.npy are exchanged.

    If F = C, the shape does not show this, but the heating power of each colour in the summary of the run does.
    """
    try:
        numbers = _summary(folder).get("methods", {}).get("corrected", {}).get("heating_power_K_per_pixel")
        light = None if numbers is None else torch.tensor(numbers, dtype=torch.float64)[experiment.lit]
    except (ValueError, AttributeError, TypeError, LookupError, RuntimeError, OverflowError):
        raise ValueError("summary.json is damaged: it does not say the heating power of each colour") from None
    if not len(heaters) == heaters.shape[1] > 1 or light is None:
        return

    def fits(phases: Tensor) -> bool:
        power = experiment.array.temperature(phases[:, experiment.lit].double()).mean((0, -2, -1))
        return torch.allclose(power, light, rtol=1e-3)

    if not fits(heaters) and fits(heaters.transpose(0, 1)):
        raise ValueError(
            f"phase.npy holds [C, F, H, W], colours before frames, by the heating power of each colour in the run's "
            f"summary, and [F, C, H, W] is wanted; as F = C = {len(heaters)}, its shape does not tell: swap its first "
            "two axes"
        )


def _depth(folder: Path, settings: VolumeSettings) -> float:
    """The middle of the depths at which the run was refocused, in metres."""
    try:
        depths = _summary(folder).get("refocused_m") or [settings.hologram.distance / settings.scale]
        return checks.finite("refocused_m", depths[len(depths) // 2], "metres")
    except (ValueError, AttributeError, TypeError, LookupError):
        raise ValueError("summary.json is damaged: it does not say at which depths the run was refocused") from None


def _summary(folder: Path) -> dict[str, Any]:
    """Summary of a complete or interrupted run; an empty dictionary if there is neither file."""
    for name in ("summary.json", "interrupted.json"):
        if (folder / name).is_file():
            return read_json(folder / name)
    return {}


def run_array(path: Path, shape: tuple[int, ...], axes: str, dtype: str) -> Tensor:
    """An array of the run. ValueError if it is missing, damaged or of another shape or dtype."""
    if not path.is_file():
        raise ValueError(f"{path.name} is not in its arrays; finish the run first: holotorch resume")
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # a memory map checks the size before it allocates
        stated = values.shape, str(values.dtype)
    except Exception as error:  # damaged bytes may raise any exception
        raise ValueError(f"{path.name} cannot be read: {error}") from None
    if stated != (shape, dtype):
        expected = f"the shape {axes} = {shape} of its configuration in {dtype}"
        raise ValueError(f"{path.name} must have {expected}, got {stated[0]} in {stated[1]}")
    return torch.from_numpy(values.copy())
