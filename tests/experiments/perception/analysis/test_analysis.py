import json
import math

import numpy as np
import pytest
from pydantic import ValidationError

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.perception.analysis.config import (
    AnalysisSettings,
    CleaningSettings,
    SimulationSettings,
    TargetTimeSettings,
)
from holotorch.experiments.perception.analysis.curves import (
    Responses,
    equal_efficiency,
    fit_curves,
    perception_times,
    read_responses,
)
from holotorch.experiments.perception.analysis.run import analyse, on_frames
from holotorch.experiments.perception.analysis.simulation import simulate

RULE = CleaningSettings()
SIZES = (5.0, 8, 11, 14, 17, 20, 23, 26)
TARGET = TargetTimeSettings(seconds=0.45)


def trial(participant=1, *, number, angle=50.0, size=5.0, target=True, reaction: float | None = 0.45, practice=False):
    return {
        "participant": participant,
        "round": 0 if practice else 1,
        "trial": number,
        "eccentricity_deg": angle,
        "size_deg": size,
        "pattern": "cross" if target else "circle",
        "target": target,
        "practice": practice,
        "responded": reaction is not None,
        "onset_s": 1.0,
        "response_s": None if reaction is None else 1.0 + reaction,
        "reaction_s": reaction,
        "frame_s": 1 / 60,
        "design": "abc",
        "time_utc": "2026-01-01T00:00:00Z",
    }


def write(path, trials, participant=1, end="\n"):
    header = {"format": "holotorch-trials", "version": 1, "participant": participant}
    path.write_text("\n".join(json.dumps(row) for row in (header, *trials)) + end)
    return str(path)


def responses(rows):
    """From (participant, eccentricity, size, target, reaction or NaN)."""
    person, angle, size, target, reaction = zip(*rows, strict=True)
    columns = (np.array(person), np.array(angle, float), np.array(size, float), np.array(target))
    return Responses(*columns, np.array(reaction, float), np.full(len(rows), 1 / 60))


def study(curve, angles=(40, 50, 60, 70, 80), people=6, sizes=SIZES):
    """Four equal answers per condition, of curve(person, angle, size)."""
    rows = [
        (p, e, s, True, curve(p, e, s)) for p in range(1, people + 1) for e in angles for s in sizes for _ in range(4)
    ]
    return perception_times(responses(rows), RULE)


def settings(**changes):
    changes.setdefault("repeated_measures", False)
    return AnalysisSettings.model_validate(
        {"experiment": "perception_analysis", "targets": [{"seconds": 0.45}], "resamples": 100, **changes}
    )


def test_logs_are_read_without_their_practice(tmp_path):
    rows = [trial(number=1, practice=True), trial(number=1), trial(number=2, target=False, reaction=None)]
    write(tmp_path / "a.jsonl", rows)
    half = json.dumps(trial(4, number=2))[:40]
    write(tmp_path / "b.jsonl", [trial(4, number=1, angle=60, size=8, reaction=0.5)], 4, "\n" + half)
    made = read_responses([str(tmp_path)])
    assert made.participant.tolist() == [1, 1, 4] and made.eccentricity_deg.tolist() == [50, 50, 60]
    assert made.target.tolist() == [True, False, True] and made.torn == 1 and not made.simulated
    assert np.array_equal(made.reaction_s, [0.45, np.nan, 0.5], equal_nan=True)


def test_logs_that_hold_nothing_to_analyse(tmp_path):
    with pytest.raises(ConfigError, match=r"holds no \*.jsonl files"):
        read_responses([str(tmp_path)])
    with pytest.raises(ConfigError, match="cannot read the log"):
        read_responses([str(tmp_path / "none.jsonl")])
    (tmp_path / "void.jsonl").write_text("")
    with pytest.raises(ConfigError, match="the log is empty"):
        read_responses([str(tmp_path / "void.jsonl")])
    practice = write(tmp_path / "practice.jsonl", [trial(number=1, practice=True)])
    with pytest.raises(ConfigError, match="practice.jsonl: the log is empty: no trials after the practice"):
        read_responses([practice])
    wrong = write(tmp_path / "wrong.jsonl", [trial(number=1, angle=-10), trial(number=2, size=0)])
    with pytest.raises(ConfigError) as caught:
        read_responses([wrong])
    assert len(caught.value.mistakes) == 2 and "got -10 and 5" in str(caught.value)


