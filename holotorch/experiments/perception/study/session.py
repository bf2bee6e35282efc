"""The session of one participant, which sends the design to the page and records the results of the page."""

import sys
import time
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any

from holotorch.experiments.perception.study.config import TRAVEL_DEG, StudySettings
from holotorch.experiments.perception.study.design import Design
from holotorch.experiments.perception.study.gaze import GazeFile, GazeTrack
from holotorch.experiments.perception.study.log import TrialLog
from holotorch.experiments.perception.study.order import Order
from holotorch.experiments.perception.study.records import TrialResult, parse_record


class StudySession:
    """Sends the design to the page and appends its results to the log. Each result is saved before it is acknowledged.

    ``design`` is that of the participant. The session continues after the trials that the open ``log`` contains.

    Attributes:
        order: All appearances of trials, those to come included.
        gaze: The samples of the eye tracker; None if no samples come while the study runs.
    """

    def __init__(self, settings: StudySettings, design: Design, log: TrialLog, gaze_file: GazeFile | None = None):
        self.settings, self.design, self.log = settings, design, log
        self.holder: str | None = None  # the window that requested the session last
        gaze = settings.gaze if settings.gaze and settings.gaze.live else None
        self.gaze = GazeTrack(gaze) if gaze else None
        self._gaze_file = gaze_file
        self.order = Order(design, gaze.attempts if gaze else 1)
        for index, trial in enumerate(log.trials):
            self.order.record(index, trial.get("fixated"))

    @property
    def complete(self) -> bool:
        """Whether every trial and repeat is in the log."""
        return len(self.log.trials) >= len(self.order.appearances)

    def open(self, window: str) -> dict[str, Any]:
        """Return the data that the page needs; from now on only the results of ``window`` are recorded."""
        self.holder = window
        return {
            "participant": self.design.participant,
            **self.settings.recorded(),
            "travel_deg": TRAVEL_DEG,
            "trials": [appearance.to_json() for appearance in self.order.appearances],
            "next": len(self.log.trials),
        }

    def look(self, samples: Any) -> dict[str, Any]:
        """Add gaze samples sent by the eye tracker; returns how many were used, of these and in all."""
        assert self.gaze is not None  # checked by the server
        added = self.gaze.add(samples, time.time())
        if self._gaze_file:
            try:
                self._gaze_file.write(added)
            except OSError as error:  # the check of the fixation goes on
                print(f"cannot write gaze samples: {error.strerror}", file=sys.stderr)
        return {"accepted": len(added), "total": self.gaze.accepted, "dropped": dict(self.gaze.dropped)}

    def end_of(self, request: Any) -> float | None:
        """Unix time at which the pattern of a result ended; None without an eye tracker, or for a malformed result."""
        try:
            return self._end(parse_record(TrialResult, request)) if self.gaze else None
        except ValueError:
            return None

    def record(self, request: Any) -> tuple[HTTPStatus, dict[str, Any]]:
        """Append a result sent by the page; return the HTTP status and the answer, which names the next trial.

        A result that is already in the log is not written again.
        """
        try:
            result = parse_record(TrialResult, request)
        except ValueError as error:
            return HTTPStatus.BAD_REQUEST, {"error": str(error)}
        index = result.index
        # After a restart of the server, the window that was already open may continue.
        self.holder = self.holder or result.window
        if result.window != self.holder:
            return HTTPStatus.CONFLICT, {"error": "the study was opened in another window; close this one"}
        done = len(self.log.trials)
        if index > done or index >= len(self.order.appearances):
            return HTTPStatus.BAD_REQUEST, {"error": f"trial {index} is not the next one, {done}; load the page again"}
        if self.gaze and result.onset_unix_s is None:
            return HTTPStatus.BAD_REQUEST, {"error": "onset_unix_s is missing; the fixation cannot be checked"}
        if index == done:
            try:
                line = self._line(result)
                self.log.append(line)
                self.order.record(index, line.get("fixated"))
            except OSError as error:
                reason = f"{error.filename}: {error.strerror}"
                print(f"cannot write a trial: {reason}", file=sys.stderr)
                return HTTPStatus.SERVICE_UNAVAILABLE, {"error": reason}  # the page repeats the request
        answer: dict[str, Any] = {"next": len(self.log.trials)}
        if (again := self.order.repeat_of(index)) is not None:
            answer |= {"repeat_at": again, "repeat": self.order.appearances[again].to_json()}
        return HTTPStatus.OK, answer

    def _end(self, result: TrialResult) -> float | None:
        if result.onset_unix_s is None:
            return None
        return result.onset_unix_s + (self.settings.timing.show_s if result.reaction_s is None else result.reaction_s)

    def _line(self, result: TrialResult) -> dict[str, Any]:
        appearance = self.order.appearances[result.index]
        trial = appearance.trial
        planned = {key: value for key, value in trial.to_json().items() if key != "wait_s"}
        if self.settings.gaze:
            planned["attempt"] = appearance.attempt
        end = self._end(result)
        if self.gaze and result.onset_unix_s is not None and end is not None:
            fixation = self.gaze.check(result.onset_unix_s, end)
            source = self.gaze.settings.source
            planned |= {"fixated": fixation.held, "fixation": fixation.to_json() | {"source": source}}
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        outcome = {"practice": trial.practice, **result.measured(), "design": self.design.name, "time_utc": now}
        return {"participant": self.design.participant, **planned, **outcome}
