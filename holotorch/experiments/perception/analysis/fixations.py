"""Whether fixation was held in the trials of a log, if an eye tracker checked it."""

from typing import Any

from pydantic import ValidationError

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.gaze import GazeSettings, read_gaze
from holotorch.experiments.perception.study.log import Trials


def fixated(log: Trials) -> list[bool | None]:
    """Whether fixation was held in each trial of a log; None for all of them without an eye tracker.

    With the source "file", the samples are read from the file ``participant-001.gaze.csv`` beside
    ``participant-001.jsonl``.

    Raises:
        ConfigError: The mouse stood in for an eye tracker, or the samples are missing or cannot be read.
    """
    if log.header.get("gaze") is None:
        return [None] * len(log.trials)
    try:
        settings = GazeSettings.model_validate(log.header["gaze"])
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise ConfigError([f"{log.path}:1:1: the settings of the gaze cannot be read: {key}: {first['msg']}"]) from None
    if settings.source == "mouse":
        trial_run = "the mouse stood in for an eye tracker: these answers try the study out and are no results"
        raise ConfigError([f"{log.path}: {trial_run}; leave this log out"])
    if settings.live:
        return [trial.get("fixated") for trial in log.trials]
    track = read_gaze(log.path.with_suffix(".gaze.csv"), settings)
    return [track.check(*_interval(log, number, trial)).held for number, trial in enumerate(log.trials, 2)]


def _interval(log: Trials, number: int, trial: dict[str, Any]) -> tuple[float, float]:
    """Unix times of the onset and of the end of a pattern, whose trial is in line ``number``."""
    onset, reaction = trial.get("onset_unix_s"), trial["reaction_s"]
    timing = log.header.get("timing")
    shown = timing.get("show_s") if isinstance(timing, dict) else None
    duration = shown if reaction is None else reaction
    if onset is None or not isinstance(duration, int | float):
        raise ConfigError([f"{log.path}:{number}:1: onset_unix_s or timing.show_s is missing; gaze cannot be checked"])
    return onset, onset + duration
