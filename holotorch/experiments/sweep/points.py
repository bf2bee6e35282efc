"""The points of a sweep: the settings of each run, and the name of its folder."""

import hashlib
import itertools
import re
from collections.abc import Sequence
from typing import NamedTuple

from holotorch.experiments.config.errors import ConfigError

_LONGEST = 80  # characters of a folder's name; longer ones end in a hash of all values
MOST = 10_000  # points of a sweep


class Point(NamedTuple):
    """One run of a sweep."""

    name: str  # of its folder, from the swept values alone, so that a larger sweep finds the runs of a smaller one
    overrides: tuple[str, ...]  # key=value, fixed ones and those of this point
    values: dict[str, str]  # swept keys and their values as written


def points(arguments: Sequence[str]) -> list[Point]:
    """All combinations of ``key=a,b,c``; a key with one value is fixed. Commas in brackets and quotes separate nothing.

    ConfigError for words that are no settings, values that appear twice, keys given twice, or more than 10,000 points.
    """
    mistakes: list[str] = []
    choices: dict[str, list[str]] = {}
    for word in arguments:
        key, equals, text = word.partition("=")
        values = _split(text)
        if not equals or not key:
            mistakes.append(f"argument {word!r}: expected key=value, or key=a,b,c to sweep it")
        elif key in choices:
            mistakes.append(f"argument {word!r}: {key} is given twice; write all values after one key, {key}=a,b")
        elif len(set(values)) < len(values):
            mistakes.append(f"argument {word!r}: a value appears twice")
        elif not all(values):
            mistakes.append(f"argument {word!r}: a value is missing beside a comma")
        choices[key] = values
    if mistakes:
        raise ConfigError(mistakes)
    fixed = [f"{key}={value}" for key, (value, *more) in choices.items() if not more]
    swept = {key: values for key, values in choices.items() if len(values) > 1}
    if not swept:
        raise ConfigError(
            ["nothing to sweep: give a key several values, such as seed=0,1,2; for a single run: holotorch run"]
        )
    grid = [
        dict(zip(swept, values, strict=True))
        for values in itertools.islice(itertools.product(*swept.values()), MOST + 1)
    ]
    if len(grid) > MOST:
        raise ConfigError([f"expected at most {MOST} runs in a sweep"])
    return [Point(_name(values), (*fixed, *(f"{k}={v}" for k, v in values.items())), values) for values in grid]


def _split(text: str) -> list[str]:
    """Parts between the commas that are not within brackets or quotes, stripped."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        else:
            depth += (letter in "[{(") - (letter in "]})")
        if letter == "," and depth <= 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _name(values: dict[str, str]) -> str:
    """A folder's name such as sigma_px=0.3,frames=2; values that differ have names that differ, on any file system."""
    whole = ",".join(f"{key.rpartition('.')[2]}={value}" for key, value in values.items())
    safe = re.sub(r"[^A-Za-z0-9._=,+-]", "_", whole)
    if safe == whole and len(safe) <= _LONGEST and not safe.startswith("."):
        return safe
    digest = hashlib.sha256(repr(sorted(values.items())).encode()).hexdigest()[:8]
    return f"{safe[: _LONGEST - 9].lstrip('.')}-{digest}"
