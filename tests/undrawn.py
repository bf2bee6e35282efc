"""Runs without figures, which take longer than tiny runs do."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from holotorch.experiments.runs import figures


class Blank:
    """A canvas that draws nothing."""

    def __init__(self, figure):
        pass

    def print_png(self, buffer):
        """Leave the picture empty."""


@contextmanager
def without_figures() -> Iterator[None]:
    """Runs within draw no figures; the files of these are empty."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("comparison", "channel_maps", "convergence", "picture_table", "visual_field"):
            patch.setattr(figures, name, lambda *_, **__: b"")
        patch.setattr(figures, "FigureCanvasAgg", Blank)
        yield
