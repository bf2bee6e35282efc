"""The kind ``pec``: proximity effect correction of one picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from holotorch.experiments.config.source import Key
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.pec.config import PECSettings, contradictions
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:
    from holotorch.experiments.pec.experiment import PECExperiment
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord


class PECKind(ExperimentKind[PECSettings, "PECExperiment"]):
    """Proximity effect correction of one picture; see :mod:`holotorch.experiments.kind`."""

    settings = PECSettings
    example = "configs/pec/fourier.yaml"
    parallel = True
    data = "target.image"

    def contradictions(self, settings: PECSettings) -> list[tuple[Key, str]]:
        return list(contradictions(settings))

    def build(self, settings: PECSettings) -> PECExperiment:
        from holotorch.experiments.pec.experiment import build

        return build(settings)

    def plan(self, experiment: PECExperiment) -> RunPlan:
        from holotorch.experiments.pec.plan import plan_text, plan_values
        from holotorch.experiments.runs.memory import shortage

        values = plan_values(experiment)
        return RunPlan(plan_text(experiment, values), values, shortage(values))

    def run(self, experiment: PECExperiment, folder: RunFolder) -> bool:
        from holotorch.experiments.pec.run import run_pec

        return run_pec(experiment, folder)

    def device(self, experiment: PECExperiment) -> str:
        return str(experiment.device)

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.pec.report import pec_outcome

        return pec_outcome(summary)

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.pec.report import pec_section

        return pec_section(record)

    def comparison(self, records: Sequence[RunRecord]) -> list[str]:
        from holotorch.experiments.pec.report import comparison

        return comparison(records)


KIND = PECKind()
