"""The chart of propagation methods on a small scale, and the page of all charts; the real ones are committed."""

import csv
import inspect
import re
from dataclasses import replace
from importlib import import_module

import pytest

from holotorch.cli import main
from holotorch.experiments import chart as charts
from holotorch.experiments.chart import CHARTS, QUICK_FORM, Subject
from holotorch.experiments.chart_all import PAGE, chart_all
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.propagation import chart as chart_propagation
from holotorch.experiments.propagation.chart import Amount
from holotorch.experiments.runs.figures import pareto_front
from holotorch.experiments.timing import interleaved

SMALL = Amount(cases=((48, 8e-6), (64, 8e-6)), distances=(1e-3, 60e-3), shown=(64, 8e-6), predictions=3)


def test_a_small_chart_is_complete(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(chart_propagation, "FULL", SMALL)
    assert main(["chart", "propagation", "--out", str(tmp_path / "c")]) == 0
    names = {"chart.csv", "chart.png", "validity.png", "prediction.csv", "verdict.txt"}
    assert {path.name for path in (tmp_path / "c").iterdir()} == names
    with open(tmp_path / "c" / "chart.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    planned = [row for row in rows if row["method"].startswith("planned")]
    assert len(planned) == 2 * 2 * 2 * 4  # both precisions
    assert all(float(row["error"]) < 3 * chart_propagation.TOLERANCE for row in planned)
    assert "predicted error: true / predicted" in capsys.readouterr().out


def test_the_help_names_every_subject(capsys):
    with pytest.raises(SystemExit):
        main(["chart", "--help"])
    assert set(CHARTS) <= set(re.split(r"[,\s]+", capsys.readouterr().out))


@pytest.mark.usefixtures("undrawn")
def test_a_quick_chart_says_so_and_is_not_beside_the_committed_ones(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(chart_propagation, "QUICK", replace(SMALL, cases=(SMALL.shown,), predictions=2))
    monkeypatch.setattr(chart_propagation, "FULL", None)  # the quick form reads nothing of the full one
    monkeypatch.chdir(tmp_path)
    assert main(["chart", "propagation", "--quick"]) == 0
    verdict = (tmp_path / "runs/charts-quick/propagation/verdict.txt").read_text()
    assert verdict.startswith(f"{QUICK_FORM}. planned, tolerance 1e-3: worst error ")
    assert verdict in capsys.readouterr().out


@pytest.mark.parametrize("subject", CHARTS)
def test_every_subject_has_a_smaller_quick_form(subject):
    module = import_module(CHARTS[subject].module)
    assert inspect.signature(getattr(module, subject)).parameters["quick"].default is False
    if subject == "stability":  # its quick form takes every other value of the same sweeps
        return
    assert type(module.QUICK) is type(module.FULL) and module.QUICK != module.FULL


def drawn(name: str, goal: str = ""):
    """A stand-in for the function of a subject, with an escaped character in its verdict."""

    def draw(quick: bool):
        lines = [f"{name} <fast>", "on two threads", *([] if quick else [goal])]
        return [{"a": 1}], {f"table of {name}": [{"b": 2}]}, {"chart": b"png", "more": b"png"}, lines

    return draw


@pytest.fixture
def stand_ins(monkeypatch):
    """Subjects by name, each a function ``quick -> results`` in place of the real charts."""

    def use(**subjects):
        module = type(
            "module", (), {"__doc__": "Chart of a stand-in."} | {k: staticmethod(v) for k, v in subjects.items()}
        )
        for name in list(CHARTS):
            monkeypatch.delitem(charts.CHARTS, name)
        for name in subjects:
            monkeypatch.setitem(charts.CHARTS, name, Subject("a module"))
        monkeypatch.setattr(charts, "import_module", lambda _: module)

    return use


def fails(error: BaseException):
    def draw(quick: bool):
        raise error

    return draw


def test_all_charts_are_one_page_and_a_failure_stops_no_other(tmp_path, stand_ins, capsys):
    missing = fails(ConfigError(["PHOTOGRAPHS must name a folder"]))
    stand_ins(first=drawn("first"), bad=missing, broken=fails(KeyError("weights")), last=drawn("last"))
    assert main(["chart", "all", "--out", str(tmp_path), "--quick"]) == 1
    text = (tmp_path / PAGE).read_text()
    headings = re.findall("<h2>(.*?)</h2>", text)
    assert headings == ["first", "bad", "broken", "last"]
    assert "2 of 4 drawn" in text and "quick form" in text
    assert f'<p class="headline">{QUICK_FORM}. last &lt;fast&gt;</p>' in text
    assert "<details><summary>All of the verdict</summary><p>on two threads</p></details>" in text
    assert '<p class="warn">PHOTOGRAPHS must name a folder</p>' in text
    assert "KeyError: &#39;weights&#39;" in text
    assert 'src="last/chart.png"' in text and 'src="bad/chart.png"' not in text
    links = re.findall('href="(.*?)"', text)
    assert "last/table%20of%20last.csv" in links or "last/table of last.csv" in links
    assert all((tmp_path / link.replace("%20", " ")).is_file() for link in links)
    assert "bad: PHOTOGRAPHS must name a folder" in capsys.readouterr().err


def test_an_interruption_keeps_what_is_drawn(tmp_path, stand_ins):
    stand_ins(first=drawn("first"), second=fails(KeyboardInterrupt()), third=fails(AssertionError("not reached")))
    assert main(["chart", "all", "--out", str(tmp_path)]) == 130
    text = (tmp_path / PAGE).read_text()
    assert 'src="first/chart.png"' in text and "1 of 3 drawn" in text
    assert '<p class="warn">interrupted</p>' in text and '<p class="warn">not drawn yet</p>' in text
    assert "not reached" not in text


def test_a_page_of_charts_that_are_all_drawn_is_complete(tmp_path, stand_ins):
    stand_ins(only=drawn("only", goal="goal met"))
    outcomes = chart_all(tmp_path / "new")
    assert [outcome.problem for outcome in outcomes.values()] == [""]
    text = (tmp_path / "new" / PAGE).read_text()
    assert "drawn</span>" not in text and "quick form" not in text and "goal met" in text


def test_a_full_chart_says_first_what_it_takes(tmp_path, stand_ins, monkeypatch, capsys):
    stand_ins(only=drawn("only"))
    monkeypatch.setitem(charts.CHARTS, "only", Subject("a module", minutes=90, gigabytes=2.25))
    for free, little in ((4e9, ""), (2e9, ", but only 2.0 GB are free"), (None, "")):
        monkeypatch.setattr(charts, "available_memory", lambda free=free: free)
        charts.chart("only", tmp_path)
        assert capsys.readouterr().err == f"only: about 90 min of a CPU core and 2.2 GB of memory{little}\n"
    monkeypatch.setitem(charts.CHARTS, "only", Subject("a module"))
    charts.chart("only", tmp_path)
    assert capsys.readouterr().err == "only: minutes or hours (not measured); its memory has not been measured\n"
    monkeypatch.setitem(charts.CHARTS, "only", Subject("a module", gigabytes=2.25))
    charts.chart("only", tmp_path)
    assert capsys.readouterr().err == "only: minutes or hours (not measured) and 2.2 GB of memory\n"
    charts.chart("only", tmp_path, quick=True)
    assert capsys.readouterr().err == ""


def test_the_front_holds_what_no_other_point_beats():
    points = [(1.0, 0.5), (2.0, 0.5), (2.0, 0.1), (0.5, 0.9), (3.0, 0.2), (4.0, 0.05)]
    front = pareto_front(points)
    beaten = [a for a in points if any(b != a and b[0] <= a[0] and b[1] <= a[1] for b in points)]
    assert sorted(front) == sorted(set(points) - set(beaten)) and front == sorted(front)


def test_unknown_subject(tmp_path, capsys):
    assert main(["chart", "propagatoin", "--out", str(tmp_path)]) == 2
    assert (
        "no chart of 'propagatoin'; known: camera, chain, devices, eye, joint, network, pec, propagation, retina, "
        "scaling, stability, tracking, volume" in capsys.readouterr().err
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
