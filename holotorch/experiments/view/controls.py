"""What a user of the page chooses: sliders and choices, and the check of the values that a page sends."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Slider:
    """A number within limits.

    Attributes:
        name: Key of the value.
        label: Words beside the slider.
        unit: Unit of all numbers here; empty for a number without one.
        low, high, step: Limits, and distance of the positions of the slider.
        value: Value at the start.
        explanation: A sentence that says what the number means; may be empty.
    """

    name: str
    label: str
    unit: str
    low: float
    high: float
    step: float
    value: float
    explanation: str

    def checked(self, value: Any) -> float:
        """The value as a number. ValueError if it is none, or outside of the limits."""
        number = math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            with suppress(OverflowError):
                number = float(value)
        slack = 1e-6 * (self.high - self.low)  # for the rounding of a browser
        if not self.low - slack <= number <= self.high + slack:
            unit = f" {self.unit}" if self.unit else ""
            got = f"{number:g}{unit}" if math.isfinite(number) else "no number"
            raise ValueError(f"{self.label}: expected {self.low:g} to {self.high:g}{unit}, got {got}")
        return min(max(number, self.low), self.high)

    def described(self) -> dict[str, Any]:
        """The slider as a page gets it."""
        return {"kind": "slider", **vars(self)}


@dataclass(frozen=True)
class Choice:
    """One of several options.

    Attributes:
        name: Key of the value.
        label: Words beside the list.
        options: Words of each option by its value.
        value: Value at the start.
        explanation: A sentence that says what is chosen.
    """

    name: str
    label: str
    options: Mapping[str, str]
    value: str
    explanation: str

    def checked(self, value: Any) -> str:
        """The value. ValueError if it is none of the options."""
        if not isinstance(value, str) or value not in self.options:
            raise ValueError(f"{self.label}: expected one of {', '.join(self.options)}, got {str(value)[:40]!r}")
        return value

    def described(self) -> dict[str, Any]:
        """The choice as a page gets it."""
        return {"kind": "choice", **vars(self), "options": list(self.options.items())}


Control = Slider | Choice


def checked(controls: Sequence[Control], values: Any) -> dict[str, Any]:
    """Values by the names of all controls; those that are left out keep their value at the start.

    ValueError in one line for a value outside of its limits, or an unknown name.
    """
    if not isinstance(values, dict):
        raise ValueError("expected the values by the names of their controls")
    known = {control.name: control for control in controls}
    if unknown := sorted(str(name)[:40] for name in values if name not in known):
        raise ValueError(f"unknown {unknown[0]!r}; this run has {', '.join(known)}")
    return {name: control.checked(values.get(name, control.value)) for name, control in known.items()}


def steps(low: float, high: float, count: int = 200) -> float:
    """A round distance of the positions of a slider, such that there are at least ``count`` of them."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    return max(power * m for m in (1, 2, 5) if power * m <= raw * (1 + 1e-9))


def span(low: float, high: float, at: float, count: int = 200) -> dict[str, float]:
    """Arguments of a slider from about ``low`` to ``high`` whose positions include ``at`` exactly."""
    step = steps(low, high, count)
    below, above = math.floor((at - low) / step + 1e-9), math.floor((high - at) / step + 1e-9)
    return {"low": at - below * step, "high": at + above * step, "step": step, "value": at}
