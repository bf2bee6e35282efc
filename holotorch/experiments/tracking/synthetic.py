"""A synthetic recording of a catheter that moves over a drape, with its true poses."""

import csv
import math
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.folder import claim
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.tracking import devices
from holotorch.experiments.tracking.config import SYNTHETIC
from holotorch.experiments.tracking.forecast import HALF, working_range
from holotorch.experiments.tracking.report import COLUMNS, quantile
from holotorch.io.bundled import find_config
from holotorch.io.recording import Recorder, is_recording
from holotorch.io.video import Frame, replacing_video
from holotorch.tracking.evaluation.protocols import coverage
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.simulation.cast import Tube
from holotorch.tracking.simulation.scenery import SKIN, drape, finger
from holotorch.tracking.simulation.world import World, synthetic_camera

RATE = 30.0  # frames per second
VIDEO = "video.avi"  # Motion JPEG: unlike MPEG-4 it keeps the band edges sharp enough for every frame
_SIZE = (1080, 1920)  # (H, W) for a camera without a frame size
_SWING = 45  # frames after which the motion repeats
_DISTANCE = 0.5  # metres: usual mean distance of the middle of the bands from the camera
_SHARE = 0.8  # of the working range: the bands are tilted by up to 23 degrees and swing 6 % farther away
_TIP, _COVARIANCE = COLUMNS[5:8], COLUMNS[11:17]
_TRUTH = ("frame", "time_s", *COLUMNS[5:11])  # columns of truth.csv
_WRONG = 5.0  # mm: error above which a pose counts as wrong


def write_synthetic(
    out: Path,
    frames: int,
    size: tuple[int, int] = _SIZE,
    camera: Path | None = None,
    catheter: Path | None = None,
    *,
    video: bool = False,
) -> Path:
    """Render a recording with its true poses in ``truth.csv``. Returns the folder.

    A catheter swings over a surgical drape, at :func:`synthetic_distance`, and skin-coloured fingers pass over its
    bands. ``holotorch track`` can read the folder, which also contains the rendered camera and catheter. If rendering
    ends early, the folder is removed.

    Args:
        out: New or empty folder.
        frames: Number of frames to render.
        size: (H, W) in pixels, for a camera without a frame size.
        camera: YAML file; by default :func:`synthetic_camera` is used.
        catheter: YAML file; by default the catheter of the thesis is used.
        video: Whether the frames are also written as ``video.avi``, to try with what a camera would have recorded.

    Raises:
        ConfigError: A file cannot be used, the folder is in use, or the catheter would not be in front of the camera.
    """
    world = synthetic_world(camera, catheter, size)
    distance = synthetic_distance(world)
    poses = synthetic_poses(world, frames, distance)
    folder = claim(out, "synthetic")
    try:
        _render(folder, poses, world, _DISTANCE / distance, video)
    except BaseException:
        shutil.rmtree(folder)  # the folder was empty before
        raise
    return folder


def synthetic_world(camera: Path | None, catheter: Path | None, size: tuple[int, int] = _SIZE) -> World:
    """Frame size, camera and catheter that :func:`write_synthetic` renders. ConfigError for invalid files."""
    settings = None if camera is None else devices.load_camera(find_config(camera) or camera)
    tool = THESIS
    if catheter is not None:
        tool = devices.build_catheter(devices.load_catheter(find_config(catheter) or catheter))
    size = (settings and settings.size) or size
    return World(size, synthetic_camera(size) if settings is None else devices.build_camera(settings), tool)


def synthetic_distance(world: World) -> float:
    """Mean distance in metres of the middle of the bands from the camera.

    It is 0.5 m, or four fifths of :func:`working_range` in colours of half the resolution where that is less, so that
    the video can be tracked too. It is not so small that the bands leave the frame or that the tube is too close to be
    rendered; if that is so up to 0.5 m, it is 0.5 m.
    """
    near = _SHARE * working_range(world.camera, world.catheter, HALF)[0]
    if near >= _DISTANCE:
        return _DISTANCE
    for step in range(_SWING):
        distance = near * (_DISTANCE / near) ** (step / _SWING)
        if all(_in_view(world, *_swing(world, i, distance)) for i in range(0, _SWING, 5)):
            return distance
    return _DISTANCE


