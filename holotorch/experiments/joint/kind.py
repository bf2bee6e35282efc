"""The kind ``joint``: a volume on a phased array whose heat spreads, as an eye sees it at every focus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holotorch.experiments.config.source import Key
from holotorch.experiments.joint.config import JointSettings, contradictions
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:
    from holotorch.experiments.joint.experiment import JointExperiment
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord


class JointKind(ExperimentKind[JointSettings, "JointExperiment"]):
    """A volume shown by frames that are optimised together; see :mod:`holotorch.experiments.kind`."""

    settings = JointSettings
    example = "configs/joint/teapot.yaml"
    parallel = True
    data = "volume.path"

    def contradictions(self, settings: JointSettings) -> list[tuple[Key, str]]:
        return contradictions(settings)

    def build(self, settings: JointSettings) -> JointExperiment:
        from holotorch.experiments.joint.experiment import build

        return build(settings)

    def plan(self, experiment: JointExperiment) -> RunPlan:
        from holotorch.experiments.joint.plan import plan_text, plan_values
        from holotorch.experiments.runs.memory import shortage

        values = plan_values(experiment)
        return RunPlan(plan_text(experiment, values), values, shortage(values))

    def preview(self, experiment: JointExperiment) -> tuple[bytes, str]:
        from holotorch.experiments.volume.preview import preview

        return preview(experiment.scene)

    def run(self, experiment: JointExperiment, folder: RunFolder) -> bool:
        from holotorch.experiments.joint.run import run_joint

        return run_joint(experiment, folder)

    def device(self, experiment: JointExperiment) -> str:
        return str(experiment.device)

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.joint.report import joint_outcome

        return joint_outcome(summary)

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.joint.report import joint_section

        return joint_section(record)


KIND = JointKind()
