"""ExperimentKind: what the command line needs to know of one kind of experiment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from holotorch.experiments.config.settings import Settings
from holotorch.experiments.config.source import Key
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:  # torch and matplotlib are loaded by what runs, not by what checks a configuration
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord

SettingsT = TypeVar("SettingsT", bound=Settings)
Experiment = TypeVar("Experiment")


class ExperimentKind(ABC, Generic[SettingsT, Experiment]):
    """One kind of experiment: a folder with a module ``kind`` whose ``KIND`` is an instance, a line in the registry.

    ``check``, ``run``, ``resume`` and ``report`` of the command line do the rest. Methods import what they need when
    they are called, so that a configuration is checked before torch is loaded.

    Attributes:
        settings: Model of its configuration.
        parallel: Whether several processes, started by ``torchrun``, share one run.
        announces: Whether the plan is printed before the run begins.
        example: Configuration that comes with the package, to begin with.
    """

    settings: type[SettingsT]
    parallel: ClassVar[bool] = False
    announces: ClassVar[bool] = True
    example: ClassVar[str]

    def contradictions(self, settings: SettingsT) -> list[tuple[Key, str]]:
        """Settings that are fine one by one and not together: their keys, and what to change."""
        return []

    @abstractmethod
    def build(self, settings: SettingsT) -> Experiment:
        """Load the inputs and resolve what the configuration leaves open. ConfigError for inputs that do not fit."""

    @abstractmethod
    def plan(self, experiment: Experiment) -> RunPlan:
        """What a run will do and cost; computes nothing."""

    def prepare(self, experiment: Experiment) -> None:
        """Find what would stop the run, before it claims a folder. ConfigError for that."""

    @abstractmethod
    def run(self, experiment: Experiment, folder: RunFolder) -> bool:
        """Compute, fill the folder and conclude it; whether the run is complete."""

    def restart(self, folder: Path, config: Mapping[str, Any]) -> str | None:
        """What to do instead of continuing an interrupted run; None for the kinds whose runs can be continued.

        Args:
            folder: Of the run.
            config: Its configuration, as it stands in the folder.
        """
        return None

    def device(self, experiment: Experiment) -> str:
        """Where the run computes."""
        return "cpu"

    @abstractmethod
    def section(self, record: RunRecord) -> list[str]:
        """The run's part of a report page, as HTML, from the files of its folder alone."""

    def comparison(self, records: Sequence[RunRecord]) -> list[str]:
        """What a page of several runs of this kind begins with."""
        return []
