"""ExperimentKind: the interface between the command line and one kind of experiment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from holotorch.experiments.config.settings import Settings
from holotorch.experiments.config.source import Key
from holotorch.experiments.runs.plan import RunPlan

if TYPE_CHECKING:  # importing these loads torch and matplotlib, which checking a configuration does not need
    from holotorch.experiments.runs.folder import RunFolder
    from holotorch.experiments.runs.record import RunRecord

SettingsT = TypeVar("SettingsT", bound=Settings)
Experiment = TypeVar("Experiment")


class ExperimentKind(ABC, Generic[SettingsT, Experiment]):
    """One kind of experiment.

    To add a kind, write a folder whose module ``kind`` defines an instance ``KIND``, and add a line to the registry;
    the commands ``check``, ``run``, ``resume`` and ``report`` then work for it. Methods import heavy modules when they
    are called, so that a configuration is checked before torch is loaded.
    """

    settings: type[SettingsT]  # pydantic model of the configuration
    parallel: ClassVar[bool] = False  # whether several processes, started by ``torchrun``, share one run
    announces: ClassVar[bool] = True  # whether the plan is printed before the run begins
    data: ClassVar[str] = ""  # key of the user's own data, such as "target.image"; empty if there is none
    example: ClassVar[str]  # path of the bundled configuration that ``holotorch new`` copies

    def contradictions(self, settings: SettingsT) -> list[tuple[Key, str]]:
        """Key and message for each setting that is valid by itself but contradicts another setting."""
        return []

    @abstractmethod
    def build(self, settings: SettingsT) -> Experiment:
        """Load the inputs and choose the settings that the configuration leaves open. ConfigError for bad inputs."""

    @abstractmethod
    def plan(self, experiment: Experiment) -> RunPlan:
        """The methods and the cost of a run, without computing its results."""

    def preview(self, experiment: Experiment) -> tuple[bytes, str] | None:
        """A quick look at the inputs: a PNG, and lines of text; None for a kind that has none."""
        return None

    def prepare(self, experiment: Experiment) -> None:
        """Raise ConfigError if the run cannot start; called before its folder is created."""

    @abstractmethod
    def run(self, experiment: Experiment, folder: RunFolder) -> bool:
        """Compute the results and write all files of the folder; returns whether the run is complete."""

    def outcome(self, summary: dict[str, Any]) -> list[str]:
        """The main numbers of a run in one or two lines, from the content of summary.json or interrupted.json."""
        return []

    def restart(self, folder: Path, config: Mapping[str, Any]) -> str | None:
        """What to do instead if the interrupted run in ``folder`` cannot be continued, otherwise None."""
        return None

    def device(self, experiment: Experiment) -> str:
        """Device of the computation, as torch names it."""
        return "cpu"

    @abstractmethod
    def section(self, record: RunRecord) -> list[str]:
        """The section of a report page for a run, as parts of HTML, from the files of the run folder alone."""

    def comparison(self, records: Sequence[RunRecord]) -> list[str]:
        """Parts of HTML that compare several runs of this kind; a page shows them before the sections of the runs."""
        return []
