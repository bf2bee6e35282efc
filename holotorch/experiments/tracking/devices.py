"""YAML files of cameras, of catheters, and of a camera's position on a headset."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import torch
import yaml
from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from holotorch.core.quantities import TOOL_LENGTH, TOOL_POSITION, TOOL_RADIUS
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.messages import validated
from holotorch.experiments.config.settings import Count, Length, Number, Settings, Side, number, plausible
from holotorch.experiments.config.source import read_source
from holotorch.io.files import write_text
from holotorch.tracking.camera.calibration import PARAMETERS, Calibration
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.alignment import Alignment
from holotorch.tracking.pose.catheter import NO_GAPS, Catheter
from holotorch.tracking.pose.pose import solve_pose
from holotorch.tracking.pose.status import Pose


def _tone(value: Any) -> Any:
    if value in ("srgb", "linear") or (
        isinstance(value, list | tuple)
        and len(value) == 256
        and all(isinstance(item, float | int) and 0 <= item <= 1 for item in value)
        and all(b > a for a, b in pairwise(value))
    ):
        return value
    raise PydanticCustomError("tone", "expected srgb, linear, or the light of the 256 levels, rising from 0 to 1")


def _colour(value: Any) -> Any:
    if value is None:
        raise PydanticCustomError("colour", "a colour ({no_gaps})", {"no_gaps": NO_GAPS})
    return value


_INTRINSICS = "fx", "fy", "cx", "cy"
Positive = Annotated[Number, Field(gt=0)]
Level = Annotated[int, BeforeValidator(number), Field(ge=0, le=255)]
Colour = Annotated[tuple[Level, Level, Level], BeforeValidator(_colour)]
Row = tuple[Number, Number, Number, Number]
Row6 = tuple[Number, Number, Number, Number, Number, Number]


class EvidenceSettings(Settings):
    """Quality of a calibration, for users and for warnings while tracking; see ``Calibration`` and ``Coverage``."""

    deviations: dict[str, Number]
    rms_px: Number
    views: dict[str, Number]
    left_out: dict[str, Number] = {}
    cells: Number
    radius: Number
    tilts: tuple[Number, Number]
    between: Number
    warnings: tuple[str, ...] = ()


class CameraSettings(Settings):
    """A camera; see ``Camera``.

    ``distortion``: k1, k2, p1, p2, k3 in OpenCV's order. ``size``: rows and columns of its frames.
    ``tone``: srgb, linear, or a list of the linear intensity (0 to 1) of each of the 256 grey levels. ``shutter``:
    rolling, as of most webcams, which read a frame row after row; global if all rows are exposed at the same time.
    """

    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    distortion: Annotated[tuple[Number, ...], Field(min_length=5, max_length=5)] = (0.0, 0.0, 0.0, 0.0, 0.0)
    size: tuple[Side, Side] | None = None
    tone: Annotated[str | tuple[Number, ...], BeforeValidator(_tone)] = "srgb"
    shutter: Literal["rolling", "global"] = "rolling"
    calibration: EvidenceSettings | None = None


class CatheterSettings(Settings):
    """A catheter; see ``Catheter``.

    ``edges``: distances of the band edges from the tip, four or more, since those of two bands leave no pose that could
    be verified. ``colours``: sRGB triples, one for each band; bands touch each other, so there is one less than edges.
    ``colours_from``: name of the picture or video from which the colours were read; in its frames, the order of the
    colour channels cannot be wrong.
    """

    edges: Annotated[tuple[Annotated[Length, plausible(TOOL_POSITION)], ...], Field(min_length=4)]
    colours: tuple[Colour, ...]
    radius: Annotated[Length, plausible(TOOL_RADIUS)]
    length: Annotated[Length, plausible(TOOL_LENGTH)]
    colours_from: str | None = None


class HeadsetSettings(Settings):
    """Position of a camera on a headset: rows of the 4 x 4 matrix from camera to headset coordinates, in metres.

    The axes of both are x right, y down, z forward. ``frame``: name of the frame, headset, or world for a camera that
    stands in a room. ``residuals`` and ``leave_one_out``: errors in metres of the alignments from which the matrix was
    computed, and ``covariance`` of its turn and shift, see ``Alignment``. An entry of ``leave_one_out`` is null if the
    other alignments alone do not determine the matrix.
    """

    headset_from_camera: tuple[Row, Row, Row, Row]
    frame: Literal["headset", "world"] = "headset"
    covariance: tuple[Row6, Row6, Row6, Row6, Row6, Row6] | None = None
    residuals: tuple[Number, ...] = ()
    leave_one_out: tuple[Number | None, ...] = ()
    alignments: Count | None = None


AnySettings = TypeVar("AnySettings", bound=Settings)


def load_camera(path: Path | str, overrides: Sequence[str] = ()) -> CameraSettings:
    """Read a camera's file, apply overrides and check it. ConfigError gives file, line and column of mistakes."""
    return _load(CameraSettings, build_camera, path, overrides)


