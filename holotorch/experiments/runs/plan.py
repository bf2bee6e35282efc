"""RunPlan: description, cost and feasibility of a run."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class RunPlan:
    """The plan of a run, made before anything is computed.

    Attributes:
        text: Lines to print.
        values: Choices with their reasons, cost and physics, as plain JSON values; written to plan.json unless empty.
        shortage: The reason why this machine cannot carry out the run, or None.
    """

    text: str
    values: dict[str, Any] = field(default_factory=dict)
    shortage: str | None = None
