"""Figures of a run: what is written on them fits, covers nothing, and explains what a reader would stumble over."""

import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from holotorch.experiments import pictures


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were drawn, laid out."""
    figures = []

    def keep(figure):
        FigureCanvasAgg(figure).draw()
        figures.append(figure)
        return b""

    monkeypatch.setattr(pictures, "_png", keep)
    return figures


@pytest.mark.parametrize(("height", "width"), [(96, 192), (64, 64), (40, 20)])
def test_captions_stay_inside_and_scores_stay_whole(height, width, drawn):
    captions = [
        "Target",
        "Corrected, all errors alike, SSIM 0.548",
        "Corrected, on a chip that stands alone, SSIM 0.467",
    ]
    pictures.comparison([torch.rand(3, height, width)] * 3, captions)
    (figure,) = drawn
    for axes, caption in zip(figure.axes, captions, strict=True):
        place = axes.title.get_window_extent()
        assert figure.bbox.y1 - place.y1 > 5 and place.y0 > axes.get_window_extent().y1
        what, _, score = caption.partition(", SSIM ")
        assert axes.get_title().splitlines()[-1] == (f"SSIM {score}" if score else what)