def calibration_sd(settings: CameraSettings, catheter: Catheter, pose: Pose) -> float | None:
    """Standard deviation in metres that the camera's calibration adds to the tip of a pose; None without one.

    ``pose`` is that of one catheter, in the camera's frame, and ``settings`` are those of the camera that saw it.
    The tip of the same edges is solved with each of fx, fy, cx and cy changed by its deviation, and the displacements
    are added in squares. Those of the distortion are left out: they make up for one another between the boards.
    """
    if settings.calibration is None:
        return None
    edges = build_camera(settings).project(pose.tip + catheter.positions[:, None] * pose.direction)
    others = [
        build_camera(settings.model_copy(update={name: getattr(settings, name) + deviation}))
        for name in _INTRINSICS
        if (deviation := settings.calibration.deviations.get(name, 0.0))
    ]
    tips = [solve_pose(edges[None], catheter.positions, camera).tip[0] for camera in others]
    moved = [tip - pose.tip for tip in tips if bool(tip.isfinite().all())]
    return float(torch.stack(moved).norm()) if moved else None


def load_catheter(path: Path | str, overrides: Sequence[str] = ()) -> CatheterSettings:
    """Read and check a catheter's file; see :func:`load_camera`."""
    return _load(CatheterSettings, build_catheter, path, overrides)


def load_headset(path: Path | str, overrides: Sequence[str] = ()) -> HeadsetSettings:
    """Read and check the file of a camera's position on a headset; see :func:`load_camera`."""
    return _load(HeadsetSettings, build_headset, path, overrides)


def _load(
    model: type[AnySettings], build: Callable[[AnySettings], Any], path: Path | str, overrides: Sequence[str]
) -> AnySettings:
    """Read and check settings; an error of ``build`` that begins with the name of a key is reported at its line."""
    needed = ", ".join(name for name, field in model.model_fields.items() if field.is_required())
    kind = model.__name__.removesuffix("Settings").lower()
    source = read_source(Path(path), list(overrides), f"the settings of a {kind}: {needed}")
    for other in (CameraSettings, CatheterSettings, HeadsetSettings):
        if other is not model and set(source.data) and set(source.data) <= set(other.model_fields):
            given = other.__name__.removesuffix("Settings").lower()
            raise ConfigError([f"{path}: this is the file of a {given}, but that of a {kind} is expected ({needed})"])
    settings = validated(source, model)
    try:
        build(settings)
    except ValueError as error:
        word, _, rest = str(error).partition(" ")
        known = word in model.model_fields
        raise ConfigError([source.mistake((word,) if known else (), rest if known else str(error))]) from None
    return settings


def build_camera(settings: CameraSettings) -> Camera:
    """Create the camera that the settings describe."""
    matrix = [[settings.fx, 0.0, settings.cx], [0.0, settings.fy, settings.cy], [0.0, 0.0, 1.0]]
    tone = settings.tone if isinstance(settings.tone, str) else torch.tensor(settings.tone, dtype=torch.float64)
    distortion = torch.tensor(settings.distortion, dtype=torch.float64)
    return Camera(torch.tensor(matrix, dtype=torch.float64), distortion, tone, settings.size)


def build_catheter(settings: CatheterSettings) -> Catheter:
    """Create the catheter that the settings describe."""
    return Catheter(settings.edges, settings.colours, settings.radius, settings.length)


def build_headset(settings: HeadsetSettings) -> torch.Tensor:
    """The matrix headset_from_camera, float64 [4, 4]. ValueError unless it is rigid."""
    matrix = rigid_matrix("headset_from_camera", settings.headset_from_camera)
    if (covariance := headset_covariance(settings)) is not None:
        least = torch.linalg.eigvalsh(covariance).min()
        if not torch.equal(covariance, covariance.mT) or least < -1e-9 * covariance.trace().abs():
            raise ValueError("covariance must be symmetric and without negative eigenvalues")
    return matrix


