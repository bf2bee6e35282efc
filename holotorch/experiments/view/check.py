"""``holotorch view DIR --check``: time of the pictures for each control, compared with two bare transforms."""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch

from holotorch.core.fourier import fft2, ifft2
from holotorch.experiments.view.controls import Slider, checked
from holotorch.experiments.view.viewer import Viewer

_PICTURES = 5  # of each control


def check(viewer: Viewer, show: Callable[[str], None] = print) -> None:
    """Print the pictures per second while a control moves, and the seconds of a picture at rest, for each control."""
    start = checked(viewer.controls, {})
    with torch.no_grad():
        viewer.show(start, False, _proceed)  # fills the caches
        for control in viewer.controls:
            if isinstance(control, Slider):
                values = [control.low + (control.high - control.low) * (0.3 + 0.05 * k) for k in range(2 * _PICTURES)]
            else:
                options = list(control.options)
                values = [options[k % len(options)] for k in range(2 * _PICTURES)]
            moving = median(_seconds(viewer, start | {control.name: value}, True) for value in values[:_PICTURES])
            resting = median(_seconds(viewer, start | {control.name: value}, False) for value in values[_PICTURES:])
            bare = median(_bare_seconds(viewer) for _ in range(_PICTURES))
            ratio = f"{moving / bare:.1f} times two bare transforms" if bare else ""
            name = f"{control.label[:28]:28}"
            show(f"{name} {1 / moving:6.1f} pictures/s while it moves, {1e3 * resting:6.0f} ms at rest; {ratio}")


def _seconds(viewer: Viewer, values: dict[str, Any], coarse: bool) -> float:
    started = time.perf_counter()
    viewer.show(values, coarse, _proceed)
    return time.perf_counter() - started


def _bare_seconds(viewer: Viewer) -> float:
    """Seconds of a pair of transforms without anything else, of the size of those behind a picture."""
    field = torch.randn(*viewer.transforms, dtype=torch.complex64)
    started = time.perf_counter()
    ifft2(fft2(field))
    return time.perf_counter() - started


def _proceed() -> None:
    """Do nothing, since no request replaces these pictures."""
