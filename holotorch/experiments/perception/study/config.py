"""Settings of a perception study: screen, patterns, order of trials and times."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field
from pydantic_core import PydanticCustomError
from torch import Tensor

from holotorch.core.quantities import SCREEN, shown
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.messages import validated
from holotorch.experiments.config.settings import (
    Count,
    Length,
    Number,
    Settings,
    Side,
    number,
    plausible,
    several,
    within,
)
from holotorch.experiments.config.source import Key, read_source
from holotorch.experiments.perception.study.design import AS_IN_THESIS, MOST_TRIALS, Design, make_design, too_many
from holotorch.experiments.perception.study.gaze import GazeSettings
from holotorch.perception.geometry import CurvedScreen, FlatScreen

Eccentricity = Annotated[
    Number, within(0, 120, "an eccentricity between 0 and 120 deg (left and right are drawn by the design)")
]
Size = Annotated[Number, within(0.1, 80, "a size between 0.1 and 80 deg")]
Contrast = Annotated[Number, within(0.02, 1, "a contrast between 0.02 and 1, which is black")]
Speed = Annotated[Number, within(0, 60, "a speed between 0 and 60 deg/s")]
Metres = Annotated[Length, plausible(SCREEN)]


def _unit_if_unusual(value: Any) -> Any:
    """Refuse a number without a unit that is unusual in metres: a distance of 21 was probably meant in centimetres."""
    low, high = SCREEN.usual
    if isinstance(value, int | float) and not isinstance(value, bool) and high < value <= SCREEN.high:
        expected = f"a distance in metres, usually {shown(low, 'm')} to {shown(high, 'm')}"
        hint = f"write {value:g} cm, or {value:g} m if metres are meant"
        raise PydanticCustomError("quantity", "expected {words}", {"words": expected, "hint": f"; {hint}"})
    return value


Distance = Annotated[Metres, BeforeValidator(_unit_if_unusual)]
Seconds = Annotated[Number, within(0.02, 60, "a time between 0.02 and 60 seconds, not milliseconds")]
Whole = Annotated[int, BeforeValidator(number), Field(ge=0)]
TRAVEL_DEG = 2.5  # a moving pattern goes up and down by this angle, so that its eccentricity hardly changes
_TOLERANCE_PX = 0.5  # a pattern may extend this far beyond the edge of the screen, since nothing visible is lost


def _ordered(times: tuple[float, float]) -> tuple[float, float]:
    if times[1] < times[0]:
        raise PydanticCustomError("order", "expected the shortest wait, then the longest")
    return times


class _ScreenSettings(Settings):
    """``shape``: pixels (rows, columns). ``size``: metres (height, width). ``cut``: show patterns that do not fit."""

    shape: tuple[Side, Side]
    size: tuple[Metres, Metres]
    distance: Distance
    cut: bool = False


class FlatSettings(_ScreenSettings):
    """A flat screen whose centre is straight ahead at ``distance`` metres."""

    kind: Literal["flat"]


class CurvedSettings(_ScreenSettings):
    """A screen on an upright cylinder of ``radius`` metres, concave towards the eye; its width is along the arc."""

    kind: Literal["curved"]
    radius: Distance


class ConditionSettings(Settings):
    """Eccentricities in degrees, each shown with all of the sizes in degrees."""

    eccentricities_deg: Annotated[tuple[Eccentricity, ...], BeforeValidator(several), Field(min_length=1)]
    sizes_deg: Annotated[tuple[Size, ...], BeforeValidator(several), Field(min_length=1)]

    @property
    def pairs(self) -> Iterator[tuple[float, float]]:
        """All pairs of an eccentricity and a size."""
        return product(self.eccentricities_deg, self.sizes_deg)


class RepeatSettings(Settings):
    """Number of trials of each condition and pattern, as the target and as the distraction."""

    target: Count = 5
    distraction: Whole = 2


class TimingSettings(Settings):
    """Times in seconds: ``wait_s`` before a pattern (shortest, longest), ``show_s`` of a pattern without an answer.

    A pattern that was answered by mistake is shown in red for ``feedback_s``.
    """

    wait_s: Annotated[tuple[Seconds, Seconds], AfterValidator(_ordered)] = (0.8, 1.6)
    show_s: Seconds = 2.0
    feedback_s: Seconds = 0.5


class StudySettings(Settings):
    """A study; see ``make_design``. ``practice``: number of trials before the first round, excluded from analyses.

    ``contrasts``, ``speeds_deg_s``: every pattern is shown with each contrast and at each speed. Contrast is Weber's,
    of a dark pattern on an sRGB screen. A moving pattern goes up and down at a constant speed, from where it appears.
    ``gaze``: check of the fixation with an eye tracker; without it, nobody checks where the participant looks.
    """

    seed: Whole
    screen: Annotated[FlatSettings | CurvedSettings, Discriminator("kind")]
    patterns: Annotated[tuple[ConditionSettings, ...], Field(min_length=1)]
    repeats: RepeatSettings = RepeatSettings()
    order: Literal["thesis", "williams"] = "thesis"
    sides: Literal["both", "left", "right"] = "both"
    practice: Whole = 14
    timing: TimingSettings = TimingSettings()
    contrasts: Annotated[tuple[Contrast, ...], BeforeValidator(several), Field(min_length=1)] = (AS_IN_THESIS[0],)
    speeds_deg_s: Annotated[tuple[Speed, ...], BeforeValidator(several), Field(min_length=1)] = (AS_IN_THESIS[1],)
    gaze: GazeSettings | None = None

    @property
    def conditions(self) -> tuple[tuple[float, float], ...]:
        """All pairs of eccentricity and size in degrees."""
        return tuple(pair for group in self.patterns for pair in group.pairs)

    @property
    def trials(self) -> int:
        """Number of trials of each participant after the practice."""
        conditions = sum(len(group.eccentricities_deg) * len(group.sizes_deg) for group in self.patterns)
        variants = len(self.contrasts) * len(self.speeds_deg_s)
        return 2 * conditions * variants * (self.repeats.target + self.repeats.distraction)

    def recorded(self) -> dict[str, Any]:
        """The settings that the page needs and the log keeps, as JSON data."""
        names = {"screen", "timing"} | ({"gaze"} if self.gaze else set())
        return self.model_dump(mode="json", include=names)

    def design(self, participant: int) -> Design:
        """The trials of one participant."""
        return make_design(
            participant,
            self.conditions,
            target_repeats=self.repeats.target,
            distraction_repeats=self.repeats.distraction,
            order=self.order,
            sides=self.sides,
            practice=self.practice,
            wait_s=self.timing.wait_s,
            variants=tuple(product(self.contrasts, self.speeds_deg_s)),
            seed=self.seed,
        )


@dataclass(frozen=True)
class Cut:
    """A pattern that extends beyond the edge of the screen; ``text`` states by how much."""

    eccentricity_deg: float
    size_deg: float
    text: str


def load_study(path: Path | str, overrides: Sequence[str] = ()) -> StudySettings:
    """Read the configuration file of a study, apply the overrides and check the settings.

    Raises:
        ConfigError: All mistakes in the file, one line per mistake with file, line and column.
    """
    source = read_source(Path(path), list(overrides))
    settings = validated(source, StudySettings)
    mistakes: list[tuple[Key, str]] = []
    screen = settings.screen
    if isinstance(screen, CurvedSettings):
        if screen.distance >= 2 * screen.radius:
            mistakes.append((("screen", "distance"), "expected an eye inside the cylinder: less than twice the radius"))
        if screen.size[1] > 2 * math.pi * screen.radius:
            mistakes.append((("screen", "size"), "expected an arc of at most one turn, 2 pi times the radius"))
    if settings.trials > MOST_TRIALS:  # listing the conditions would take too long
        raise ConfigError([source.mistake(("repeats",), too_many(settings.trials))])
    for name in ("contrasts", "speeds_deg_s"):
        values = getattr(settings, name)
        if len(set(values)) < len(values):
            mistakes.append(((name,), "expected different numbers; raise the repeats instead"))
    conditions: set[tuple[float, float]] = set()
    for i, group in enumerate(settings.patterns):
        for pair in group.pairs:
            if pair in conditions:
                twice = f"{pair[0]:g} deg with size {pair[1]:g} deg is there twice; raise the repeats instead"
                mistakes.append((("patterns", i), twice))
            conditions.add(pair)
    if not mistakes:
        cuts = beyond_screen(settings)
        shows = build_screen(screen).shows
        middles = sorted({cut.eccentricity_deg for cut in cuts if not shows(0.0, cut.eccentricity_deg)})
        if cuts and not screen.cut:
            cure = "sit nearer, use a larger screen, leave them out, or say 'cut: true' to show the part that fits"
            listed = "; ".join(cut.text for cut in cuts[:4]) + (f"; and {len(cuts) - 4} more" if len(cuts) > 4 else "")
            mistakes.append((("screen",), f"patterns beyond the screen: {listed}; {cure}"))
        elif middles:
            names = ", ".join(f"{eccentricity:g} deg" for eccentricity in middles)
            mistakes.append((("screen", "cut"), f"at {names} even the middle of a pattern is beyond the screen"))
    if mistakes:
        raise ConfigError([source.mistake(key, message) for key, message in mistakes])
    return settings


def beyond_screen(settings: StudySettings) -> list[Cut]:
    """The patterns that extend beyond the edge of the screen."""
    screen = build_screen(settings.screen)
    rows, columns = screen.shape
    cuts = []
    up = TRAVEL_DEG if any(settings.speeds_deg_s) else 0.0
    for eccentricity, size in settings.conditions:
        y, x = screen.pixels(*_outline(eccentricity, size, up))
        # Pixel centres have integer coordinates, so that the screen ends half a pixel beyond the last centre.
        # Directions that do not meet the screen surface give NaN, which counts as outside.
        fits_width = ((x - (columns - 1) / 2).abs() <= columns / 2 + _TOLERANCE_PX).all()
        half_height = (y - (rows - 1) / 2).abs().max().item()
        if not fits_width:
            text = f"reaches {eccentricity + size / 2:g} deg and the screen {screen.field_deg[1] / 2:.1f} deg"
        elif half_height > rows / 2 + _TOLERANCE_PX:
            text = f"takes {math.ceil(2 * half_height)} pixels in height and the screen has {rows}"
        else:
            continue
        cuts.append(Cut(eccentricity, size, f"{size:g} deg at {eccentricity:g} deg {text}"))
    return cuts


def build_screen(settings: FlatSettings | CurvedSettings) -> FlatScreen | CurvedScreen:
    """Create the geometry of the screen."""
    if isinstance(settings, FlatSettings):
        return FlatScreen(settings.shape, settings.size, settings.distance)
    return CurvedScreen(settings.shape, settings.size, settings.distance, settings.radius)


def _outline(eccentricity: float, size: float, up_deg: float = 0.0) -> tuple[Tensor, Tensor]:
    """(elevation, azimuth) in degrees of points on the circle pattern, which also encloses the cross pattern.

    ``up_deg``: elevation of the centre of the pattern, at the highest point of its motion.
    """
    angle = torch.arange(0, 360, 5, dtype=torch.float64).deg2rad()
    centre, half = math.radians(eccentricity), math.tan(math.radians(size) / 2)
    u, v = half * angle.cos(), half * angle.sin()  # in the plane tangent to the unit sphere at the centre
    up = math.radians(up_deg)
    ahead, y = math.cos(up) - v * math.sin(up), math.sin(up) + v * math.cos(up)
    x, z = ahead * math.sin(centre) + u * math.cos(centre), ahead * math.cos(centre) - u * math.sin(centre)
    return torch.atan2(y, torch.hypot(x, z)).rad2deg(), torch.atan2(x, z).rad2deg()
