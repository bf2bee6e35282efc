"""The claims of the README beside what the files of the last runs say: python scripts/claims.py."""

import json
import re
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import yaml

FOLDER = Path(__file__).parent / "charts" / "claims"


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


def main() -> None:
    """Print a line for each claim."""
    for says, command, file, found, holds in verdicts():
        numbers = ", ".join(f"{number:.4g}" for number in found)
        print(f"{'holds' if holds else 'FAILS'}: {says}\n    {command}\n    {file.name}: {numbers}")


if __name__ == "__main__":
    main()