def test_every_part_of_the_rule_is_counted():
    good = [0.40, 0.42, 0.44, 0.46, 0.48]
    rows = [(1, 50, 5, True, t) for t in (*good, 0.05, 2.5, 1.9, math.nan)]
    rows += [(1, 50, 5, False, math.nan), (1, 50, 5, False, 0.3)]
    rows += [(1, 50, 8, True, t) for t in (0.3, 0.31, math.nan)]
    made = perception_times(responses(rows), RULE)
    # Median of good and 1.9: 0.45; |ln 1.9 / 0.45| = 1.44, the others at most 0.12.
    assert made.counts == {
        "trials": 14,
        "targets": 12,
        "missed targets": 2,
        "answered distractions": 1,
        "too early": 1,
        "too late": 1,
        "outliers": 1,
        "conditions": 2,
        "missing conditions": 1,
        "unfinished trials": 0,
    }
    assert made.seconds[0, 0, 0] == pytest.approx(0.44) and math.isnan(made.seconds[0, 0, 1])
    assert made.kept[0, 0].tolist() == [5, 2]
    two = perception_times(responses(rows), CleaningSettings(responses=2))
    assert two.seconds[0, 0, 1] == pytest.approx(0.305)


def test_equal_times_of_coarse_frames_are_no_outliers():
    """Their spread is zero: half a frame counts instead, 8.3 ms, of which 33 ms are four and 100 ms twelve."""
    rows = [(1, 50, 5, True, t) for t in (0.45,) * 6 + (0.45 + 2 / 60, 0.45 + 6 / 60)]
    assert perception_times(responses(rows), RULE).counts["outliers"] == 1


def test_all_misses_and_all_too_late_are_said():
    rows = [(1, 50, 5, True, math.nan)] * 6
    with pytest.raises(ConfigError, match="no answers to analyse in 6 trials with a target: 6 missed targets"):
        perception_times(responses(rows), RULE)
    with pytest.raises(ConfigError, match="5 too late"):
        perception_times(responses([(1, 50, 5, True, 9.0)] * 5), RULE)
    with pytest.raises(ConfigError, match="no condition has 3 answers .*; 2 at most"):
        perception_times(responses([(1, 50, 5, True, 0.4)] * 2), RULE)


def test_curves_and_scales_by_hand():
    times = study(lambda p, e, s: 0.6 + p / 100 - 0.1 * math.log(s))
    curves = fit_curves(times, 40, 3)
    assert curves.a == pytest.approx(np.full((6, 5), -0.1)) and curves.b[:, 0] == pytest.approx(
        0.6 + times.participants / 100
    )
    scales = equal_efficiency(curves, np.full(6, 0.45), (1, 60))
    assert scales.degrees[:, 2] == pytest.approx(np.exp((0.15 + times.participants / 100) / 0.1))
    assert scales.defined.all() and not scales.limited.any()
    pattern = times.of(TargetTimeSettings(size_deg=8, eccentricity_deg=60))
    assert equal_efficiency(curves, pattern, (1, 60)).degrees == pytest.approx(np.full((6, 5), 8.0))
    assert fit_curves(times, 65, 3).eccentricities.tolist() == [70, 80]


def test_one_size_only_and_no_far_eccentricity_are_said():
    with pytest.raises(ConfigError, match=r"needs times of 3 sizes \(cleaning.sizes\) at an eccentricity, got 1"):
        fit_curves(study(lambda p, e, s: 0.4, sizes=(5.0,)), 40, 3)
    with pytest.raises(ConfigError, match="no eccentricity of 40 deg or more; there are 10, 20 deg"):
        fit_curves(study(lambda p, e, s: 0.4, angles=(10, 20)), 40, 3)


def test_an_eccentricity_with_few_sizes_is_missing_for_that_participant():
    rows = [
        (p, e, s, True, 0.7 - 0.1 * math.log(s) + p / 1000)
        for p in (1, 2)
        for e in (40, 50)
        for s in SIZES
        if (p, e) != (2, 50) or s < 9
        for _ in range(3)
    ]
    curves = fit_curves(perception_times(responses(rows), RULE), 40, 3)
    assert np.isnan(curves.a).tolist() == [[False, False], [False, True]]
    scales = equal_efficiency(curves, np.full(2, 0.45), (1, 60))
    assert np.isnan(scales.degrees).tolist() == [[False, False], [False, True]] and not scales.defined[1, 1]


