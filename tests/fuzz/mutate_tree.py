"""Mutations of what YAML and JSON hold: values of another kind, keys left out, lists without end."""

import copy
import json
import math
from collections.abc import Callable
from itertools import islice
from random import Random
from typing import Any

import yaml
from fuzz.engine import FULL
from fuzz.mutate import NUMBERS, mutated

LENGTHS = (
    "360",
    "1e99999999nm",
    "-1e99999999 nm",
    "1e-99999999nm",
    "0 mm",
    "-5 mm",
    "1e5 m",
    "nan mm",
    "inf m",
    "5 px",
)
_VALUES: tuple[Any, ...] = (
    *(
        [],
        {},
        None,
        True,
        False,
        "",
        " ",
        0,
        -1,
        1,
        2,
        3,
        7,
        16384,
        10**9,
        10**10,
        -(10**9),
        2**31,
        2**63,
        2**64,
        10**400,
    ),
    *(0.0, -0.0, 1e-9, 1e9, 1e15, 1e300, 1e-300, math.nan, math.inf, -math.inf, 360, 0.5, 530, 100.0),
    *([[]], [{}], [None], [0], [1, 2, 3, 4], ["a"], {"a": 1}, {"kind": "x"}, [[1, 2], [3]], [1] * 3000),
    *("x", "none", "null", "auto", "cpu", "cuda", "\0", "\ud7ff", "é" * 300, "../../etc/passwd", "/dev/zero", ".", "/"),
    *(
        "a" * 20000,
        "1" * 20000,
        "[" * 3000,
        "{}" * 500,
        "1e" * 4000,
        " " * 9000 + "x",
        "%s%s%n",
        "<script>",
        "\x1b[31m",
    ),
    *LENGTHS,
    *NUMBERS,
)
_SNIPPETS = (
    "a: &a [x, x]\nb: &b [*a, *a, *a, *a]\nc: &c [*b, *b, *b, *b]\nd: &d [*c, *c, *c, *c]\ne: [*d, *d, *d, *d]\n",
    "seed: &s [*s]\n",
    "seed: !!python/object:os.system ls\n",
    "seed: !!timestamp 2001-99-99\n",
    "seed: !!binary \U0001f600\n",
    "seed: !!set {1, 2}\n",
    "seed: !!float x\n",
    "seed: 0o777777777777777777777777\n",
    "seed: 190:20:30:15:99:99\n",
    "? [a, b]\n: 1\n",
    "<<: {seed: 1}\n",
    "<<: [1]\n",
    "%YAML 9.9\n---\n",
    "---\n---\n",
    "\t\n",
    "seed: |\n  " + "x" * 5000 + "\n",
    "seed: " + "[" * 2000 + "]" * 2000 + "\n",
    "seed: " + "{a: " * 500 + "1" + "}" * 500 + "\n",
)


def tree_mutated(rng: Random, data: Any, other: Any) -> Any:
    """Plain data after one to five changes of values and keys at random places; ``other`` gives parts to put in."""
    data = json.loads(json.dumps(data))
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        places = list(islice(_places(data), 20_000))  # lists of a thousand within each other have millions
        if not places:
            return _value(rng)
        holder, key = rng.choice(places)
        rng.choice(_CHANGES)(rng, holder, key, other)
    return data


def _value(rng: Random) -> Any:
    return copy.deepcopy(rng.choice(_VALUES))  # what is put into one input must not change in another


def _places(data: Any) -> Any:
    pairs = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in pairs:
        yield data, key
        yield from _places(value)


def _replaced(rng: Random, holder: Any, key: Any, other: Any) -> None:
    holder[key] = _value(rng)


def _scaled(rng: Random, holder: Any, key: Any, other: Any) -> None:
    value, factor = holder[key], rng.choice((0, -1, 1e3, 1e-3, 1e6, 1e9, 1e12, 1e-12, 0.999, 1.001, 2, 10))
    if isinstance(value, bool) or not isinstance(value, int | float):
        text, _, unit = str(value).partition(" ")
        try:
            holder[key] = f"{float(text) * factor!r} {unit}"
        except ValueError:
            holder[key] = _value(rng)
    else:
        holder[key] = type(value)(value * factor) if abs(value) < 1e100 else 0


def _removed(rng: Random, holder: Any, key: Any, other: Any) -> None:
    del holder[key]


def _listed(rng: Random, holder: Any, key: Any, other: Any) -> None:
    holder[key] = [holder[key]] * rng.choice((1, 2, 3, 4, 1000))


def _opened(rng: Random, holder: Any, key: Any, other: Any) -> None:
    value = holder[key]
    holder[key] = value[0] if isinstance(value, list) and value else {"kind": value, "a": value}


