"""The inputs of a tracking run: a source of frames, its camera, the catheter, and the tracker."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking import devices
from holotorch.io.bundled import find_config
from holotorch.io.recording import is_recording, open_recording
from holotorch.io.video import Frames, is_camera, no_such_source, open_frames
from holotorch.tracking import Camera, Catheter, CatheterTracker, ChannelOrder, Pose, ThesisTracker
from holotorch.tracking.camera.calibration import SURE
from holotorch.tracking.detection.channels import ambiguities, ambiguity_text
from holotorch.tracking.pose.rolling_shutter import READOUT

# Largest distance of a principal point from the centre of the frame, as a share of the frame's side. For frames of 720
# rows and a camera calibrated for 1080 rows, or vice versa, the distance is a sixth or more.
_OFF_CENTRE = 0.15
Tracker = Callable[[Tensor, Sequence[Pose] | None], list[Pose]]


class TrackingInputs(NamedTuple):
    """The inputs of a run. The caller that opened them must close ``frames``.

    ``paths`` maps the names of the copies in the run folder to the two YAML files.
    """

    frames: Frames
    camera: Camera
    catheter: Catheter
    tracker: Tracker
    paths: dict[str, Path]


def open_inputs(
    source: str | Path,
    camera: Path | None,
    catheter: Path | None,
    method: str,
    rate: float | None,
    *,
    still: bool = False,
) -> TrackingInputs:
    """Open a source and its YAML files, and create a tracker for it.

    Args:
        source: A video, a folder of pictures, a folder of a recording, or the index of a camera.
        camera: YAML file; by default the one beside the recording.
        catheter: YAML file; by default the one beside the recording.
        method: "ours" or "thesis".
        rate: Frames per second of a source without time stamps.
        still: Whether the catheter rests, so that a rolling shutter does no harm.

    Raises:
        ConfigError: An input cannot be used, or the inputs do not fit together.
    """
    replayed = _is_replay(source)
    paths: dict[str, Path] = {}
    missing: list[str] = []
    for name, path in (("camera", camera), ("catheter", catheter)):
        beside = Path(source) / f"{name}.yaml"
        if path is not None:
            paths[f"{name}.yaml"] = find_config(path) or path
        elif replayed and beside.is_file():
            paths[f"{name}.yaml"] = beside
        else:
            here = f", such as --{name} {name}.yaml" if Path(f"{name}.yaml").is_file() else ""
            missing.append(f"no {name} is given: say which with --{name}{here}, or {name}: in a configuration")
    if missing:
        raise ConfigError(missing)
    lens, bands = _loaded(paths)
    model, tool = devices.build_camera(lens), devices.build_catheter(bands)
    readout = 0.0 if still or lens.shutter == "global" else READOUT
    tracker = fitting_tracker(method, model, tool, paths["catheter.yaml"], readout)
    try:
        frames = open_recording(Path(source)) if replayed else open_frames(source, rate)
    except ValueError as error:
        raise ConfigError([str(error)]) from None
    try:
        _check_intrinsics(lens, frames)
    except ConfigError:
        frames.__exit__()
        raise
    if not _same_colours(bands.colours_from, source, frames) and (doubt := ambiguity_text(ambiguities(model, tool))):
        frames.notes.append(doubt)
    return TrackingInputs(frames, model, tool, tracker, paths)


def first_frame(video: Path) -> Path:
    """Name of the picture of the first frame of a video, as ``calibrate catheter`` saves it."""
    return Path(f"{video.stem}-frame.png")


def _same_colours(colours_from: str | None, source: str | Path, frames: Frames) -> bool:
    """Whether the bands' colours were read from these frames, so that exchanged channels are exchanged in both."""
    path = Path(source)
    return bool(colours_from) and colours_from in {path.name, str(first_frame(path)), frames.recorded_from}


def _is_replay(source: str | Path) -> bool:
    """Whether the source is a recording. Raises ConfigError if it does not exist or is an incomplete recording."""
    path = Path(source)
    if not (path.exists() or is_camera(source)):
        raise ConfigError([no_such_source(source)])
    if is_recording(path):
        return True
    parts = ("recording.json", "frames.rgb")
    if any((path / name).is_file() for name in parts):
        missing = [name for name in (parts[0], "times.csv") if not (path / name).is_file()]
        raise ConfigError([f"{path}: a recording without its {' and '.join(missing)} cannot be replayed"])
    return False


def _loaded(paths: dict[str, Path]) -> tuple[devices.CameraSettings, devices.CatheterSettings]:
    """Load the camera and the catheter. ConfigError lists the mistakes of both files."""
    mistakes: list[str] = []
    loaded: list[Any] = []
    for load, name in ((devices.load_camera, "camera.yaml"), (devices.load_catheter, "catheter.yaml")):
        try:
            loaded.append(load(paths[name]))
        except ConfigError as error:
            mistakes += error.mistakes
    if mistakes:
        raise ConfigError(mistakes)
    return loaded[0], loaded[1]


def fitting_tracker(
    method: str, camera: Camera, catheter: Catheter, path: Path | None, readout: float = READOUT
) -> Tracker:
    """:func:`make_tracker`, with a ConfigError for unsuitable colours at their line in ``path``, the catheter's file.

    Without a file, the catheter is the one of the thesis.
    """
    try:
        return make_tracker(method, camera, catheter, readout)
    except ValueError as error:
        if path is None:
            raise ConfigError([f"the camera does not suit the catheter of the thesis: {error}"]) from None
        raise devices.misfit(path, error) from None


def make_tracker(method: str, camera: Camera, catheter: Catheter, readout: float = READOUT) -> Tracker:
    """Create the tracker of a method. Raises ValueError if the method cannot distinguish the catheter's colours.

    ``readout`` is that of :class:`CatheterTracker`.
    """
    if method == "thesis":
        return ThesisTracker(camera, catheter)
    return CatheterTracker(camera, catheter, channels=ChannelOrder.RGB, readout=readout)  # all sources deliver RGB


def _check_intrinsics(lens: devices.CameraSettings, frames: Frames) -> None:
    """Check that the intrinsics belong to these frames, since wrong ones give wrong poses that look plausible.

    Raises ConfigError for another frame size, and adds a note for a principal point far from the centre or an uncertain
    focal length.
    """
    height, width = frames.shape
    if lens.size is not None and tuple(lens.size) != frames.shape:
        size = f"{lens.size[1]} x {lens.size[0]}"
        raise ConfigError([f"the camera's file holds for frames of {size} px, and these have {width} x {height} px"])
    if lens.size is None and max(abs(lens.cx / width - 0.5), abs(lens.cy / height - 0.5)) > _OFF_CENTRE:
        frames.notes.append(
            f"the principal point ({lens.cx:.0f}, {lens.cy:.0f}) is far from the middle of frames of {width} x "
            f"{height} px: was the camera calibrated at another resolution?"
        )
    unsure = lens.calibration.deviations.get("fx", 0.0) / lens.fx if lens.calibration else 0.0
    if unsure > SURE:
        frames.notes.append(
            f"the camera's calibration determines its focal length only to {100 * unsure:.1f} %: distances are about "
            "as uncertain, with the same error in all frames, besides the deviations"
        )
