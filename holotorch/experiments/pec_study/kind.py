"""The kind ``pec_study``: methods of proximity effect correction over several photographs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.pec.config import SIGMA_MEANING
from holotorch.experiments.pec_study.config import METHODS, StudySettings
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:
    from holotorch.experiments.pec_study.run import Study
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord


class StudyKind(ExperimentKind[StudySettings, "Study"]):
    """A comparison of methods over several photographs; see :mod:`holotorch.experiments.kind`."""

    settings = StudySettings
    example = "configs/pec/studies/targets.yaml"
    announces = False

    def build(self, settings: StudySettings) -> Study:
        from holotorch.experiments.pec_study.run import build_study

        return build_study(settings)

    def plan(self, experiment: Study) -> RunPlan:
        settings = experiment.settings
        swept = "cut-off in cycles/px" if settings.study == "lowpass" else "sigma in px"
        return RunPlan(
            f"Study      {settings.study} of {', '.join(settings.images)} on {settings.size} x {settings.size} px\n"
            f"Sweep      {swept}: {', '.join(f'{value:g}' for value in settings.sweep)}; {settings.max_steps} steps at "
            f"most\nCrosstalk  {SIGMA_MEANING}\nMethods    {METHODS}"
        )

    def run(self, experiment: Study, folder: RunFolder) -> bool:
        from holotorch.experiments.pec_study.run import run_study

        return run_study(experiment, folder)

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.pec_study.report import study_outcome

        return study_outcome(summary)

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.pec_study.report import study_section

        return study_section(record)


KIND = StudyKind()
