"""A synthetic recording of a catheter that moves over a drape, with where it truly is: something to track at once."""

import csv
import io
import math
from contextlib import suppress
from pathlib import Path

import torch
from tqdm import tqdm

from holotorch.experiments.config_tracking import save_camera, save_catheter
from holotorch.experiments.run import claim
from holotorch.io.files import write_text
from holotorch.io.recording import Recorder
from holotorch.io.video import Frame
from holotorch.tracking.protocols import coverage
from holotorch.tracking.scenery import SKIN, drape, finger
from holotorch.tracking.world import World

RATE = 30.0  # frames per second
_TIP = ("tip_x_m", "tip_y_m", "tip_z_m")
_COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2")
_SHARES = {"median": 0.5, "p95": 0.95, "worst": 1.0}
_WRONG = 5.0  # mm
_COLUMNS = ("frame", "time_s", *_TIP, "direction_x", "direction_y", "direction_z")


def write_synthetic(out: Path | None, frames: int = 45, size: tuple[int, int] = (1080, 1920)) -> Path:
    """Render a recording, and ``truth.csv`` beside its frames; its folder, ``out`` or the next free runs/synthetic-001.

    A catheter swings over a surgical drape and skin-coloured fingers pass over its bands. ``holotorch track`` takes
    the folder as it is, with the camera and the catheter that were rendered.
    """
    folder = claim(out, "synthetic")
    if (folder / "images").is_dir():
        (folder / "images").rmdir()
    world = World(size=size)
    cloth = drape(size, 0, (70, 120, 130))
    scale = size[1] / 1920
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
                middle = world.camera.project((tip + 0.127 * along)[None])[0]
                # A finger passes over the second band for a while.
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
    return folder


def errors(poses: Path, truth: Path) -> dict[str, float]:
    """How far the tips of a poses.csv lie from a truth.csv, as plain JSON values in mm; nothing where there is none.

    ``coverage``: share of the answered frames whose truth lies in the 95 % ellipsoid of the stated covariance.
    ``wrong``: frames off by more than 5 mm.
    """
    if not (poses.is_file() and truth.is_file()):
        return {}
    with open(truth, newline="") as stream:
        table = csv.DictReader(stream)
        if not {"frame", *_TIP} <= set(table.fieldnames or ()):
            return {}  # another table of that name
        true = {row["frame"]: [row[name] for name in _TIP] for row in table}
    with open(poses, newline="") as stream:
        known = [row for row in csv.DictReader(stream) if row["frame"] in true]
    rows = [row for row in known if row["tip_x_m"] not in ("", "nan")]
    found: dict[str, float] = {"frames": len(rows), "refused": len(known) - len(rows)}
    if not rows:
        return found
    tips, places = (
        torch.tensor([[float(value) for value in values] for values in part], dtype=torch.float64)
        for part in ([[row[name] for name in _TIP] for row in rows], [true[row["frame"]] for row in rows])
    )
    away = (1e3 * (tips - places).norm(dim=-1)).sort().values
    last = len(away) - 1
    found |= {f"{name}_mm": float(away[round(share * last)]) for name, share in _SHARES.items()}
    found["wrong"] = int((away > _WRONG).sum())
    if all(rows[0].get(name) for name in _COVARIANCE):
        upper = torch.tensor([[float(row[name]) for name in _COVARIANCE] for row in rows], dtype=torch.float64)
        with suppress(ValueError):  # a covariance that is none has no ellipsoid
            found["coverage"] = coverage(tips, upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3), places)[0]
    return found


def compared(poses: Path, truth: Path) -> str:
    """The same in words."""
    found = errors(poses, truth)
    if not found.get("frames"):
        return f"Truth      no frame answered of {found.get('refused', 0)} (synthetic)"
    return (
        f"Truth      the tip is {found['median_mm']:.2f} mm off (median), {found['worst_mm']:.2f} at most, "
        f"in {found['frames']} frames; {found['refused']} refused (synthetic)"
    )
