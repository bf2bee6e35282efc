"""A study as a run: a folder with its table, a picture, and what it says in words."""

import sys
from pathlib import Path
from typing import Any

import torch

from holotorch.experiments.chart import write_table
from holotorch.experiments.config import StudySettings
from holotorch.experiments.fingerprint import fingerprint
from holotorch.experiments.markup import element
from holotorch.experiments.memory import peak_memory
from holotorch.experiments.pec_bench import Bench
from holotorch.experiments.pec_claims import with_claims
from holotorch.experiments.pec_studies import STUDIES
from holotorch.experiments.pictures import curves
from holotorch.experiments.run_folder import Run, conclude, open_run
from holotorch.experiments.saving import Checkpoint, Results
from holotorch.experiments.study_cases import Cases
from holotorch.io.files import write_bytes, write_text
from holotorch.metrics import PerceptualSimilarity


def run_study(settings: StudySettings, out: Path | None, name: str) -> tuple[Path, bool]:
    """Carry a study out and fill a folder; returns and raises as :func:`holotorch.experiments.run.run`.

    An interrupted one goes on after the last case that is complete.
    """
    bench = Bench(images=settings.images, size=settings.size, perceptual=_perceptual())
    with open_run(out, name, settings, torch.device("cpu"), settings.seed) as opened:
        return opened.path, _fill(opened, settings, bench)


def _fill(opened: Run, settings: StudySettings, bench: Bench) -> bool:
    folder, files = opened.path, Results()
    inputs = {"images": (bench.image,), "perceptual": ("none" if bench.perceptual is None else "LPIPS",)}
    cases = Cases(Checkpoint(folder / "checkpoint.pt", fingerprint(settings, inputs)))
    try:
        rows = with_claims(settings.study, STUDIES[settings.study](bench, settings.sweep, settings.max_steps, cases))
    except KeyboardInterrupt:
        if not cases.saved:
            raise
        summary = {"experiment": settings.experiment, "study": settings.study, "status": "", "cases": cases.saved}
        return conclude(opened, summary, files, None, done=False, checkpoint=cases.checkpoint)
    files.write(write_table, folder / "table.csv", rows)
    text = table_text(rows)
    files.write(write_text, folder / "table.txt", text)
    picture = curves(rows, f"{settings.study}: mean of {', '.join(settings.images)} at {settings.size} px")
    files.write(write_bytes, folder / "images" / "table.png", picture)
    page = element("title", settings.study) + element("h1", settings.study)
    page += "<img src='images/table.png'>" + element("pre", text)
    verdicts = [row["verdict"].split(":")[0] for row in rows if row["verdict"]]
    summary = {
        "experiment": settings.experiment,
        "study": settings.study,
        "status": "",
        "rows": len(rows),
        "verdicts": {verdict: verdicts.count(verdict) for verdict in dict.fromkeys(verdicts)},
        "seconds": round(cases.seconds, 1),
        "peak_memory_bytes": peak_memory(),
    }
    page = f"<!DOCTYPE html><meta charset='utf-8'>{page}"
    files.write(write_text, folder / "report.html", page)
    complete = conclude(opened, summary, files, None, done=True)
    print(text)
    return complete


def _perceptual() -> PerceptualSimilarity | None:
    """The learned similarity, if its extra is installed and its weights are at hand."""
    try:
        return PerceptualSimilarity()
    except ImportError:
        return None
    except OSError as error:
        print(f"LPIPS is left out: {error}", file=sys.stderr)
        return None


def table_text(rows: list[dict[str, Any]]) -> str:
    """Rows as a table of fixed columns, without those that are empty throughout."""
    names = [name for name in rows[0] if any(row[name] != "" for row in rows)]
    cells = [names, *([str(row[name]) for name in names] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(names))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in cells]
    return "\n".join(lines) + "\n"
