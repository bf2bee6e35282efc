"""The kind ``eye``: an observer's view of the hologram of a volume."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:
    from holotorch.experiments.eye.experiment import Observer
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord


class ObserverKind(ExperimentKind[ObserverSettings, "Observer"]):
    """An observer's view of the hologram of a volume; see :mod:`holotorch.experiments.kind`."""

    settings = ObserverSettings
    example = "configs/eye/teapot.yaml"
    parallel = True
    data = "volume.path"

    def build(self, settings: ObserverSettings) -> Observer:
        from holotorch.experiments.eye.experiment import observer
        from holotorch.experiments.eye.run import scene_settings

        return observer(settings, scene_settings(settings))

    def plan(self, experiment: Observer) -> RunPlan:
        from holotorch.experiments.eye.plan import plan_text, plan_values, too_large

        values = plan_values(experiment)
        values["text"] = plan_text(experiment, values)
        return RunPlan(values["text"], values, too_large(values))

    def preview(self, experiment: Observer) -> tuple[bytes, str]:
        from holotorch.experiments.volume.preview import preview

        return preview(experiment.scene)

    def prepare(self, experiment: Observer) -> None:
        from holotorch.experiments.eye.run import visible_surface

        visible_surface(experiment)

    def run(self, experiment: Observer, folder: RunFolder) -> bool:
        from holotorch.experiments.eye.run import run_observer

        return run_observer(experiment, folder)

    def device(self, experiment: Observer) -> str:
        return str(experiment.scene.device)

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.eye.report import eye_outcome

        return eye_outcome(summary)

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.eye.report import eye_section

        return eye_section(record)


KIND = ObserverKind()
