"""RunRecord: the contents of a run folder, for reports."""

import base64
import csv
import io
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError
from holotorch.io.files import read_json

SUMMARIES = ("summary.json", "interrupted.json")
_LISTED = 6  # run folders that a message lists


class RunRecord:
    """The files in the ``folder`` of a run, complete or interrupted. ConfigError if the folder holds no run.

    ``title`` is the name of the folder, ``summary`` the content of summary.json or interrupted.json, and ``kind`` the
    name of the kind of experiment.
    """

    def __init__(
        self, folder: Path, command: str = "holotorch report {}", wanted: Callable[[Path], bool] = lambda _: True
    ):
        """Read the summary; a message about a folder without one uses the rest as :func:`runs_inside` does."""
        self.folder, self.title = folder, folder.resolve().name
        names = [name for name in SUMMARIES if (folder / name).is_file()]
        if not names:
            if not folder.exists():
                raise ConfigError(
                    [f"{folder}: no such folder in {folder.parent}{runs_inside(folder.parent, command, wanted)}"]
                )
            hint = f"; finish it with: holotorch resume {folder}" if (folder / "plan.json").is_file() else ""
            hint = hint or runs_inside(folder, command, wanted)
            raise ConfigError([f"{folder} holds no run: neither summary.json nor interrupted.json is there{hint}"])
        self.summary: dict[str, Any] = read_json(folder / names[0])
        self.kind = str(self.summary["experiment"])

    def load(self) -> None:
        """Set ``plan`` (empty if there is none), ``env`` and ``config``, from the files of these names."""
        plan = self.folder / "plan.json"
        self.plan: dict[str, Any] = read_json(plan) if plan.is_file() else {}
        self.env: dict[str, Any] = read_json(self.folder / "env.json")
        self.config = (self.folder / "config.yaml").read_text(encoding="utf-8")

    def text(self, name: str) -> str:
        """The contents of a text file in the folder; empty if there is no such file."""
        path = self.folder / name
        return path.read_text(encoding="utf-8") if path.is_file() else ""

    def rows(self, name: str) -> list[dict[str, str]]:
        """Rows of a table in the folder; none if there is no such file."""
        return list(csv.DictReader(io.StringIO(self.text(name))))

    def picture(self, name: str) -> str:
        """A picture in the folder as a data URL; empty if there is no such file."""
        path = self.folder / "images" / f"{name}.png"
        return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}" if path.is_file() else ""


def runs_inside(folder: Path, command: str, wanted: Callable[[Path], bool] = lambda _: True) -> str:
    """The end of a message about a folder that holds no run itself: which runs are in it, and what to enter.

    Args:
        folder: Such as ``runs``, or that of ``holotorch demo`` or of a sweep.
        command: The command, with {} in place of the folder of a run; the message has that of the latest run.
        wanted: Whether the command takes the run in a folder.

    Returns:
        The text after a semicolon; empty if no wanted run is inside, directly or in a folder of several runs.
    """
    inside: set[Path] = set()
    for level in ("*", "*/*"):
        inside |= {path.parent for name in SUMMARIES for path in folder.glob(f"{level}/{name}")}
        inside |= {path.parent for path in folder.glob(f"{level}/config.yaml") if (path.parent / "env.json").is_file()}
    runs = sorted(run for run in inside if wanted(run))
    if not runs:
        return ""
    names = ", ".join(map(str, runs[:_LISTED])) + (", ..." if len(runs) > _LISTED else "")
    latest = max(runs, key=_started)
    return f"; give one of the runs in it: {names}; for the latest: {command.format(shlex.quote(str(latest)))}"


def _started(folder: Path) -> float:
    """When a run was started or resumed; later changes to its folder, such as exports, do not count."""
    env = folder / "env.json"
    return (env if env.is_file() else folder).stat().st_mtime


def kind_of(folder: Path) -> str:
    """The kind of the run in a folder, complete or not, as its config.yaml says; empty if it does not."""
    config = folder / "config.yaml"
    text = config.read_text(encoding="utf-8", errors="replace") if config.is_file() else ""
    kind = re.search(r"^experiment: *(\w+)", text, re.MULTILINE)
    return kind[1] if kind else ""
