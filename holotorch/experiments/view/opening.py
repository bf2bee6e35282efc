"""Opens the viewer of a finished run."""

from importlib import import_module
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.registry import find_kind, load_config
from holotorch.experiments.runs.record import RunRecord, kind_of
from holotorch.experiments.view.viewer import Viewer

# Module and class of the viewer of each kind that has one.
VIEWERS = {
    "pec": ("holotorch.experiments.view.kinds.pec", "PECViewer"),
    "volume": ("holotorch.experiments.view.kinds.volume", "VolumeViewer"),
    "eye": ("holotorch.experiments.view.kinds.eye", "EyeViewer"),
    "joint": ("holotorch.experiments.view.kinds.joint", "JointViewer"),
}


def open_viewer(folder: Path) -> Viewer:
    """The viewer of a finished run. ConfigError for any other folder, or one whose files cannot be used."""
    try:
        record = RunRecord(folder, "holotorch view {}", lambda run: kind_of(run) in VIEWERS)
        status = record.summary["status"]
    except ConfigError:
        raise
    except (ValueError, TypeError, LookupError, OSError) as error:
        raise ConfigError([f"{folder} holds a run that cannot be read: {type(error).__name__} {error}"]) from None
    if record.kind not in VIEWERS:
        kinds = f"only those of {', '.join(VIEWERS)} can be viewed; see {folder / 'report.html'}"
        raise ConfigError([f"{folder} holds a run of kind {record.kind}, and {kinds}"])
    if status != "complete":
        raise ConfigError([f"{folder} holds a run that is not finished; go on with: holotorch resume {folder}"])
    settings = load_config(folder / "config.yaml")
    if settings.experiment != record.kind:
        kinds = f"config.yaml describes a {settings.experiment} and summary.json a {record.kind}"
        raise ConfigError([f"{folder} holds no run: {kinds}"])
    module, name = VIEWERS[record.kind]
    try:
        return getattr(import_module(module), name)(folder, find_kind(record.kind).build(settings))
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError([f"{folder}: {error}"]) from None
