"""The page of a stream: which catheter and camera it shows, and where it is served."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.streaming.stream import Frame, address, recording_of
from holotorch.experiments.tracking.devices import build_camera, build_catheter, load_camera, load_catheter
from holotorch.io.bundled import find_config
from holotorch.tracking import THESIS

if TYPE_CHECKING:
    from holotorch.experiments.streaming.page import PageServer

PLACE = "127.0.0.1:8765"
# What a page says in place of the tracked frames of a replay.
_UNSEEN = "no frames: the run has kept none; holotorch track with --record keeps them"


def open_page(
    source: str,
    camera: Path | None = None,
    catheter: Path | None = None,
    headset: Path | None = None,
    place: str | None = None,
    tls: Sequence[Path] | None = None,
    align: Path | None = None,
    volume: Path | None = None,
    panel: str | None = None,
) -> "PageServer":
    """Make the server of the page for a source; it is opened by ``async with``.

    The files of camera and catheter are by default those beside the source, as in a run folder or a recording, and then
    the dissertation's catheter and no camera. Poses in the frame of a headset are not shown as the camera sees them.
    ``align``: file of a headset, to which a user of the page aligns the camera. ``volume``: file of a registered
    volume. ``panel``: a video that the page shows, or ``pattern`` or ``overlay``, see ``pictures``.

    Raises:
        ConfigError: A file or address cannot be used.
    """
    from holotorch.experiments.streaming.aligning import Aligner
    from holotorch.experiments.streaming.page import PageServer
    from holotorch.experiments.streaming.pictures import OVERLAY, PanelSource
    from holotorch.experiments.streaming.registered import load_registered

    if align is not None and headset is not None:
        raise ConfigError(["--align and --headset: give one; --align FILE uses FILE where it exists"])
    folder = Path(source).parent if source.lower().endswith(".csv") else Path(source)
    lens, tool = (_file(folder, name, given) for name, given in (("camera", camera), ("catheter", catheter)))
    host, port = address(place or PLACE)
    if place is not None and ":" not in place:
        port = address(PLACE)[1]
    for path in tls or ():
        if not path.is_file():
            raise ConfigError([f"--tls: no file {path}; expected a certificate and its key"])
    try:
        shown = OVERLAY if panel == OVERLAY else None if panel is None else PanelSource(panel)
    except ValueError as error:
        raise ConfigError([f"--panel: {error}; or pattern, or overlay"]) from None
    replayed = source.lower().endswith(".csv")
    return PageServer(
        THESIS if tool is None else build_catheter(load_catheter(tool)),
        None if lens is None or headset is not None else build_camera(load_camera(lens)),
        frame=Frame.of(headset).name,
        host=host,
        port=port,
        certificate=None if tls is None else (tls[0], tls[1]),
        aligner=None if align is None else Aligner(align),
        volume=None if volume is None else load_registered(volume),
        panel=shown,
        empty=_UNSEEN if replayed and recording_of(folder) is None else "",
    )


def _file(folder: Path, name: str, given: Path | None) -> Path | None:
    """The file that was named, or the one in the folder, or None."""
    beside = folder / f"{name}.yaml"
    return (find_config(given) or given) if given is not None else beside if beside.is_file() else None
