"""What the file of a perception study may say: its screen, patterns, order and times."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field
from pydantic_core import PydanticCustomError
from torch import Tensor

from holotorch.core.quantities import SCREEN
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
from holotorch.experiments.perception.study.design import MOST_TRIALS, Design, make_design, too_many
from holotorch.perception.geometry import CurvedScreen, FlatScreen

Eccentricity = Annotated[
    Number, within(0, 120, "an eccentricity between 0 and 120 deg (left and right are drawn by the design)")
]
Size = Annotated[Number, within(0.1, 80, "a size between 0.1 and 80 deg")]
Metres = Annotated[Length, plausible(SCREEN)]
Seconds = Annotated[Number, within(0.02, 60, "a time between 0.02 and 60 seconds, not milliseconds")]
Whole = Annotated[int, BeforeValidator(number), Field(ge=0)]
_SLACK_PX = 0.5


def _ordered(times: tuple[float, float]) -> tuple[float, float]:
    if times[1] < times[0]:
        raise PydanticCustomError("order", "expected the shortest wait, then the longest")
    return times


def _some(items: tuple) -> tuple:
    if not items:
        raise PydanticCustomError("some", "expected at least one")
    return items


class _ScreenSettings(Settings):
    """``shape``: pixels (rows, columns). ``size``: metres (height, width). ``cut``: show what fits of a pattern."""

    shape: tuple[Side, Side]
    size: tuple[Metres, Metres]
    distance: Metres
    cut: bool = False


class FlatSettings(_ScreenSettings):
    """A flat screen, its centre straight ahead at ``distance`` metres."""

    kind: Literal["flat"]


class CurvedSettings(_ScreenSettings):
    """A screen on an upright cylinder of ``radius`` metres, hollow towards the eye; its width is along the arc."""

    kind: Literal["curved"]
    radius: Metres


class ConditionSettings(Settings):
    """Eccentricities that are shown with the same sizes, both in degrees."""

    eccentricities_deg: Annotated[tuple[Eccentricity, ...], BeforeValidator(several), AfterValidator(_some)]
    sizes_deg: Annotated[tuple[Size, ...], BeforeValidator(several), AfterValidator(_some)]


class RepeatSettings(Settings):
    """How often each condition comes for each pattern as the target and as the distraction."""

    target: Count = 5
    distraction: Whole = 2


class TimingSettings(Settings):
    """Seconds: the wait before a pattern (shortest, longest), how long it stays, how long a mistake is shown."""

    wait_s: Annotated[tuple[Seconds, Seconds], AfterValidator(_ordered)] = (0.8, 1.6)
    show_s: Seconds = 2.0
    feedback_s: Seconds = 0.5


class StudySettings(Settings):
    """A study; see ``make_design``. ``practice``: trials before the first round, which no analysis counts."""

    seed: Whole
    screen: Annotated[FlatSettings | CurvedSettings, Discriminator("kind")]
    patterns: Annotated[tuple[ConditionSettings, ...], AfterValidator(_some)]
    repeats: RepeatSettings = RepeatSettings()
    order: Literal["thesis", "williams"] = "thesis"
    sides: Literal["both", "left", "right"] = "both"
    practice: Whole = 14
    timing: TimingSettings = TimingSettings()

    @property
    def conditions(self) -> tuple[tuple[float, float], ...]:
        """All pairs of eccentricity and size in degrees."""
        return tuple((e, s) for group in self.patterns for e in group.eccentricities_deg for s in group.sizes_deg)

    @property
    def trials(self) -> int:
        """How many each participant has after the practice."""
        conditions = sum(len(group.eccentricities_deg) * len(group.sizes_deg) for group in self.patterns)
        return 2 * conditions * (self.repeats.target + self.repeats.distraction)

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
            seed=self.seed,
        )


@dataclass(frozen=True)
class Cut:
    """A pattern that does not fit the screen, and by how much."""

    eccentricity_deg: float
    size_deg: float
    text: str


def load_study(path: Path | str, overrides: Sequence[str] = ()) -> StudySettings:
    """Read, override and check the file of a study.

    Raises:
        ConfigError: Everything that is wrong with it, one line per mistake with its file, line and column.
    """
    source = read_source(Path(path), list(overrides))
    settings = validated(source, StudySettings)
    found: list[tuple[Key, str]] = []
    screen = settings.screen
    if isinstance(screen, CurvedSettings):
        if screen.distance >= 2 * screen.radius:
            found.append((("screen", "distance"), "expected an eye inside the cylinder: less than twice the radius"))
        if screen.size[1] > 2 * math.pi * screen.radius:
            found.append((("screen", "size"), "expected an arc of one turn at most: 2 pi times the radius"))
    if settings.trials > MOST_TRIALS:  # not to be listed
        raise ConfigError([source.mistake(("repeats",), too_many(settings.trials))])
    seen: set[tuple[float, float]] = set()
    for i, group in enumerate(settings.patterns):
        for pair in [(e, s) for e in group.eccentricities_deg for s in group.sizes_deg]:
            if pair in seen:
                words = f"{pair[0]:g} deg with size {pair[1]:g} deg is there twice; raise the repeats instead"
                found.append((("patterns", i), words))
            seen.add(pair)
    if not found:
        cuts = beyond_screen(settings)
        shows = build_screen(screen).shows
        middles = sorted({cut.eccentricity_deg for cut in cuts if not shows(0.0, cut.eccentricity_deg)})
        if cuts and not screen.cut:
            words = "; sit nearer, use a larger screen, leave them out, or say 'cut: true' to show the part that fits"
            shown = "; ".join(cut.text for cut in cuts[:4]) + (f"; and {len(cuts) - 4} more" if len(cuts) > 4 else "")
            found.append((("screen",), f"patterns beyond the screen: {shown}{words}"))
        elif middles:
            names = ", ".join(f"{eccentricity:g} deg" for eccentricity in middles)
            found.append((("screen", "cut"), f"at {names} even the middle of a pattern is beyond the screen"))
    if found:
        raise ConfigError([source.mistake(key, message) for key, message in found])
    return settings


def beyond_screen(settings: StudySettings) -> list[Cut]:
    """The patterns that do not fit the screen, with the reason."""
    screen = build_screen(settings.screen)
    rows, columns = screen.shape
    found = []
    for eccentricity, size in settings.conditions:
        y, x = screen.pixels(*_outline(eccentricity, size))
        # Centres of pixels count from 0, so the screen ends half a pixel beyond the last; half a pixel more is no loss.
        # NaN, in both, where a direction meets no point of the screen: nothing is within a limit there.
        wide = ((x - (columns - 1) / 2).abs() <= columns / 2 + _SLACK_PX).all()
        high = (y - (rows - 1) / 2).abs().max().item()
        name = f"{size:g} deg at {eccentricity:g} deg"
        if not wide:
            reach, covered = eccentricity + size / 2, screen.field_deg[1] / 2
            found.append(Cut(eccentricity, size, f"{name} reaches {reach:g} deg and the screen {covered:.1f} deg"))
        elif high > rows / 2 + _SLACK_PX:
            text = f"{name} takes {math.ceil(2 * high)} pixels in height and the screen has {rows}"
            found.append(Cut(eccentricity, size, text))
    return found


def build_screen(settings: FlatSettings | CurvedSettings) -> FlatScreen | CurvedScreen:
    """The screen as geometry."""
    if isinstance(settings, FlatSettings):
        return FlatScreen(settings.shape, settings.size, settings.distance)
    return CurvedScreen(settings.shape, settings.size, settings.distance, settings.radius)


def _outline(eccentricity: float, size: float) -> tuple[Tensor, Tensor]:
    """(elevation, azimuth) in degrees of points of the circle, which the cross lies within."""
    turn = torch.arange(0, 360, 5, dtype=torch.float64).deg2rad()
    centre, half = math.radians(eccentricity), math.tan(math.radians(size) / 2)
    u, v = half * turn.cos(), half * turn.sin()  # in the plane that touches the unit sphere there
    x, z = math.sin(centre) + u * math.cos(centre), math.cos(centre) - u * math.sin(centre)
    return torch.atan2(v, torch.hypot(x, z)).rad2deg(), torch.atan2(x, z).rad2deg()
