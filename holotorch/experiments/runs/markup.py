"""Small pieces of HTML that reports are made of; every text is escaped here, and nowhere else."""

import html
from collections.abc import Sequence
from typing import Any


def element(tag: str, text: Any, kind: str = "") -> str:
    """An element that holds text, of the class ``kind``."""
    return f"<{tag}{f' class={chr(34)}{html.escape(kind)}{chr(34)}' if kind else ''}>{html.escape(str(text))}</{tag}>"


def heading(title: str, status: Any) -> str:
    """The title of a run, and its status where that is not "complete"."""
    warning = "" if status == "complete" else " " + element("span", status, "warn")
    return f"<h1>{html.escape(title)}{warning}</h1>"


def figure(source: str, caption: str, kind: str) -> str:
    """A picture with its caption; ``source`` is a data URL or a place seen from the page."""
    words, place = html.escape(caption), html.escape(source)
    return f'<figure class="{kind}"><img src="{place}" alt="{words}"><figcaption>{words}</figcaption></figure>'


def table(names: Sequence[str], rows: Sequence[Sequence[str]], *, head: bool = True) -> str:
    """Rows of text; a column that is empty throughout says nothing and is left out."""
    kept = [i for i in range(len(names)) if any(row[i] for row in rows)]
    top = "".join(element("th", names[i]) for i in kept)
    lines = ["".join(element("td", row[i]) for i in kept) for row in rows]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in ([top] if head else []) + lines) + "</table>"


def plain(value: Any) -> str:
    """A JSON value in words."""
    if isinstance(value, dict):
        return "; ".join(f"{k.replace('_', ' ')}: {plain(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(plain(item) for item in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)
