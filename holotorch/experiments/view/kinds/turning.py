"""Turning a volume: the controls, and the experiment of the turned volume, also in a smaller version."""

from dataclasses import replace

from holotorch.experiments.view.controls import Slider
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.experiment import VolumeExperiment

_LEAST = 32  # pixels: smallest side of a hologram


def turning_controls(experiment: VolumeExperiment) -> list[Slider]:
    """Sliders of the orientation, which dragging a picture moves too."""
    view = experiment.settings.view
    # The sliders begin with the orientation of the configuration, whatever its number of whole turns.
    azimuth, elevation = (round(angle) for angle in (view.azimuth_deg, view.elevation_deg))
    first = view.azimuth_deg - azimuth, view.elevation_deg - elevation
    return [
        Slider("azimuth", "Turn about the vertical", "deg", azimuth - 180 + first[0], azimuth + 180 + first[0], 1.0,
               view.azimuth_deg, "Drag a picture to turn the volume; the hologram is computed anew."),
        Slider("elevation", "Turn about the horizontal", "deg", elevation - 90 + first[1], elevation + 90 + first[1],
               1.0, view.elevation_deg, ""),
    ]  # fmt: skip


def coarser(settings: VolumeSettings, largest: int) -> int:
    """Least number that divides pixels and rays and leaves at most ``largest`` pixels a side, as ``scale`` does.

    If none does, the largest that leaves at least ``_LEAST`` pixels a side.
    """
    sides = [side // settings.scale for side in settings.hologram.shape]
    rays = settings.hologram.rays
    counts = [*sides, *([] if rays is None else [rays // settings.scale])]
    divisors = [n for n in range(1, max(1, min(sides) // _LEAST) + 1) if not any(count % n for count in counts)]
    return next((n for n in divisors if max(sides) // n <= largest), divisors[-1])


def turned(experiment: VolumeExperiment, azimuth: float, elevation: float, divisor: int = 1) -> VolumeExperiment:
    """The experiment with another orientation in degrees, and with all its lengths and counts divided."""
    settings = experiment.settings
    samples = max(1, experiment.samples // divisor)  # a moving volume may be rough
    update = {"azimuth_deg": azimuth, "elevation_deg": elevation, "samples": samples}
    view = settings.view.model_copy(update=update)
    return replace(experiment, settings=settings.model_copy(update={"view": view, "scale": settings.scale * divisor}))
