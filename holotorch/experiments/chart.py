"""Charts of speed against accuracy: every method on the same task, as a figure and a table."""

from importlib import import_module
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.tables import write_table
from holotorch.io.files import write_bytes, write_text

# The module whose function ``subject`` draws the chart, and the name of its second table. Functions that return several
# further tables return them by name instead.
CHARTS = {
    "camera": ("holotorch.experiments.camera.chart", "corrected"),
    "chain": ("holotorch.experiments.joint.chain", ""),
    "eye": ("holotorch.experiments.eye.chart", "tradeoff"),
    "joint": ("holotorch.experiments.joint.chart", ""),
    "network": ("holotorch.experiments.network.chart", "training"),
    "pec": ("holotorch.experiments.pec_study.chart", "comparison"),
    "propagation": ("holotorch.experiments.propagation.chart", "prediction"),
    "stability": ("holotorch.experiments.stability.chart", ""),
    "tracking": ("holotorch.experiments.tracking_benchmark.chart", "grids"),
    "volume": ("holotorch.experiments.volume.chart", "scaling"),
}


def chart(subject: str, out: Path) -> list[str]:
    """Write the figures, tables and verdict of a chart into the folder ``out``; returns the lines of the verdict."""
    if subject not in CHARTS:
        raise ConfigError([f"no chart of {subject!r}; known: {', '.join(CHARTS)}"])
    module, second = CHARTS[subject]
    draw = getattr(import_module(module), subject)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError([f"cannot write to {out}: {error.strerror}; choose another place with --out"]) from None
    rows, further, figures, verdict = draw()
    write_table(out / "chart.csv", rows)
    for name, table in (further if isinstance(further, dict) else {second: further}).items():
        write_table(out / f"{name}.csv", table)
    for name, data in figures.items():
        write_bytes(out / f"{name}.png", data)
    write_text(out / "verdict.txt", "\n".join(verdict) + "\n")
    return verdict
