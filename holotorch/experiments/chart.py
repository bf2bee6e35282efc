"""Charts of speed against accuracy: every method on the same task, as a figure and a table."""

import warnings
from importlib import import_module
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.tables import write_table
from holotorch.io.files import write_bytes, write_text

# The module whose function ``subject`` draws the chart, and the name of its second table. Functions that return several
# further tables return them by name instead. The subjects whose full form takes the least time come first.
CHARTS = {
    "propagation": ("holotorch.experiments.propagation.chart", "prediction"),
    "stability": ("holotorch.experiments.stability.chart", ""),
    "volume": ("holotorch.experiments.volume.chart", "scaling"),
    "eye": ("holotorch.experiments.eye.chart", "tradeoff"),
    "retina": ("holotorch.experiments.eye.retina_chart", ""),
    "scaling": ("holotorch.experiments.scaling.chart", ""),
    "devices": ("holotorch.experiments.devices.chart", ""),
    "camera": ("holotorch.experiments.camera.chart", "corrected"),
    "pec": ("holotorch.experiments.pec_study.chart", "comparison"),
    "network": ("holotorch.experiments.network.chart", "training"),
    "joint": ("holotorch.experiments.joint.charts.chart", ""),
    "chain": ("holotorch.experiments.joint.charts.chain", ""),
    "tracking": ("holotorch.experiments.tracking_benchmark.chart", "grids"),
}
QUICK_FORM = "Quick form: smaller and fewer cases, no goal is tested"  # how the verdict of a quick chart begins


def chart(subject: str, out: Path, *, quick: bool = False) -> list[str]:
    """Write the figures, tables and verdict of a chart into the folder ``out``; returns the lines of the verdict.

    ``quick`` draws the reduced form of the subject, which takes seconds; its verdict says so and compares with no goal.
    """
    if subject not in CHARTS:
        raise ConfigError([f"no chart of {subject!r}; known: {', '.join(sorted(CHARTS))}"])
    module, second = CHARTS[subject]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError([f"cannot write to {out}: {error.strerror}; choose another place with --out"]) from None
    with warnings.catch_warnings():  # a subject may ignore warnings; the next one should not
        rows, further, figures, verdict = getattr(import_module(module), subject)(quick=quick)
    if quick:
        verdict = [f"{QUICK_FORM}. {verdict[0]}", *verdict[1:]]
    write_table(out / "chart.csv", rows)
    for name, table in (further if isinstance(further, dict) else {second: further}).items():
        write_table(out / f"{name}.csv", table)
    for name, data in figures.items():
        write_bytes(out / f"{name}.png", data)
    write_text(out / "verdict.txt", "\n".join(verdict) + "\n")
    return verdict


def description(subject: str) -> str:
    """What the chart of a subject shows, in one sentence."""
    return (import_module(CHARTS[subject][0]).__doc__ or "").splitlines()[0]
