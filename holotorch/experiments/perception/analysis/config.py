"""What the configuration of the analysis of a perception study may say."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from holotorch.experiments.config.settings import Count, ExistingPath, Number, Settings, number, several

Angle = Annotated[Number, Field(ge=0, le=180)]
Size = Annotated[Number, Field(gt=0, le=180)]
Seconds = Annotated[Number, Field(gt=0, le=60)]
Share = Annotated[Number, Field(ge=0, lt=1)]
Spread = Annotated[Number, Field(ge=0, le=10)]
Resamples = Annotated[Count, Field(ge=100, le=1_000_000)]
Seed = Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)]


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise PydanticCustomError("range", "expected two numbers, the smaller one first")
    return pair


Range = Annotated[tuple[Angle, Angle], AfterValidator(_rising)]
Sizes = Annotated[tuple[Size, Size], AfterValidator(_rising)]


class TargetTimeSettings(Settings):
    """The time to reach elsewhere: each participant's own for a pattern that was shown, or ``seconds`` for all."""

    size_deg: Size | None = None
    eccentricity_deg: Angle | None = None
    seconds: Seconds | None = None

    @model_validator(mode="after")
    def _one_of_two(self) -> "TargetTimeSettings":
        pattern = (self.size_deg is not None, self.eccentricity_deg is not None)
        if pattern != (self.seconds is None,) * 2:
            raise PydanticCustomError("target", "expected {size_deg: 5, eccentricity_deg: 10} or {seconds: 0.45}")
        return self

    def __str__(self) -> str:
        if self.seconds is not None:
            return f"{1e3 * self.seconds:g} ms"
        return f"{self.size_deg:g} deg at {self.eccentricity_deg:g} deg"


class CleaningSettings(Settings):
    """The rule for reaction times, applied in this order; what each part leaves out is counted.

    ``fastest``, ``slowest``: bounds in seconds; outside, a press is an anticipation or no answer to the pattern.
    ``deviations``: a time is an outlier where its logarithm is further than this from the median of its condition, in
    units of 1.4826 times the participant's median absolute distance. ``responses``: a condition with fewer is missing.
    ``sizes``: an eccentricity with fewer sizes left has no curve.
    """

    fastest: Seconds = 0.1
    slowest: Seconds = 2.0
    deviations: Annotated[Number, Field(gt=0, le=1000)] = 5.0
    responses: Count = 3
    sizes: Annotated[Count, Field(ge=2)] = 3

    @model_validator(mode="after")
    def _in_order(self) -> "CleaningSettings":
        if not self.fastest < self.slowest:
            raise PydanticCustomError("range", "expected fastest below slowest")
        return self


class SimulationSettings(Settings):
    """Simulated participants whose equal-efficiency scales are known: alpha E + beta for a 5 deg pattern at 10 deg.

    The defaults have the thesis's noise level. ``slope``: of the time over ln S in seconds; 5 deg patterns at 40 and
    80 deg then differ by 150 ms (Sec. 2.4.2). The spreads and the deviation of a trial were set so that the analysis of
    variance comes out as in the first row of Table 2.2: F near 7, which is a spread of about 14.5 deg between
    participants, and 2 to 5 % of the scales undefined, as its p-values have denominators of 148 to 153, not 156.

    ``slope_spread``, ``scale_spread``, ``local_spread``: standard deviations of the logarithm of a participant's slope,
    of all their scales, and of those at each eccentricity. ``time_spread``: of their times, in seconds. ``trial``:
    deviation of one reaction in seconds, a Gaussian plus an exponential; ``gaussian``: the Gaussian's part of it.
    ``miss``, ``false_alarm``, ``lapse``: shares of targets missed, distractions answered, and answers that come up to
    1.5 s late.
    """

    participants: Annotated[Count, Field(le=100_000)] = 40
    alpha: Annotated[Number, Field(gt=-5, lt=5)] = 0.47
    beta: Number = -11.04
    seconds: Seconds = 0.45
    slope: Annotated[Number, Field(lt=0, ge=-10)] = -0.122
    slope_spread: Spread = 0.4
    scale_spread: Spread = 0.3
    local_spread: Spread = 0.3
    time_spread: Spread = 0.05
    trial: Spread = 0.26
    gaussian: Annotated[Number, Field(ge=0, le=1)] = 0.2
    miss: Share = 0.02
    false_alarm: Share = 0.03
    lapse: Share = 0.01
    frame: Annotated[Number, Field(gt=0, le=1)] = 1 / 60

    @model_validator(mode="after")
    def _scales_exist(self) -> "SimulationSettings":
        least = min(self.alpha * e + self.beta for e in (40, 80))
        if least <= 0:
            text = "expected alpha and beta with sizes above zero from 40 to 80 deg, got {least:.3g} deg"
            raise PydanticCustomError("scale", "{text}", {"text": text.format(least=least)})
        return self


class PowerSettings(Settings):
    """How often studies of so many participants would find a slope of so many degrees per degree to differ from 0.

    The lines of all slopes have the simulation's scale in the middle of ``range_deg``.
    """

    slopes: Annotated[tuple[Annotated[Number, Field(ge=0, lt=5)], ...], BeforeValidator(several), Field(min_length=1)]
    participants: Annotated[tuple[Annotated[Count, Field(ge=5)], ...], BeforeValidator(several), Field(min_length=1)]
    studies: Annotated[Count, Field(ge=10, le=100_000)] = 200
    resamples: Resamples = 400


class AnalysisSettings(Settings):
    """Analysis of the logs of a perception study, or of a simulated one where no ``logs`` are given.

    ``range_deg``: eccentricities of the lines. ``limits_deg``: scales outside count as being at these limits.
    ``tested_deg``: sizes within which scales are more than an extrapolation. ``confidence``: of intervals.
    ``shown``: the participant of Fig. 2.5, the first by default. ``repeated_measures``: and a mixed model beside the
    one-way analysis, which need statsmodels; where nothing is said, they are made if it is installed.
    """

    experiment: Literal["perception_analysis"]
    seed: Seed = 0
    logs: Annotated[tuple[ExistingPath, ...], BeforeValidator(several)] = ()
    simulation: SimulationSettings = SimulationSettings()
    cleaning: CleaningSettings = CleaningSettings()
    targets: Annotated[tuple[TargetTimeSettings, ...], BeforeValidator(several), Field(min_length=1)]
    range_deg: Range = (40.0, 70.0)
    tested_deg: Sizes = (5.0, 26.0)
    limits_deg: Sizes = (1.0, 60.0)
    resamples: Resamples = 2000
    confidence: Annotated[Number, Field(ge=0.5, lt=1)] = 0.95
    repeated_measures: bool | None = None
    shown: Count | None = None
    power: PowerSettings | None = None
