"""Pydantic models of JSON input: lines of a log, and requests of the page.

The ``description`` of a field completes the message "expected ..." when a value is refused.
"""

from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from holotorch.experiments.config.errors import short

FORMAT, VERSION = "holotorch-trials", 1

Finite = Annotated[float, Field(description="a finite number")]
Whole = Annotated[int, Field(description="a whole number")]
Flag = Annotated[bool, Field(description="true or false")]
Text = Annotated[str, Field(description="text")]
Count = Annotated[int, Field(ge=0, description="a count, 0 or more")]
Device = Literal["key", "pointer", "gamepad"]


class Record(BaseModel):
    """Base of the models: no conversion between types, no NaN or infinity; further keys are ignored."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, frozen=True)


class LogHeader(Record):
    """The first line of a log. ``gaze``: the settings of the eye tracker, if there was one."""

    participant: Whole
    gaze: Annotated[dict[str, Any] | None, Field(description="the settings of the gaze or null")] = None


class TrialRecord(Record):
    """A line of a log after the first: a trial and its outcome.

    With an eye tracker, ``onset_unix_s`` is the onset in seconds since 1970, ``attempt`` counts the appearances of the
    trial, and ``fixated`` says whether the participant looked at the fixation point; it is null if the samples come in
    a file later.
    """

    eccentricity_deg: Finite
    size_deg: Finite
    onset_s: Finite
    frame_s: Annotated[float, Field(gt=0, description="a finite number above 0")]
    participant: Whole
    round: Whole
    trial: Whole
    target: Flag
    practice: Flag
    responded: Flag
    design: Text
    time_utc: Text
    pattern: Annotated[Literal["cross", "circle"], Field(description="cross or circle")]
    response_s: Annotated[float | None, Field(description="a finite number or null")]
    reaction_s: Annotated[float | None, Field(ge=0, description="a finite number, 0 or more, or null")]
    attempt: Annotated[int, Field(ge=1, description="a count, 1 or more")] = 1
    fixated: Annotated[bool | None, Field(description="true, false or null")] = None
    onset_unix_s: Annotated[float | None, Field(description="a finite number or null")] = None
    contrast: Annotated[float, Field(gt=0, le=1, description="a number above 0 and at most 1")] = 1.0
    speed_deg_s: Annotated[float, Field(ge=0, description="a finite number, 0 or more")] = 0.0

    @model_validator(mode="after")
    def _response_is_consistent(self) -> Self:
        if any(self.responded == (value is None) for value in (self.response_s, self.reaction_s)):
            text = "response_s and reaction_s: expected numbers where responded is true, and null where it is false"
            raise PydanticCustomError("response", text)
        return self


class SessionRequest(Record):
    """Request of a browser window to become the one whose results are recorded."""

    window: Annotated[str, Field(min_length=1, description="the name of the window")]


class FixationRequest(SessionRequest):
    """Request of the page, answered when the state of the fixation is no longer ``fixated``, or after a second."""

    fixated: Flag


class TrialResult(SessionRequest):
    """Request of the page after a trial; times are in seconds on the clock of the browser.

    ``onset_unix_s`` is ``onset_s`` in seconds since 1970, to be compared with the times of gaze samples.
    """

    index: Annotated[int, Field(ge=0, description="the index of the trial, 0 or more")]
    onset_s: Annotated[float, Field(ge=0, description="seconds, 0 or more")]
    frame_s: Annotated[float, Field(gt=0, description="more than 0 seconds")]
    response_s: Annotated[float | None, Field(ge=0, description="seconds, 0 or more, or null")] = None
    early: Count = 0
    dropped_frames: Count = 0
    device: Annotated[Device | None, Field(description="key, pointer, gamepad or null")] = None
    onset_unix_s: Annotated[float | None, Field(ge=0, description="seconds, 0 or more, or null")] = None

    @property
    def reaction_s(self) -> float | None:
        """Time from the onset to the response in seconds, to the microsecond; None without a response."""
        return None if self.response_s is None else round(self.response_s - self.onset_s, 6)

    @model_validator(mode="after")
    def _response_follows_onset(self) -> Self:
        if self.reaction_s is not None and self.reaction_s < 0:
            raise PydanticCustomError("order", "response_s: expected a time after onset_s")
        return self

    def measured(self) -> dict[str, Any]:
        """The measured part of a line of the log."""
        times = {"responded": self.response_s is not None, "reaction_s": self.reaction_s}
        without = {"index", "window"} | ({"onset_unix_s"} if self.onset_unix_s is None else set())
        return times | self.model_dump(exclude=without)


Model = TypeVar("Model", bound=Record)


def parse_record(model: type[Model], value: Any) -> Model:
    """Validate a value. ValueError names the first wrong field, the expected value and the value received."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    if not first["loc"]:
        # Either a custom message of the models above, or a value that is no JSON object.
        custom = first["type"] in ("response", "order")
        raise ValueError(first["msg"] if custom else f"expected {{...}}, got {short(value)}")
    name = str(first["loc"][0])
    if first["type"] == "missing":
        raise ValueError(f"{name} is missing; expected {model.model_fields[name].description}")
    raise ValueError(f"{name}: expected {model.model_fields[name].description}, got {short(first['input'])}")
