"""What the configuration of a tracking run may say."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.settings import Count, Number, Settings

SYNTHETIC = "synthetic"


def _camera_number(value: Any) -> Any:
    """The number of a camera, which YAML reads as a number, as text."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class TrackSettings(Settings):
    """A catheter tracked through a video, a folder of pictures, a recording, or what a camera sees.

    ``source``: a path, the number of a camera, or ``synthetic``, which renders a recording of ``frames`` with its truth
    first. ``camera``, ``catheter``: YAML files; by default those beside a recording, or a synthetic camera and the
    dissertation's catheter. ``record``: keep every frame, losslessly, so that it can be tracked again. ``video``: write
    the overlay video. ``still``: the catheter is at rest, so measure its stability. ``rate_hz``: frames per second of a
    source that has no times.
    """

    experiment: Literal["track"]
    source: Annotated[str, BeforeValidator(_camera_number)]
    camera: str | None = None
    catheter: str | None = None
    frames: Count = 45
    method: Literal["ours", "thesis"] = "ours"
    record: bool = False
    video: bool = True
    still: bool = False
    rate_hz: Annotated[Number, Field(gt=0)] | None = None
