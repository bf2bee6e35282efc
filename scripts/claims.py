"""The claims of README and guides beside what the files of the last runs say: python scripts/claims.py."""

import csv
import json
import operator
import re
import statistics
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import yaml

FOLDER = Path(__file__).parent / "charts" / "claims"
GUIDES = Path(__file__).parent / "docs"
TAKES = {"min": min, "max": max, "mean": statistics.fmean, "last": operator.itemgetter(-1)}
NUMBER = re.compile(r"(?<![\w.])(\d+(?:,\d{3})*(?:\.\d+)?(?:e-?\d+)?)(?![\w])")
# What looks measured: a decimal point or a power of ten, a range, "3 of 48", or a unit after the last of a list.
UNIT = r"(?: ?%| (?:dB|times|as|ms|s|h|min|minutes|days|GB|MB|mm|cm|nm|degC|K|rad|deg|degrees|degree|pixels|cycles)\b)"
MEASURED = re.compile(
    r"(?<![\w.,])(\d+(?:,\d{3})*(?:\.\d+|(?:\.\d+)?e-?\d+|(?= (?:to|of) \d)|"
    rf"(?=(?:(?:,| and| or|;) [\d.]+)*{UNIT})))(?!\w)"
)
# Numbers that name something: code, links, and places in the dissertation.
NAMES = re.compile(
    r"`[^`]*`|\]\([^)]*\)|(?:Secs?|Figs?|Eqs?|Tables?|Algorithm)\.? [\d.]+(?:(?:,| and| or| to) [\d.]+)*"
)


class Verdict(NamedTuple):
    """One claim and its verdict."""

    says: str
    command: str
    file: Path  # of the last run
    found: list[float]  # a number for each test
    holds: bool


def verdicts(folder: Path = FOLDER) -> list[Verdict]:
    """All claims of ``claims.yaml``, judged by the files that it names. ValueError for a number that is not there."""
    return [_judged(claim, folder) for claim in load(folder / "claims.yaml")]


def load(path: Path) -> list[dict[str, Any]]:
    """The rows of a YAML file of claims."""
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _judged(claim: dict[str, Any], folder: Path) -> Verdict:
    file = (folder / claim["file"]).resolve()
    texts = [(folder / test.get("file", claim["file"])).read_text(encoding="utf-8") for test in claim["tests"]]
    found = [_number(test, text) for test, text in zip(claim["tests"], texts, strict=True)]
    holds = all(_passes(test, number) for test, number in zip(claim["tests"], found, strict=True))
    return Verdict(claim["says"], claim["command"], file, found, holds)


def _number(test: dict[str, Any], text: str) -> float:
    """The number of a test: what it names in the text, ``minus`` and ``over`` something else there, times ``scale``.

    Where a pattern or rows of a table give several, ``take`` says what is taken of them: min, max, mean or last.
    """
    take = TAKES[test["take"]] if "take" in test else operator.itemgetter(0)
    values = _values(test, text, "take" not in test)
    for name, act in (("minus", operator.sub), ("over", operator.truediv)):
        if name in test:
            source = test[name] if isinstance(test[name], dict) else {"find": test[name]}
            others = _values(source, text, "take" not in test)
            others = others * len(values) if len(others) == 1 else others
            values = [act(a, b) for a, b in zip(values, others, strict=True)]
    return take(values) * test.get("scale", 1)


def _values(source: dict[str, Any], text: str, one: bool) -> list[float]:
    """Numbers in the text of a run, ``one`` or all: at a path of JSON, in a column of CSV, or in a pattern's group."""
    if "json" in source:
        return [float(reduce(_entry, source["json"].split("."), json.loads(text)))]
    if "column" in source:
        return [float(row[source["column"]]) for row in _rows(text, source["rows"], one)]
    if not (values := [float(number) for number in re.findall(source["find"], text, re.MULTILINE)]):
        raise ValueError(f"nothing like {source['find']!r} in the file of the last run")
    return values[:1] if one else values


