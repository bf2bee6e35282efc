"""RunPlan: what a run will do, before it starts."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class RunPlan:
    """What a run will do, before anything is computed.

    Attributes:
        text: In words, for a display engineer.
        values: Choices with their reasons, cost and physics, as plain JSON values; written to plan.json if there are
            any.
        shortage: Why the run cannot be carried out on this machine, or None.
    """

    text: str
    values: dict[str, Any] = field(default_factory=dict)
    shortage: str | None = None