def rigid_matrix(name: str, rows: Sequence[Sequence[float]]) -> torch.Tensor:
    """Rows of a 4 x 4 matrix as float64 [4, 4]. ValueError unless it is a rotation and a shift of at most 10 m."""
    matrix, last = torch.tensor(rows, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[3]
    rotation, shift = matrix[:3, :3], matrix[:3, 3]
    orthogonal = torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-6)
    if not orthogonal or rotation.det() < 0 or not torch.equal(matrix[3], last) or shift.abs().max() > 10:
        raise ValueError(f"{name} must be a rotation without mirroring, a shift in metres, and the last row 0, 0, 0, 1")
    return matrix


def headset_covariance(settings: HeadsetSettings) -> torch.Tensor | None:
    """Covariance float64 [6, 6] of the matrix, as in ``Alignment``; None if it is unknown."""
    return None if settings.covariance is None else torch.tensor(settings.covariance, dtype=torch.float64)


def save_camera(
    path: Path,
    camera: Camera | Calibration,
    size: tuple[int, int] | None = None,
    shutter: Literal["rolling", "global"] = "rolling",
) -> None:
    """Write a camera, or a calibration with its quality. ``size`` (H, W) in pixels is only used for a ``Camera``."""
    evidence = None
    if isinstance(camera, Calibration):
        values = vars(camera) | vars(camera.coverage)
        evidence = EvidenceSettings(**{name: values[name] for name in EvidenceSettings.model_fields})
        camera, size = camera.camera, camera.size
    matrix = camera.matrix.detach()
    intrinsics = map(float, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    settings = CameraSettings(
        **dict(zip(PARAMETERS, intrinsics, strict=False)),
        distortion=tuple(camera.distortion.detach().tolist()),
        size=size,
        tone=camera.tone if isinstance(camera.tone, str) else tuple(camera.tone.tolist()),
        shutter=shutter,
        calibration=evidence,
    )
    words = "A camera: pixels; distortion k1, k2, p1, p2, k3; size in rows and columns; shutter: rolling or global."
    _write(path, words, settings)


def save_tone(path: Path, settings: CameraSettings, tone: torch.Tensor) -> None:
    """Write a camera with another tone curve, float64 [256], and all else, also the quality of its calibration."""
    changed = settings.model_copy(update={"tone": tuple(tone.tolist())})
    _write(path, "A camera: pixels; distortion k1, k2, p1, p2, k3; size in rows and columns; measured tone.", changed)


def save_catheter(path: Path, catheter: Catheter, colours_from: str | None = None) -> None:
    """Write a catheter, for instance one whose edges were measured; see ``CatheterSettings`` on ``colours_from``."""
    settings = CatheterSettings(**vars(catheter), colours_from=colours_from)
    _write(path, "A catheter: lengths in metres, edges of its bands from the tip, colours as 8-bit sRGB.", settings)


def save_headset(path: Path, alignment: Alignment) -> None:
    """Write the position of a camera on a headset, with the residuals of the alignment."""
    left_out = [value if value != float("inf") else None for value in alignment.leave_one_out.tolist()]
    settings = {
        "headset_from_camera": alignment.headset_from_camera.detach().tolist(),
        "covariance": ((alignment.covariance + alignment.covariance.mT) / 2).tolist(),
        "residuals": alignment.residuals.tolist(),
        "leave_one_out": left_out,
        "alignments": len(left_out),
    }
    _write(path, "From the camera's frame to the headset's: metres, points as columns.", HeadsetSettings(**settings))


def misfit(path: Path, error: ValueError) -> ConfigError:
    """Error for a catheter that a tracker refused because of its colours; it names the line of the colours."""
    return ConfigError([read_source(path, []).mistake(("colours",), str(error))])


def _write(path: Path, comment: str, settings: Settings) -> None:
    data = settings.model_dump(mode="json", exclude_none=True)
    text = yaml.safe_dump(data, sort_keys=False, width=110, allow_unicode=True, default_flow_style=None)
    write_text(path, f"# {comment}\n{text}")
