"""A synthetic recording of a catheter that moves over a drape, with its true poses."""

import csv
import io
import math
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import torch
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.folder import claim
from holotorch.experiments.tracking.devices import (
    build_camera,
    build_catheter,
    load_camera,
    load_catheter,
    save_camera,
    save_catheter,
)
from holotorch.io.bundled import find_config
from holotorch.io.files import write_text
from holotorch.io.recording import Recorder, is_recording
from holotorch.io.video import Frame
from holotorch.tracking.evaluation.protocols import coverage
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.simulation.scenery import SKIN, drape, finger
from holotorch.tracking.simulation.world import World, synthetic_camera

RATE = 30.0  # frames per second
_SIZE = (1080, 1920)  # (H, W) for a camera without a frame size
_TIP = ("tip_x_m", "tip_y_m", "tip_z_m")
_COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2")
_SHARES = {"median": 0.5, "p95": 0.95, "worst": 1.0}
_WRONG = 5.0  # mm: error above which a pose counts as wrong
_COLUMNS = ("frame", "time_s", *_TIP, "direction_x", "direction_y", "direction_z")


def write_synthetic(
    out: Path,
    frames: int,
    size: tuple[int, int] = _SIZE,
    camera: Path | None = None,
    catheter: Path | None = None,
) -> Path:
    """Render a recording with its true poses in ``truth.csv``. Returns the folder.

    A catheter swings over a surgical drape, and skin-coloured fingers pass over its bands. ``holotorch track`` can read
    the folder, which also contains the rendered camera and catheter. If rendering ends early, the folder is removed.

    Args:
        out: New or empty folder.
        frames: Number of frames to render.
        size: (H, W) in pixels, for a camera without a frame size.
        camera: YAML file; by default :func:`synthetic_camera` is used.
        catheter: YAML file; by default the catheter of the thesis is used.

    Raises:
        ConfigError: A file cannot be used, the folder is in use, or the catheter would not be in front of the camera.
    """
    lens = None if camera is None else load_camera(find_config(camera) or camera)
    tool = THESIS if catheter is None else build_catheter(load_catheter(find_config(catheter) or catheter))
    size = (lens and lens.size) or size
    seen = synthetic_camera(size) if lens is None else build_camera(lens)
    folder = claim(out, "synthetic")
    try:
        _render(folder, frames, World(size=size, camera=seen, catheter=tool))
    except ValueError as error:
        shutil.rmtree(folder)
        raise ConfigError([f"this catheter cannot be rendered with this camera: {error}"]) from None
    except BaseException:
        shutil.rmtree(folder)  # it was empty when this function began
        raise
    return folder


def frame_size(camera: Path | None) -> tuple[int, int]:
    """(H, W) of the frames that :func:`write_synthetic` renders for a camera. ConfigError for an invalid file."""
    return (None if camera is None else load_camera(find_config(camera) or camera).size) or _SIZE


