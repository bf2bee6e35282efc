"""A synthetic recording of a catheter that moves over a drape, with where it truly is: something to track at once."""

import csv
import io
import math
from pathlib import Path

import torch
from tqdm import tqdm

from holotorch.experiments.config_tracking import save_camera, save_catheter
from holotorch.experiments.run import claim
from holotorch.io.files import write_text
from holotorch.io.recording import Recorder
from holotorch.io.video import Frame
from holotorch.tracking.scenery import SKIN, drape, finger
from holotorch.tracking.world import World

RATE = 30.0  # frames per second
_COLUMNS = ("frame", "time_s", "tip_x_m", "tip_y_m", "tip_z_m", "direction_x", "direction_y", "direction_z")


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


def compared(poses: Path, truth: Path) -> str:
    """How far the tips of a poses.csv lie from a truth.csv, in words."""
    with open(truth, newline="") as stream:
        true = {int(row["frame"]): row for row in csv.DictReader(stream)}
    names = _COLUMNS[2:5]
    away, refused = [], 0
    with open(poses, newline="") as stream:
        for row in csv.DictReader(stream):
            if row["tip_x_m"] in ("", "nan"):
                refused += 1
                continue
            other = true[int(row["frame"])]
            away.append(1e3 * math.dist([float(row[n]) for n in names], [float(other[n]) for n in names]))
    if not away:
        return f"Truth      no frame answered of {refused} (synthetic)"
    away.sort()
    return (
        f"Truth      the tip is {away[len(away) // 2]:.2f} mm off (median), {away[-1]:.2f} at most, "
        f"in {len(away)} frames; {refused} refused (synthetic)"
    )