def _entry(value: Any, key: str) -> Any:
    return value[int(key)] if isinstance(value, list) else value[key]


def _rows(text: str, rows: dict[str, str], one: bool) -> list[dict[str, str]]:
    """The rows of a CSV file whose cells are as in ``rows``. ValueError for none, and for several instead of one."""
    found = list(csv.DictReader(text.splitlines()))
    chosen = [row for row in found if all(row[key] == value for key, value in rows.items())]
    if not chosen or (len(chosen) > 1 and one):
        raise ValueError(f"{len(chosen)} rows with {rows}")
    return chosen


def _passes(test: dict[str, Any], number: float) -> bool:
    if "shows" in test:
        return _rounds_to(number, test["shows"])
    if "is" in test:
        return abs(number - test["is"]) <= test["margin"]
    return number <= test["at_most"] if "at_most" in test else number >= test["at_least"]


def _rounds_to(number: float, shown: str) -> bool:
    """Whether a number as shown, such as 0.30 or 1e-3, is what another one rounds to."""
    digits, _, power = shown.replace(",", "").partition("e")
    unit = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    return abs(float(shown.replace(",", "")) - number) <= 0.5001 * unit


class Cell(NamedTuple):
    """The numbers of a cell in a table of a guide, as shown, and those of the last run."""

    guide: str
    row: str
    shown: list[str]
    found: list[float]

    @property
    def holds(self) -> bool:
        """Whether each shown number is what the last run rounds to."""
        pairs = zip(self.found, self.shown, strict=False)
        return len(self.shown) >= len(self.found) and all(_rounds_to(number, shown) for number, shown in pairs)


def cells(folder: Path = FOLDER, guides: Path = GUIDES) -> list[Cell]:
    """All cells of ``tables.yaml``. ValueError for a row that is not in its guide once, or without its cells."""
    found = []
    for table in load(folder / "tables.yaml"):
        if "row" not in table:
            continue
        lines = (guides / f"{table['guide']}.md").read_text(encoding="utf-8").splitlines()
        rows = [line for line in lines if line.startswith(table["row"])]
        if len(rows) != 1:
            raise ValueError(f"{table['guide']}: {len(rows)} rows begin with {table['row']!r}")
        texts = rows[0].strip("|").split("|")[1:]
        if len(texts) < len(table["cells"]):
            raise ValueError(f"{table['guide']}: too few cells in {rows[0]!r}")
        for text, cell in zip(texts, table["cells"], strict=False):
            numbers = re.findall(r"\d+(?:\.\d+)?", text)
            parts = cell if isinstance(cell, list) else [cell]
            values = [value for part in parts for value in _columns((folder / part["file"]).resolve(), part)]
            found.append(Cell(table["guide"], table["row"], numbers, values))
    return found


def bare_rows(guide: str, folder: Path = FOLDER, guides: Path = GUIDES) -> list[str]:
    """Rows of a guide's tables that show what looks measured, and that are not in ``tables.yaml``."""
    tables = [table for table in load(folder / "tables.yaml") if table["guide"] == guide]
    known = [row for table in tables for row in (table.get("not_measured") or [table["row"]])]
    lines = (guides / f"{guide}.md").read_text(encoding="utf-8").splitlines()
    if stale := [row for row in known if not any(line.startswith(row) for line in lines)]:
        raise ValueError(f"{guide}: no longer there: {stale}")
    rows = [line for line in lines if line.startswith("|") and not line.startswith(tuple(known) or "-")]
    return [line for line in rows if MEASURED.search(NAMES.sub("", line))]


