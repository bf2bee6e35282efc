"""What one begins a configuration of a kind with: an example, and the schema that an editor completes and checks by."""

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
    """Write a configuration of a kind to begin with. ConfigError for an unknown kind and for a file that is there."""
    source = find_config(_named(name).example)
    assert source is not None  # it comes with the package
    if path.exists():
        raise ConfigError([f"{path} is there already; choose another --out"])
    try:
        write_text(path, source.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError([f"cannot write {path}: {error.strerror}; choose another --out"]) from None


def schema(name: str) -> str:
    """JSON Schema of the configurations of a kind. ConfigError for an unknown kind.

    An editor completes by it; ``holotorch check`` alone is strict. Numbers may be text with a unit, and a single value
    may stand for a list of one.
    """
    return json.dumps(_loosened(_named(name).settings.model_json_schema()), indent=2)


_LIMITS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}
_WRITTEN_AS = {
    "number": ["number", "string"],
    "integer": ["integer", "string"],
    "array": ["array", "number", "string"],
}


def _loosened(value: Any) -> Any:
    """A schema with its limits by their standard names, and the types that the settings' own validators take."""
    if isinstance(value, list):
        return [_loosened(each) for each in value]
    if not isinstance(value, dict):
        return value
    loose = {_LIMITS.get(key, key): _loosened(each) for key, each in value.items()}
    kind = value.get("type")
    return loose | {"type": _WRITTEN_AS[kind]} if isinstance(kind, str) and kind in _WRITTEN_AS else loose


def _named(name: str) -> ExperimentKind:
    if name not in KINDS:
        raise ConfigError([f"no kind {name!r}{nearest(name, list(KINDS))}; known: {', '.join(KINDS)}"])
    return find_kind(name)
