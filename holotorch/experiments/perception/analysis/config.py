"""Settings of the analysis of a perception study."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from holotorch.experiments.config.settings import Count, ExistingPath, Number, Settings, number, several

Angle = Annotated[Number, Field(ge=0, le=180)]
Size = Annotated[Number, Field(gt=0, le=180)]
Seconds = Annotated[Number, Field(gt=0, le=60)]
Share = Annotated[Number, Field(ge=0, lt=1)]
Spread = Annotated[Number, Field(ge=0, le=10)]
Contrast = Annotated[Number, Field(ge=0.02, le=1)]
Speed = Annotated[Number, Field(ge=0, le=60)]
Resamples = Annotated[Count, Field(ge=100, le=1_000_000)]


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise PydanticCustomError("range", "expected two numbers, the smaller one first")
    return pair


Sizes = Annotated[tuple[Size, Size], AfterValidator(_rising)]


class TargetTimeSettings(Settings):
    """The target time: each participant's time for a pattern that was shown, or ``seconds`` for all participants."""

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
    """Criteria for valid reaction times, applied in this order; the answers excluded by each one are counted.

    ``fastest``, ``slowest``: bounds in seconds; a faster answer is an anticipation, a slower one is not an answer to
    the pattern. ``deviations``: a time is an outlier if its logarithm differs from the median of its condition by more
    than this number of standard deviations, estimated as 1.4826 times the participant's median absolute deviation.
    ``responses``: a condition with fewer valid answers is missing. ``sizes``: an eccentricity with fewer sizes has no
    curve.
    """

    fastest: Seconds = 0.1
    slowest: Seconds = 2.0
    deviations: Annotated[Number, Field(gt=0, le=1000)] = 5.0
    responses: Count = 3
    sizes: Annotated[Count, Field(ge=2)] = 3

    @model_validator(mode="after")
    def _in_order(self) -> "CleaningSettings":
        if self.fastest >= self.slowest:
            raise PydanticCustomError("range", "expected fastest below slowest")
        return self


class SimulationSettings(Settings):
    """Simulated participants whose equal-efficiency scales are known: alpha E + beta for a 5 deg pattern at 10 deg.

    The default noise reproduces the first row of Table 2.2: F is near 7, which corresponds to a standard deviation of
    about 14.5 deg between participants, and 2 to 5 % of the scales are undefined. The p-values of the table belong to
    148 to 153 degrees of freedom within the groups, whereas 40 participants at four eccentricities have 156.

    ``seconds``: median time of the 5 deg pattern. ``slope``: derivative of the time with respect to ln S, in seconds;
    with the default, times of 5 deg patterns at 40 and 80 deg differ by 150 ms (thesis Sec. 2.4.2). ``slope_spread``,
    ``scale_spread``, ``local_spread``: standard deviations of the logarithms of a participant's slope, of all scales of
    a participant, and of the scale at each eccentricity. ``time_spread``: standard deviation of ``seconds`` between
    participants. ``trial``: standard deviation of the noise of a single reaction time in seconds, a Gaussian plus an
    exponential. ``gaussian``: standard deviation of the Gaussian as a share of ``trial``. ``miss``: share of missed
    targets. ``false_alarm``: share of answered distractions. ``lapse``: share of answers that are delayed by up to
    1.5 s. ``frame``: frame interval of the display in seconds.

    ``contrasts`` and ``speeds_deg_s``: every pattern is shown with each contrast and at each speed. They change the
    time by the laws of ``holotorch.perception.factors``: (k + k' e) (1 / C - 1) - (m + m' e) g(V, E), with e the
    eccentricity from 55 deg in units of 10 deg. ``contrast`` and ``motion`` are the means over participants of k and m
    in seconds, ``contrast_growth`` and ``motion_growth`` are k' and m', and ``factor_spread`` is the standard deviation
    of k / mean and m / mean between participants. The forms of the laws are cited there; these five numbers are
    assumed, because no source gives them for the far periphery. That contrast and speed leave the misses and lapses
    unchanged is assumed too.
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
    contrasts: Annotated[tuple[Contrast, ...], BeforeValidator(several), Field(min_length=1)] = (1.0,)
    speeds_deg_s: Annotated[tuple[Speed, ...], BeforeValidator(several), Field(min_length=1)] = (0.0,)
    contrast: Annotated[Number, Field(ge=-1, le=1)] = 0.01
    contrast_growth: Annotated[Number, Field(ge=-1, le=1)] = 0.0
    motion: Annotated[Number, Field(ge=-1, le=1)] = 0.04
    motion_growth: Annotated[Number, Field(ge=-1, le=1)] = 0.0
    factor_spread: Spread = 0.5

    @model_validator(mode="after")
    def _scales_exist(self) -> "SimulationSettings":
        least = min(self.alpha * e + self.beta for e in (40, 80))
        if least <= 0:
            text = "expected alpha and beta with sizes above zero from 40 to 80 deg, got {least:.3g} deg"
            raise PydanticCustomError("scale", "{text}", {"text": text.format(least=least)})
        if 1 not in self.contrasts or 0 not in self.speeds_deg_s:
            raise PydanticCustomError(
                "factors", "expected contrast 1 and speed 0 among others, to which alpha and beta apply"
            )
        return self


class PowerSettings(Settings):
    """Simulated studies that determine how often a slope, in degrees per degree, is found to differ from 0.

    ``studies``: number of simulated studies per slope. ``participants``: numbers of participants of these
    studies. The lines of all slopes have the simulation's scale in the middle of ``range_deg``.
    """

    slopes: Annotated[tuple[Annotated[Number, Field(ge=0, lt=5)], ...], BeforeValidator(several), Field(min_length=1)]
    participants: Annotated[tuple[Annotated[Count, Field(ge=5)], ...], BeforeValidator(several), Field(min_length=1)]
    studies: Annotated[Count, Field(ge=10, le=100_000)] = 200
    resamples: Resamples = 400


class AnalysisSettings(Settings):
    """Analysis of the logs of a perception study, or of a simulated study if there are no ``logs``.

    ``range_deg``: eccentricities to which lines are fitted. ``limits_deg``: scales outside are clipped to these limits.
    ``tested_deg``: sizes shown in the study; scales outside are extrapolated. ``resamples``: number of bootstrap
    samples. ``confidence``: level of all intervals. ``shown``: the participant of Fig. 2.5, by default the first.
    ``repeated_measures``: whether to add a repeated-measures analysis and a mixed model, which need statsmodels; by
    default, they are added if statsmodels is installed.
    """

    experiment: Literal["perception_analysis"]
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 0
    logs: Annotated[tuple[ExistingPath, ...], BeforeValidator(several)] = ()
    simulation: SimulationSettings = SimulationSettings()
    cleaning: CleaningSettings = CleaningSettings()
    targets: Annotated[tuple[TargetTimeSettings, ...], BeforeValidator(several), Field(min_length=1)]
    range_deg: Annotated[tuple[Angle, Angle], AfterValidator(_rising)] = (40.0, 70.0)
    tested_deg: Sizes = (5.0, 26.0)
    limits_deg: Sizes = (1.0, 60.0)
    resamples: Resamples = 2000
    confidence: Annotated[Number, Field(ge=0.5, lt=1)] = 0.95
    repeated_measures: bool | None = None
    shown: Count | None = None
    power: PowerSettings | None = None
