"""Contrast and motion: simulated effects are recovered, also from people who follow other laws than the model's."""

import csv
import json
import math
import sys

import numpy as np
import pytest
from pydantic import ValidationError

from holotorch.experiments.execute import execute
from holotorch.experiments.perception.analysis.config import AnalysisSettings, CleaningSettings, SimulationSettings
from holotorch.experiments.perception.analysis.curves import Responses, fit_curves, perception_times
from holotorch.experiments.perception.analysis.factors import level_effects, model_effects
from holotorch.experiments.perception.analysis.simulation import simulate

CELLS = [(e, s) for e in (40.0, 60.0, 80.0, 100.0) for s in (8.0, 14.0, 20.0)]
# Neither the defaults nor numbers with which the analysis was written.
TRUTH = {"contrast": 0.014, "contrast_growth": -0.0015, "motion": 0.055, "motion_growth": 0.008}
FACTORS = SimulationSettings(participants=16, contrasts=(1, 0.4, 0.15), speeds_deg_s=(0, 6, 25), **TRUTH)  # type: ignore[arg-type]
RULE = CleaningSettings()


def effects(settings, seed):
    made = simulate(settings, np.random.default_rng(seed), CELLS, targets=6, distractions=1)
    return model_effects(perception_times(made, RULE), 55, 0.95)


def coverage(seeds, settings=FACTORS):
    """Number of seeds whose intervals contain each truth, and of those whose interval excludes 0."""
    truth = [settings.contrast, settings.contrast_growth, settings.motion, settings.motion_growth]
    held, found = np.zeros(4, int), np.zeros(4, int)
    for seed in seeds:
        ends = [effect.interval for effect in effects(settings, seed)]
        held += [low <= true <= high for (low, high), true in zip(ends, truth, strict=True)]
        found += [low > 0 or high < 0 for low, high in ends]
    return held, found


def test_without_noise_the_truth_comes_back():
    still = {"slope_spread": 0, "scale_spread": 0, "local_spread": 0, "time_spread": 0, "trial": 0, "miss": 0}
    exact = FACTORS.model_copy(update={**still, "lapse": 0, "frame": 1e-9, "factor_spread": 0})
    found = effects(exact, 0)
    assert [e.name for e in found] == [
        "contrast", "contrast per 10 deg of eccentricity", "motion", "motion per 10 deg of eccentricity"]  # fmt: skip
    assert [e.seconds for e in found] == pytest.approx(list(TRUTH.values()), abs=1e-7)  # frames of 1 ns


def test_simulated_effects_are_within_their_intervals_on_new_seeds():
    """A small version of the check of 400 seeds, which running this file carries out."""
    held, found = coverage(range(81_000, 81_040))
    # 40 trials at 0.95 have a standard deviation of 3.4 %; four of them.
    assert (held / 40 > 0.95 - 4 * 0.034).all(), held
    # The intervals are narrow enough to find contrast and motion.
    assert found[0] > 35 and found[2] > 20, found
    # Effects that do not change with the eccentricity are rarely said to.
    none = FACTORS.model_copy(update={"contrast_growth": 0.0, "motion_growth": 0.0})
    _, wrong = coverage(range(82_000, 82_040), none)
    assert (wrong[[1, 3]] / 40 < 0.05 + 4 * 0.034).all(), wrong


def other_people(generator, people=16):
    """Answers by other laws: Burkhardt's power -0.67 of contrast, and a time that falls by a fixed step with motion."""
    rows = []
    for person in range(people):
        b, m = 0.05 * generator.lognormal(0, 0.3), generator.normal(0.02, 0.01)
        base = generator.normal(0.5, 0.05)
        for (e, s), c, v in ((cell, c, v) for cell in CELLS for c in (1, 0.4, 0.15) for v in (0, 25)):
            time = base + 2e-3 * e - 0.1 * math.log(s / 10) + b * (c**-0.67 - 1) - m * (v > 0)
            rows += [(person, e, s, c, v, time + generator.normal(0, 0.1)) for _ in range(5)]
    p, e, s, c, v, t = (np.array(column, float) for column in zip(*rows, strict=True))
    frames = np.full(len(t), 1e-3)
    return Responses(p.astype(int), e, s, np.ones(len(t), bool), t, frames, contrast=c, speed_deg_s=v)


