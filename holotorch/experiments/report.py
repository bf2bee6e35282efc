"""One static HTML page for one or more run folders."""

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.registry import KINDS, find_kind
from holotorch.experiments.runs.page import page, plain, render
from holotorch.experiments.runs.record import SUMMARIES, RunRecord
from holotorch.io.files import read_json, write_text

_NAMED = 3  # runs that the title of a page names


def write_report(folders: Sequence[Path], path: Path, more: Mapping[str, str] | None = None) -> None:
    """Write the page of run folders to ``path``. ConfigError for a folder without a run, or a run that cannot be read.

    ``more`` are further pages to link to: addresses relative to ``path`` by the texts of the links.
    """
    runs = [_read(folder) for folder in folders]
    parts = []
    for name in dict.fromkeys(run.kind for run, _ in runs):
        same_kind = [run for run, _ in runs if run.kind == name]
        parts += find_kind(name).comparison(same_kind) if len(same_kind) > 1 else []
    parts += [section for _, section in runs]
    parts += [render("links", more)] if more else []
    title = "holotorch: " + (", ".join(run.title for run, _ in runs) if len(runs) <= _NAMED else f"{len(runs)} runs")
    write_text(path, page(title, "\n".join(parts)))


def outcome_lines(folder: Path) -> list[str]:
    """The main numbers of a run in words, and where its pictures are; none for a folder without a summary.

    Those of an interrupted run are called "Unfinished", not "Result".

    ConfigError if the summary cannot be read.
    """
    lines = []
    if any((folder / name).is_file() for name in SUMMARIES):
        with _readable(folder):
            run = RunRecord(folder)
            lines += find_kind(run.kind).outcome(run.summary) if run.kind in KINDS else []
            if run.summary.get("status") == "interrupted":
                lines = [re.sub("^Result {5}", "Unfinished ", line) for line in lines]
            if (plan := folder / "plan.json").is_file():  # the plan itself is out of sight after a long run
                lines += [f"WARNING    {warning}" for warning in read_json(plan).get("warnings", [])]
    if any((folder / "images").glob("*.png")):
        lines.append(f"Pictures   {folder / 'images'}")
    return lines


def _read(folder: Path) -> tuple[RunRecord, str]:
    """The record of a run folder and its section of the page."""
    with _readable(folder):
        run = RunRecord(folder)
        if run.kind not in KINDS:
            existing = folder / "report.html"
            hint = f"; its own page is {existing}" if existing.is_file() else ""
            kinds = f"only those of {', '.join(KINDS)} can be shown together"
            raise ConfigError([f"{folder} holds a run of kind {run.kind}, and {kinds}{hint}"])
        run.load()
        environment = [[key, _environment(key, value)] for key, value in run.env.items()]
        repeat = render("repeat", f"holotorch run {run.folder / 'config.yaml'}", run.config, environment)
        return run, "\n".join([*find_kind(run.kind).section(run), repeat])


def _environment(key: str, value: Any) -> str:
    """A value of env.json as text; the command as a shell takes it."""
    return shlex.join(map(str, value)) if key == "command" and isinstance(value, list) else plain(value)


@contextmanager
def _readable(folder: Path) -> Iterator[None]:
    """Context manager that raises ConfigError for what reading the files of a damaged run raises."""
    try:
        yield
    except ConfigError:
        raise
    except (OSError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise ConfigError([f"{folder} holds a run that cannot be read: {type(error).__name__} {error}"]) from None
