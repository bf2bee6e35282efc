"""RunRecord: the contents of a run folder, for reports."""

import base64
import csv
import io
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

    def __init__(self, folder: Path):
        self.folder, self.title = folder, folder.resolve().name
        names = [name for name in SUMMARIES if (folder / name).is_file()]
        if not names and len(inside := _runs_in(folder)) > 1:
            more = ", ..." if len(inside) > _LISTED else ""
            words = ", ".join(map(str, inside[:_LISTED]))
            raise ConfigError([f"{folder} holds several runs in folders of their own: give one of {words}{more}"])
        if not names:
            hint = f"; finish it with: holotorch resume {folder}" if (folder / "plan.json").is_file() else ""
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


def _runs_in(folder: Path) -> list[Path]:
    """The folders directly inside ``folder`` that hold a run, as in that of ``holotorch demo`` or of a sweep."""
    return sorted({path.parent for name in SUMMARIES for path in folder.glob(f"*/{name}")})
