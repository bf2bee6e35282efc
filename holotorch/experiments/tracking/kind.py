"""The kind ``track``: tracks a catheter's tip through all frames of a source."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.tracking.config import TrackSettings

if TYPE_CHECKING:
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord
    from holotorch.experiments.tracking.run import TrackingExperiment


class TrackKind(ExperimentKind[TrackSettings, "TrackingExperiment"]):
    """See :mod:`holotorch.experiments.kind`."""

    settings = TrackSettings
    example = "configs/tracking/track.yaml"
    data = "source"

    def build(self, settings: TrackSettings) -> TrackingExperiment:
        from holotorch.experiments.tracking.run import build_tracking

        return build_tracking(settings)

    def plan(self, experiment: TrackingExperiment) -> RunPlan:
        from holotorch.experiments.tracking.run import plan_tracking

        return plan_tracking(experiment)

    def run(self, experiment: TrackingExperiment, folder: RunFolder) -> bool:
        from holotorch.experiments.tracking.run import run_tracking

        return run_tracking(experiment, folder)

    def restart(self, folder: Path, config: Mapping[str, Any]) -> str:
        source = folder / "synthetic" if config.get("source") == "synthetic" else config.get("source", "SOURCE")
        text = f"the poses it has found are kept, and all frames are tracked anew by: holotorch track {source}"
        recording = folder / "recording"
        return text + (f", the recorded ones by: holotorch track {recording}" if recording.is_dir() else "")

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.tracking.report import camera_line, doubts, refusals, verdict
        from holotorch.experiments.tracking.synthetic import compared

        truth = [compared(summary["truth"])] if "truth" in summary else []
        return [verdict(summary), *refusals(summary), *doubts(summary), *camera_line(summary), *truth]

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.tracking.report import track_section

        return track_section(record)


KIND = TrackKind()
