"""The command line as a target: what may come of a bad input, and runs so small that inputs by the thousand fit."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

from fuzz.engine import Input, Refused

from holotorch.cli import main

_LONG = 200_000  # characters of a message


def command(*words: str) -> str:
    """What a command prints; Refused where it ends with status 2 and says why, AssertionError for all other ends."""
    said, told = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(said):
        try:
            status = main(list(words))
        except SystemExit as error:  # argparse
            status = error.code
    text = said.getvalue()
    if status == 0:
        return told.getvalue()
    assert status == 2, f"exit status {status}: {text[-3000:]}"
    assert text.strip() and "Traceback" not in text and len(text) < _LONG, f"not a message: {text[-3000:]}"
    raise Refused(text)


@contextlib.contextmanager
def without_figures() -> Iterator[None]:
    """Runs within draw no figures, which take longer than they do."""
    with contextlib.ExitStack() as stack:
        for name in ("comparison", "channel_maps", "convergence", "visual_field"):
            stack.enter_context(patch(f"holotorch.experiments.runs.figures.{name}", lambda *_, **__: b""))
        yield


def files(folder: Path, *, below: str = "") -> Input:
    """All files of a folder as an input, within a folder ``below``."""
    return {
        str(below / path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }
