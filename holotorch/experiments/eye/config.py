"""What the configuration of an observer's view may say."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError

from holotorch.core.quantities import DEPTH, EYE_LENGTH, FOCAL_LENGTH, PUPIL_RADIUS, SPACING
from holotorch.experiments.config.errors import short
from holotorch.experiments.config.settings import Count, Length, Number, Settings, existing, number, plausible, several
from holotorch.io.bundled import find_config

Source = Literal["laser", "narrow_sled", "sled", "led"]


def _above_zero(value: float) -> float:
    if not value > 0:
        raise PydanticCustomError("above", "expected a length above zero")
    return value


def _no_scene(value: str) -> str:
    return f"expected a configuration file of a volume that exists, got {short(value)}"


Positive = Annotated[Length, AfterValidator(_above_zero)]


class SceneSettings(Settings):
    """The hologram that is looked at: a volume's configuration, with settings to change as on the command line."""

    config: Annotated[str, existing(find_config, _no_scene)]
    change: Annotated[tuple[str, ...], BeforeValidator(several)] = ()


class MagnifyingSettings(Settings):
    """The thesis's display (Fig. 5.5): an eyepiece beyond the volume, whose magnified image the eye sees.

    ``lens_distance``: from hologram to eyepiece; by default where the volume's middle appears at ``focus_distance``.
    """

    kind: Literal["magnifying"]
    focal_length: Annotated[Positive, plausible(FOCAL_LENGTH)] = 20e-3
    eye_distance: Annotated[Positive, plausible(SPACING)] = 50e-3
    focus_distance: Annotated[Positive, plausible(DEPTH)] = 120e-3
    lens_distance: Annotated[Positive, plausible(SPACING)] | None = None


class PlanarSettings(Settings):
    """No eyepiece: the eye looks at the hologram from ``distance``."""

    kind: Literal["planar"]
    distance: Annotated[Positive, plausible(SPACING)] = 250e-3


class EyeSettings(Settings):
    """The eye: radius of its pupil, distance of its retina, and whether it has the colour error of human eyes."""

    pupil_radius: Annotated[Length, plausible(PUPIL_RADIUS)] = 1.5e-3
    axial_length: Annotated[Length, plausible(EYE_LENGTH)] = 24e-3
    chromatic: bool = False


class LightSettings(Settings):
    """Sources to compare, by name or by their FWHM.

    ``tolerance``: of the sum over wavelengths, and of making most of them from few, relative to a picture's rms
    brightness.
    ``extent``: sine of the half angle under which the hologram sees the sources, discs; 0 for points.
    """

    sources: Annotated[tuple[Source, ...], BeforeValidator(several), Field(min_length=1)] = (
        "laser",
        "narrow_sled",
        "sled",
        "led",
    )
    tolerance: Annotated[Number, Field(gt=0, lt=1)] = 0.02
    extent: Annotated[Number, Field(ge=0, lt=0.1)] = 0.0


class SweepSettings(Settings):
    """Focus swept over the scene in ``steps``, whose surface is cut into ``bands`` of depth."""

    bands: Annotated[Count, Field(le=64)] = 5
    steps: Annotated[Count, Field(ge=3, le=256)] = 11
    realisations: Annotated[Count, Field(le=256)] = 6


class ObserverSettings(Settings):
    """What an observer sees of a volume's hologram, for several light sources and depths of focus.

    ``focus``: depths of the scene in which the eye is focused; a tenth, half and nine tenths of it by default.
    ``seeds``: realisations of the phases, which are compared with the mean of eight times as many others.
    ``tolerance``: error of the way to the retina, relative L2 of the intensity; below what the collapse keeps, elements
    take 10 to 300 times as long and much memory.
    ``sweep``: the eye's focus is swept over the scene as well, to see where each part of it looks sharpest.
    ``tradeoff``: distances at which the best spectral width is looked for as well, colour by colour.
    """

    experiment: Literal["eye"]
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**62)] = 0
    scene: SceneSettings
    display: Annotated[MagnifyingSettings | PlanarSettings, Field(discriminator="kind")]
    eye: EyeSettings = EyeSettings()
    light: LightSettings = LightSettings()
    focus: Annotated[tuple[Annotated[Positive, plausible(DEPTH)], ...], BeforeValidator(several)] | None = None
    seeds: Annotated[Count, Field(le=64)] = 2
    tolerance: Annotated[Number, Field(gt=0, lt=1)] = 0.03
    sweep: SweepSettings | None = None
    tradeoff: Annotated[tuple[Annotated[Positive, plausible(DEPTH)], ...], BeforeValidator(several)] = ()
