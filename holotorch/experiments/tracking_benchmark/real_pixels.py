"""Trackers on photographs by real cameras, into which the catheter is rendered."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.tracking_benchmark import methods
from holotorch.experiments.tracking_benchmark.bench import Row
from holotorch.experiments.tracking_benchmark.methods import BASE, COLD, FIT, Answer
from holotorch.io.images import load_image
from holotorch.tracking.camera.boards import Charuco, Chessboard, find_board
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import THESIS
from holotorch.tracking.simulation.photographs import Photograph, Pixels, measure, published_camera, rendered
from holotorch.tracking.simulation.world import Case, World

_SHARED = (
    ("bard_calib*.png", Chessboard(14, 10, 0.006), ("bard_intrinsics.txt", "bard_distortion.txt")),
    ("opencv_left*.jpg", Chessboard(9, 6, 0.025), ("opencv_left_intrinsics.yml",)),
    ("charuco_choriginal.jpg", Charuco(5, 7, 0.04, 0.02, "DICT_6X6_250"), ("charuco_camera.yml",)),
)


def shared_photographs(folder: Path) -> list[Photograph]:
    """Photographs of the boards of scikit-surgerybard and OpenCV in ``folder``, with their published cameras."""
    photographs = []
    for pattern, board, files in _SHARED:
        camera = published_camera([folder / name for name in files])
        photographs += [_opened(path, camera, board) for path in sorted(folder.glob(pattern))]
    return photographs


def _opened(path: Path, camera: Camera, board: Chessboard | Charuco) -> Photograph:
    frame = (255 * load_image(path)).round().to(torch.uint8).expand(3, -1, -1).contiguous()
    try:
        view = find_board(frame, board, path.name)
    except ValueError:
        view = None
    return Photograph(path.name, frame, camera, view, path.read_bytes() if path.suffix == ".jpg" else None)


def real_pixels(photographs: Sequence[Photograph], poses: int) -> tuple[list[Row], bytes, list[str]]:
    """Outcomes of the trackers on photographs with and without the catheter.

    Args:
        photographs: Photographs of boards.
        poses: Number of poses of the catheter in each.

    Returns:
        A row for each photograph and method, a PNG of the photographs with the true and the estimated tip, and lines
        of text.
    """
    rows, shown, everything = [], [], list[Answer]()
    for photograph in tqdm(photographs, "real pixels", unit="photo", dynamic_ncols=True):
        pixels = measure(photograph)
        height, width = photograph.frame.shape[-2:]
        world = World((height, width), photograph.camera, THESIS)
        trackers = methods.methods(world, (BASE, COLD, FIT))
        cases = [rendered(photograph, pixels, seed) for seed in range(poses)]
        cases[0] = replace(cases[0], frame=cache(cases[0].frame))  # it is shown too
        own = list(methods.answers(cases, trackers, None))
        bare = Case(f"bare {photograph.name}", lambda frame=photograph.frame: frame, None, None, False, "")
        own += methods.answers([bare], trackers, None)
        rows += [_row(photograph, pixels, name, own) for name in trackers]
        shown.append((photograph, cases[0], next(answer for answer in own if answer.method == COLD)))
        everything += own
    return rows, _sheet(shown), list(_lines(everything))


def _row(photograph: Photograph, pixels: Pixels, method: str, own: Sequence[Answer]) -> Row:
    shown = [answer for answer in own if answer.method == method and answer.answerable]
    bare = [answer for answer in own if answer.method == method and not answer.answerable]
    errors = [1e3 * answer.error for answer in shown if answer.answered]
    return {
        "photograph": photograph.name,
        "colours": "grey" if photograph.grey else "colour",
        "blur_px": round(pixels.blur_px, 2) if math.isfinite(pixels.blur_px) else "",
        "noise_levels": round(_noise_levels(photograph, pixels), 2),
        "white": " ".join(f"{value:.2f}" for value in pixels.white),
        "method": method,
        "frames": len(shown),
        "right": sum(answer.right for answer in shown),
        "wrong": sum(answer.wrong for answer in shown),
        "refused": sum(not answer.answered for answer in shown),
        "median_mm": round(float(np.median(errors)), 3) if errors else "",
        "refusals": "; ".join(sorted({answer.reason for answer in shown if not answer.answered})),
        "bare": "answered" if any(answer.answered for answer in bare) else "refused",
    }


def _noise_levels(photograph: Photograph, pixels: Pixels) -> float:
    """Standard deviation of the noise in 8-bit levels, at half the light of white squares."""
    light = 0.5 * max(pixels.white)
    spread = math.sqrt(pixels.shot_noise * light + pixels.read_noise**2)
    low, high = photograph.camera.levels(
        torch.tensor([light - spread / 2, light + spread / 2], dtype=torch.float64)
    ).tolist()
    return high - low


def _lines(own: Sequence[Answer]) -> Iterator[str]:
    for method in dict.fromkeys(answer.method for answer in own):
        shown = [answer for answer in own if answer.method == method and answer.answerable]
        bare = [answer for answer in own if answer.method == method and not answer.answerable]
        errors = [1e3 * answer.error for answer in shown if answer.answered]
        median = f"median {np.median(errors):.3f} mm" if errors else "no pose"
        yield (
            f"catheter in real photographs, {method}: {sum(a.right for a in shown)} of {len(shown)} right, "
            f"{sum(a.wrong for a in shown)} wrong by more than 5 mm, {sum(not a.answered for a in shown)} refused, "
            f"{median}; "
            f"{sum(a.answered for a in bare)} of {len(bare)} bare photographs answered"
        )


def _sheet(shown: Sequence[tuple[Photograph, Case, Answer]]) -> bytes:
    """PNG of a frame of each photograph with the true tip as a circle, and the estimated one as a cross."""
    columns = min(4, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure = Figure(figsize=(4.8 * columns, 3.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, (photograph, case, answer) in zip(panels, shown, strict=False):
        assert case.tip is not None
        axes.imshow(case.frame().permute(1, 2, 0).numpy())
        for tip, marker, colour in ((case.tip.tolist(), "o", "lime"), (answer.tip, "+", "yellow")):
            x, y = photograph.camera.project(torch.tensor(tip, dtype=torch.float64)).tolist()
            axes.plot(x, y, marker, color=colour, markersize=14, markerfacecolor="none", scalex=False, scaley=False)
        outcome = "right" if answer.right else "wrong" if answer.wrong else answer.status.name
        axes.set_title(f"{photograph.name}: {outcome}", fontsize=9)
    return figure_png(figure)
