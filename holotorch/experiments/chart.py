"""Charts of speed against accuracy: every method on the same task, as a figure and a table."""

import sys
import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from holotorch.core.memory import available_memory
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.planning.duration import duration
from holotorch.experiments.runs.tables import write_table
from holotorch.io.files import write_bytes, write_text


@dataclass(frozen=True)
class Subject:
    """What draws a chart, and what its full form takes; the quick form takes a minute or two.

    ``module`` has a function of the subject's name. ``table`` is the name of its second table; functions that return
    several further tables return them by name instead. ``minutes`` of one CPU core and ``gigabytes`` (1e9 bytes, of the
    largest process, at the peak) were measured as by ``python scripts/predictions.py --charts``, those of ``chain``
    by its own table ``cost``; None: not measured.
    """

    module: str
    table: str = ""
    minutes: float | None = None
    gigabytes: float | None = None

    @property
    def cost(self) -> str:
        """Time and memory of the full form in words, and whether the memory is not free."""
        cost = (
            f"about {duration(60 * self.minutes)} of a CPU core" if self.minutes else "minutes or hours (not measured)"
        )
        if self.gigabytes is None:
            return f"{cost}; its memory has not been measured"
        free = available_memory()
        little = f", but only {free / 1e9:.1f} GB are free" if free is not None and free < self.gigabytes * 1e9 else ""
        return f"{cost} and {self.gigabytes:.1f} GB of memory{little}"


# In the order in which all of them are drawn.
CHARTS = {
    "propagation": Subject("holotorch.experiments.propagation.chart", "prediction", minutes=17.5, gigabytes=12.6),
    "stability": Subject("holotorch.experiments.stability.chart", minutes=1.9, gigabytes=0.84),
    "volume": Subject("holotorch.experiments.volume.chart", "scaling", minutes=12.7, gigabytes=4.4),
    "eye": Subject("holotorch.experiments.eye.chart", "tradeoff", minutes=7.6, gigabytes=8.3),
    "retina": Subject("holotorch.experiments.eye.retina_chart", minutes=19, gigabytes=12.2),
    "scaling": Subject("holotorch.experiments.scaling.chart", minutes=1.7, gigabytes=0.83),
    "devices": Subject("holotorch.experiments.devices.chart", minutes=6.2, gigabytes=5.8),
    "camera": Subject("holotorch.experiments.camera.chart", "corrected", minutes=9.7, gigabytes=0.73),
    "pec": Subject("holotorch.experiments.pec_study.chart", "comparison", minutes=13, gigabytes=0.44),
    "network": Subject("holotorch.experiments.network.chart", "training", minutes=6.6, gigabytes=0.67),
    "joint": Subject("holotorch.experiments.joint.charts.chart", minutes=33, gigabytes=0.89),
    "whole": Subject("holotorch.experiments.joint.charts.whole", minutes=33, gigabytes=0.89),
    "chain": Subject("holotorch.experiments.joint.charts.chain", gigabytes=4.8),
    "tracking": Subject("holotorch.experiments.tracking_benchmark.chart", "grids", minutes=90, gigabytes=1.2),
}
QUICK_FORM = "Quick form: smaller and fewer cases, no goal is tested"  # how the verdict of a quick chart begins


def chart(subject: str, out: Path, *, quick: bool = False) -> list[str]:
    """Write the figures, tables and verdict of a chart into the folder ``out``; returns the lines of the verdict.

    ``quick`` draws the reduced form of the subject, which takes seconds; its verdict says so and compares with no goal.
    """
    if subject not in CHARTS:
        raise ConfigError([f"no chart of {subject!r}; known: {', '.join(sorted(CHARTS))}"])
    drawing = CHARTS[subject]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError([f"cannot write to {out}: {error.strerror}; choose another place with --out"]) from None
    if not quick:
        print(f"{subject}: {drawing.cost}", file=sys.stderr, flush=True)
    with warnings.catch_warnings():  # a subject may ignore warnings; the next one should not
        rows, further, figures, verdict = getattr(import_module(drawing.module), subject)(quick=quick)
    if quick:
        verdict = [f"{QUICK_FORM}. {verdict[0]}", *verdict[1:]]
    write_table(out / "chart.csv", rows)
    for name, table in (further if isinstance(further, dict) else {drawing.table: further}).items():
        write_table(out / f"{name}.csv", table)
    for name, data in figures.items():
        write_bytes(out / f"{name}.png", data)
    write_text(out / "verdict.txt", "\n".join(verdict) + "\n")
    return verdict


def description(subject: str) -> str:
    """What the chart of a subject shows, in one sentence."""
    return (import_module(CHARTS[subject].module).__doc__ or "").splitlines()[0]
