"""Help for writing a configuration: an example of each kind, all of its keys, and the JSON schema for editors."""

import json
from pathlib import Path
from textwrap import wrap
from typing import Any

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.keys import keys
from holotorch.experiments.config.messages import nearest
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.registry import KINDS, find_kind
from holotorch.io.bundled import find_config
from holotorch.io.files import write_text


def write_example(name: str, path: Path) -> None:
    """Write an example configuration of a kind, followed by all keys of the kind as comments.

    ConfigError for an unknown kind, or if the file exists already.
    """
    kind = _kind(name)
    source = find_config(kind.example)
    assert source is not None  # the package contains the example of each kind
    if path.exists():
        raise ConfigError([f"{path} is there already; choose another --out"])
    text = source.read_text(encoding="utf-8").rstrip("\n")
    head = f"# A configuration of kind {name} to begin with; its values are those of {kind.example}:"
    every = [f"# {line}" for line in keys_text(name).splitlines()]
    try:
        write_text(
            path, "\n".join([head, text, "", "# All keys, their values, [defaults] and meanings:", "#", *every, ""])
        )
    except OSError as error:
        raise ConfigError([f"cannot write {path}: {error.strerror}; choose another --out"]) from None


def keys_text(name: str, prefix: str = "") -> str:
    """A paragraph for each key of a kind that begins with ``prefix``. ConfigError for an unknown kind or key."""
    every = list(keys(_kind(name).settings))
    chosen = [key for key in every if key.name == prefix or key.name.startswith(f"{prefix.rstrip('.')}.") or not prefix]
    if not chosen:
        hint = nearest(prefix, [key.name for key in every])
        raise ConfigError([f"no key of {name} begins with {prefix!r}{hint}; all of them: holotorch keys {name}"])
    lines = []
    for key in chosen:
        default = f" [{key.default}]" if key.default else ""
        lines.append(f"{key.name}: {key.values}{default}")
        lines += wrap(key.meaning, 110, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(lines)


def schema(name: str) -> str:
    """JSON Schema of the configurations of a kind, with which editors complete keys. ConfigError for an unknown kind.

    It accepts any text as a number, since lengths have units, and a single value instead of a list; only
    ``holotorch check`` validates fully.
    """
    return json.dumps(_loosened(_kind(name).settings.model_json_schema()), indent=2)


_LIMITS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
_ACCEPTED = {
    "number": ["number", "string"],
    "integer": ["integer", "string"],
    "array": ["array", "number", "string"],
}


def _loosened(value: Any) -> Any:
    """A schema with pydantic's limits renamed as JSON Schema names them, and with all types that settings accept."""
    if isinstance(value, list):
        return [_loosened(each) for each in value]
    if not isinstance(value, dict):
        return value
    loose = {_LIMITS.get(key, key): _loosened(each) for key, each in value.items()}
    type_ = value.get("type")
    return loose | {"type": _ACCEPTED[type_]} if isinstance(type_, str) and type_ in _ACCEPTED else loose


def _kind(name: str) -> ExperimentKind:
    if name not in KINDS:
        raise ConfigError([f"no kind {name!r}{nearest(name, list(KINDS))}"])
    return find_kind(name)
