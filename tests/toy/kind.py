"""A kind of experiment as small as one can be: it counts, and can be interrupted."""

from typing import Annotated, Any, Literal

from pydantic import Field

from holotorch.experiments.config.settings import Count, Settings
from holotorch.experiments.config.source import Key
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.runs.fingerprint import fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.page import element, heading
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.runs.record import RunRecord
from holotorch.experiments.runs.saving import Checkpoint, Results


class ToySettings(Settings):
    experiment: Literal["toy"]
    steps: Annotated[Count, Field(le=100)] = 3
    gigabytes: Count = 1


class ToyKind(ExperimentKind[ToySettings, ToySettings]):
    settings = ToySettings
    example = "configs/demo.yaml"

    def contradictions(self, settings: ToySettings) -> list[tuple[Key, str]]:
        return [(("steps",), "expected anything but 13")] if settings.steps == 13 else []

    def build(self, settings: ToySettings) -> ToySettings:
        return settings

    def plan(self, experiment: ToySettings) -> RunPlan:
        short = "needs too much" if experiment.gigabytes > 9 else None
        return RunPlan(f"Steps      {experiment.steps}", {"steps": experiment.steps}, short)

    def run(self, experiment: ToySettings, folder: RunFolder) -> bool:
        checkpoint = Checkpoint(folder.path / "checkpoint.pt", fingerprint(experiment, {}))
        total, done = (checkpoint.load() or {"total": (0, 0)})["total"]
        try:
            for number in range(done + 1, experiment.steps + 1):
                total, done = total + self.step(number), number
                checkpoint.save({"total": (total, done)})
        except KeyboardInterrupt:
            if not done:
                raise
        summary = {"experiment": "toy", "status": "", "total": total}
        return conclude(folder, summary, Results(), done=done == experiment.steps, checkpoint=checkpoint)

    def step(self, number: int) -> int:
        return number

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        return [f"Result     total {summary['total']}"]

    def section(self, record: RunRecord) -> list[str]:
        return [heading(record.title, record.summary["status"]), element("p", f"total {record.summary['total']}")]


KIND = ToyKind()