def distance_text(world: World) -> str:
    """A line with :func:`synthetic_distance` and its reason, to follow that of the working range."""
    distance, largest = synthetic_distance(world), working_range(world.camera, world.catheter, HALF)[0]
    if _SHARE * largest >= _DISTANCE:
        reason = "well within the range"
    elif distance == _SHARE * largest:
        reason = f"four fifths of the range in such colours, since the usual {_DISTANCE:g} m is too far for its video"
    else:
        reason = "any nearer, its bands would leave the frame, or the tube come within ten radii of the camera"
        if distance >= largest:
            reason += "; this is beyond the range in such colours, so that few frames of its video will have a pose"
    return f"Distance   the bands of the synthetic catheter are about {distance:.2g} m from the camera: {reason}"


def synthetic_poses(world: World, frames: int, distance: float) -> list[tuple[Tensor, Tensor]]:
    """Tip in metres and direction, float64 [3] each, of each frame. ConfigError if one of them cannot be rendered."""
    poses = [_swing(world, i, distance) for i in range(frames)]
    try:
        for pose in poses[:_SWING]:
            Tube(world.catheter, *pose, world.look)
    except ValueError as error:
        raise ConfigError([f"this catheter cannot be rendered with this camera: {error}"]) from None
    return poses


def _swing(world: World, frame: int, distance: float) -> tuple[Tensor, Tensor]:
    phase = 2 * math.pi * frame / _SWING
    at = (0.05 * math.sin(phase), 0.03 * math.cos(phase))
    depth = distance + 0.06 * distance * math.sin(phase)
    return world.pose(depth, math.radians(15 + 8 * math.cos(phase)), 0.4, at)


def _in_view(world: World, tip: Tensor, direction: Tensor) -> bool:
    """Whether all band edges are in the frame, and the tube is not too close to the camera to be rendered."""
    try:
        Tube(world.catheter, tip, direction, world.look)
    except ValueError:
        return False
    height, width = world.size
    x, y = (
        world.camera.project(tip + world.catheter.positions[:, None] * direction).detach().unbind(-1)
    )  # NaN behind the camera
    return bool(((x >= 0) & (x < width) & (y >= 0) & (y < height)).all())


def _render(folder: Path, poses: Sequence[tuple[Tensor, Tensor]], world: World, enlarged: float, video: bool) -> None:
    if (folder / "images").is_dir():
        (folder / "images").rmdir()
    size, tool = world.size, world.catheter
    cloth = drape(size, 0, (70, 120, 130))
    # The finger's sizes below are for fx = 1400 px and the usual distance, from which it appears ``enlarged``.
    scale = float(world.camera.matrix[0, 0]) / 1400 * enlarged
    middle = (tool.edges[0] + tool.edges[-1]) / 2  # metres from the tip
    rows = []
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as temporary:
        copies = {name: Path(temporary, name) for name in ("camera.yaml", "catheter.yaml")}
        devices.save_camera(copies["camera.yaml"], world.camera, size, "global")
        devices.save_catheter(copies["catheter.yaml"], tool, SYNTHETIC)
        movie = replacing_video(folder / VIDEO, size, RATE) if video else nullcontext()
        with Recorder(folder, size, RATE, SYNTHETIC, copies) as recorder, movie as writer:
            for i, (tip, along) in enumerate(tqdm(poses, desc="rendering", unit="frame")):
                x, y = world.camera.project((tip + middle * along)[None])[0].tolist()
                # A finger covers the middle of the bands in 10 of 45 frames.
                covered = 20 <= i % _SWING < 30
                fingers = finger((x, y - 260 * scale), (x, y + 14 * scale), 16 * scale, SKIN) if covered else ()
                case = world.case(f"synthetic {i}", (tip, along), lambda: cloth, occluders=tuple(fingers))
                pixels = case.frame()
                recorder.write(Frame(i / RATE, pixels))
                if writer is not None:
                    writer.write(pixels)
                numbers = [f"{value:.9f}" for value in torch.cat([tip, along]).tolist()]
                rows.append(dict(zip(_TRUTH, (i, f"{i / RATE:.6f}", *numbers), strict=True)))
    write_table(folder / "truth.csv", rows)


