"""Chart of free-space propagation: error and time of every method, and a test of the predicted errors."""

import math
import platform
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import phasor
from holotorch.core.fourier import fft2, filter_spectrum, ifft2
from holotorch.core.grid import Grid
from holotorch.experiments.runs.figures import draw_front, figure_png, mark_choice
from holotorch.experiments.timing import interleaved
from holotorch.optics import AngularSpectrum, CroppedKernel, Fresnel, Propagator, unaliased_distance
from holotorch.optics.free_space.plane_pair import PlanePair
from holotorch.optics.planning.candidates import candidates
from holotorch.optics.planning.content import FieldContent
from holotorch.optics.planning.propagate import kernel_of

WAVELENGTH = 530e-9  # metres
PEER_LIMIT = 512  # pixels along a side up to which torchoptics is measured; larger grids take minutes
SOURCES = ("smooth", "slm", "white", "hard edge")  # test fields, see ``source``
TOLERANCE = 1e-3  # allowed relative L2 error of the planned method
PLANNED = "planned, tolerance 1e-3"
BARE = "bare FFTs, pad 2, float32 kernel"


@dataclass(frozen=True)
class Amount:
    """Size of the measurement; the grids are pixels along each side, and pitch in metres."""

    cases: tuple[tuple[int, float], ...] = (
        (256, 8e-6), (512, 8e-6), (1024, 8e-6), (2048, 8e-6), (256, 3.74e-6), (512, 3.74e-6), (1024, 3.74e-6)
    )  # fmt: skip
    distances: tuple[float, ...] = (1e-3, 5e-3, 20e-3, 60e-3, 200e-3, 2.0)  # metres
    shown: tuple[int, float] = (512, 8e-6)  # the grid whose error is drawn against time
    large: int = 2000  # pixels along a side from which only ``few_distances`` are measured
    few_distances: tuple[float, ...] = (5e-3, 60e-3, 2.0)  # metres
    predictions: int = 40  # number of random cases that test the predicted errors


FULL = Amount()
QUICK = Amount(cases=((256, 8e-6), (256, 3.74e-6)), distances=(5e-3, 60e-3, 2.0), shown=(256, 8e-6), predictions=6)


