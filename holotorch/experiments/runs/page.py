"""The page of a report, which is one static HTML file without scripts, and the elements of its body."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Template


@cache
def _template() -> "Template":
    from jinja2 import Environment, FileSystemLoader  # only a report needs it

    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, keep_trailing_newline=True)
    return environment.get_template("report.html.jinja")


def page(title: str, body: str) -> str:
    """The page around a body of HTML; characters that UTF-8 cannot encode, such as lone surrogates, become "?"."""
    return _template().render(title=title, body=body).encode("utf-8", "replace").decode("utf-8")


def render(macro: str, *values: Any) -> str:
    """HTML from a macro of the template; ``values`` are its arguments, which the template escapes."""
    return str(getattr(_template().module, macro)(*values))


def element(tag: str, text: Any, kind: str = "") -> str:
    """An HTML element ``tag`` that contains ``text``; ``kind`` is its CSS class."""
    return render("element", tag, text, kind)


def heading(title: str, status: Any) -> str:
    """The title of a run, followed by its status unless that is "complete"."""
    return render("heading", title, status)


def figure(source: str, caption: str, kind: str) -> str:
    """A picture with its caption; ``source`` is a data URL or an address relative to the page."""
    return render("figure", source, caption, kind)


def fold(summary: str, lines: Sequence[str]) -> str:
    """Paragraphs that the reader opens by a click on ``summary``."""
    return render("fold", summary, lines)


def addresses(files: dict[str, str]) -> str:
    """Links in a row; ``files`` maps their text to addresses relative to the page."""
    return render("addresses", files)


def table(names: Sequence[str], rows: Sequence[Sequence[str]], *, head: bool = True) -> str:
    """A table of text. Columns that are empty in every row are left out, and so are the names if ``head`` is False."""
    kept = [i for i in range(len(names)) if any(row[i] for row in rows)]
    return render("table", [names[i] for i in kept] if head else [], [[row[i] for i in kept] for row in rows])


def plain(value: Any) -> str:
    """A JSON value as text."""
    if isinstance(value, dict):
        return "; ".join(f"{k.replace('_', ' ')}: {plain(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(plain(item) for item in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)
