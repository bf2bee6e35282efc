"""The experiment ``perception_layout``: icons over a wide field, scaled for equal perception time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.perception.layout.config import LayoutSettings
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:
    from holotorch.experiments.perception.layout.run import Layouts
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord


class LayoutKind(ExperimentKind[LayoutSettings, "Layouts"]):
    """Loads the modules of the layout experiment only when needed; see :mod:`holotorch.experiments.kind`."""

    settings = LayoutSettings
    example = "configs/perception/layout.yaml"
    announces = False  # the plan is not printed before the run, because it already contains the results

    def build(self, settings: LayoutSettings) -> Layouts:
        from holotorch.experiments.perception.layout.run import build_layouts

        return build_layouts(settings)

    def plan(self, experiment: Layouts) -> RunPlan:
        from holotorch.experiments.perception.layout.run import layout_text

        return RunPlan(layout_text(experiment))

    def run(self, experiment: Layouts, folder: RunFolder) -> bool:
        from holotorch.experiments.perception.layout.run import run_layout

        return run_layout(experiment, folder)

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        return list(summary["lines"])

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.perception.layout.report import layout_section

        return layout_section(record)


KIND = LayoutKind()
