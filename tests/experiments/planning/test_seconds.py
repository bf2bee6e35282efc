"""Predicted seconds of whole runs of kind pec and joint: all parts are there, and grow with the work."""

from typing import get_args

import pytest
from paths import CONFIGS

from holotorch.experiments.execute import check
from holotorch.experiments.joint.config import Baseline as JointBaseline
from holotorch.experiments.pec.config import Baseline
from holotorch.experiments.planning import machine
from holotorch.experiments.planning.machine import Machine
from holotorch.experiments.registry import load_config

WORDS = {
    "pec": ["device=cpu", "grid.shape=[64, 64]", "report.baselines=[]", "solver.max_steps=50"],
    "joint": ["device=cpu", "volume={phantom: shells, samples: 8}", "view={width: 0.2 mm}", "report.baselines=[]",
              "display={shape: [32, 32], pitch: 9 um, distance: 2 mm, depth: 2 mm, planes: 2}", "steps=50"],
}  # fmt: skip
FILES = {"pec": CONFIGS / "pec" / "fourier.yaml", "joint": CONFIGS / "joint" / "teapot.yaml"}
STEPS = {"pec": "solver.max_steps=100", "joint": "steps=100"}
WEIGHT = "target.weight={kind: peripheral, field_deg: 90}"
BASELINES = [("pec", name) for name in get_args(Baseline)] + [("joint", name) for name in get_args(JointBaseline)]


@pytest.fixture(autouse=True)
def _reference(monkeypatch):
    """The reference machine, so that the numbers are those of the constants."""
    for module in ("pec", "joint"):
        monkeypatch.setattr(f"holotorch.experiments.{module}.plan.machine_speed", lambda *_: Machine())


def seconds(kind: str, *words: str) -> dict[str, float]:
    values = check(load_config(FILES[kind], [*WORDS[kind], *words])).values
    assert values["predicted_seconds"] == pytest.approx(sum(values["seconds_of"].values()), abs=0.05)
    return values["seconds_of"]


@pytest.mark.parametrize("kind", WORDS)
def test_a_plan_counts_start_up_and_figures_and_says_so(kind):
    plan = check(load_config(FILES[kind], WORDS[kind]))
    assert plan.values["seconds_of"]["start-up and figures"] > 3
    assert "s start-up and figures" in plan.text and "without start-up" not in plan.text


@pytest.mark.parametrize("kind", WORDS)
def test_twice_the_steps_take_twice_as_long_and_the_figures_do_not(kind):
    once, twice = seconds(kind), seconds(kind, STEPS[kind])
    assert twice["solver"] == pytest.approx(2 * once["solver"], rel=0.2)
    assert twice["start-up and figures"] == once["start-up and figures"]


def test_large_pictures_take_longer_to_draw_and_to_score():
    small, large = (seconds("pec", f"grid.shape=[{n}, {n}]") for n in (128, 1024))
    assert large["start-up and figures"] > small["start-up and figures"] + 2
    assert large["evaluation"] > 64 * small["evaluation"] > 0
    assert machine.Machine().score(100, double=True) == 2 * machine.Machine().score(100, double=False)


@pytest.mark.parametrize(("kind", "name"), BASELINES)
def test_every_method_of_comparison_has_its_time(kind, name):
    more = [WEIGHT] if name == "unweighted" else ["frames=4"] if kind == "joint" else []
    alone, compared = seconds(kind, *more), seconds(kind, *more, f"report.baselines=[{name}]")
    assert sum(compared.values()) > sum(alone.values())
