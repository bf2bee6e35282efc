"""One tolerance of a run, divided among the parts that contribute errors.

The errors of independent parts add in squares. Of N parts that share a tolerance T, the part that is planned first may
err by T / sqrt(N). When its error is predicted, the rest, sqrt(T^2 - e^2), is divided among the others by the same
rule, so that a part without error gives its whole share to the parts after it. A part with its own setting keeps
it, and the setting counts as its error. If such settings leave nothing, the other parts get T / sqrt(N), and the plan
says that the tolerance is exceeded.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Part:
    """A part of a run that contributes an error.

    Attributes:
        name: In words, such as "hologram".
        default: Tolerance of the part if neither the run nor the part has one, relative L2 error.
        key: Setting of the part that overrides its share; "" if there is none.
        given: Value of that setting, or None.
    """

    name: str
    default: float
    key: str = ""
    given: float | None = None


class Budget:
    """The shares of a tolerance; the module describes the rule.

    Args:
        tolerance: Allowed relative L2 error of the result of a run; None if the run has none, and then each part has
            its setting or its default.
        parts: The parts in the order in which they are planned.
    """

    def __init__(self, tolerance: float | None, parts: Sequence[Part]):
        self.tolerance, self.parts = tolerance, {part.name: part for part in parts}
        self._predicted: dict[str, float] = {}
        self._shares: dict[str, float] = {}

    def share(self, name: str) -> float:
        """Tolerance of a part, which stays the same from the first call on."""
        if name not in self._shares:
            part = self.parts[name]
            given = part.given if self.tolerance is None or part.given is not None else self._divided(name)
            self._shares[name] = part.default if given is None else given
        return self._shares[name]

    def predict(self, name: str, error: float) -> None:
        """State the predicted error of a part, before the shares of the parts after it are requested."""
        self._predicted[name] = error

    def _divided(self, name: str) -> float:
        assert self.tolerance is not None
        spent = 0.0
        sharing = [other for other, part in self.parts.items() if part.given is None]
        for other, part in self.parts.items():
            spent += (self._predicted.get(other, part.given or 0.0) if other != name else 0.0) ** 2
        waiting = [other for other in sharing if other == name or other not in self._predicted]
        rest = self.tolerance**2 - spent
        return math.sqrt(rest / len(waiting)) if rest > 0 else self.tolerance / math.sqrt(len(self.parts))

    @property
    def predicted_error(self) -> float:
        """Error of the result: that of the parts, added in squares; the share of a part without a prediction."""
        return math.hypot(*(self._predicted.get(name, self.share(name)) for name in self.parts))

    def error(self, name: str) -> float:
        """Predicted error of a part; its share if there is no prediction."""
        return self._predicted.get(name, self.share(name))

    def values(self) -> dict[str, Any]:
        """Entries of plan.json."""
        rows = [
            {
                "part": name,
                "tolerance": self.share(name),
                "from": self._source(name),
                "predicted_error": self.error(name),
            }
            for name in self.parts
        ]
        return {"tolerance": self.tolerance, "tolerances": rows, "predicted_error": self.predicted_error}

    def _source(self, name: str) -> str:
        part = self.parts[name]
        if part.given is not None:
            return part.key
        return "default" if self.tolerance is None else "share"

    @property
    def text(self) -> str:
        """The tolerance in words, one line of a plan."""
        parts = []
        for name, part in self.parts.items():
            source = {"share": "", "default": " by default"}.get(self._source(name), f" by {part.key}")
            parts.append(f"{self.share(name):.1e} {name}{source} (predicted {self.error(name):.1e})")
        whole = "" if self.tolerance is None else f"{self.tolerance:.1e} = "
        exceeded = ""
        if self.tolerance is not None and self.predicted_error > 1.001 * self.tolerance:
            exceeded = f"; the run may err by {self.tolerance:.1e} in all, and the prediction exceeds it"
        words = "allowed relative error of each step" if len(parts) > 1 else "allowed relative error"
        together = f"; together the root of the sum of their squares, predicted {self.predicted_error:.1e}"
        return f"Tolerance  {whole}{', '.join(parts)}: {words}{together if len(parts) > 1 else ''}{exceeded}"
