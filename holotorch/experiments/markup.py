"""Small pieces of HTML that reports are made of."""

import html
from collections.abc import Sequence
from typing import Any


def figure(source: str, caption: str, kind: str) -> str:
    """A picture with its caption; ``source`` is a data URL."""
    words = html.escape(caption)
    return f'<figure class="{kind}"><img src="{source}" alt="{words}"><figcaption>{words}</figcaption></figure>'


def table(names: Sequence[str], rows: list[list[str]], *, head: bool = True) -> str:
    """Rows of cells that are HTML already; a column that is empty throughout says nothing and is left out."""
    kept = [i for i in range(len(names)) if any(row[i] for row in rows)]
    top = "".join(f"<th>{names[i]}</th>" for i in kept)
    lines = ["".join(f"<td>{row[i]}</td>" for i in kept) for row in rows]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in ([top] if head else []) + lines) + "</table>"


def plain(value: Any) -> str:
    """A JSON value in words."""
    if isinstance(value, dict):
        return "; ".join(f"{k.replace('_', ' ')}: {plain(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(plain(item) for item in value)
    return f"{value:.5g}" if isinstance(value, float) else str(value)
