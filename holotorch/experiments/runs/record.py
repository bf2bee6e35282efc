"""RunRecord: what the folder of a run says of it."""

import base64
import csv
import io
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError
from holotorch.io.files import read_json


class RunRecord:
    """The files of a run, complete or interrupted.

    Attributes:
        folder: Where they are.
        title: Name of the folder.
        summary: Its numbers.
        kind: Name of its kind.

    Raises:
        ConfigError: A folder that holds no run.
    """

    def __init__(self, folder: Path):
        self.folder, self.title = folder, folder.resolve().name
        names = [name for name in ("summary.json", "interrupted.json") if (folder / name).is_file()]
        if not names:
            cure = f"; finish it with: holotorch resume {folder}" if (folder / "plan.json").is_file() else ""
            raise ConfigError([f"{folder} holds no run: neither summary.json nor interrupted.json is there{cure}"])
        self.summary: dict[str, Any] = read_json(folder / names[0])
        self.kind = str(self.summary["experiment"])

    def load(self) -> None:
        """Read what a section of a page is made of: ``plan``, where there is one, ``env`` and ``config``."""
        plan = self.folder / "plan.json"
        self.plan: dict[str, Any] = read_json(plan) if plan.is_file() else {}
        self.env: dict[str, Any] = read_json(self.folder / "env.json")
        self.config = (self.folder / "config.yaml").read_text(encoding="utf-8")

    def text(self, name: str) -> str:
        """A text file of the folder, or nothing where there is none."""
        path = self.folder / name
        return path.read_text(encoding="utf-8") if path.is_file() else ""

    def rows(self, name: str) -> list[dict[str, str]]:
        """Rows of a table of the folder, none where there is none."""
        return list(csv.DictReader(io.StringIO(self.text(name))))

    def picture(self, name: str) -> str:
        """A picture of the folder as a data URL, or nothing where there is none."""
        path = self.folder / "images" / f"{name}.png"
        if not path.is_file():
            return ""
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
