"""Settings of a tracking run."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.settings import Count, Number, Settings

SYNTHETIC = "synthetic"
FRAMES = 45  # of a synthetic recording: one swing of the catheter


def _camera_number(value: Any) -> Any:
    """Convert the index of a camera, which YAML reads as a number, to text."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class TrackSettings(Settings):
    """Tracking of a catheter in a video, a folder of pictures, a recording, or the frames of a live camera.

    ``source``: a path, the index of a camera, or ``synthetic``. A synthetic run first renders a recording of
    ``frames`` frames with true poses, 45 by default; of other sources, all frames are tracked. ``camera``: YAML file of
    its intrinsics, as ``holotorch calibrate`` writes it; by default, that beside the recording, or a synthetic camera
    if ``source`` is ``synthetic``. ``catheter``: YAML file of its bands; by default, that beside the recording, or the
    dissertation's catheter. ``headset``: YAML file of the camera's place on a headset; poses are also written in its
    frame. ``record``: save every frame without loss for a later run. ``video``: write a video with the pose drawn on
    every frame; of a synthetic recording also one without. ``still``: measure the tip's stability; the catheter must
    rest. ``rate_hz``: frames per second without time stamps. ``batch``: frames that are tracked at a time; above 1,
    each is searched as a whole, without the pose before.
    """

    experiment: Literal["track"]
    source: Annotated[str, BeforeValidator(_camera_number)]
    camera: str | None = None
    catheter: str | None = None
    headset: str | None = None
    frames: Count | None = None
    method: Literal["ours", "thesis"] = "ours"
    record: bool = False
    video: bool = True
    still: bool = False
    rate_hz: Annotated[Number, Field(gt=0)] | None = None
    batch: Annotated[Count, Field(le=64)] = 1  # 64 frames of 1080 x 1920 px take 400 MB

    @property
    def rendered(self) -> int:
        """Frames of a synthetic recording."""
        return FRAMES if self.frames is None else self.frames
