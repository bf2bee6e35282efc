"""The kind ``perception_analysis``: computes equal-efficiency scales from the answers of a study."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.perception.analysis.config import AnalysisSettings
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord


class AnalysisKind(ExperimentKind[AnalysisSettings, AnalysisSettings]):
    """See :mod:`holotorch.experiments.kind`."""

    settings = AnalysisSettings
    example = "configs/perception/analysis.yaml"
    announces = False

    def build(self, settings: AnalysisSettings) -> AnalysisSettings:
        return settings

    def plan(self, experiment: AnalysisSettings) -> RunPlan:
        simulated = f"{experiment.simulation.participants} simulated people"
        source = f"{len(experiment.logs)} logs" if experiment.logs else simulated
        return RunPlan("Analysis   of {}, lines over {:g} .. {:g} deg".format(source, *experiment.range_deg))

    def prepare(self, experiment: AnalysisSettings) -> None:
        from holotorch.experiments.perception.analysis.run import prepare_analysis

        prepare_analysis(experiment)

    def run(self, experiment: AnalysisSettings, folder: RunFolder) -> bool:
        from holotorch.experiments.perception.analysis.run import run_analysis

        return run_analysis(experiment, folder)

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.perception.analysis.report import analysis_outcome

        return analysis_outcome(summary)

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.perception.analysis.report import analysis_section

        return analysis_section(record)


KIND = AnalysisKind()
