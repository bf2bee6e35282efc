"""YAML with positions: every value knows its place in the file, so that every mistake can be pointed at."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from holotorch.experiments.config.errors import ConfigError, short

Key = tuple[str | int, ...]
_LARGEST = 1 << 17  # bytes of a file, which take up to 4 s to parse
_MOST = 100_000  # values of a file, more than one of that size can write out
MOST_MISTAKES = 50  # that are listed


@dataclass
class Source:
    """Plain data of a configuration and where each of its keys stands."""

    path: Path
    data: dict[str, Any]
    places: dict[Key, str] = field(default_factory=dict)

    def mistake(self, key: Key, message: str) -> str:
        """A line that names the place of ``key`` (or of its nearest parent that is written down) and the message."""
        known = key
        while known and known not in self.places:
            known = known[:-1]
        name = ".".join(str(part) for part in key)
        return f"{self.places.get(known, f'{self.path}:1:1')}: {name + ': ' if name else ''}{message}"


def read_source(path: Path, overrides: list[str], wanted: str = "settings such as 'experiment: pec'") -> Source:
    """Read a YAML file and apply ``key.sub=value`` words to it; ConfigError lists all that cannot be read.

    ``wanted`` says what such a file holds, to whoever gives one that holds nothing of the kind.
    """
    try:
        with open(path, "rb") as stream:
            data = stream.read(_LARGEST + 1)
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a UTF-8 text file"
        raise ConfigError([f"{path}: cannot read the configuration: {reason}"]) from None
    if len(data) > _LARGEST:
        raise ConfigError(
            [f"{path}: more than {_LARGEST} bytes; expected {wanted}, with long tables in files of their own"]
        )
    source = Source(path, {})
    mistakes: list[str] = []
    data = _parse(text, str(path), source.places, (), mistakes)
    if data is None and not mistakes:
        mistakes.append(f"{path}:1:1: the file is empty; expected {wanted}")
    elif not isinstance(data, dict) and not mistakes:
        mistakes.append(f"{path}:1:1: expected {wanted}, got {short(data)}")
    if not mistakes and isinstance(data, dict):
        source.data = data
        for word in overrides:
            _override(source, word, mistakes)
    if mistakes:
        more = [f"{path}: and {len(mistakes) - MOST_MISTAKES} more mistakes"] if len(mistakes) > MOST_MISTAKES else []
        raise ConfigError([*mistakes[:MOST_MISTAKES], *more])
    return source


def _override(source: Source, word: str, mistakes: list[str]) -> None:
    name, equals, text = word.partition("=")
    key = tuple(name.split("."))
    if not equals or not all(key):
        mistakes.append(f"argument {word!r}: expected key=value or key.sub=value")
        return
    parent = source.data
    for part in key[:-1]:
        child = parent.setdefault(part, {})
        if not isinstance(child, dict):
            mistakes.append(f"argument {word!r}: {part!r} is a single value and has no settings inside")
            return
        parent = child
    place = f"argument {word!r}"
    for stale in [known for known in source.places if known[: len(key)] == key]:
        del source.places[stale]
    for end in range(1, len(key) + 1):
        source.places.setdefault(key[:end], place)
    value = _parse(text, place, {}, key, mistakes)
    parent[key[-1]] = value


def _parse(text: str, name: str, places: dict[Key, str], key: Key, mistakes: list[str]) -> Any:
    try:
        loader = yaml.SafeLoader(text)
        loader.name = name
        node = loader.get_single_node()
        return None if node is None else _construct(loader, node, name, places, key, mistakes)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        mistakes.append(f"{place}: not valid YAML: {error.problem or error.context}")
    except yaml.YAMLError as error:
        mistakes.append(f"{name}: not valid YAML: {' '.join(str(error).split())}")
    except _Expanded as error:
        mistakes.append(
            f"{error}: its aliases (*name) stand for more than {_MOST} values in all; write out what is needed"
        )
    except RecursionError:
        mistakes.append(f"{name}: not a configuration: nested without end")
    return None


class _Expanded(Exception):
    """Aliases of aliases, whose values no memory could hold; the place of the first value too many."""


def _construct(loader, node: yaml.Node, name: str, places: dict[Key, str], key: Key, mistakes: list[str]) -> Any:
    places.setdefault(key, f"{name}:{node.start_mark.line + 1}:{node.start_mark.column + 1}")
    if len(places) > _MOST:  # every value has its place
        raise _Expanded(places[key])
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            part = key_node.value if isinstance(key_node, yaml.ScalarNode) else "?"
            place = f"{name}:{key_node.start_mark.line + 1}:{key_node.start_mark.column + 1}"
            if part in result:
                mistakes.append(f"{place}: {'.'.join(map(str, (*key, part)))}: written twice; keep one")
            places[(*key, part)] = place
            result[part] = _construct(loader, value_node, name, places, (*key, part), mistakes)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [_construct(loader, item, name, places, (*key, i), mistakes) for i, item in enumerate(node.value)]
    try:
        return loader.construct_object(node)
    except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError) as error:
        # An impossible date, a number beyond all, a tag that does not fit.
        mistakes.append(f"{places[key]}: {'.'.join(map(str, key))}: not a value: {error}")
        return None
