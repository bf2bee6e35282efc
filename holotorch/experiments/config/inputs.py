"""Input files that the configuration of a run names, for commands in another folder than that of the run's start."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from holotorch.experiments.config.source import Key, Source
from holotorch.io.bundled import find_config

_LONGEST = 4096  # characters of a path


def with_its_files(source: Source) -> Source:
    """The configuration of a run's folder with absolute paths of files that it names relative to the run's start.

    ``env.json`` beside it tells in which folder the run was started. Other files than the ``config.yaml`` of a run,
    values of the command line and the names of bundled configurations stay as they are.
    """
    start = started_in(source.path.parent) if source.path.name == "config.yaml" else None
    if start is not None and start != Path.cwd():
        source.data = _absolute(source.data, (), source, start)
    return source


def started_in(run: Path) -> Path | None:
    """The folder in which the run of a folder was started; None if its ``env.json`` does not say."""
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):  # the last, if it is nested deeply
        return Path(json.loads((run / "env.json").read_text(encoding="utf-8"))["folder"])
    return None


def _absolute(value: Any, key: Key, source: Source, start: Path) -> Any:
    if isinstance(value, dict):
        return {name: _absolute(part, (*key, name), source, start) for name, part in value.items()}
    if isinstance(value, list):
        return [_absolute(part, (*key, i), source, start) for i, part in enumerate(value)]
    if not isinstance(value, str) or len(value) > _LONGEST or source.positions.get(key, "").startswith("argument"):
        return value
    path, *member = value.split("::")  # of an array in an archive
    with suppress(OSError, ValueError):
        # Bundled pictures, presets and kinds of things have names without a suffix.
        bundled = find_config(path) not in (None, Path(path))
        if Path(path).suffix and (start / path).exists() and not bundled:
            return "::".join([str(start / path), *member])
    return value
