"""The registry of the kinds of experiments, and the reader of their configurations."""

from importlib import import_module
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError, short
from holotorch.experiments.config.inputs import with_its_files
from holotorch.experiments.config.messages import nearest, validated
from holotorch.experiments.config.source import Source, override, read_source
from holotorch.experiments.config.version import upgraded
from holotorch.experiments.kind import ExperimentKind
from holotorch.io.bundled import find_config

# Name of a kind in YAML, and the package whose module ``kind`` defines that kind; the module is loaded on demand.
KINDS = {
    "pec": "holotorch.experiments.pec",
    "pec_study": "holotorch.experiments.pec_study",
    "volume": "holotorch.experiments.volume",
    "eye": "holotorch.experiments.eye",
    "joint": "holotorch.experiments.joint",
    "track": "holotorch.experiments.tracking",
    "measure": "holotorch.experiments.measure",
    "perception_layout": "holotorch.experiments.perception.layout",
    "perception_analysis": "holotorch.experiments.perception.analysis",
}


def find_kind(name: str) -> ExperimentKind[Any, Any]:
    """The kind of this name. KeyError for a name that is not in ``KINDS``."""
    return import_module(f"{KINDS[name]}.kind").KIND


def run_name(config: Path | str, overrides: list[str], kind: str) -> str:
    """The name of a run's default folder: that of the user's data in ``overrides``, otherwise of the configuration.

    The kind follows the name of data, which runs of several kinds may show: "head-eye". Data of a file in a format that
    holds several, such as "a.h5::ct", have the name of the file.
    """
    given = Source(Path(config), {})
    for word in overrides:
        override(given, word, [])
    value: Any = given.data
    for part in find_kind(kind).data.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    path = Path(value.split("::")[0]) if isinstance(value, str) else None
    if path is None or not path.exists():  # such as the name of a bundled picture
        return Path(config).stem
    name = path.resolve().name if path.is_dir() else path.stem.removesuffix(".nii")
    return f"{name}-{kind}"


def load_config(path: Path | str, overrides: list[str] | None = None) -> Any:
    """Read a configuration, apply overrides ``key=value`` and validate it; returns the settings of its kind.

    ``path`` is a file, or the name of a configuration that comes with holotorch, such as "configs/demo.yaml".
    ConfigError with all mistakes, one line each with file, line and column.
    """
    source = with_its_files(upgraded(read_source(find_config(path) or Path(path), overrides or [])))
    name = source.data.get("experiment")
    if not isinstance(name, str) or name not in KINDS:
        got = (
            f"got {short(name)}" + nearest(str(name)[:100], list(KINDS))
            if "experiment" in source.data
            else "it is missing"
        )
        raise ConfigError([source.mistake(("experiment",), f"expected one of {', '.join(KINDS)}, {got}")])
    kind = find_kind(name)
    settings = validated(source, kind.settings)
    if mistakes := [source.mistake(key, message) for key, message in kind.contradictions(settings)]:
        raise ConfigError(mistakes)
    return settings
