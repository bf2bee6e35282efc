"""Run of kind ``pec_study``: writes the table of a study as CSV and text, and as a picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from holotorch.experiments.pec_study.bench import Bench
from holotorch.experiments.pec_study.cases import Cases
from holotorch.experiments.pec_study.config import StudySettings
from holotorch.experiments.pec_study.studies import STUDIES
from holotorch.experiments.pec_study.times import times_picture
from holotorch.experiments.runs.figures import curves
from holotorch.experiments.runs.fingerprint import fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.tables import write_table
from holotorch.io.files import write_bytes, write_text

_FEW = 4  # pictures that the title of a figure names


@dataclass(frozen=True)
class Study:
    """A study and the bench with its photographs."""

    settings: StudySettings
    bench: Bench


def build_study(settings: StudySettings) -> Study:
    """A study with the bench for its photographs."""
    return Study(settings, Bench(images=settings.images, size=settings.size))


def run_study(study: Study, opened: RunFolder) -> bool:
    """Run the missing cases of a study, fill the folder and print the table. True if the study is complete."""
    settings, bench = study.settings, study.bench
    folder, files = opened.path, Results()
    inputs = {"images": (bench.experiment.image,)}
    cases = Cases(Checkpoint(folder / "checkpoint.pt", fingerprint(settings, inputs)))
    summary: dict[str, Any] = {"experiment": settings.experiment, "study": settings.study, "status": ""}
    try:
        for row in STUDIES[settings.study](bench, settings.sweep, settings.max_steps, cases):
            cases.rows.append(row)
    except KeyboardInterrupt:
        if not cases.saved:
            raise
        return conclude(opened, summary | {"cases": cases.saved}, files, done=False, checkpoint=cases.checkpoint)
    rows, text = cases.rows, table_text(cases.rows)
    files.write(write_table, folder / "table.csv", rows)
    files.write(write_text, folder / "table.txt", text)
    draw = times_picture if settings.study == "time" else curves
    picture = draw(rows, f"{settings.study}: mean of {_named(settings.images)} at {settings.size} px")
    files.write(write_bytes, folder / "images" / "table.png", picture)
    summary |= {"rows": len(rows), "seconds": round(cases.seconds, 1), "peak_memory_bytes": peak_memory()}
    complete = conclude(opened, summary, files, done=True)
    print(text)
    return complete


def _named(images: Sequence[str]) -> str:
    """Names of a few pictures, or how many there are."""
    return ", ".join(Path(image).stem for image in images) if len(images) <= _FEW else f"{len(images)} photographs"


def table_text(rows: list[dict[str, Any]]) -> str:
    """Rows as a table of aligned columns, without the columns that are empty."""
    names = [name for name in rows[0] if any(row[name] != "" for row in rows)]
    cells = [names, *([str(row[name]) for name in names] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(names))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in cells]
    return "\n".join(lines) + "\n"