def propagation(quick: bool = False) -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Table rows of the chart, table rows of the test of predictions, PNG pictures by name, and lines of text."""
    amount = QUICK if quick else FULL
    with warnings.catch_warnings(action="ignore", category=SamplingWarning):
        rows = [row for size, pitch in amount.cases for row in _measure(size, pitch, amount)]
        prediction = _predictions(amount.predictions)
    pictures = {"chart": _draw(rows, amount), "validity": _draw_validity(rows, amount)}
    return rows, prediction, pictures, _verdict(rows, prediction, amount)


def source(kind: str, grid: Grid) -> Tensor:
    """A test field, complex128 [H, W].

    ``kind``: "smooth" is a Gaussian amplitude, "slm" a smooth random phase, "white" a random phase that is independent
    in every sample, "hard edge" a disc.
    """
    generator = torch.Generator().manual_seed(1)
    y, x = grid.coordinates()
    square = y**2 + x**2
    random = torch.rand(grid.shape, dtype=torch.float64, generator=generator)
    if kind == "smooth":
        return torch.exp(-square / (0.1 * grid.extent[0]) ** 2).to(torch.complex128)
    if kind == "hard edge":
        return (square < (0.3 * grid.extent[0]) ** 2).to(torch.complex128)
    if kind == "slm":
        # White noise times a Gaussian spectrum that falls to 1/e at 0.06 cycles per pixel.
        fy, fx = grid.frequencies()
        low = torch.exp(-((fy * grid.pitch[0]) ** 2 + (fx * grid.pitch[1]) ** 2) / 0.06**2)
        smooth = ifft2(fft2(random - 0.5) * low).real
        return phasor(2 * smooth / smooth.std())
    return phasor(2 * math.pi * random)


def _measure(size: int, pitch: float, amount: Amount) -> list[dict[str, Any]]:
    """Table rows of every method, source and distance on one grid; ``pitch`` in metres."""
    grid, wide, rows = Grid(size, pitch), Grid(2 * size, pitch), []
    fields = {kind: source(kind, grid) for kind in SOURCES}
    distances = amount.distances if size < amount.large else amount.few_distances
    for distance in tqdm(distances, desc=f"{size} px, {pitch * 1e6:g} um", unit="distance"):
        reference = CroppedKernel(wide, WAVELENGTH, distance)
        exact = {kind: _exact(reference, field) for kind, field in fields.items()}
        methods = _methods(grid, distance)
        dtypes = {name: torch.complex128 if "complex128" in name else torch.complex64 for name in methods}
        calls = {name: partial(call, fields["white"].to(dtypes[name])) for name, call in methods.items()}
        seconds = interleaved(calls, rounds=5 if size < amount.large else 3)
        for name, call in methods.items():
            for kind, field in fields.items():
                rows.append(
                    {
                        "size_px": size,
                        "pitch_um": pitch * 1e6,
                        "distance_m": distance,
                        "crossovers": round(distance / unaliased_distance(grid, WAVELENGTH, 2), 4),
                        "source": kind,
                        "method": name,
                        "error": _error(call(field.to(dtypes[name])), exact[kind]),
                        "seconds": f"{seconds[name]:.3e}",
                        "ratio_to_bare": round(seconds[name] / seconds[BARE], 3),
                    }
                )
    return rows


def _exact(reference: CroppedKernel, field: Tensor) -> Tensor:
    """Propagate a field [H, W], padded with zeros to the larger window of ``reference``; the result is [H, W]."""
    (height, width), (rows, columns) = field.shape, reference.grid.shape
    padded = torch.nn.functional.pad(field, (0, columns - width, 0, rows - height))
    return reference(padded[None])[0, :height, :width]


def _error(field: Tensor, exact: Tensor) -> str:
    """Relative L2 error of a field, as text."""
    return f"{((field.to(torch.complex128) - exact).norm() / exact.norm()).item():.3e}"


def _methods(grid: Grid, distance: float) -> dict[str, Callable[[Tensor], Tensor]]:
    """Functions that propagate a field [H, W] by each method, with kernels computed in advance."""
    height, width = grid.shape
    padded = grid.padded(2)
    fy, fx = (f.float() for f in padded.frequencies())
    root = torch.sqrt(torch.clamp(1 / WAVELENGTH**2 - fy**2 - fx**2, min=0))
    # Many programs compute the kernel in float32 like this.
    naive = torch.exp(2j * math.pi * distance * root) / math.prod(padded.shape)

    def bare(field: Tensor) -> Tensor:
        # ``naive`` contains the factor 1 / N of the inverse transform, as the kernels of core.fourier do.
        return torch.fft.ifft2(torch.fft.fft2(field, s=padded.shape) * naive, norm="forward")[:height, :width]

    setup = grid, WAVELENGTH, distance
    modules: dict[str, torch.nn.Module] = {
        PLANNED: Propagator(*setup, tolerance=TOLERANCE),
        "planned, 1e-3, complex128": Propagator(*setup, tolerance=TOLERANCE),
        "cropped kernel": CroppedKernel(*setup),
        **{f"angular spectrum, pad {pad:g}": AngularSpectrum(*setup, pad=pad) for pad in (1.125, 2.0, 4.0)},
        "Fresnel, pad 2": Fresnel(*setup, pad=2),
    }
    calls: dict[str, Callable[[Tensor], Tensor]] = {BARE: bare}
    calls |= {name: (lambda field, m=module: m(field[None])[0]) for name, module in modules.items()}
    if max(grid.shape) > PEER_LIMIT:
        return calls
    try:
        from torchoptics import Field  # type: ignore[import-not-found]
    except ImportError:
        return calls

    def peer(field: Tensor) -> Tensor:
        return Field(field, wavelength=WAVELENGTH, z=0, spacing=grid.pitch).propagate_to_z(distance).data

    return calls | {"torchoptics, automatic": peer}


def _predictions(cases: int) -> list[dict[str, Any]]:
    """True and predicted error of every method for band-limited noise; grid, distance and band are random."""
    generator, rows = np.random.default_rng(11), []
    for case in tqdm(range(cases), desc="predictions", unit="case"):
        pitch, share = float(generator.choice([3.74e-6, 8e-6])), float(generator.uniform(0.2, 1.0))
        grid = Grid((int(generator.integers(40, 120)), int(generator.integers(40, 120))), pitch)
        wavelength = float(generator.choice([450e-9, 530e-9, 636e-9]))
        distance = 10 ** generator.uniform(-2, 0.7) * 2 * max(grid.extent) * pitch / wavelength
        field, wide = _noise(grid, share, case), Grid((4 * grid.shape[0], 4 * grid.shape[1]), pitch)
        exact = _exact(CroppedKernel(wide, wavelength, distance), field)
        path, content = PlanePair(grid, grid), FieldContent((share / 2 / pitch, share / 2 / pitch))
        for method in candidates(path, [wavelength], [distance], content):
            length, z = (torch.tensor(value, dtype=torch.float64) for value in (wavelength, distance))
            kernel = kernel_of(path, method, length, z, torch.complex64)
            rows.append(
                {
                    "case": case,
                    "method": method.method,
                    "padded": f"{method.padded[0]}x{method.padded[1]}",
                    "predicted": f"{method.error:.3e}",
                    "true": _error(filter_spectrum(field.to(torch.complex64), kernel), exact),
                    "flops": f"{method.flops:.3e}",
                }
            )
    return rows


def _noise(grid: Grid, share: float, seed: int) -> Tensor:
    """Complex noise that fills ``share`` of the band of the grid along each axis, complex128 [H, W]."""
    generator = torch.Generator().manual_seed(seed)
    wide = [8 * size for size in grid.shape]
    fy, fx = (torch.fft.fftfreq(size, dtype=torch.float64).abs() <= share / 2 for size in wide)
    spectrum = torch.randn(*wide, dtype=torch.complex128, generator=generator) * fy[:, None] * fx
    return ifft2(spectrum, grid.shape)


def _verdict(rows: list[dict], prediction: list[dict], amount: Amount) -> list[str]:
    lines = []
    for name in sorted(dict.fromkeys(row["method"] for row in rows), key=lambda name: name != PLANNED):
        selected = [row for row in rows if row["method"] == name]
        worst = {kind: max(float(row["error"]) for row in selected if row["source"] == kind) for kind in SOURCES}
        errors = ", ".join(f"{kind} {error:.0e}" for kind, error in worst.items())
        ratio = np.median([row["ratio_to_bare"] for row in selected])
        lines.append(f"{name}: worst error {errors}; median time {ratio:.2f} of bare FFTs")
    lines.insert(
        1,
        f"torch {torch.__version__}, {torch.get_num_threads()} threads, {platform.machine()}, complex64; errors "
        "against the cropped kernel in complex128 on twice the window",
    )
    peers = [row for row in rows if row["method"].startswith("torchoptics") and row["source"] == "white"]
    if peers:
        case = itemgetter("size_px", "pitch_um", "distance_m")
        planned = {case(row): row["ratio_to_bare"] for row in rows if row["method"] == PLANNED}
        ratios = [row["ratio_to_bare"] / planned[case(row)] for row in peers]
        size = amount.shown[0]
        at_size = [ratio for row, ratio in zip(peers, ratios, strict=True) if row["size_px"] == size]
        lines.append(
            f"torchoptics takes {min(ratios):.1f} to {max(ratios):.1f} times as long as the planned method, at "
            f"{size} px at least {min(at_size):.1f} times"
        )
    checked = [row for row in prediction if 1e-6 < float(row["predicted"]) < 0.05]
    factors = [float(row["true"]) / float(row["predicted"]) for row in checked]
    optimal = 0
    for number in range(amount.predictions):
        methods = [row for row in prediction if row["case"] == number]
        adequate = [float(row["flops"]) for row in methods if float(row["true"]) <= TOLERANCE]
        chosen = [float(row["flops"]) for row in methods if float(row["predicted"]) <= TOLERANCE]
        optimal += min(chosen) <= min(adequate) * 1.001
    lines.append(
        f"predicted error: true / predicted from {min(factors):.2f} to {max(factors):.2f} over {len(factors)} cases; "
        f"the cheapest adequate method chosen in {optimal} of {amount.predictions}"
    )
    return lines


def _draw(rows: list[dict], amount: Amount) -> bytes:
    """PNG of error against time, one panel for each source and distance, on one grid."""
    size, pitch = amount.shown
    shown = [row for row in rows if row["size_px"] == size and row["pitch_um"] == pitch * 1e6]
    names = list(dict.fromkeys(row["method"] for row in shown))
    figure = Figure(figsize=(3.2 * len(amount.distances), 2.6 * len(SOURCES)), layout="constrained")
    panels = figure.subplots(len(SOURCES), len(amount.distances), sharex=True, sharey=True)
    for i, kind in enumerate(SOURCES):
        for j, distance in enumerate(amount.distances):
            axes = panels[i][j]
            selected = [row for row in shown if (row["source"], row["distance_m"]) == (kind, distance)]
            points = {row["method"]: (row["ratio_to_bare"], _in_range(row["error"])) for row in selected}
            for k, name in enumerate(names):
                axes.loglog(*points[name], "os^vD*PhX"[k % 9], color=f"C{k}", label=name, markersize=8)
            draw_front(axes, points.values())
            mark_choice(axes, [points[PLANNED]])
            crossovers = distance / unaliased_distance(Grid(size, pitch), WAVELENGTH, 2)
            axes.set_title(f"{kind}, {distance * 1e3:g} mm = {crossovers:.2g} z_c", fontsize=9)
            axes.grid(alpha=0.3)
    setup = f"{size} px, {pitch * 1e6:g} um, 530 nm, complex64"
    figure.supxlabel(f"time of one call / time of two bare FFTs at pad 2 ({setup})")
    figure.supylabel("relative L2 error")
    return _with_legend(figure, panels[0][0])


def _in_range(error: str) -> float:
    """An error within the range that the figure shows."""
    return min(max(float(error), 1e-8), 10)


def _draw_validity(rows: list[dict], amount: Amount) -> bytes:
    """PNG of error against distance / cross-over distance; bars at the top mark where a method becomes inaccurate."""
    names = list(dict.fromkeys(row["method"] for row in rows))
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, kind in zip(panels, ("white", "smooth"), strict=True):
        for k, name in enumerate(names):
            chosen = [row for row in rows if row["method"] == name and row["source"] == kind]
            points = sorted((row["crossovers"], min(float(row["error"]), 10)) for row in chosen)
            axes.loglog(*zip(*points, strict=True), "os^vD*PhX"[k % 9], color=f"C{k}", label=name, alpha=0.8)
            for border in _borders(name, amount):
                axes.axvline(border, ymin=0.9, color=f"C{k}", linewidth=2)
        axes.axvline(1, color="k", linestyle=":", linewidth=1)
        axes.axhline(TOLERANCE, color="k", linestyle=":", linewidth=1)
        axes.set_title(f"{kind} source, {len(amount.cases)} grids")
        axes.set(xlabel="distance / cross-over distance z_c = 2 L pitch / wavelength", ylabel="relative L2 error")
        axes.grid(alpha=0.3)
    return _with_legend(figure, panels[0])


def _with_legend(figure: Figure, axes: Any) -> bytes:
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=9)
    return figure_png(figure)


def _borders(name: str, amount: Amount) -> list[float]:
    """Distances at which a method becomes inaccurate in theory, divided by the cross-over distance z_c of each grid.

    Padding by a factor P suffices up to (P - 1) z_c. Other methods are inaccurate once the error of the phase reaches
    the tolerance. The Fresnel approximation neglects a phase pi z s^4 / (4 wavelength) for light of sine s, which is
    evaluated at the corner of the band. Rounding to float32 changes the phase k z by a relative 6e-8.
    """
    if name.startswith("angular spectrum"):
        return [float(name.split()[-1]) - 1]
    grids = [Grid(size, pitch) for size, pitch in amount.cases]
    if name.startswith("bare"):
        distances = [TOLERANCE / 6e-8 * WAVELENGTH / (2 * math.pi)] * len(grids)
    elif name.startswith("Fresnel"):
        sines = [WAVELENGTH / (2 * grid.pitch[0]) for grid in grids]
        distances = [TOLERANCE * 4 * WAVELENGTH / (math.pi * (2 * sine**2) ** 2) for sine in sines]
    else:
        return []
    return [z / unaliased_distance(grid, WAVELENGTH, 2) for z, grid in zip(distances, grids, strict=True)]
