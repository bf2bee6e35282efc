"""YAML files with the position of every value, so that messages can point at mistakes."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from holotorch.experiments.config.errors import ConfigError, short
from holotorch.io.bundled import similar_config, similar_path

Key = tuple[str | int, ...]
EXPERIMENT = "settings such as 'experiment: pec'"
_MAX_BYTES = 1 << 17  # limit for a file; parsing that many bytes takes up to 4 s
_MAX_VALUES = 100_000  # a file of _MAX_BYTES can have more values only through YAML aliases
_MAX_DEPTH = 50  # levels of nested keys; configurations have fewer than ten
_BY_NAME = {"transfer": "preset", "solver": "kind"}  # sections that may be given as the value of one of their keys


@dataclass
class Source:
    """Plain ``data`` of a file, and ``positions`` by key: ``file:line:column``, or the argument that sets the key."""

    path: Path
    data: dict[str, Any]
    positions: dict[Key, str] = field(default_factory=dict)

    def mistake(self, key: Key, message: str) -> str:
        """A line with the position of ``key``, or else of its nearest parent, and the message."""
        parent = key
        while parent and parent not in self.positions:
            parent = parent[:-1]
        name = ".".join(str(part) for part in key)
        return f"{self.positions.get(parent, f'{self.path}:1:1')}: {name + ': ' if name else ''}{message}"


def read_source(path: Path, overrides: list[str], wanted: str = EXPERIMENT) -> Source:
    """Read a YAML file and apply overrides ``key.sub=value`` to it. ConfigError with all mistakes that prevent reading.

    ``wanted`` describes in messages what such a file contains.
    """
    try:
        with open(path, "rb") as stream:
            data = stream.read(_MAX_BYTES + 1)
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a UTF-8 text file"
        if isinstance(error, FileNotFoundError):
            # Bundled configurations are experiments: none of them is a camera that this file was meant to be.
            near = similar_config(path) if wanted == EXPERIMENT else similar_path(path)
            hint = f"; did you mean {near}?" if near else "" if wanted == EXPERIMENT else f"; expected {wanted}"
            reason = f"{reason}{hint}"
        raise ConfigError([f"{path}: cannot read the configuration: {reason}"]) from None
    if len(data) > _MAX_BYTES:
        size = f"more than {_MAX_BYTES} bytes"
        raise ConfigError([f"{path}: {size}; expected {wanted}, with long tables in files of their own"])
    source = Source(path, {})
    mistakes: list[str] = []
    data = _parse(text, str(path), source.positions, (), mistakes)
    if isinstance(data, dict) and not mistakes:
        source.data = data
        for word in overrides:
            override(source, word, mistakes)
    elif not mistakes:
        problem = f"the file is empty; expected {wanted}" if data is None else f"expected {wanted}, got {short(data)}"
        mistakes.append(f"{path}:1:1: {problem}")
    if mistakes:
        raise ConfigError(mistakes)
    return source


def override(source: Source, word: str, mistakes: list[str]) -> None:
    """Apply ``key.sub=value`` to the data of ``source``; a word that cannot be applied is added to ``mistakes``."""
    name, equals, text = word.partition("=")
    key = tuple(name.split("."))
    if not equals or not all(key):
        mistakes.append(f"argument {word!r}: expected key=value or key.sub=value")
        return
    parent = source.data
    for part in key[:-1]:
        if part in _BY_NAME and isinstance(parent.get(part), str):
            parent[part] = {_BY_NAME[part]: parent[part]}
        parent = parent.setdefault(part, {})
        if not isinstance(parent, dict):
            mistakes.append(f"argument {word!r}: {part!r} is a single value and has no settings inside")
            return
    position = f"argument {word!r}"
    for replaced in [other for other in source.positions if other[: len(key)] == key]:
        del source.positions[replaced]
    for end in range(1, len(key) + 1):
        source.positions.setdefault(key[:end], position)
    parent[key[-1]] = _parse(text, position, {}, key, mistakes)


class _Loader(yaml.SafeLoader):
    """Refuses deep nesting while reading, since PyYAML's time grows with the square of the number of open brackets."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.depth > _MAX_DEPTH:
            raise RecursionError
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _parse(text: str, name: str, positions: dict[Key, str], key: Key, mistakes: list[str]) -> Any:
    try:
        loader = _Loader(text)
        loader.name = name
        node = loader.get_single_node()
        return None if node is None else _construct(loader, node, name, positions, key, mistakes)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        position = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        mistakes.append(f"{position}: not valid YAML: {error.problem or error.context}")
    except yaml.YAMLError as error:
        mistakes.append(f"{name}: not valid YAML: {' '.join(str(error).split())}")
    except _TooManyValues as error:
        many = f"more than {_MAX_VALUES} values in all"
        mistakes.append(f"{error}: its aliases (*name) stand for {many}; write out what is needed")
    except RecursionError:
        mistakes.append(f"{name}: not a configuration: nested without end")
    return None


class _TooManyValues(Exception):
    """Aliases stand for too many values; the message is the position at which the limit is exceeded."""


def _construct(loader, node: yaml.Node, name: str, positions: dict[Key, str], key: Key, mistakes: list[str]) -> Any:
    if len(key) > _MAX_DEPTH:
        raise RecursionError
    positions.setdefault(key, f"{name}:{node.start_mark.line + 1}:{node.start_mark.column + 1}")
    if len(positions) > _MAX_VALUES:  # every value has a position
        raise _TooManyValues(positions[key])
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            part = key_node.value if isinstance(key_node, yaml.ScalarNode) else "?"
            position = f"{name}:{key_node.start_mark.line + 1}:{key_node.start_mark.column + 1}"
            if part in result:
                mistakes.append(f"{position}: {'.'.join(map(str, (*key, part)))}: written twice; keep one")
            positions[(*key, part)] = position
            result[part] = _construct(loader, value_node, name, positions, (*key, part), mistakes)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [_construct(loader, item, name, positions, (*key, i), mistakes) for i, item in enumerate(node.value)]
    try:
        value = loader.construct_object(node)
        if isinstance(value, int):
            str(value)  # ValueError beyond 4300 digits, which no message could state; YAML has such hexadecimal numbers
        return value
    except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError) as error:
        # Examples are an impossible date, a number that is too large, and a tag that does not fit its value.
        mistakes.append(f"{positions[key]}: {'.'.join(map(str, key))}: not a value: {error}")
        return None
