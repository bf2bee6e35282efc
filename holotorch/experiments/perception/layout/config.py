"""Settings of a layout over a wide field."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.errors import short
from holotorch.experiments.config.messages import nearest
from holotorch.experiments.config.settings import Number, Settings, existing, several

ICONS = ("wheel", "coaster", "castle", "boat", "tent", "carousel", "food", "first_aid")


def _no_icon(name: str) -> str:
    hint = nearest(name, list(ICONS))
    expected = f"expected {', '.join(map(repr, ICONS))}, or a picture file (PNG, JPEG) that exists"
    return f"{expected}, got {short(name)}{hint if 'did you mean' in hint else ''}"


Icon = Annotated[str, existing(lambda name: name in ICONS or Path(name).is_file(), _no_icon)]
Angle = Annotated[Number, Field(ge=-180, le=180)]


class TargetPatternSettings(Settings):
    """The target pattern, a row of thesis Table 2.2. All icons are scaled to have its perception time."""

    size_deg: Annotated[Number, Field(gt=0, le=90)]
    eccentricity_deg: Annotated[Number, Field(ge=0, le=90)]

    @property
    def name(self) -> str:
        """Size and eccentricity as text."""
        return f"{self.size_deg:g} deg at {self.eccentricity_deg:g} deg"


class ItemSettings(Settings):
    """An item of the layout: icon, label, and direction of its centre (azimuth positive to the right).

    ``icon``: wheel, coaster, castle, boat, tent, carousel, food, first_aid, or a picture file of your own, whose longer
    side has the size of the icon.
    """

    icon: Icon
    label: str = ""
    azimuth_deg: Angle
    elevation_deg: Annotated[Number, Field(ge=-80, le=80)] = 0.0


class DisplaySettings(Settings):
    """A display of your own, which is checked beside those of thesis Table 2.1.

    ``field_deg``: horizontal field of view from edge to edge. ``arcmin``: size of its coarsest pixels in minutes
    of arc, which is 60 / pixels per degree; null if it is not known. ``name``: as the table of displays calls it.
    """

    name: str = "own display"
    field_deg: Annotated[Number, Field(gt=0, le=360)]
    arcmin: Annotated[Number, Field(gt=0, le=600)] | None = None


class LayoutSettings(Settings):
    """Icons over a wide field, scaled for equal perception time, with one panel per target (thesis Fig. 2.8).

    ``extrapolate``: whether icons beyond 70 deg of eccentricity are scaled by the extrapolated line of Table 2.2;
    otherwise they have the target's size. ``field_deg``: (vertical, horizontal) field of the picture in degrees.
    ``display``: a display of your own, to be checked as well.
    """

    experiment: Literal["perception_layout"]
    targets: Annotated[tuple[TargetPatternSettings, ...], BeforeValidator(several), Field(min_length=1, max_length=6)]
    items: Annotated[tuple[ItemSettings, ...], Field(min_length=1, max_length=200)]
    extrapolate: bool = False
    field_deg: tuple[Annotated[Number, Field(gt=0, le=180)], Annotated[Number, Field(gt=0, le=360)]] = (60.0, 180.0)
    display: DisplaySettings | None = None
