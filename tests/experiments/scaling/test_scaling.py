"""The model of many processes against closed forms, and the measurement on two processes at a tiny size."""

import csv
import math

import pytest

from holotorch.cli import main
from holotorch.experiments.scaling import chart as chart_scaling
from holotorch.experiments.scaling.chart import MODEL, QUICK
from holotorch.experiments.scaling.measurement import Case, Measured, measure
from holotorch.experiments.scaling.model import Cluster, Link, Work
from holotorch.experiments.scaling.tasks import Display, largest_part, largest_share, tasks

PHANTOM = "volume={phantom: shells, samples: 8}"
HOLOGRAM = "hologram={shape: [32, 32], pitch: 3.74 um, distance: 3 mm, depths: 4, rays: 16}"
DISPLAY = "display={shape: [24, 20], pitch: 9 um, distance: 2 mm, depth: 2 mm, planes: 2}"
TINY = (
    Case("volume", "configs/volume/c60.yaml", (PHANTOM, HOLOGRAM), 1),
    Case("pec", "configs/pec/fourier.yaml", ("grid.shape=[24,20]", "solver={kind: apg, max_steps: 3}"), 3),
    Case("joint", "configs/joint/teapot.yaml", (PHANTOM, DISPLAY, "view={width: 0.2 mm}", "frames=2", "steps=3"), 3),
)


def test_sums_take_the_time_of_a_ring_and_of_a_tree():
    link = Link(bandwidth=1e9, latency=1e-3)
    assert link.all_reduce(1e9, 5, 1) == 0
    assert link.all_reduce(1e9, 5, 2) == pytest.approx(1 + 5e-3)
    assert link.all_reduce(1e9, 5, 8) == pytest.approx(2 * 7 / 8 + 15e-3)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7, 24, 100])
def test_the_largest_share_is_at_least_the_mean_and_a_whole_unit(count):
    for largest, outer in ((largest_part, 29), (largest_share, 8)):
        units = 3 * outer
        assert max(1, units / count) <= largest(outer, 3, count) <= math.ceil(outer / max(1, count // 3)) * 3


def test_seconds_of_equal_units_without_anything_repeated_fall_as_their_number_in_a_share():
    work = Work("ten", 10, lambda count: math.ceil(10 / count), 20.0, 0.0, 0.0, 0, rounds=2)
    free = Link(math.inf, 0.0)
    assert [sum(work.seconds(count, free).values()) for count in (1, 2, 3, 10, 11)] == [40, 20, 16, 4, 4]


def test_reading_is_bound_by_each_process_and_then_by_the_storage():
    work, cluster = Work("read", 1, lambda _: 1, 0.0, 0.0, 0.0, 0, file=1e9), Cluster(reading=1e9, storage=4e9)
    assert [work.seconds(count, cluster.link(count), cluster)["reading"] for count in (1, 4, 8)] == [1, 1, 2]


def test_no_large_task_is_faster_than_its_largest_share_and_repeated_part_allow():
    cluster = Cluster()
    for work in tasks(cluster, Display()):
        alone = work.seconds(1, cluster.link(1), cluster)
        assert alone["exchange"] == 0 and alone["divided"] == pytest.approx(work.rounds * work.divided)
        for count in (2, 8, 64, 512):
            parts = work.seconds(count, cluster.link(count), cluster)
            assert parts["repeated"] == alone["repeated"] and parts["exchange"] > 0
            assert parts["divided"] >= alone["divided"] / min(count, work.units) * (1 - 1e-12)


def test_two_processes_are_measured_beside_one(tmp_path):
    measured, link = measure(TINY, 1)
    assert link.bandwidth > 0 and link.latency > 0
    assert [each.work.units for each in measured] == [4 * 3, 3, 2 * 3]
    for each in measured:
        assert each.error < 1e-6
        assert len(each.alone) == len(each.together) == 1 and each.work.divided > 0
        assert each.speedup == each.alone[0] / each.together[0]
        # One process is described by its own parts.
        parts = each.work.seconds(1, link)
        assert sum(parts.values()) == pytest.approx(max(each.working[0], parts["divided"]))


def test_the_chart_says_what_is_measured_and_what_is_not(tmp_path, monkeypatch, capsys):
    work = Work("a task", 4, lambda count: math.ceil(4 / count), 0.8, 0.2, 1e6, 1, rounds=10)
    measured = [Measured(work, [10.0, 10.0], [6.0, 8.0], (9.0, 6.0), 1e-8)]
    monkeypatch.setattr(chart_scaling, "measure", lambda cases, repetitions: (measured, Link(1e9, 1e-3)))
    monkeypatch.setattr(chart_scaling, "FULL", QUICK)
    assert main(["chart", "scaling", "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        *("chart.csv", "model.csv", "assumptions.csv", "chart.png", "verdict.txt")
    }
    with open(tmp_path / "chart.csv", newline="") as stream:
        one, two = csv.DictReader(stream)
    assert float(two["speedup"]) == pytest.approx((10 / 6 + 10 / 8) / 2, abs=1e-3)
    assert float(two["model_seconds"]) == pytest.approx(10 * (0.4 + 0.2 + 2e-3), rel=1e-3)
    with open(tmp_path / "model.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 3 * len(QUICK.counts) and {row["what"] for row in rows} == {MODEL}
    said = capsys.readouterr().out
    assert "a task: two processes 1.46 times as fast as one (1.25 to 1.67 in 2 repetitions), 1.50 by the time" in said
    assert sum(line.startswith(f"{MODEL}: ") for line in said.splitlines()) == 3
