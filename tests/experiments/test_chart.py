"""The chart of propagation methods on a small scale; the real one is run by hand and committed."""

import csv

import pytest

from holotorch.cli import main
from holotorch.experiments.propagation import chart as chart_propagation
from holotorch.experiments.timing import interleaved


def test_a_small_chart_is_complete(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(chart_propagation, "CASES", ((48, 8e-6), (64, 8e-6)))
    monkeypatch.setattr(chart_propagation, "SHOWN", (64, 8e-6))
    monkeypatch.setattr(chart_propagation, "DISTANCES", (1e-3, 60e-3))
    monkeypatch.setattr(chart_propagation, "PREDICTION_CASES", 3)
    assert main(["chart", "propagation", "--out", str(tmp_path / "c")]) == 0
    names = {"chart.csv", "chart.png", "validity.png", "prediction.csv", "verdict.txt"}
    assert {path.name for path in (tmp_path / "c").iterdir()} == names
    with open(tmp_path / "c" / "chart.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    planned = [row for row in rows if row["method"].startswith("planned")]
    assert len(planned) == 2 * 2 * 2 * 4  # both precisions
    assert all(float(row["error"]) < 3 * chart_propagation.TOLERANCE for row in planned)
    assert "predicted error: true / predicted" in capsys.readouterr().out


def test_unknown_subject(tmp_path, capsys):
    assert main(["chart", "propagatoin", "--out", str(tmp_path)]) == 2
    assert (
        "no chart of 'propagatoin'; known: camera, chain, eye, joint, network, pec, propagation, stability, tracking, "
        "volume" in capsys.readouterr().err
    )


def test_contenders_take_turns():
    order: list[str] = []
    seconds = interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, rounds=2)
    assert order == ["a", "b"] * 3 and set(seconds) == {"a", "b"}


@pytest.mark.parametrize("kind", chart_propagation.SOURCES)
def test_sources_fill_what_they_promise(kind):
    from holotorch import Grid

    field = chart_propagation.source(kind, Grid(64, 8e-6))
    if kind in ("slm", "white"):
        assert (field.abs() - 1).abs().max() < 1e-12
    else:
        assert field[0].abs().max() < 1e-6 < field.abs().max()
