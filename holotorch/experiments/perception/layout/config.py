"""What the configuration of a layout over a wide field may say."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.settings import Number, Settings, several

Icon = Literal["wheel", "coaster", "castle", "boat", "tent", "carousel", "food", "first_aid"]
Angle = Annotated[Number, Field(ge=-180, le=180)]


class TargetPatternSettings(Settings):
    """A row of thesis Table 2.2: the pattern as soon as which all others are to be perceived."""

    size_deg: Annotated[Number, Field(gt=0, le=90)]
    eccentricity_deg: Annotated[Number, Field(ge=0, le=90)]


class ItemSettings(Settings):
    """A place of the layout: its icon and label, and where its centre is; azimuths to the left are negative."""

    icon: Icon
    label: str = ""
    azimuth_deg: Angle
    elevation_deg: Annotated[Number, Field(ge=-80, le=80)] = 0.0


class LayoutSettings(Settings):
    """Icons over a wide field, scaled so that each is perceived in equal time (thesis Fig. 2.8), a panel per target.

    ``extrapolate``: follow the lines beyond 70 deg of eccentricity; otherwise such icons keep the target's size.
    ``field_deg``: what the picture spans, (vertical, horizontal), at equal angles per pixel.
    """

    experiment: Literal["perception_layout"]
    targets: Annotated[tuple[TargetPatternSettings, ...], BeforeValidator(several), Field(min_length=1, max_length=6)]
    items: Annotated[tuple[ItemSettings, ...], Field(min_length=1, max_length=200)]
    extrapolate: bool = False
    field_deg: tuple[Annotated[Number, Field(gt=0, le=180)], Annotated[Number, Field(gt=0, le=360)]] = (60.0, 180.0)
