"""The folder of an export: the usual one in the folder of the run, numbered where that is taken, or a given one."""

from itertools import chain, count
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError


def claim(out: Path | None, usual: Path) -> Path:
    """Create the folder ``out``, or the first of ``usual``, ``usual-002``, ... that holds no files.

    ConfigError if ``out`` holds files, or the folder cannot be created.
    """
    numbered = (usual.with_name(f"{usual.name}-{number:03d}") for number in count(2))
    for place in chain([usual], numbered) if out is None else [out]:
        try:
            place.mkdir(parents=True, exist_ok=True)
            if not any(place.iterdir()):
                return place
        except OSError as error:
            raise ConfigError([f"cannot write to {place}: {error.strerror}; choose another place with --out"]) from None
    raise ConfigError([f"{out} holds files already; choose another --out or delete it"])
