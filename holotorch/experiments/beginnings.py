"""Help for writing a configuration: an example of each kind, and the JSON schema for editors."""

import json
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.messages import nearest
from holotorch.experiments.kind import ExperimentKind
from holotorch.experiments.registry import KINDS, find_kind
from holotorch.io.bundled import find_config
from holotorch.io.files import write_text


def write_example(name: str, path: Path) -> None:
    """Write an example configuration of a kind. ConfigError for an unknown kind, or if the file exists already."""
    source = find_config(_kind(name).example)
    assert source is not None  # the package contains the example of each kind
    if path.exists():
        raise ConfigError([f"{path} is there already; choose another --out"])
    try:
        write_text(path, source.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError([f"cannot write {path}: {error.strerror}; choose another --out"]) from None


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
        raise ConfigError([f"no kind {name!r}{nearest(name, list(KINDS))}; known: {', '.join(KINDS)}"])
    return find_kind(name)