def _render(folder: Path, frames: int, world: World) -> None:
    if (folder / "images").is_dir():
        (folder / "images").rmdir()
    size, tool = world.size, world.catheter
    cloth = drape(size, 0, (70, 120, 130))
    scale = float(world.camera.matrix[0, 0]) / 1400  # the finger's sizes below are for fx = 1400 px
    across = (tool.edges[0] + tool.edges[-1]) / 2
    table = io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(_COLUMNS)
    own = folder.with_name(f".{folder.name}.parts")
    own.mkdir(exist_ok=True)
    try:
        save_camera(own / "camera.yaml", world.camera, size)
        save_catheter(own / "catheter.yaml", world.catheter)
        copies = {name: own / name for name in ("camera.yaml", "catheter.yaml")}
        with Recorder(folder, size, RATE, "synthetic", copies) as recorder:
            for i in tqdm(range(frames), desc="rendering", unit="frame"):
                turn = 2 * math.pi * i / 45
                at = (0.05 * math.sin(turn), 0.03 * math.cos(turn))
                tip, along = world.pose(0.5 + 0.03 * math.sin(turn), math.radians(15 + 8 * math.cos(turn)), 0.4, at)
                middle = world.camera.project((tip + across * along)[None])[0]
                # A finger covers the middle of the bands in 10 of 45 frames.
                covers = 20 <= i % 45 < 30
                start = (float(middle[0]), float(middle[1]) - 260 * scale)
                end = (float(middle[0]), float(middle[1]) + 14 * scale)
                fingers = finger(start, end, 16 * scale, SKIN) if covers else ()
                case = world.case(f"synthetic {i}", (tip, along), lambda: cloth, occluders=tuple(fingers))
                recorder.write(Frame(i / RATE, case.frame()))
                rows.writerow([i, f"{i / RATE:.6f}", *(f"{value:.9f}" for value in torch.cat([tip, along]).tolist())])
    finally:
        for path in own.iterdir():
            path.unlink()
        own.rmdir()
    write_text(folder / "truth.csv", table.getvalue())


def read_truth(folder: Path) -> dict[str, list[float]]:
    """True tips in metres by frame number, from truth.csv in a folder; empty without such a table.

    A table of this name with other columns is ignored in a folder of pictures, and is an error in a recording.

    Raises:
        ConfigError: The table is not valid. The message names the first wrong line.
    """
    path = folder / "truth.csv"
    if not path.is_file():
        return {}
    wanted, truth = ("frame", *_TIP), dict[str, list[float]]()
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            table = csv.DictReader(stream)
            names = table.fieldnames or ()
            if missing := [name for name in wanted if name not in names]:
                if not is_recording(folder):
                    return {}
                raise ConfigError([f"{path}:1: columns {', '.join(missing)} are missing, got {', '.join(names)}"])
            for row in table:
                try:
                    frame, tip = str(int(row["frame"])), [float(row[name]) for name in _TIP]
                    if not all(map(math.isfinite, tip)) or frame in truth:
                        raise ValueError
                except (TypeError, ValueError):
                    got = ",".join(str(row[name]) for name in wanted)
                    text = "the number of a frame, each once, and a finite tip in metres"
                    raise ConfigError([f"{path}:{table.line_num}: expected {text}, got {got}"]) from None
                truth[frame] = tip
    except (UnicodeDecodeError, csv.Error):
        raise ConfigError([f"{path}: not a table in UTF-8 text"]) from None
    return truth


def errors(poses: Path, true: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Statistics of the distances from the tips in a poses.csv to the truth, as JSON values; empty without a truth.

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
    tips, true_tips = (
        torch.tensor([[float(value) for value in values] for values in part], dtype=torch.float64)
        for part in ([[row[name] for name in _TIP] for row in rows], [true[row["frame"]] for row in rows])
    )
    distances = (1e3 * (tips - true_tips).norm(dim=-1)).sort().values
    last = len(distances) - 1
    statistics |= {f"{name}_mm": float(distances[round(share * last)]) for name, share in _SHARES.items()}
    statistics["wrong"] = int((distances > _WRONG).sum())
    if all(rows[0].get(name) for name in _COVARIANCE):
        upper = torch.tensor([[float(row[name]) for name in _COVARIANCE] for row in rows], dtype=torch.float64)
        with suppress(ValueError):  # a singular covariance has no ellipsoid
            statistics["coverage"] = coverage(tips, upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3), true_tips)[
                0
            ]
    return statistics


def compared(statistics: Mapping[str, float]) -> str:
    """The result of :func:`errors` as a sentence."""
    if not statistics["frames"]:
        return f"Truth      no frame answered of {statistics['refused']} (synthetic)"
    return (
        f"Truth      the tip is {statistics['median_mm']:.2f} mm off (median), {statistics['worst_mm']:.2f} at most, "
        f"in {statistics['frames']} frames; {statistics['refused']} refused (synthetic)"
    )