def _columns(path: Path, cell: dict[str, Any]) -> list[float]:
    """The values that a cell names: of each column in rows of a CSV file, the only one or the smallest; or of JSON.

    A list in JSON counts by its mean.
    """
    scale = cell.get("scale", 1)
    if "json" in cell:
        data = json.loads(path.read_text(encoding="utf-8"))
        values = [reduce(_entry, name.split("."), data) for name in cell["json"]]
        return [scale * (statistics.fmean(value) if isinstance(value, list) else value) for value in values]
    rows = _rows(path.read_text(encoding="utf-8"), cell["rows"], one=not cell.get("worst"))
    return [scale * min(float(row[column]) for row in rows) for column in cell["columns"]]


class Quote(NamedTuple):
    """A measured result in the prose of a guide, and its verdict."""

    guide: str
    says: str
    command: str
    file: Path  # of the last run
    found: list[float]  # a number for each test
    holds: bool
    untested: list[str]  # numbers that it shows and no test has, nor the list of those that are given


def quotes(folder: Path = FOLDER, guides: Path = GUIDES) -> list[Quote]:
    """All results of ``prose.yaml``. ValueError for one that its guide does not have once."""
    found = []
    for row in load(folder / "prose.yaml"):
        if "tests" not in row:
            continue
        if (times := prose(guides / f"{row['guide']}.md").count(row["says"])) != 1:
            raise ValueError(f"{row['guide']}: {times} times {row['says']!r}")
        shown = NUMBER.findall(row["says"])
        tested = [str(test[key]) for test in row["tests"] for key in ("shows", "at_most", "at_least") if key in test]
        if strange := [test["shows"] for test in row["tests"] if "shows" in test and test["shows"] not in shown]:
            raise ValueError(f"{row['guide']}: {strange} not in {row['says']!r}")
        untested = [each for each in shown if each not in [*tested, *row.get("given", [])]]
        found.append(Quote(row["guide"], *_judged(row, folder), untested))
    return found


def prose(path: Path) -> str:
    """The sentences of a guide in one line, without headings, pictures, tables, blocks of code and quoted verdicts."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    lines = [line for line in text.splitlines() if not line.startswith(("#", "|", "!", "    "))]
    return " ".join(" ".join(lines).split())


def uncovered(guide: str, folder: Path = FOLDER, guides: Path = GUIDES) -> list[str]:
    """Numbers in a guide's prose that look measured and are in no quote of ``prose.yaml``, with words around them."""
    text = prose(guides / f"{guide}.md")
    rows = [row for row in load(folder / "prose.yaml") if row["guide"] == guide]
    lists = [
        [row["says"]] if "says" in row else [*row.get("not_measured", []), *row.get("in_tests", [])] for row in rows
    ]
    known = [quote for quotes in lists for quote in quotes]
    if stale := [quote for quote in known if quote not in text]:
        raise ValueError(f"{guide}: no longer there: {stale}")
    spans = [match.span() for quote in known for match in re.finditer(re.escape(quote), text)]
    bare = NAMES.sub(lambda match: " " * len(match[0]), text)
    found = [match.span(1) for match in MEASURED.finditer(bare)]
    return [text[max(0, a - 40) : b + 30] for a, b in found if not any(c <= a and b <= d for c, d in spans)]


def main() -> None:
    """Print a line for each claim, and for each row of a table in a guide."""
    for says, command, file, found, holds in verdicts():
        numbers = ", ".join(f"{number:.4g}" for number in found)
        print(f"{'holds' if holds else 'FAILS'}: {says}\n    {command}\n    {file.name}: {numbers}")
    for quote in quotes():
        numbers = ", ".join(f"{number:.4g}" for number in quote.found)
        print(
            f"{'holds' if quote.holds else 'FAILS'}: {quote.guide}.md: {quote.says}\n    {quote.file.name}: {numbers}"
        )
    for cell in cells():
        numbers = ", ".join(f"{number:.4g}" for number in cell.found)
        print(f"{'holds' if cell.holds else 'FAILS'}: {cell.guide}.md {cell.row} {' '.join(cell.shown)}: {numbers}")


if __name__ == "__main__":
    main()
