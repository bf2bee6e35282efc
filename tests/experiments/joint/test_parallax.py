"""Parts of the pupil: which are corrected and which are held back, and steps that take some of them at random."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from paths import CONFIGS
from tiny_runs import VOLUME, command

from holotorch.cli import main
from holotorch.experiments.joint.config import JointSettings
from holotorch.experiments.joint.evaluation import evaluate
from holotorch.experiments.joint.experiment import build
from holotorch.experiments.joint.methods import show
from holotorch.experiments.joint.plan import plan_values
from holotorch.experiments.joint.views import pupils
from holotorch.experiments.joint.views.sampled import Group, SampledViews
from holotorch.experiments.registry import load_config

FOCI, RADIUS = [6e-3, 8e-3, 11e-3], 0.02
SAMPLED = "eye={parallax: 12, per_step: 3}"


def experiment(*changes: str):
    words = ["volume={phantom: shells, samples: 24}", VOLUME[1], "view={width: 0.3 mm}", "device=cpu", "frames=2"]
    words += ["display={shape: [32, 28], pitch: 9 um, distance: 6 mm, depth: 8 mm, planes: 4}", "wavelengths=[520 nm]"]
    settings = load_config(CONFIGS / "joint" / "teapot.yaml", [*words, "report.baselines=[]", *changes])
    assert isinstance(settings, JointSettings)
    return build(settings)


def angle(one, other) -> float:
    """Angle in degrees between two vectors."""
    cosine = sum(a * b for a, b in zip(one, other, strict=True)) / math.hypot(*one) / math.hypot(*other)
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def test_corrected_parts_lie_in_the_pupil_and_keep_away_from_those_held_back():
    views = pupils.corrected_parts(FOCI, RADIUS, 400, seed=3)
    edges = [view for view in views if view.covered != (0.0, 0.0)]
    circles = [view for view in views if view.covered == (0.0, 0.0)]
    assert len(edges) == len(circles) == 200 and all(FOCI[0] <= view.focus <= FOCI[-1] for view in views)
    assert all(math.hypot(*view.centre) + view.radius <= RADIUS * (1 + 1e-12) for view in views)
    nearest = min(angle(view.covered, half.covered) for view in edges for half in pupils.halves(FOCI, RADIUS))
    assert 15 - 1e-9 <= nearest < 16  # and all other directions occur
    for corner in itertools.product((-1, 1), repeat=2):
        assert min(angle(view.covered, corner) for view in edges) < 5
    centres = [held.centre for held in pupils.held_parts(FOCI, RADIUS)]
    apart = min(math.dist(view.centre, centre) for view in circles for centre in centres) / RADIUS
    assert 0.15 <= apart < 0.2
    assert {view.radius for view in pupils.held_parts(FOCI, RADIUS)} == {RADIUS / 2}


def test_parts_are_those_of_the_seed_and_few_are_the_first_of_many():
    few, many = (pupils.corrected_parts(FOCI, RADIUS, count, seed=3) for count in (5, 9))
    assert few == many[:5] and few != pupils.corrected_parts(FOCI, RADIUS, 5, seed=4)


def test_a_step_takes_its_share_of_each_group_and_all_views_before_one_again():
    drawn: list[list[int]] = []
    made = experiment(SAMPLED)

    def record(views: list[int]):
        drawn.append(views)
        return made.problem(made.heat, made.trained.select(views), None)

    loss = SampledViews(record, [Group(range(3), 1), Group(range(3, 9), 2)], seed=5)
    for step in range(1, 6):
        loss.at_step(step)
    assert [len(views) for views in drawn] == [3] * 6
    for half in (drawn[:3], drawn[3:]):
        assert sorted(view for views in half for view in views) == list(range(9))
    assert drawn[:3] != drawn[3:]
    loss.at_step(2)
    assert drawn[-1] == drawn[2]  # whatever was drawn before


def test_the_loss_of_some_views_is_that_of_these_views_alone():
    made = experiment(SAMPLED)
    chosen = [5, 0, 9]
    alone = made.views([made.trained.operator.views[v] for v in chosen])
    torch.testing.assert_close(made.trained.select(chosen).images, alone.images)
    phase = 6 * torch.rand(2, 1, 32, 28, generator=torch.Generator().manual_seed(1))
    for x in (phase, phase.double()):
        some, own = (made.problem(made.heat, views, 4.0)(x) for views in (made.trained.select(chosen), alone))
        torch.testing.assert_close(some, own, rtol=1e-5, atol=0)


def test_steps_of_random_views_continue_where_they_were_interrupted():
    made = experiment(SAMPLED, "steps=8")
    states = []
    whole = made.solve(lambda solution: states.append(solution.state))
    torch.testing.assert_close(made.solve(resume=states[3]).x, whole.x, rtol=0, atol=0)
    assert len(whole.losses) == 9


@pytest.mark.usefixtures("tiny")
def test_a_run_of_random_views_is_complete_and_says_so(tmp_path, capsys):
    folder = tmp_path / "a"
    words = ["eye={parallax: 4, per_step: 2}", "report.baselines=[light_field, unheated]"]
    assert main(command("joint", folder, *words)) == 0
    page = (folder / "report.html").read_text()
    assert "half covered towards" in page and "one random view a step without heat" in page
    assert "Adam, 6 steps, each with 4 of the views at random" in capsys.readouterr().out


def test_random_views_hold_through_parts_that_fixed_views_of_the_same_time_do_not():
    """The first two solvers take the same number of views in all: 60 steps of 2 + 2, and 20 of 4 + 8."""
    sampled, fixed, whole = (
        evaluate(made, show(made, made.solve().x))[0]
        for made in (
            experiment("frames=6", "steps=60", "eye={parallax: 64, per_step: 2}"),
            experiment("frames=6", "steps=20", "eye.parallax=8"),
            experiment("frames=6", "steps=60"),
        )
    )
    assert sampled["part_psnr"] > fixed["part_psnr"] + 1 and fixed["part_psnr"] > whole["part_psnr"] + 1
    assert sampled["half_psnr"] > whole["half_psnr"] + 0.5


def test_the_predicted_memory_and_time_are_those_of_the_views_of_a_step():
    fixed, sampled = experiment("eye.parallax=12"), experiment(SAMPLED)
    one, other = plan_values(fixed), plan_values(sampled)
    assert one["views"] == other["views"] == 16
    assert other["predicted_peak_bytes"] < one["predicted_peak_bytes"]
    assert other["seconds_of"]["solver"] <= one["seconds_of"]["solver"]
    more = plan_values(replace(sampled, settings=sampled.settings.model_copy(update={"frames": 8})))
    assert more["predicted_peak_bytes"] > other["predicted_peak_bytes"]
