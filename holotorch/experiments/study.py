"""A study as a run: a folder with its table, a picture, and what it says in words."""

import sys
import time
from pathlib import Path
from typing import Any

import yaml

from holotorch.experiments.chart import write_table
from holotorch.experiments.config import StudySettings
from holotorch.experiments.environment import environment
from holotorch.experiments.markup import element
from holotorch.experiments.memory import peak_memory
from holotorch.experiments.pec_bench import Bench
from holotorch.experiments.pec_claims import with_claims
from holotorch.experiments.pec_studies import STUDIES
from holotorch.experiments.pictures import curves
from holotorch.experiments.run_folder import claim
from holotorch.io.files import write_bytes, write_json, write_text
from holotorch.metrics import PerceptualSimilarity


def run_study(settings: StudySettings, out: Path | None, name: str) -> tuple[Path, bool]:
    """Carry a study out and fill a folder as :func:`holotorch.experiments.run.run` does; False never comes back."""
    import torch

    folder = claim(out, name)
    (folder / "images").mkdir(exist_ok=True)
    write_text(folder / "config.yaml", yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
    write_json(folder / "env.json", environment(settings.seed, torch.device("cpu")))
    started = time.perf_counter()
    bench = Bench(images=settings.images, size=settings.size, perceptual=_perceptual())
    rows = with_claims(settings.study, STUDIES[settings.study](bench, settings.sweep, settings.max_steps))
    write_table(folder / "table.csv", rows)
    picture = curves(rows, f"{settings.study}: mean of {', '.join(settings.images)} at {settings.size} px")
    write_bytes(folder / "images" / "table.png", picture)
    text = table_text(rows)
    write_text(folder / "table.txt", text)
    page = element("title", settings.study) + element("h1", settings.study)
    page += "<img src='images/table.png'>" + element("pre", text)
    write_text(folder / "report.html", f"<!DOCTYPE html><meta charset='utf-8'>{page}")
    verdicts = [row["verdict"].split(":")[0] for row in rows if row["verdict"]]
    summary = {
        "experiment": settings.experiment,
        "study": settings.study,
        "status": "complete",
        "rows": len(rows),
        "verdicts": {verdict: verdicts.count(verdict) for verdict in dict.fromkeys(verdicts)},
        "seconds": round(time.perf_counter() - started, 1),
        "peak_memory_bytes": peak_memory(),
    }
    write_json(folder / "summary.json", summary)
    print(text)
    return folder, True


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
