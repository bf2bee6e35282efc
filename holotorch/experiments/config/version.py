"""Version of the configurations that runs write into their folders, and what older ones mean."""

import re
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.source import Source

# Version 1 has no version line; in an eye run, ``tolerance`` is for the propagation to the retina alone.
# In version 2, ``tolerance`` is for all parts together, and ``eye.tolerance`` for the propagation to the retina.
VERSION = 2
FIRST_LINE = f"# holotorch configuration, version {VERSION}\n"
_LINE = re.compile(r"# holotorch configuration, version (\d{1,6})\s*")


def upgraded(source: Source) -> Source:
    """A configuration with the keys of this version. ConfigError if a later holotorch has written it.

    Only files with a version line, and files of run folders without one, are changed; other files are used as they are.
    """
    version = _version(source.path)
    if version > VERSION:
        raise ConfigError(
            [
                f"{source.path}:1:1: expected a configuration of version {VERSION} or older, got {version}: a later "
                "holotorch has written it; update this one (pip install -U holotorch)"
            ]
        )
    data = source.data
    if (
        version < 2
        and data.get("experiment") == "eye"
        and "tolerance" in data
        and isinstance(data.get("eye", {}), dict)
    ):
        source.data = {key: value for key, value in data.items() if key != "tolerance"}
        source.data["eye"] = {"tolerance": data["tolerance"]} | data.get("eye", {})
    return source


def _version(path: Path) -> int:
    try:
        with open(path, encoding="utf-8") as stream:
            first = stream.readline(200)
    except (OSError, UnicodeDecodeError):
        return VERSION
    if match := _LINE.fullmatch(first):
        return int(match[1])
    return 1 if path.name == "config.yaml" and (path.parent / "env.json").is_file() else VERSION
