"""The session of one participant, which sends the design to the page and records the results of the page."""

import sys
from dataclasses import asdict
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any

from holotorch.experiments.perception.study.config import StudySettings
from holotorch.experiments.perception.study.design import Design
from holotorch.experiments.perception.study.log import TrialLog
from holotorch.experiments.perception.study.records import TrialResult, parse_record


class StudySession:
    """Sends the design to the page and appends its results to the log. Each result is saved before it is acknowledged.

    ``design`` is that of the participant. The session continues after the trials that the open ``log`` contains.
    """

    def __init__(self, settings: StudySettings, design: Design, log: TrialLog):
        self.settings, self.design, self.log = settings, design, log
        self.holder: str | None = None  # the window that requested the session last

    @property
    def complete(self) -> bool:
        """Whether every trial is in the log."""
        return len(self.log.trials) >= len(self.design.trials)

    def open(self, window: str) -> dict[str, Any]:
        """Return the data that the page needs; from now on only the results of ``window`` are recorded."""
        self.holder = window
        return {
            "participant": self.design.participant,
            **self.settings.model_dump(mode="json", include={"screen", "timing"}),
            "trials": [asdict(trial) | {"goal": trial.goal} for trial in self.design.trials],
            "next": len(self.log.trials),
        }

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
        if index > done or index >= len(self.design.trials):
            return HTTPStatus.BAD_REQUEST, {"error": f"trial {index} is not the next one, {done}; load the page again"}
        if index == done:
            try:
                self.log.append(self._line(result))
            except OSError as error:
                reason = f"{error.filename}: {error.strerror}"
                print(f"cannot write a trial: {reason}", file=sys.stderr)
                return HTTPStatus.SERVICE_UNAVAILABLE, {"error": reason}  # the page repeats the request
        return HTTPStatus.OK, {"next": len(self.log.trials)}

    def _line(self, result: TrialResult) -> dict[str, Any]:
        trial = self.design.trials[result.index]
        planned = {key: value for key, value in asdict(trial).items() if key != "wait_s"}
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        outcome = {"practice": trial.practice, **result.measured(), "design": self.design.name, "time_utc": now}
        return {"participant": self.design.participant, **planned, **outcome}
