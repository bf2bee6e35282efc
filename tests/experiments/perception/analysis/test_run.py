"""A run of the analysis of simulated participants: its folder, what it says, and what it does without statsmodels."""

import csv
import html
import importlib.util
import json

import pytest
import yaml
from scipy import stats

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.perception.analysis.config import AnalysisSettings


def settings(**changes):
    changes.setdefault("repeated_measures", False)
    return AnalysisSettings.model_validate(
        {"experiment": "perception_analysis", "targets": [{"seconds": 0.45}], "resamples": 100, **changes}
    )


def test_a_run_of_simulated_people_fills_its_folder(tmp_path, capsys):
    pytest.importorskip("statsmodels", reason="pip install 'holotorch[stats]'")
    chosen = settings(
        repeated_measures=True,
        simulation={"participants": 12},
        targets=[{"size_deg": 5, "eccentricity_deg": 10}, {"seconds": 0.45}],
        power={"slopes": [0.4], "participants": [6], "studies": 10, "resamples": 100},
    )
    folder, complete = execute(chosen, tmp_path / "run", "analysis")
    assert complete and folder == tmp_path / "run"
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    pictures = {"time_surface", "time_map", "participant", "time_slices", "scale_lines", "power"}
    tables = {"metrics.csv", "conditions.csv", "curves.csv", "power.csv"}
    rest = {
        "config.yaml",
        "plan.json",
        "env.json",
        "summary.json",
        "report.html",
        "arrays/times.npy",
        "arrays/scales.npy",
    }
    assert names == {f"images/{name}.png" for name in pictures} | tables | rest
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["simulated"] and summary["status"] == "complete" and summary["participants"] == 12
    assert summary["counts"]["trials"] == 12 * 52 * 14 and len(summary["power"]) == 1
    assert summary["quantisation"]["frame_s"] == pytest.approx(1 / 60) and summary["quantisation"]["on_frames"] == 1
    with open(folder / "metrics.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["target"] for row in rows] == ["5 deg at 10 deg", "450 ms"] and rows[0]["true_alpha"] == "0.47"
    assert float(rows[0]["one_way_f"]) > 0 and float(rows[0]["repeated_p_corrected"]) <= 1
    said = capsys.readouterr().out
    # The degrees of freedom that belong to the corrected p: epsilon times 3 and 3 (n - 1).
    for row in rows:
        share, p, f = (float(row[key]) for key in ("epsilon", "repeated_p_corrected", "repeated_f"))
        first, second = share * int(row["repeated_df"]), share * int(row["repeated_error_df"])
        assert p == pytest.approx(stats.f.sf(f, first, second)) and share < 1
        assert f"F({first:.4g}, {second:.4g}) = {f:.3g}, p = {p:.3g}, epsilon {share:.3g}" in said
    assert "12 simulated participants" in said and "16.7 ms" in said and "one-way ANOVA, as in the thesis" in said
    assert AnalysisSettings.model_validate(yaml.safe_load((folder / "config.yaml").read_text())) == chosen


def test_without_statsmodels_the_rest_runs_and_says_what_is_left_out(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    few = {"simulation": {"participants": 6}, "targets": [{"seconds": 0.45}], "resamples": 100}
    given = AnalysisSettings.model_validate({"experiment": "perception_analysis", **few})
    folder, complete = execute(given, tmp_path / "a", "a")
    words = "repeated measures and the mixed model, which need statsmodels: pip install 'holotorch[stats]'"
    assert complete and words in capsys.readouterr().out
    assert words in html.unescape((folder / "report.html").read_text())
    summary = json.loads((folder / "summary.json").read_text())
    assert not summary["repeated_measures"] and "repeated_f" not in summary["rows"][0]
    # Asked for in so many words, it is refused; not wanted, nothing is missed.
    with pytest.raises(ConfigError, match=r"statsmodels is missing: pip install 'holotorch\[stats\]', or leave it out"):
        execute(settings(repeated_measures=True, **few), tmp_path / "b", "b")
    execute(settings(repeated_measures=False, **few), tmp_path / "c", "c")
    assert "Left out" not in capsys.readouterr().out


def test_a_power_study_that_cannot_be_is_refused_before_the_folder(tmp_path):
    chosen = settings(power={"slopes": [1.5], "participants": [6]})
    with pytest.raises(ConfigError, match="power.slopes: 1.5: expected alpha and beta with sizes above zero"):
        execute(chosen, tmp_path / "run", "analysis")
    assert not (tmp_path / "run").exists()
