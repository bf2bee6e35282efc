"""Results of the analysis of a perception study, as a row of a table and in words."""

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
    """Results for one target time. A scale is the size of a pattern that a participant perceives in this time."""

    name: str  # the target in words
    scales: Scales  # of all participants at all eccentricities
    line: Line  # through the medians
    thesis: Anova  # one-way analysis of variance, as in the thesis
    repeated: Anova | None  # repeated-measures analysis; None if it was not requested
    mixed: Mixed | None  # mixed model; None if it was not requested or not fitted
    undefined: int  # number of scales in the fitted range that do not exist, because times do not fall with the size
    limited: int  # number of defined scales in this range that are clipped to a limit
    missing: int  # number of scales in this range without a measured time

    def row(self, truth: tuple[float, float] | None) -> dict[str, Any]:
        """The row of metrics.csv; ``truth`` is the true (alpha, beta) of simulated participants."""
        line = self.line
        row: dict[str, Any] = {"target": self.name, "alpha": line.alpha, "beta": line.beta}
        row["alpha_low"], row["alpha_high"] = line.alpha_interval
        row["beta_low"], row["beta_high"] = line.beta_interval
        if truth is not None:
            row |= {"true_alpha": truth[0], "true_beta": truth[1]}
        row |= _anova("one_way", self.thesis)
        if self.repeated is not None:
            row |= _anova("repeated", self.repeated)
            row |= {"epsilon": self.repeated.epsilon, "repeated_p_corrected": self.repeated.p_corrected}
            nan = math.nan
            mixed = self.mixed or Mixed(nan, nan, (nan, nan), (nan, nan), nan, "not fitted", 0, 0)
            row |= {"repeated_left_out": self.repeated.left_out, "mixed_alpha": mixed.alpha, "mixed_beta": mixed.beta}
            row["mixed_alpha_low"], row["mixed_alpha_high"] = mixed.alpha_interval
            row |= {"mixed_p": mixed.p, "mixed_effects": mixed.effects}
        row |= {"undefined": self.undefined, "at_limits": self.limited, "missing": self.missing}
        return {key: in_json(value) for key, value in row.items()} | {"refused": line.refused}


def in_words(
    settings: AnalysisSettings,
    times: Times,
    curves: Curves,
    findings: list[Finding],
    frames: Quantisation,
    whole_frames: float,
) -> str:
    """The results line by line; ``whole_frames`` is the share of reaction times that are whole numbers of frames."""
    who = "simulated participants" if times.simulated else "participants"
    fitted = np.isfinite(curves.a)
    lines = [
        f"Study      {len(times.participants)} {who}",
        "Answers    " + ", ".join(f"{number} {key}" for key, number in times.counts.items()),
        f"Frames     {frames}; {100 * whole_frames:.0f} % of the times are whole frames",
        f"Curves     T = a ln S + b: {int((curves.a[fitted] >= 0).sum())} of {int(fitted.sum())} do not fall with the "
        f"size, {int((~fitted).sum())} have too few sizes",
    ]
    low, high = settings.limits_deg
    for f in findings:
        line = f.line
        if line.refused:
            lines.append(f"Scale      as fast as {f.name}: no line, as {line.refused}")
            continue
        (a, b), (c, d) = line.alpha_interval, line.beta_interval
        lines.append(
            f"Scale      as fast as {f.name}: {line.alpha:.3g} [{a:.3g}, {b:.3g}] E {line.beta:+.3g} [{c:.3g}, {d:.3g}]"
            f" deg; {100 * settings.confidence:g} % intervals; {f.undefined} scales undefined "
            f"(time does not fall with size), {f.limited} clipped to {low:g} or {high:g} deg"
        )
        lines.append(_test_line("one-way ANOVA, as in the thesis", f.thesis, f.thesis.p))
        if f.repeated is not None:
            epsilon = f.repeated.epsilon
            words = _test_line("repeated measures, Greenhouse-Geisser", f.repeated, f.repeated.p_corrected, epsilon)
            lines.append(f"{words}, epsilon {epsilon:.3g}")
        if f.mixed is not None:
            a, b = f.mixed.alpha_interval
            lines.append(f"             mixed model: alpha {f.mixed.alpha:.3g} [{a:.3g}, {b:.3g}], p = {f.mixed.p:.3g}")
    return "\n".join(lines)


def _test_line(name: str, anova: Anova, p: float, epsilon: float = 1.0) -> str:
    """An F test in words; ``epsilon`` multiplies both degrees of freedom."""
    first, second = (f"{epsilon * freedom:.4g}" for freedom in anova.freedom)
    return f"             {name}: F({first}, {second}) = {anova.f:.3g}, p = {p:.3g}"


def _anova(name: str, anova: Anova) -> dict[str, Any]:
    return {
        f"{name}_f": anova.f,
        f"{name}_p": anova.p,
        f"{name}_df": anova.freedom[0],
        f"{name}_error_df": anova.freedom[1],
    }


def in_json(value: Any) -> Any:
    """The value for JSON: None instead of NaN and infinity."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