def _borrowed(rng: Random, holder: Any, key: Any, other: Any) -> None:
    places = list(_places(other))
    if places:
        lender, name = rng.choice(places)
        value = json.loads(json.dumps(lender[name]))
        if isinstance(holder, dict) and rng.random() < 0.5:
            holder[str(name)] = value
        else:
            holder[key] = value


def _renamed(rng: Random, holder: Any, key: Any, other: Any) -> None:
    if isinstance(holder, dict):
        holder[rng.choice((f"{key}x", key[:-1], key.upper(), "", "kind", "a.b", "1", "\0", "é", "__class__"))] = (
            holder.pop(key)
        )
    else:
        holder.append(holder[key])


def _nested(rng: Random, holder: Any, key: Any, other: Any) -> None:
    for _ in range(rng.choice((1, 10, 300))):
        holder[key] = [holder[key]] if rng.random() < 0.5 else {"a": holder[key]}


_MOST = 50_000  # values of a tree that is written as YAML, which takes seconds
_MOST_PARTS = 20_000  # of a JSON file; where it is nested deeply, each takes the encoder 0.1 ms

_CHANGES: tuple[Callable[[Random, Any, Any, Any], None], ...] = (
    *(_replaced, _replaced, _replaced, _replaced, _scaled, _scaled, _removed, _listed, _opened, _borrowed, _borrowed),
    *(_renamed, _nested),
)


def _count(tree: Any) -> int:
    """Number of values and of 20 characters of a tree, as often as they are written: what is shared is written once."""
    waiting, known, count = [tree], set(), 0
    while waiting and count <= _MOST:
        value = waiting.pop()
        count += 1 + (len(value) // 20 if isinstance(value, str) else 0)
        if isinstance(value, dict | list) and id(value) not in known:
            known.add(id(value))
            waiting += [*value, *value.values()] if isinstance(value, dict) else value
    return count


def yaml_mutated(rng: Random, text: bytes, other: bytes) -> bytes:
    """A YAML file: its values changed, snippets of bad YAML put in, or its bytes."""
    kind = rng.random()
    if kind < 0.12:
        return mutated(rng, text, other)
    if kind < 0.2:
        lines = text.decode().splitlines(keepends=True)
        lines.insert(rng.randint(0, len(lines)), rng.choice(_SNIPPETS))
        return "".join(lines).encode("utf-8", "surrogatepass")
    style = rng.choice((None, True, False))
    try:
        changed = tree_mutated(rng, yaml.safe_load(text), yaml.safe_load(other))
        if _count(changed) > _MOST:
            raise RecursionError
        made = yaml.safe_dump(changed, sort_keys=False, default_flow_style=style, allow_unicode=True)
    except RecursionError:  # of what is nested too deeply, or too much, to be written by the library
        made = text.decode() + "deep: " + "[" * 1000 + "]" * 1000
    return made.encode("utf-8", "surrogatepass")[:FULL]


def json_mutated(rng: Random, text: bytes, other: bytes) -> bytes:
    """A JSON file: its values changed, or its bytes; NaN and infinity as Python writes them."""
    if rng.random() < 0.15:
        return mutated(
            rng, text, other, (b"[" * 100_000, b'{"a":' * 100_000, b"1e999", b"NaN", b"-Infinity", b"\\ud800")
        )
    try:
        tree = tree_mutated(rng, json.loads(text), json.loads(other))
        made, parts = bytearray(), json.JSONEncoder(ensure_ascii=rng.random() < 0.5).iterencode(tree)
        for part in islice(parts, _MOST_PARTS):  # borrowed parts may hold each other
            made += part.encode("utf-8", "surrogatepass")
            if len(made) >= FULL:
                break
        return bytes(made)
    except RecursionError:
        return b"[" * 100_000


def table_mutated(rng: Random, text: bytes, other: bytes) -> bytes:
    """A table of comma-separated values: cells changed, left out or added, or its bytes."""
    if rng.random() < 0.3:
        return mutated(rng, text, other, (b"\r", b'"', b"\0", b"\xff", b",,,,"))
    rows = [line.split(b",") for line in text.split(b"\n")]
    for _ in range(rng.choice((1, 1, 2, 4))):
        row = rng.choice(rows[: rng.choice((2, len(rows)))])
        place = rng.randrange(len(row)) if row else 0
        kind = rng.randrange(5)
        if kind == 0 and row:
            del row[place]
        elif kind == 1:
            row.insert(place, b"x")
        elif kind == 2 and row:
            row[place] = row[place] + rng.choice((b"\r", b"\0", b'"', b" ", b"e", b"\xff"))
        elif row:
            row[place] = rng.choice(NUMBERS).encode()
    return b"\n".join(b",".join(row) for row in rows)
