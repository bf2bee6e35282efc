"""Settings of a measurement."""

import re
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.settings import Count, Length, Number, Settings, number, several

SYNTHETIC = "synthetic"
# Rows, columns and spacing in metres of the grids of Secs. 3.5.2 (8.16 cm wide) and 3.5.3 of the dissertation.
GRIDS = {"grid2d": (9, 9, 10.2e-3), "grid3d": (8, 8, 10e-3)}
Protocol = Literal["still", "grid2d", "grid3d", "latency", "prediction", "edges", "tone"]
_KNOWN = r"^\d{1,2}(-\d{1,2})?$"  # an edge, or two

Side = Annotated[Count, Field(ge=2, le=100)]
Spacing = Annotated[Length, Field(ge=1e-3, le=0.5)]
Seconds = Annotated[Number, Field(gt=0, le=60)]


def _sources(value: Any) -> Any:
    """One source becomes a list of one; the index of a camera, which YAML reads as a number, becomes text."""
    return _words(several(value))


def _words(value: Any) -> Any:
    """A list whose whole numbers, as YAML reads 0, become text."""
    if not isinstance(value, list | tuple):
        return value
    return tuple(str(item) if isinstance(item, int) and not isinstance(item, bool) else item for item in value)


def _exposure(value: Any) -> Any:
    """Seconds of an exposure time such as 1/250 or 0.004."""
    if isinstance(value, str) and (match := re.fullmatch(r"(\d{1,6}(?:\.\d{1,9})?)(?:/(\d{1,6}))?", value.strip())):
        return float(match[1]) / max(float(match[2] or 1), 1e-9)
    return value


Exposure = Annotated[Number, BeforeValidator(_exposure), Field(gt=0, le=1e4)]


class GridSettings(Settings):
    """The grid that the tip visits row by row, each row from left to right.

    ``rows``, ``columns``, ``spacing``: by default those of the dissertation. ``reference``: (row, column) of the point
    to which all distances are taken, counted from 1; by default the middle. ``partial``: evaluate a grid of which
    points are missing. ``board``: chessboard on the sheet of grid2d, as after --board of ``holotorch calibrate``.
    """

    rows: Side | None = None
    columns: Side | None = None
    spacing: Spacing | None = None
    reference: tuple[Count, Count] | None = None
    partial: bool = False
    board: str = "chessboard 7x5 10mm"


class RestSettings(Settings):
    """When the tip counts as resting: for ``seconds`` and in ``frames``, within ``spread`` (rms, metres) of its mean.

    The default spread allows for a hand that holds the tip: the dissertation's S_RMS of a resting catheter is 0.33 mm.
    """

    seconds: Seconds = 0.5
    frames: Annotated[int, BeforeValidator(number), Field(ge=3, le=1000)] = 10
    spread: Annotated[Length, Field(gt=0, le=0.05)] = 0.5e-3


class MeasureSettings(Settings):
    """A protocol of Sec. 3.5 of the dissertation, for the user's own camera and catheter.

    ``source``: one or, for the faces of grid3d, several of: a video, a folder of pictures, a recording, the index of a
    camera, a run folder of ``holotorch track``, its poses.csv, or ``synthetic``: simulated poses of still, grid2d and
    grid3d. ``camera``, ``catheter``: YAML files, needed for frames without their own. ``rate_hz``: frames per second
    of a source without time stamps. ``reference_log``: table of the reference tracker of the protocol latency, with
    the columns time_s, x_m, y_m, z_m. ``delay``: seconds from capture to display, of the protocol prediction.
    ``known``: distances along the catheter that are exact, of the protocol edges: ``0`` for edge 0 and the tip, ``1-2``
    for edges 1 and 2. ``resting``: the tip was in one place in all frames. ``exposures``: exposure time in seconds of
    each photograph of the protocol tone, in the order of the file names; its source is a folder of photographs.
    """

    experiment: Literal["measure"]
    protocol: Protocol
    source: Annotated[tuple[str, ...], BeforeValidator(_sources), Field(min_length=1)]
    camera: str | None = None
    catheter: str | None = None
    rate_hz: Annotated[Number, Field(gt=0)] | None = None
    grid: GridSettings = GridSettings()
    rest: RestSettings = RestSettings()
    reference_log: str | None = None
    known: Annotated[tuple[Annotated[str, Field(pattern=_KNOWN)], ...], BeforeValidator(_words)] = ()
    resting: bool = False
    exposures: Annotated[tuple[Exposure, ...], BeforeValidator(_words)] = ()
    delay: Annotated[Number, Field(ge=0, le=1)] = 0.095
