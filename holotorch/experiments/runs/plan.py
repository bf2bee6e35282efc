"""RunPlan: description, cost and feasibility of a run."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class RunPlan:
    """The plan of a run, made before anything is computed."""

    text: str  # lines to print
    values: dict[str, Any] = field(default_factory=dict)  # choices with reasons, cost and physics, as JSON values
    shortage: str | None = None  # the reason why this machine cannot carry out the run
