"""Signals while a checkpoint is written, and those that Python drops."""

import signal
import sys
import time

import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from holotorch.experiments.runs import saving
from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.runs.saving import Checkpoint
from holotorch.experiments.runs.signals import interruptible


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_torch_writes_takes_effect_when_the_file_is_whole(number, tmp_path, monkeypatch):
    """An exception within torch's writer ends the process by SIGABRT (a find of scripts/kills.py)."""
    save, checkpoint = torch.save, Checkpoint(tmp_path / "checkpoint.pt", {})
    went_on = []

    def interrupted(content, stream):
        signal.raise_signal(number)
        save(content, stream)
        went_on.append(True)

    monkeypatch.setattr(saving.torch, "save", interrupted)
    with interruptible() as signals, pytest.raises(KeyboardInterrupt):
        checkpoint.save({"step": 3, "x": torch.ones(5)})
    assert signals == [number] and went_on
    content = checkpoint.load()
    assert content and content["step"] == 3 and torch.equal(content["x"], torch.ones(5))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]


class Gone:
    """Python drops exceptions that are raised while it removes an object."""

    def __init__(self, error: type[BaseException] | None):
        self.error = error

    def __del__(self):
        if self.error:
            raise self.error
        signal.raise_signal(signal.SIGTERM)


def test_a_signal_that_python_drops_comes_again():
    with interruptible() as signals, pytest.raises(KeyboardInterrupt):
        Gone(None)
        end = time.monotonic() + 20
        while time.monotonic() < end:
            time.sleep(0.01)
    assert signals == [signal.SIGTERM]


def test_other_dropped_exceptions_are_reported_as_before(monkeypatch):
    dropped = []
    monkeypatch.setattr(sys, "unraisablehook", lambda args: dropped.append(args.exc_type))
    before = sys.unraisablehook
    with interruptible() as signals:
        Gone(ValueError)
    assert dropped == [ValueError] and not signals and sys.unraisablehook is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_figure_is_drawn_takes_effect_when_it_is_whole(number, monkeypatch):
    """An exception within the compiled part of matplotlib comes out as a ValueError (a find of scripts/kills.py)."""
    draw, drawn = Line2D.draw, []

    def interrupted(line, renderer):
        signal.raise_signal(number)
        draw(line, renderer)
        drawn.append(True)

    monkeypatch.setattr(Line2D, "draw", interrupted)
    figure = Figure()
    figure.add_artist(Line2D([0, 1], [0, 1], marker="o"))
    with pytest.raises(KeyboardInterrupt), interruptible() as signals:
        figure_png(figure)
    assert drawn == [True] and signals == [number]