def test_times_that_rise_with_the_size_have_no_scale_but_a_place():
    """Slower than the target time throughout: no size is large enough; faster: none is small enough."""
    times = study(lambda p, e, s: (0.6 if p <= 3 else 0.3) + 0.01 * math.log(s))
    curves = fit_curves(times, 40, 3)
    assert (curves.a > 0).all()
    scales = equal_efficiency(curves, np.full(6, 0.45), (1, 60))
    assert not scales.defined.any() and not scales.limited.any() and np.isnan(scales.defined_degrees).all()
    assert scales.degrees[:, 0].tolist() == [60, 60, 60, 1, 1, 1]
    (found,) = analyse(settings(), times, curves)
    assert found.undefined == 24 and math.isnan(found.thesis.f)
    slow = study(lambda p, e, s: 0.6 + 0.01 * math.log(s))
    (refused,) = analyse(settings(), slow, fit_curves(slow, 40, 3))
    assert "no scale within 1 .. 60 deg at 40, 50, 60, 70 deg" in refused.line.refused
    assert refused.row(None)["alpha"] is None


def test_80_deg_is_shown_and_outside_the_line():
    """Scales along a line up to 70 deg, and far above it at 80 deg."""

    def curve(p, e, s):
        scale = (0.5 * e - 15) * (1 if e < 75 else 1.6)
        return 0.45 - 0.12 * math.log(s / scale)

    times = study(curve)
    (found,) = analyse(settings(), times, fit_curves(times, 40, 3))
    assert (found.line.alpha, found.line.beta) == pytest.approx((0.5, -15))
    assert found.line.medians[-1] == pytest.approx(40)


def test_targets_that_were_not_shown_name_those_that_were():
    times = study(lambda p, e, s: 0.7 - 0.1 * math.log(s))
    with pytest.raises(ConfigError, match="10 deg at 50 deg; there are some with sizes there: 5, 8, 11"):
        times.of(TargetTimeSettings(size_deg=10, eccentricity_deg=50))
    with pytest.raises(ConfigError, match="at 40, 50, 60, 70, 80 deg"):
        times.of(TargetTimeSettings(size_deg=5, eccentricity_deg=10))


def test_settings_refuse_what_contradicts():
    for wrong in ({"size_deg": 5}, {"seconds": 0.4, "size_deg": 5, "eccentricity_deg": 10}, {}):
        with pytest.raises(ValidationError, match="expected {size_deg: 5"):
            TargetTimeSettings.model_validate(wrong)
    with pytest.raises(ValidationError, match="fastest below slowest"):
        CleaningSettings(fastest=3)
    for change, words in (({"range_deg": (70, 40)}, "smaller one first"), ({"limits_deg": (0, 60)}, "greater than 0")):
        with pytest.raises(ValidationError, match=words):
            settings(**change)


def test_frames_show_in_the_times():
    made = simulate(SimulationSettings(participants=2), np.random.default_rng(0))
    assert on_frames(made) == 1
    generator = np.random.default_rng(1)
    free = responses([(1, 50, 5, True, t) for t in generator.uniform(0.3, 0.6, 4000)])
    assert on_frames(free) == pytest.approx(0.2, abs=5 * math.sqrt(0.2 * 0.8 / 4000))


def test_a_run_of_logs(tmp_path):
    for person in (1, 2):
        cells = [(e, s) for e in (40.0, 50.0, 60.0, 70.0) for s in SIZES for _ in range(3)]
        rows = [
            trial(person, number=k, angle=e, size=s, reaction=0.45 - 0.12 * math.log(s / (0.5 * e - 15)))
            for k, (e, s) in enumerate(cells, 1)
        ]
        write(tmp_path / f"participant-{person}.jsonl", rows, person)
    folder, _ = execute(settings(logs=[str(tmp_path)], shown=2), tmp_path / "run", "analysis")
    summary = json.loads((folder / "summary.json").read_text())
    (row,) = summary["rows"]
    assert not summary["simulated"] and "true_alpha" not in row
    assert (row["alpha"], row["beta"]) == pytest.approx((0.5, -15))
    assert row["alpha_low"] is None  # two people
    with pytest.raises(ConfigError, match="shown: no participant 9; there are 1, 2"):
        execute(settings(logs=[str(tmp_path)], shown=9), tmp_path / "other", "analysis")
    assert not (tmp_path / "other").exists()