def test_differences_between_levels_need_no_model():
    """The truth of the slowest step, from contrast 1 at rest to 0.15 in motion, and three others."""
    mean = 0.05 * math.exp(0.3**2 / 2)  # of a lognormal variable
    truth = {
        "contrast 1 at 25 deg/s": -0.02,
        "contrast 0.4 at 0 deg/s": mean * (0.4**-0.67 - 1),
        "contrast 0.15 at 0 deg/s": mean * (0.15**-0.67 - 1),
        "contrast 0.15 at 25 deg/s": mean * (0.15**-0.67 - 1) - 0.02,
    }
    held = dict.fromkeys(truth, 0)
    for seed in range(83_000, 83_020):
        found = {
            e.name: e for e in level_effects(perception_times(other_people(np.random.default_rng(seed)), RULE), 0.95)
        }
        assert len(found) == 5
        for name, true in truth.items():
            low, high = found[name].interval
            held[name] += low <= true <= high
    # 20 trials at 0.95: a standard deviation of 4.9 %.
    assert all(count / 20 > 0.95 - 4 * 0.049 for count in held.values()), held


def test_missing_times_and_few_people():
    two = FACTORS.model_copy(update={"participants": 2})
    found = effects(two, 3)
    assert all(e.participants == 2 and math.isnan(e.interval[0]) and math.isfinite(e.seconds) for e in found)
    assert found[0].row()["low"] is None
    made = simulate(FACTORS.model_copy(update={"miss": 0.4}), np.random.default_rng(1), CELLS, targets=4)
    times = perception_times(made, RULE)
    assert 0.2 < np.isnan(times.all_seconds).mean() < 0.6
    some = model_effects(times, 55, 0.95)
    assert abs(some[0].seconds - TRUTH["contrast"]) < 0.02 and some[0].participants == 16
    # A person who has seen one contrast only determines nothing.
    one = times.all_seconds.copy()
    one[0, ..., [k for k, (c, _) in enumerate(times.variants) if c < 1]] = np.nan
    object.__setattr__(times, "of_variants", one)
    assert model_effects(times, 55, 0.95)[0].participants == 15


def test_the_study_of_the_thesis_has_no_factors():
    made = perception_times(simulate(SimulationSettings(participants=3), np.random.default_rng(0)), RULE)
    assert made.variants == ((1.0, 0.0),) and not level_effects(made, 0.95) and not model_effects(made, 55, 0.95)
    # Black patterns at rest are simulated as without the factors.
    plain, rich = (simulate(s, np.random.default_rng(4), CELLS) for s in (
        SimulationSettings(participants=3), SimulationSettings(participants=3, contrast=0.5, motion=0.5)))  # fmt: skip
    assert np.array_equal(plain.reaction_s, rich.reaction_s, equal_nan=True)


def test_the_truth_of_the_scales_is_that_of_black_patterns_at_rest():
    for wrong in ({"contrasts": [0.5]}, {"speeds_deg_s": [10]}):
        with pytest.raises(ValidationError, match="expected contrast 1 and speed 0"):
            SimulationSettings.model_validate(wrong)


def test_scales_are_those_of_black_patterns_at_rest():
    settings = SimulationSettings(participants=40, contrasts=(1, 0.2), contrast=0.1)
    times = perception_times(simulate(settings, np.random.default_rng(6)), RULE)
    plain = perception_times(simulate(SimulationSettings(participants=40), np.random.default_rng(6)), RULE)
    assert times.variants[0] == (1, 0)
    near = np.nanmedian(times.seconds - plain.seconds)
    assert abs(near) < 0.02 < 0.3 < np.nanmedian(times.all_seconds[..., 1] - plain.seconds)
    assert np.isfinite(fit_curves(times, 40, 3).a).all()


def test_a_run_writes_its_factors(tmp_path):
    chosen = AnalysisSettings.model_validate(
        {
            "experiment": "perception_analysis",
            "targets": [{"seconds": 0.45}],
            "resamples": 100,
            "repeated_measures": False,
            "simulation": {"participants": 6, "contrasts": [1, 0.2], "speeds_deg_s": [0, 20]},
        }
    )
    folder, _ = execute(chosen, tmp_path / "run", "analysis")
    with open(folder / "factors.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["effect"] for row in rows][:3] == [
        "contrast 1 at 20 deg/s", "contrast 0.2 at 0 deg/s", "contrast 0.2 at 20 deg/s"]  # fmt: skip
    summary = json.loads((folder / "summary.json").read_text())
    assert len(rows) == 7 == len(summary["factors"])
    assert any("Factors    model at 55 deg: contrast " in line for line in summary["lines"])


if __name__ == "__main__":
    first = int(sys.argv[1]) if len(sys.argv) > 1 else 90_000
    # At the default times, answers below 0.1 s are left out and shorten the effects; at 0.8 s there are hardly any.
    for seconds in (0.45, 0.8):
        held, found = coverage(range(first, first + 400), FACTORS.model_copy(update={"seconds": seconds}))
        for name, a, b in zip(TRUTH, held, found, strict=True):
            inside = f"within its 95 % interval in {a} of 400 seeds from {first}"
            print(f"{1e3 * seconds:g} ms, {name}: {inside}; different from 0 in {b}", flush=True)
