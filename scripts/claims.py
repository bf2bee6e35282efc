"""The claims of README and guides beside what the files of the last runs say: python scripts/claims.py."""

import csv
import json
import re
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import yaml

FOLDER = Path(__file__).parent / "charts" / "claims"
GUIDES = Path(__file__).parent / "docs"


class Verdict(NamedTuple):
    """One claim and its verdict."""

    says: str
    command: str
    file: Path  # of the last run
    found: list[float]  # a number for each test
    holds: bool


def verdicts(folder: Path = FOLDER) -> list[Verdict]:
    """All claims of ``claims.yaml``, judged by the files that it names. ValueError for a number that is not there."""
    claims = yaml.safe_load((folder / "claims.yaml").read_text(encoding="utf-8"))
    return [_judged(claim, (folder / claim["file"]).resolve()) for claim in claims]


def _judged(claim: dict[str, Any], file: Path) -> Verdict:
    text = file.read_text(encoding="utf-8")
    found = [_number(test, text) for test in claim["tests"]]
    holds = all(_passes(test, number) for test, number in zip(claim["tests"], found, strict=True))
    return Verdict(claim["says"], claim["command"], file, found, holds)


def _number(test: dict[str, Any], text: str) -> float:
    if "json" in test:
        return float(reduce(lambda value, key: value[key], test["json"].split("."), json.loads(text)))
    numbers = []
    for pattern in filter(None, (test["find"], test.get("over"))):
        if not (match := re.search(pattern, text, re.MULTILINE)):
            raise ValueError(f"nothing like {pattern!r} in the file of the last run")
        numbers.append(float(match[1]))
    return numbers[0] / numbers[1] if len(numbers) > 1 else numbers[0]


def _passes(test: dict[str, Any], number: float) -> bool:
    if "is" in test:
        return abs(number - test["is"]) <= test["margin"]
    return number <= test["at_most"] if "at_most" in test else number >= test["at_least"]


class Cell(NamedTuple):
    """The numbers of a cell in a table of a guide, as shown, and those of the last run."""

    guide: str
    row: str
    shown: list[str]
    found: list[float]

    @property
    def holds(self) -> bool:
        """Whether each shown number is what the last run rounds to."""
        half = [0.5001 * 10.0 ** -len(number.partition(".")[2]) for number in self.shown]
        pairs = zip(self.shown, self.found, half, strict=False)
        return len(self.shown) >= len(self.found) and all(abs(float(a) - b) <= c for a, b, c in pairs)


def cells(folder: Path = FOLDER, guides: Path = GUIDES) -> list[Cell]:
    """All cells of ``tables.yaml``. ValueError for a row that is not in its guide once, or without its cells."""
    found = []
    for table in yaml.safe_load((folder / "tables.yaml").read_text(encoding="utf-8")):
        lines = (guides / f"{table['guide']}.md").read_text(encoding="utf-8").splitlines()
        rows = [line for line in lines if line.startswith(table["row"])]
        if len(rows) != 1:
            raise ValueError(f"{table['guide']}: {len(rows)} rows begin with {table['row']!r}")
        texts = rows[0].strip("|").split("|")[1:]
        if len(texts) < len(table["cells"]):
            raise ValueError(f"{table['guide']}: too few cells in {rows[0]!r}")
        for text, cell in zip(texts, table["cells"], strict=False):
            numbers = re.findall(r"\d+(?:\.\d+)?", text)
            found.append(Cell(table["guide"], table["row"], numbers, _columns((folder / cell["file"]).resolve(), cell)))
    return found


def _columns(path: Path, cell: dict[str, Any]) -> list[float]:
    """The value of each column in the rows of a CSV file that a cell names: the only one, or the smallest."""
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    chosen = [row for row in rows if all(row[key] == value for key, value in cell["rows"].items())]
    if not chosen or (len(chosen) > 1 and not cell.get("worst")):
        raise ValueError(f"{path.name}: {len(chosen)} rows with {cell['rows']}")
    return [min(float(row[column]) for row in chosen) for column in cell["columns"]]


def main() -> None:
    """Print a line for each claim, and for each row of a table in a guide."""
    for says, command, file, found, holds in verdicts():
        numbers = ", ".join(f"{number:.4g}" for number in found)
        print(f"{'holds' if holds else 'FAILS'}: {says}\n    {command}\n    {file.name}: {numbers}")
    for cell in cells():
        numbers = ", ".join(f"{number:.4g}" for number in cell.found)
        print(f"{'holds' if cell.holds else 'FAILS'}: {cell.guide}.md {cell.row} {' '.join(cell.shown)}: {numbers}")


if __name__ == "__main__":
    main()
