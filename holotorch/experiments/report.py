"""One static HTML page for one or more run folders: pictures inline, no scripts, opens from disk years later."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.registry import KINDS, find_kind
from holotorch.experiments.runs.markup import element, plain, table
from holotorch.experiments.runs.page import page
from holotorch.experiments.runs.record import RunRecord
from holotorch.io.files import write_text


def write_report(folders: Sequence[Path], path: Path, more: Mapping[str, str] | None = None) -> None:
    """Write the page of ``folders`` to ``path``. ConfigError for a folder that holds no run.

    ``more``: pages to point to, where each lies seen from ``path``, by what they show.
    """
    runs = [_read(folder) for folder in folders]
    body = []
    for name in dict.fromkeys(run.kind for run, _ in runs):
        several = [run for run, _ in runs if run.kind == name]
        body += find_kind(name).comparison(several) if len(several) > 1 else []
    body += [section for _, section in runs]
    links = [f'<li><a href="{html.escape(place)}">{html.escape(what)}</a></li>' for what, place in (more or {}).items()]
    body += ["<h2>More</h2>", "<ul>", *links, "</ul>"] if links else []
    title = "holotorch: " + (runs[0][0].title if len(runs) == 1 else f"{len(runs)} runs")
    write_text(path, page(title, "\n".join(body)))


def _read(folder: Path) -> tuple[RunRecord, str]:
    """What a run folder says of itself, and its part of the page."""
    try:
        run = RunRecord(folder)
        if run.kind not in KINDS:
            raise ConfigError([_other(folder, run.kind)])
        run.load()
        section = find_kind(run.kind).section(run)
        return run, "\n".join(section + _repeat(run))
    except ConfigError:
        raise
    except (OSError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise ConfigError([f"{folder} holds a run that cannot be read: {type(error).__name__} {error}"]) from None


def _other(folder: Path, kind: str) -> str:
    page = folder / "report.html"
    own = f"; its own page is {page}" if page.is_file() else ""
    return f"{folder} holds a run of kind {kind}, and only those of {', '.join(KINDS)} can be shown together{own}"


def _repeat(run: RunRecord) -> list[str]:
    command = f"holotorch run {run.folder / 'config.yaml'}"
    repeat = f"Repeat with {element('code', command)}. Configuration:{element('pre', run.config)}"
    rows = [[key, plain(value)] for key, value in run.env.items()]
    return [f"<h2>How to repeat</h2>{repeat}", table(["", ""], rows, head=False)]