def read_truth(folder: Path) -> dict[str, list[float]]:
    """True tips (x, y, z) in metres from truth.csv in a folder, by frame number as text; empty without the table.

    A table of this name with other columns is ignored in a folder of pictures, and is an error in a recording.

    Raises:
        ConfigError: The table is not valid. The message names the first wrong line.
    """
    path = folder / "truth.csv"
    if not path.is_file():
        return {}
    columns, truth = ("frame", *_TIP), dict[str, list[float]]()
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            table = csv.DictReader(stream)
            names = table.fieldnames or ()
            if missing := [name for name in columns if name not in names]:
                if not is_recording(folder):
                    return {}
                raise ConfigError([f"{path}:1: columns {', '.join(missing)} are missing, got {', '.join(names)}"])
            for row in table:
                try:
                    frame, tip = str(int(row["frame"])), [float(row[name]) for name in _TIP]
                    if not all(map(math.isfinite, tip)) or frame in truth:
                        raise ValueError
                except (TypeError, ValueError):
                    got = ",".join(str(row[name]) for name in columns)
                    text = "the number of a frame, each once, and a finite tip in metres"
                    raise ConfigError([f"{path}:{table.line_num}: expected {text}, got {got}"]) from None
                truth[frame] = tip
    except (UnicodeDecodeError, csv.Error):
        raise ConfigError([f"{path}: not a table in UTF-8 text"]) from None
    return truth


def errors(poses: Path, true: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Statistics of the distances from the tips in a poses.csv to the true tips, as JSON values; empty without truth.

    ``true`` is a result of :func:`read_truth`. Keys ending in ``_mm`` are quantiles of the distances in millimetres,
    ``coverage`` is the share of poses whose 95 % ellipsoid contains the truth, and ``wrong`` the number of poses with
    an error above 5 mm.
    """
    with open(poses, newline="") as stream:
        known = [row for row in csv.DictReader(stream) if row["frame"] in true]
    if not known:
        return {}
    rows = [row for row in known if row["tip_x_m"] not in ("", "nan")]
    statistics: dict[str, float] = {"frames": len(rows), "refused": len(known) - len(rows)}
    if not rows:
        return statistics
    tips = torch.tensor([[float(row[name]) for name in _TIP] for row in rows], dtype=torch.float64)
    true_tips = torch.tensor([true[row["frame"]] for row in rows], dtype=torch.float64)
    distances = 1e3 * (tips - true_tips).norm(dim=-1)
    for name, share in (("median", 0.5), ("p95", 0.95), ("worst", 1.0)):
        statistics[f"{name}_mm"] = quantile(distances, share)
    statistics["wrong"] = int((distances > _WRONG).sum())
    if all(rows[0].get(name) for name in _COVARIANCE):
        upper = torch.tensor([[float(row[name]) for name in _COVARIANCE] for row in rows], dtype=torch.float64)
        with suppress(ValueError):  # a singular covariance has no ellipsoid
            covariance = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
            statistics["coverage"] = coverage(tips, covariance, true_tips)[0]
    return statistics


def compared(statistics: Mapping[str, float]) -> str:
    """The result of :func:`errors` as a sentence."""
    if not statistics["frames"]:
        return f"Truth      no frame answered of {statistics['refused']} (synthetic)"
    return (
        f"Truth      the tip is {statistics['median_mm']:.2f} mm off (median), {statistics['worst_mm']:.2f} at most, "
        f"in {statistics['frames']} frames; {statistics['refused']} refused (synthetic)"
    )
