"""The kind ``volume``: the hologram of a volume."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holotorch.experiments.config.source import Key
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.volume.config import VolumeSettings, contradictions

if TYPE_CHECKING:
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord
    from holotorch.experiments.volume.experiment import VolumeExperiment


class VolumeKind(ExperimentKind[VolumeSettings, "VolumeExperiment"]):
    """The hologram of a volume; see :mod:`holotorch.experiments.kind`."""

    settings = VolumeSettings
    example = "configs/volume/hand.yaml"
    parallel = True
    data = "volume.path"

    def contradictions(self, settings: VolumeSettings) -> list[tuple[Key, str]]:
        return contradictions(settings)

    def build(self, settings: VolumeSettings) -> VolumeExperiment:
        from holotorch.experiments.volume.experiment import build

        return build(settings)

    def plan(self, experiment: VolumeExperiment) -> RunPlan:
        from holotorch.experiments.runs.memory import shortage
        from holotorch.experiments.volume.plan import plan_text, plan_values

        values = plan_values(experiment)
        return RunPlan(plan_text(experiment, values), values, shortage(values))

    def preview(self, experiment: VolumeExperiment) -> tuple[bytes, str]:
        from holotorch.experiments.volume.preview import preview

        return preview(experiment)

    def run(self, experiment: VolumeExperiment, folder: RunFolder) -> bool:
        from holotorch.experiments.volume.run import run_volume

        return run_volume(experiment, folder)

    def device(self, experiment: VolumeExperiment) -> str:
        return str(experiment.device)

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.volume.report import volume_outcome

        return volume_outcome(summary)

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.volume.report import volume_section

        return volume_section(record)


KIND = VolumeKind()
