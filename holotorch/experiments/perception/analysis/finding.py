"""What the analysis of a perception study found, as a row of a table and in words."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from holotorch.experiments.perception.analysis.config import AnalysisSettings
from holotorch.experiments.perception.analysis.curves import Curves, Scales, Times
from holotorch.experiments.perception.analysis.statistics import Anova, Line, Mixed
from holotorch.experiments.perception.study.frames import Quantisation


@dataclass(frozen=True, eq=False)
class Finding:
    """What was found for one target time."""

    name: str
    scales: Scales
    line: Line
    thesis: Anova
    repeated: Anova | None
    mixed: Mixed | None
    undefined: int
    limited: int
    missing: int

    def row(self, truth: tuple[float, float] | None) -> dict[str, Any]:
        """A line of metrics.csv."""
        line = self.line
        row: dict[str, Any] = {"target": self.name, "alpha": line.alpha, "beta": line.beta}
        row |= dict(zip(("alpha_low", "alpha_high"), line.alpha_interval, strict=True))
        row |= dict(zip(("beta_low", "beta_high"), line.beta_interval, strict=True))
        if truth is not None:
            row |= {"true_alpha": truth[0], "true_beta": truth[1]}
        row |= _anova("one_way", self.thesis)
        if self.repeated is not None:
            row |= _anova("repeated", self.repeated)
            row |= {"epsilon": self.repeated.epsilon, "repeated_p_corrected": self.repeated.p_corrected}
            row |= {"repeated_left_out": self.repeated.left_out}
            mixed = self.mixed
            row |= {"mixed_alpha": mixed.alpha if mixed else math.nan, "mixed_beta": mixed.beta if mixed else math.nan}
            low, high = mixed.alpha_interval if mixed else (math.nan, math.nan)
            row |= {"mixed_alpha_low": low, "mixed_alpha_high": high, "mixed_p": mixed.p if mixed else math.nan}
            row |= {"mixed_effects": mixed.effects if mixed else "not fitted"}
        row |= {"undefined": self.undefined, "at_limits": self.limited, "missing": self.missing}
        return {key: in_json(value) for key, value in row.items()} | {"refused": line.refused}


def in_words(
    settings: AnalysisSettings, times: Times, curves: Curves, found: list[Finding], frames: Quantisation, on: float
) -> str:
    """What was found, line by line; ``on``: share of the times that are whole frames."""
    who = "simulated participants" if times.simulated else "participants"
    some = np.isfinite(curves.a)
    lines = [
        f"Study      {len(times.participants)} {who}",
        "Answers    " + ", ".join(f"{number} {key}" for key, number in times.counts.items()),
        f"Frames     {frames}; {100 * on:.0f} % of the times are whole frames",
        f"Curves     T = a ln S + b: {int((curves.a[some] >= 0).sum())} of {int(some.sum())} do not fall with the size"
        f", {int((~some).sum())} have too few sizes",
    ]
    for f in found:
        line = f.line
        if line.refused:
            lines.append(f"Scale      as fast as {f.name}: no line, as {line.refused}")
            continue
        (a, b), (c, d) = line.alpha_interval, line.beta_interval
        lines.append(
            f"Scale      as fast as {f.name}: {line.alpha:.3g} [{a:.3g}, {b:.3g}] E {line.beta:+.3g} [{c:.3g}, {d:.3g}]"
            f" deg; {100 * settings.confidence:g} % intervals; {f.undefined} scales undefined, {f.limited} at limits"
        )
        lines.append(_tested("one-way ANOVA, as in the thesis", f.thesis, f.thesis.p))
        if f.repeated is not None:
            share = f.repeated.epsilon
            words = _tested("repeated measures, Greenhouse-Geisser", f.repeated, f.repeated.p_corrected, share)
            lines.append(f"{words}, epsilon {share:.3g}")
        if f.mixed is not None:
            a, b = f.mixed.alpha_interval
            lines.append(f"             mixed model: alpha {f.mixed.alpha:.3g} [{a:.3g}, {b:.3g}], p = {f.mixed.p:.3g}")
    return "\n".join(lines)


def _tested(name: str, found: Anova, p: float, share: float = 1.0) -> str:
    """``share``: of the degrees of freedom with which ``p`` was found."""
    first, second = (f"{share * freedom:.4g}" for freedom in found.freedom)
    return f"             {name}: F({first}, {second}) = {found.f:.3g}, p = {p:.3g}"


def _anova(name: str, found: Anova) -> dict[str, Any]:
    return {
        f"{name}_f": found.f,
        f"{name}_p": found.p,
        f"{name}_df": found.freedom[0],
        f"{name}_error_df": found.freedom[1],
    }


def in_json(value: Any) -> Any:
    """Numbers that JSON has; None for NaN and infinity."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
