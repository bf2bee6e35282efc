"""Measurements that correct a file of the rig: the catheter's band edges, and the camera's tone curve."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.measure.config import MeasureSettings
from holotorch.experiments.measure.source import Source
from holotorch.experiments.tracking.devices import CameraSettings, load_camera, load_catheter, save_catheter, save_tone
from holotorch.io.bundled import find_config
from holotorch.io.video import Frames, open_frames
from holotorch.tracking import Camera, Catheter
from holotorch.tracking.camera.tone import tone_curve
from holotorch.tracking.pose.band_edges import BandEdges, fit_band_edges
from holotorch.tracking.pose.pose import solve_pose

_MOST = 200  # frames of a fit: more of one recording show the same poses again
_OUTLIER = 25.0  # chi-square of a frame above the median, above which its edges count as wrong: 5 sigma


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredCatheter:
    """A catheter with the measured positions of its edges.

    Attributes:
        catheter: The catheter, and the nominal one that was given.
        edges: Positions in metres and their covariance.
        used, left_out: Numbers of frames in the fit, and of those whose edges disagree with the others.
        rms_px: Root mean square of the residuals along and across the tool, in pixels.
        colours_from: Source of the colours of the nominal catheter.
    """

    catheter: Catheter
    nominal: Catheter
    edges: BandEdges
    used: int
    left_out: int
    rms_px: float
    colours_from: str | None = None

    def save(self, path: Path) -> None:
        """Write the catheter's file."""
        save_catheter(path, self.catheter, self.colours_from)


def known_distances(arguments: Sequence[str]) -> list[int | tuple[int, int]]:
    """Known distances from words: ``i`` for edge i and the tip, ``i-j`` for two edges, counted from 0."""
    parts = [[int(number) for number in word.split("-")] for word in arguments]
    return [part[0] if len(part) == 1 else (part[0], part[1]) for part in parts]


def measure_catheter(
    pixels: Sequence[Tensor | None], source: Source, known: Sequence[str], resting: bool
) -> MeasuredCatheter:
    """Fit the positions of the band edges to the edges that the tracker has measured.

    Args:
        pixels: For each frame the edges [N, 2] in pixels, or None.
        source: Source of the frames, with its camera and the nominal catheter.
        known: Distances that are exact, see :func:`known_distances`.
        resting: Whether the tip was in one place in all frames.

    Raises:
        ConfigError: Too few frames show all edges, or they and the known distances do not determine the positions.
    """
    if source.inputs is None or not hasattr(source.inputs.tracker, "edges_px"):
        text = "the edges are measured in the frames: expected a video, a folder, a recording or a camera"
        raise ConfigError([f"{source.name}: {text}, got poses"])
    camera, nominal = source.inputs.camera, source.inputs.catheter
    whole = [points for points in pixels if points is not None and bool(points.isfinite().all())]
    if not whole:
        text = f"none of {len(pixels)} frames shows all {len(nominal.edges)} edges; show the whole catheter, well lit"
        raise ConfigError([f"{source.name}: {text}"])
    step = math.ceil(len(whole) / _MOST)
    edges = torch.stack(whole[::step])
    try:
        given = known_distances(known)
        fit = fit_band_edges(edges, nominal.positions, camera, given, resting_tip=resting)
        kept = _agreeing(edges, fit.positions, camera)
        if not bool(kept.all()):
            fit = fit_band_edges(edges[kept], nominal.positions, camera, given, resting_tip=resting)
        positions = tuple(fit.positions.tolist())
        # An edge may have moved towards the rear end.
        catheter = dataclasses.replace(nominal, edges=positions, length=max(nominal.length, positions[-1]))
    except ValueError as error:
        raise ConfigError([f"{source.name}: {error}"]) from None
    used = int(kept.sum())
    rms = 0.1 * math.sqrt(fit.chi_square / max(fit.freedom, 1))  # the fit assumes 0.1 px
    colours_from = load_catheter(source.inputs.paths["catheter.yaml"]).colours_from
    return MeasuredCatheter(catheter, nominal, fit, used, len(kept) - used, rms, colours_from)


def catheter_rows(measured: MeasuredCatheter) -> list[dict[str, Any]]:
    """A row for each edge: nominal and measured distance from the tip, its deviation, and the change, in mm."""
    each = zip(measured.nominal.edges, measured.catheter.edges, measured.edges.deviations.tolist(), strict=True)
    return [
        {
            "edge": i,
            "nominal_mm": 1e3 * old,
            "measured_mm": 1e3 * new,
            "sd_mm": 1e3 * sd,
            "change_mm": 1e3 * (new - old),
        }
        for i, (old, new, sd) in enumerate(each)
    ]


def open_photographs(settings: MeasureSettings) -> Source:
    """The folder of photographs of the protocol tone. ConfigError if it or the camera's file cannot be used."""
    name = settings.source[0]
    if not Path(name).is_dir():
        raise ConfigError([f"source: expected a folder of photographs, got {name}"])
    _camera_settings(settings)
    with _pictures(name) as frames:
        count = frames.total
    if count != len(settings.exposures):
        got = f"{len(settings.exposures)} for the {count} photographs in {name}"
        raise ConfigError([f"exposures: expected one for each photograph, in the order of their names, got {got}"])
    return Source(name, path=Path(name))


def measure_camera(source: Source, settings: MeasureSettings) -> tuple[Tensor, Callable[[Path], None]]:
    """Tone curve float64 [256] of the photographs, and a function that writes the camera's file with it.

    Raises:
        ConfigError: A photograph cannot be read, or they and their exposures do not determine a curve.
    """
    photographs = []
    with _pictures(source.name) as frames:
        for frame in frames:
            if frame.pixels is None:
                raise ConfigError([f"{source.name}: {frame.problem}"])
            # Every n-th pixel: a million of them determine 256 levels, and a mean of pixels would blur the levels.
            step = max(1, math.ceil(math.sqrt(frame.pixels[0].numel() / 1e6)))
            photographs.append(frame.pixels[:, ::step, ::step])
    order = sorted(range(len(photographs)), key=settings.exposures.__getitem__)
    means = [float(photographs[i].double().mean()) for i in order]
    for (i, j), (dark, light) in zip(pairwise(order), pairwise(means), strict=True):
        if light < dark:
            text = f"photograph {j + 1} was exposed longer than photograph {i + 1} and is darker"
            raise ConfigError([f"{source.name}: {text}; are the exposures in the order of the file names?"])
    try:
        tone = tone_curve(torch.stack(photographs), torch.tensor(settings.exposures, dtype=torch.float64))
    except ValueError as error:
        raise ConfigError([f"{source.name}: {error}"]) from None
    return tone, partial(save_tone, settings=_camera_settings(settings), tone=tone)


def _camera_settings(settings: MeasureSettings) -> CameraSettings:
    path = settings.camera or ""
    return load_camera(find_config(path) or path)


def _pictures(name: str) -> Frames:
    try:
        return open_frames(name)
    except ValueError as error:
        raise ConfigError([str(error)]) from None


def _agreeing(edges: Tensor, positions: Tensor, camera: Camera) -> Tensor:
    """Mask [F] of the frames whose edges [F, N, 2] fit the positions [N] about as well as those of the others do."""
    chi_square = solve_pose(edges, positions, camera).chi_square
    return chi_square <= chi_square.median() + _OUTLIER
