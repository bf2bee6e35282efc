"""Statistical power of a perception study: how many participants are needed to detect a given slope."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from holotorch.experiments.perception.analysis.config import (
    AnalysisSettings,
    PowerSettings,
    SimulationSettings,
    TargetTimeSettings,
)
from holotorch.experiments.perception.analysis.curves import equal_efficiency, fit_curves, perception_times
from holotorch.experiments.perception.analysis.simulation import simulate
from holotorch.experiments.perception.analysis.statistics import fit_line
from holotorch.experiments.perception.study.design import THESIS_CONDITIONS

_TARGET = TargetTimeSettings(size_deg=5, eccentricity_deg=10)


def with_slope(settings: SimulationSettings, alpha: float, middle_deg: float) -> SimulationSettings:
    """Settings whose line has the slope ``alpha`` and an unchanged scale at ``middle_deg``.

    Raises:
        ValueError: The line is not above zero everywhere from 40 to 80 deg.
    """
    beta = settings.beta + (settings.alpha - alpha) * middle_deg
    return SimulationSettings.model_validate({**settings.model_dump(), "alpha": alpha, "beta": beta})


def power_rows(settings: AnalysisSettings, power: PowerSettings) -> Iterator[dict[str, Any]]:
    """Yield a row per slope and number of participants, from simulated studies with a target of 5 deg at 10 deg.

    ``power`` is the share of studies in which the interval of alpha excludes 0, and ``error`` its binomial standard
    deviation. ``refused`` is the share of studies without a line or an interval, which detect no slope. ``covered`` is
    the share of the remaining studies whose interval contains the true slope. Smaller studies consist of the first
    participants of the largest one.
    """
    low, high = settings.range_deg
    pattern = (_TARGET.eccentricity_deg, _TARGET.size_deg)
    # Only conditions that affect the line or the target time are simulated.
    conditions = [(e, s) for e, s in THESIS_CONDITIONS if low <= e <= high or (e, s) == pattern]
    most = max(power.participants)
    for k, alpha in enumerate(power.slopes):
        truth = with_slope(settings.simulation, alpha, (low + high) / 2).model_copy(update={"participants": most})
        generator = np.random.default_rng([settings.seed, 1, k])
        intervals: dict[int, list[tuple[float, float]]] = {people: [] for people in power.participants}
        for _ in range(power.studies):
            answers = simulate(truth, generator, conditions, distractions=0)
            times = perception_times(answers, settings.cleaning)
            curves = fit_curves(times, low, settings.cleaning.sizes)
            scales = equal_efficiency(curves, times.of(_TARGET), settings.limits_deg)
            for people, ends in intervals.items():
                line = fit_line(
                    curves.eccentricities,
                    scales.degrees[:people],
                    generator,
                    inside=curves.eccentricities <= high,
                    limits=settings.limits_deg,
                    resamples=power.resamples,
                    confidence=settings.confidence,
                )
                if math.isfinite(line.alpha_interval[0]):
                    ends.append(line.alpha_interval)
        for people, ends in intervals.items():
            share = sum(below > 0 or above < 0 for below, above in ends) / power.studies
            covered = [below <= alpha <= above for below, above in ends]
            yield {
                "alpha": alpha,
                "participants": people,
                "power": share,
                "error": math.sqrt(share * (1 - share) / power.studies),
                "refused": 1 - len(ends) / power.studies,
                "covered": sum(covered) / len(ends) if ends else None,
                "mean_interval_width": sum(above - below for below, above in ends) / len(ends) if ends else None,
            }


def needed(rows: list[dict[str, Any]], power: float = 0.8) -> list[str]:
    """For each slope, a sentence with the smallest number of participants whose studies reach ``power``."""
    lines = []
    for alpha in dict.fromkeys(row["alpha"] for row in rows):
        results = sorted((row["participants"], row["power"]) for row in rows if row["alpha"] == alpha)
        if alpha == 0:
            worst = max(share for _, share in results)
            lines.append(f"no slope: a slope is detected by mistake in at most {100 * worst:.1f} % of the studies")
            continue
        enough = [people for people, share in results if share >= power]
        if enough:
            detected = f"detected in at least {100 * power:g} % of the studies with {enough[0]} participants"
        else:
            detected = (
                f"not detected in {100 * power:g} % of the studies with {results[-1][0]} participants, the most tried"
            )
        lines.append(f"a slope of {alpha:g} deg/deg is {detected}")
    return lines
