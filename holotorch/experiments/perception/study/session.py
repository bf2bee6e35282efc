"""The session of one participant: what the page needs to begin, and the trials that it sends back."""

import sys
from dataclasses import asdict
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any

from holotorch.experiments.perception.study.config import StudySettings
from holotorch.experiments.perception.study.design import Design
from holotorch.experiments.perception.study.log import TrialLog
from holotorch.experiments.perception.study.result import checked_result


class StudySession:
    """Gives the design to the page, and appends the results it sends to the log, each on the disk before the answer.

    Args:
        settings: The study.
        design: The participant's trials.
        log: Open; what it holds already is not asked again.
    """

    def __init__(self, settings: StudySettings, design: Design, log: TrialLog):
        self.settings, self.design, self.log = settings, design, log
        self.holder: str | None = None  # the window that asked last

    @property
    def complete(self) -> bool:
        """Whether every trial is in the log."""
        return len(self.log.trials) >= len(self.design.trials)

    def open(self, window: str) -> dict[str, Any]:
        """What the page needs; ``window`` becomes the only one whose results count."""
        self.holder = window
        return {
            "participant": self.design.participant,
            "screen": self.settings.screen.model_dump(mode="json"),
            "timing": self.settings.timing.model_dump(mode="json"),
            "trials": [asdict(trial) | {"goal": trial.goal} for trial in self.design.trials],
            "next": len(self.log.trials),
        }

    def record(self, result: Any) -> tuple[HTTPStatus, dict[str, Any]]:
        """Append a result of the page, and say which trial is next; a result that came before is not written again."""
        try:
            index, window, values = checked_result(result)
        except ValueError as error:
            return HTTPStatus.BAD_REQUEST, {"error": str(error)}
        # After a restart the window that is there goes on.
        self.holder = self.holder or window
        if window != self.holder:
            return HTTPStatus.CONFLICT, {"error": "the study was opened in another window; close this one"}
        done = len(self.log.trials)
        if index > done or index >= len(self.design.trials):
            return HTTPStatus.BAD_REQUEST, {"error": f"trial {index} is not the next one, {done}; load the page again"}
        if index == done:
            try:
                self.log.append(self._line(index, values))
            except OSError as error:
                reason = f"{error.filename}: {error.strerror}"
                print(f"cannot write a trial: {reason}", file=sys.stderr)
                return HTTPStatus.SERVICE_UNAVAILABLE, {"error": reason}  # the page tries again
        return HTTPStatus.OK, {"next": len(self.log.trials)}

    def _line(self, index: int, values: dict[str, Any]) -> dict[str, Any]:
        trial = self.design.trials[index]
        planned = asdict(trial)
        del planned["wait_s"]
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        facts = {"practice": trial.practice, **values, "design": self.design.name, "time_utc": now}
        return {"participant": self.design.participant, **planned, **facts}
