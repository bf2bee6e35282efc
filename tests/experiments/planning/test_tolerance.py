"""One tolerance of a run, divided among its parts, and what becomes of it in runs."""

import json
import math

import pytest
from tiny_runs import VOLUME, command

from holotorch.cli import main
from holotorch.experiments.planning.errors import Comparison, error_line, error_sentence, error_values, not_measured
from holotorch.experiments.planning.tolerance import Budget, Part

pytestmark = pytest.mark.usefixtures("tiny")


def test_parts_share_a_tolerance_in_squares():
    budget = Budget(0.1, [Part("one", 1), Part("two", 1), Part("three", 1)])
    assert budget.share("one") == pytest.approx(0.1 / math.sqrt(3))
    budget.predict("one", 0.0)  # a part without error gives its share to the others
    assert budget.share("two") == pytest.approx(0.1 / math.sqrt(2))
    budget.predict("two", 0.06)
    assert budget.share("three") == pytest.approx(0.08)
    assert budget.share("one") == pytest.approx(0.1 / math.sqrt(3))  # what was asked for stays
    budget.predict("three", 0.08)
    assert budget.predicted_error == pytest.approx(0.1) and "exceeds" not in budget.text


def test_a_setting_of_a_part_wins_and_counts():
    budget = Budget(0.1, [Part("one", 1, "one.tolerance", 0.06), Part("two", 1)])
    assert (budget.share("one"), budget.share("two")) == (0.06, pytest.approx(0.08))
    assert "by one.tolerance" in budget.text and "1.0e-01 = " in budget.text
    spent = Budget(0.1, [Part("one", 1, "one.tolerance", 0.3), Part("two", 1)])
    assert spent.share("two") == pytest.approx(0.1 / math.sqrt(2)) and "exceeds it" in spent.text
    together = (
        f"root of the sum of their squares, predicted {math.hypot(*map(spent.error, spent.parts)):.1e}; the run may"
    )
    assert together in spent.text and "err by 1.0e-01 in all" in spent.text
    assert spent.values()["tolerances"][0]["from"] == "one.tolerance"


def test_without_a_tolerance_every_part_has_its_default():
    budget = Budget(None, [Part("one", 0.02), Part("two", 0.03, "two.tolerance", 0.01)])
    assert (budget.share("one"), budget.share("two")) == (0.02, 0.01)
    assert budget.values()["tolerance"] is None and "by default" in budget.text


def test_errors_in_a_summary_and_in_words():
    parts = [Comparison("hologram", 3e-3, 4e-3, "against all"), not_measured("wavelengths", 1e-2, 90.0)]
    values = error_values(parts)
    assert values["predicted_error"] == 3e-3 and values["measured_error"] == 4e-3
    sentence = error_sentence(values)
    assert "hologram 3.0e-03 predicted, 4.0e-03 measured" in sentence and "reference would take 90 s" in sentence
    assert error_values(parts[1:])["measured_error"] is None and error_sentence({}) == ""
    (partly,), (whole,) = error_line(values), error_line(error_values(parts[:1]))
    assert f"predicted in 1 of {len(parts)} parts, the others unmeasured; the report names its parts" in partly
    assert "predicted; the report names its parts" in whole


@pytest.mark.parametrize("tolerance", [None, 1e-2, 1e-4])
def test_the_error_of_a_volume_is_measured_and_within_its_tolerance(tolerance, tmp_path):
    words = [] if tolerance is None else [f"tolerance={tolerance}"]
    assert main(command("volume", tmp_path / "v", *words, "report.seeds=1")) == 0
    summary = json.loads((tmp_path / "v" / "summary.json").read_text())
    plan = json.loads((tmp_path / "v" / "plan.json").read_text())
    hologram, refocusing = summary["errors"]
    assert hologram["measured"] <= max(10 * hologram["predicted"], 1e-6)
    assert summary["measured_error"] <= (tolerance or 1e-3) and plan["tolerance"] == tolerance
    assert "Relative L2 error. hologram" in (tmp_path / "v" / "report.html").read_text()
    assert plan["predicted_seconds"] == pytest.approx(sum(plan["seconds_of"].values()), abs=0.05)


def test_a_tight_tolerance_takes_complex128(tmp_path, capsys):
    words = ["check", "configs/volume/tooth.yaml", *VOLUME, "device=cpu"]
    assert main(words) == 0 and "Precision  complex64" in capsys.readouterr().out
    assert main([*words, "tolerance=1e-6"]) == 0 and "Precision  complex128" in capsys.readouterr().out
