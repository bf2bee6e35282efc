"""The kind ``measure``: the accuracy and latency of a tracker, by the protocols of the dissertation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holotorch.experiments.config.source import Key
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.measure.config import MeasureSettings
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:
    from holotorch.experiments.measure.run import Measurement
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord


class MeasureKind(ExperimentKind[MeasureSettings, "Measurement"]):
    """See :mod:`holotorch.experiments.kind`."""

    settings = MeasureSettings
    data = "source"
    example = "configs/tracking/measure.yaml"

    def contradictions(self, settings: MeasureSettings) -> list[tuple[Key, str]]:
        protocol, mistakes = settings.protocol, list[tuple[Key, str]]()
        if len(settings.source) > 1 and protocol != "grid3d":
            got = f"got {len(settings.source)}"
            mistakes.append((("source",), f"expected one source; several are the faces of grid3d, {got}"))
        if (protocol == "latency") != (settings.reference_log is not None):
            text = "the protocol latency needs the reference tracker's log; no other protocol takes one"
            mistakes.append((("reference_log",), text))
        if (protocol == "edges") != bool(settings.known):
            text = "the protocol edges needs distances that are exact, such as 0 1-2; no other protocol takes them"
            mistakes.append((("known",), text))
        if (protocol == "tone") != bool(settings.exposures):
            text = "the protocol tone needs the exposure time of each photograph; no other protocol takes them"
            mistakes.append((("exposures",), text))
        for name, owners in (("grid", ("grid2d", "grid3d")), ("delay", ("prediction",)), ("resting", ("edges",))):
            value, usual = getattr(settings, name), type(settings).model_fields[name].default
            if protocol not in owners and value != usual:
                mistakes.append(((name,), f"it belongs to the protocol {' or '.join(owners)}, got {protocol}"))
        if protocol == "tone" and settings.camera is None:
            mistakes.append((("camera",), "the protocol tone needs the camera's file, whose tone it replaces"))
        return mistakes

    def build(self, settings: MeasureSettings) -> Measurement:
        from holotorch.experiments.measure.run import build_measurement

        return build_measurement(settings)

    def plan(self, experiment: Measurement) -> RunPlan:
        from holotorch.experiments.measure.run import plan_measurement

        return plan_measurement(experiment)

    def run(self, experiment: Measurement, folder: RunFolder) -> bool:
        from holotorch.experiments.measure.run import run_measurement

        return run_measurement(experiment, folder)

    def restart(self, folder: Path, config: Mapping[str, Any]) -> str | None:
        from holotorch.experiments.measure.run import restart_measurement

        return restart_measurement(folder, dict(config))

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        from holotorch.experiments.measure.report import verdict

        return [verdict(summary)]

    def section(self, record: RunRecord) -> list[str]:
        from holotorch.experiments.measure.report import measure_section

        return measure_section(record)


KIND = MeasureKind()
