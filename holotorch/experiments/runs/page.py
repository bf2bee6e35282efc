"""The page of a report: one static HTML file without scripts, which works from disk."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Template


@cache
def _template() -> "Template":
    from jinja2 import Environment, FileSystemLoader  # only a report needs it

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, keep_trailing_newline=True
    )
    return environment.get_template("report.html.jinja")


def render(macro: str, *values: Any) -> str:
    """HTML of a macro of the template; the template escapes every value."""
    return str(getattr(_template().module, macro)(*values))


def page(title: str, body: str) -> str:
    """The page around a body of HTML; characters that UTF-8 cannot encode, such as lone surrogates, become "?"."""
    return _template().render(title=title, body=body).encode("utf-8", "replace").decode("utf-8")
