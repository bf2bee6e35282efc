"""Settings of an observer's view of a hologram."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_serializer
from pydantic_core import PydanticCustomError

from holotorch.core.quantities import DEPTH, EYE_LENGTH, FOCAL_LENGTH, PUPIL_RADIUS, SPACING
from holotorch.experiments.config.errors import short
from holotorch.experiments.config.settings import (
    Count,
    Length,
    Number,
    Settings,
    Wavelength,
    existing,
    number,
    plausible,
    several,
)
from holotorch.experiments.volume.config import Scale, TransferSettings, ViewSettings, VolumeSource
from holotorch.io.bundled import find_config

Source = Literal["laser", "narrow_sled", "sled", "led"]


def _above_zero(value: float) -> float:
    if not value > 0:
        raise PydanticCustomError("above", "expected a length above zero")
    return value


Positive = Annotated[Length, AfterValidator(_above_zero)]


class SceneSettings(Settings):
    """The volume: ``config`` is its configuration file, ``change`` holds ``key=value`` overrides of that file."""

    config: Annotated[
        str,
        existing(find_config, lambda path: f"expected a configuration file of a volume that exists, got {short(path)}"),
    ]
    change: Annotated[tuple[str, ...], BeforeValidator(several)] = ()


class MagnifyingSettings(Settings):
    """The display of the thesis (Fig. 5.5): the eye sees the volume magnified by an eyepiece.

    ``eye_distance``: from eyepiece to eye. ``lens_distance``: from hologram to eyepiece; by default, it is chosen such
    that the middle of the volume appears at ``focus_distance`` from the eye.
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


class SphericalSettings(Settings):
    """A lens at the hologram, and the eye at its focal point (thesis Fig. 5.4): illumination by a spherical wave.

    The lens moves the scene: a depth z, as under a plane wave, appears at f^2 / (f + z) in front of the eye.
    """

    kind: Literal["spherical"]
    focal_length: Annotated[Positive, plausible(FOCAL_LENGTH)] = 150e-3


class EyeSettings(Settings):
    """The eye: radius of the pupil, distance from pupil to retina, and whether it has human chromatic aberration.

    ``position``: displacement (y, x) of the eye from the axis, for the perspective from there. ``tolerance``: allowed
    relative L2 error of the intensity from the propagation to the retina; by default a share of the tolerance of the
    run, or 0.03 if the run has none. If the error of collapsed propagation is larger, light is propagated element by
    element, which takes 10 to 300 times as long and needs much memory.
    """

    pupil_radius: Annotated[Length, plausible(PUPIL_RADIUS)] = 1.5e-3
    axial_length: Annotated[Length, plausible(EYE_LENGTH)] = 24e-3
    chromatic: bool = False
    position: Annotated[tuple[Length, Length], BeforeValidator(several)] = (0.0, 0.0)
    tolerance: Annotated[Number, Field(gt=0, lt=1)] | None = None


class LightSettings(Settings):
    """Sources to compare; laser, narrow_sled, sled and led have an FWHM of 1.4, 5, 10 and 20 nm.

    ``tolerance``: allowed error from summing over a few wavelengths instead of the whole spectrum, relative to the rms
    intensity of a picture; by default a share of the tolerance of the run, or 0.02. ``extent``: sine of the half
    angle that each source, a disc, subtends at the hologram; 0 for a point source. ``dispersion``: the panel's phases
    depend on the wavelength, as those of a liquid crystal do. With it, or with an eye beside the axis, every wavelength
    is propagated.
    """

    sources: Annotated[tuple[Source, ...], BeforeValidator(several), Field(min_length=1)] = (
        "laser",
        "narrow_sled",
        "sled",
        "led",
    )
    tolerance: Annotated[Number, Field(gt=0, lt=1)] | None = None
    extent: Annotated[Number, Field(ge=0, lt=0.1)] = 0.0
    dispersion: bool = False


class SweepSettings(Settings):
    """A sweep of the eye's focus over ``steps`` depths of the scene, whose surface is divided into ``bands`` of depth.

    ``realisations``: number of holograms with different random phases over which each picture is averaged.
    """

    bands: Annotated[Count, Field(le=64)] = 5
    steps: Annotated[Count, Field(ge=3, le=256)] = 11
    realisations: Annotated[Count, Field(le=256)] = 6


class ObserverSettings(Settings):
    """An observer's view of the hologram of a volume, for several light sources and depths of focus.

    ``volume``: a volume in place of the scene's, as in runs of kind volume. ``transfer``: its colours and opacities, as
    in these runs. ``view``: keys in place of those of the scene's view, which keeps the others. ``scale``: in place of
    the scene's. ``wavelengths``: wavelengths of the hologram, in place of the scene's.
    ``focus``: depths of the scene at which the eye is focused; by default, the 10, 50 and 90 % quantiles of the visible
    depths. ``seeds``: number of realisations of the random phases; they are compared with the mean of eight times as
    many other realisations. ``tolerance``: allowed relative L2 error of the intensity on the retina, divided between
    the hologram, the wavelengths (``light.tolerance``) and the propagation to the retina (``eye.tolerance``); without
    it, these err by at most 1e-3, 0.02 and 0.03. ``sweep``: sweep of the focus, which finds the focus at which each
    part of the scene looks sharpest. ``tradeoff``: distances of the scene at which the best spectral width of each
    colour is determined.
    """

    elsewhere: ClassVar[dict[str, str]] = {
        "hologram": "the scene has it; write 'scene.change=[\"hologram.KEY=VALUE\"]', or another scene.config"
    }

    experiment: Literal["eye"]
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**62)] = 0
    scene: SceneSettings
    volume: VolumeSource | None = None
    transfer: TransferSettings | None = None
    view: ViewSettings | None = None
    scale: Scale | None = None
    wavelengths: Annotated[tuple[Wavelength, ...], BeforeValidator(several)] | None = None
    display: Annotated[MagnifyingSettings | PlanarSettings | SphericalSettings, Field(discriminator="kind")]
    eye: EyeSettings = EyeSettings()
    light: LightSettings = LightSettings()
    focus: Annotated[tuple[Annotated[Positive, plausible(DEPTH)], ...], BeforeValidator(several)] | None = None
    seeds: Annotated[Count, Field(le=64)] = 2
    tolerance: Annotated[Number, Field(gt=0, lt=1)] | None = None
    sweep: SweepSettings | None = None
    tradeoff: Annotated[tuple[Annotated[Positive, plausible(DEPTH)], ...], BeforeValidator(several)] = ()

    @field_serializer("view")
    def _as_given(self, view: ViewSettings | None) -> dict[str, Any] | None:
        """Only the keys that were given: all others, also with their defaults, would replace those of the scene."""
        return None if view is None else view.model_dump(mode="json", exclude_unset=True)
