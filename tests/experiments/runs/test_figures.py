"""Figures of a run: what is written on them fits, covers nothing, and explains what a reader would stumble over."""

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from paths import CONFIGS

from holotorch import Grid
from holotorch.correction import LBFGS, PECProblem, penalty_schedule, run_stages
from holotorch.experiments.pec.weight import eccentricities, weight_map
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs import figures
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer

PERIPHERAL = CONFIGS / "pec" / "peripheral.yaml"


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were drawn, laid out."""
    kept = []

    def keep(figure):
        FigureCanvasAgg(figure).draw()
        kept.append(figure)
        return b""

    monkeypatch.setattr(figures, "figure_png", keep)
    return kept


@pytest.mark.parametrize(("height", "width"), [(96, 192), (64, 64), (40, 20)])
def test_captions_stay_inside_and_scores_stay_whole(height, width, drawn):
    captions = [
        "Target",
        "Corrected, all errors alike, SSIM 0.548",
        "Corrected, on a chip that stands alone, SSIM 0.467",
    ]
    figures.comparison([torch.rand(3, height, width)] * 3, captions)
    (figure,) = drawn
    for axes, caption in zip(figure.axes, captions, strict=True):
        place = axes.title.get_window_extent()
        assert figure.bbox.y1 - place.y1 > 5 and place.y0 > axes.get_window_extent().y1
        what, _, score = caption.partition(", SSIM ")
        assert axes.get_title().splitlines()[-1] == (f"SSIM {score}" if score else what)


def test_a_second_stage_is_named_and_the_legend_covers_no_curve(drawn):
    """L-BFGS begins with the amplitude's error, for a sixth of its steps; the intensity's is another number."""
    torch.manual_seed(0)
    target = torch.rand(3, 24, 24)
    target = target / target.mean((-2, -1), keepdim=True)
    crosstalk, propagator = ThermalCrosstalk(sigma_px=0.66), Fraunhofer(Grid((24, 24), 9e-6), (630e-9, 530e-9, 445e-9))
    make = lambda **more: PECProblem(crosstalk, propagator, target, **more)  # noqa: E731
    solver = LBFGS(max_steps=60, tolerance=0.0)
    found = run_stages(penalty_schedule(make, solver, crosstalk.total, None), 6 * torch.rand(3, 24, 24))
    figures.convergence(found.losses, ["a", "b", "c"], [(10, 0.3), (60, 0.5)], "ssim")
    plain = LBFGS(max_steps=20, tolerance=0.0)(make(), 6 * torch.rand(3, 24, 24))
    figures.convergence(plain.losses, ["a", "b", "c"], [], "ssim")
    both, one = drawn
    assert "up to step 10 (dotted)" in both.axes[0].get_title() and not one.axes[0].get_title()
    # No line leads from one loss to the other.
    assert all(len(line.get_xdata()) in (11, 50, 2) for line in both.axes[0].lines)
    legend = both.legends[0].get_window_extent()
    assert legend.y0 >= both.axes[0].get_window_extent().y1 and legend.y1 <= both.bbox.y1


def test_losses_that_only_waver_are_one_stage():
    wavering = torch.tensor([[1, 1], [2.3, 0.8], [0.3, 2], [0.9, 3.5], [0.2, 0.1]]).double().numpy()
    assert figures._next_stage(wavering) is None


def test_a_weight_is_drawn_in_degrees_with_the_rings_of_the_zones(drawn):
    weight = load_config(PERIPHERAL, ["target.weight.gaze_deg=[10,-20]"]).target.weight
    away = eccentricities(weight, (96, 192))
    figures.visual_field(weight_map(weight, (96, 192)), away, weight.field_deg, [8, 30, 60, 170], "weight")
    (figure,) = drawn
    axes = figure.axes[0]
    assert (axes.get_xlim(), axes.get_ylim()) == ((-70, 70), (-35, 35))
    assert {text.get_text() for text in axes.texts} == {"8 deg", "30 deg", "60 deg"}
    # The smallest ring lies around the gaze, 10 deg up and 20 deg to the left.
    near = axes.collections[0].get_paths()[0].vertices - (-20, 10)
    assert np.hypot(*near.T) == pytest.approx(8, abs=0.5)
