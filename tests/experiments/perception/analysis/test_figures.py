import dataclasses
import math

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from holotorch.experiments.perception.analysis import figures
from holotorch.experiments.perception.analysis.config import CleaningSettings, SimulationSettings
from holotorch.experiments.perception.analysis.curves import Times, equal_efficiency, fit_curves, perception_times
from holotorch.experiments.perception.analysis.simulation import simulate
from holotorch.experiments.perception.analysis.statistics import fit_line

POWER = [{"alpha": 0.2, "participants": n, "power": 0.5, "error": 0.1} for n in (8, 16)]


def made():
    times = perception_times(simulate(SimulationSettings(participants=8), np.random.default_rng(5)), CleaningSettings())
    curves = fit_curves(times, 40, 3)
    scales = equal_efficiency(curves, np.full(8, 0.45), (1, 60))

    def line(limits):
        return fit_line(
            curves.eccentricities,
            scales.degrees,
            np.random.default_rng(0),
            inside=curves.eccentricities <= 70,
            limits=limits,
            resamples=100,
            confidence=0.9,
        )

    shown = [("450 ms", line(limits)) for limits in ((1, 60), (59, 60))]
    assert not shown[0][1].refused and shown[1][1].refused
    return times, curves, shown


@pytest.fixture
def titles(monkeypatch):
    seen: list[str] = []
    original = Figure.suptitle
    monkeypatch.setattr(Figure, "suptitle", lambda self, t, **words: (seen.append(t), original(self, t, **words))[1])
    return seen


def draw(times, curves, shown):
    yield figures.time_surface(times)
    yield figures.time_map(times, shown, (40, 70), (5, 26))
    yield figures.single_participant(times, curves, 0)
    yield figures.time_slices(times)
    yield figures.scale_lines(times, shown, (40, 70), (5, 26), 0.9)


def test_every_picture_of_simulated_people_says_so(titles):
    times, curves, shown = made()
    for data in (*draw(times, curves, shown), figures.power_curves(POWER, 0.95)):
        assert data.startswith(b"\x89PNG")
    assert len(titles) == 6 and all("simulated" in title for title in titles)
    titles.clear()
    assert figures.time_slices(dataclasses.replace(times, simulated=False))
    assert titles == ["Perception time over eccentricity"]


def test_no_interval_is_drawn_of_too_few_people():
    """Four of them: bars of no length would claim to know the medians."""
    _, curves, _ = made()
    scales = np.exp(np.random.default_rng(2).normal(2.5, 0.2, (5, len(curves.eccentricities))))
    inside = np.ones(len(curves.eccentricities), dtype=bool)
    for people, words in ((4, "median"), (5, "median and 90 % interval")):
        line = fit_line(
            curves.eccentricities,
            scales[:people],
            np.random.default_rng(0),
            inside=inside,
            limits=(1, 60),
            resamples=100,
            confidence=0.9,
        )
        axes = Figure().add_subplot()
        figures._points(axes, line, (40, 80), 0.9)
        assert words in axes.get_legend_handles_labels()[1]
        (bars,) = [part for part in axes.collections if isinstance(part, LineCollection)]
        lengths = [np.ptp(bar[:, 1]) for bar in bars.get_segments() if bar.size and np.isfinite(bar).all()]
        assert len([length for length in lengths if length > 0]) == (0 if people < 5 else len(inside))
        assert 0 not in lengths


def test_the_surface_goes_through_the_medians_and_not_beyond_the_sizes():
    seconds = np.full((3, 2, 3), np.nan)
    seconds[:, 0, :2] = [[0.3, 0.2], [0.4, 0.3], [0.5, 0.4]]
    seconds[:, 1] = [[0.6, 0.5, 0.4]] * 3
    sizes = np.array([5.0, 10, 20])
    times = Times(np.arange(3), np.array([10.0, 50]), sizes, seconds, np.ones((3, 2, 3), dtype=int), {})
    fine, levels = figures.surface(times, (0.5, 1.0))
    at = {size: int(np.flatnonzero(fine == size)[0]) for size in (5.0, 10.0, 20.0)}
    assert levels[0, 0, at[5.0]] == pytest.approx(400) and levels[1, 0, at[10.0]] == pytest.approx(400)
    assert math.isnan(levels[0, 0, at[20.0]]) and levels[0, 1, at[20.0]] == pytest.approx(400)
    k = int(np.argmin(np.abs(fine - 7)))
    assert levels[0, 0, k] == pytest.approx(400 - 100 * math.log(fine[k] / 5) / math.log(2))
