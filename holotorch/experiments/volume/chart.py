"""Chart of volume holograms: error against time for every method, and time against planes, pixels and distance."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.core.fourier import fft2, good_length, ifft2
from holotorch.core.grid import Grid
from holotorch.experiments.runs.figures import figure_png
from holotorch.experiments.timing import interleaved, timed
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram
from holotorch.hologram.cone import cone_samples, spherical_wave

PITCH, WAVELENGTHS = 3.74e-6, (636e-9, 520e-9, 455e-9)  # metres
# Thesis Table 5.2: distance in mm, planes, and seconds by its convolution method.
TABLE = {
    "Tooth": (20, 90, 5.09),
    "C60": (30, 58, 11.56),
    "Teapot": (40, 253, 64.20),
    "Engine": (50, 116, 27.73),
    "Hand": (60, 290, 82.95),
    "Bonsai": (70, 232, 129.93),
}
ALL_PLANES = ("Tooth", "Teapot", "Hand", "Bonsai")  # scenes that are also measured with all planes and at full size
SMALL, WHOLE = 512, 2048  # pixels along each side
BASE = "thesis's convolutions (Algorithm 5)"


@dataclass(frozen=True)
class Scene:
    """Planes of random sources in a ball as wide as the hologram; a ray for every second pixel along each axis."""

    side: int
    distance: float
    planes: int

    @property
    def grid(self) -> Grid:
        """Pixels of the hologram."""
        return Grid(self.side, PITCH)

    @property
    def depths(self) -> list[float]:
        """Depths of the planes in metres; the scene is as deep as the hologram is wide."""
        width = self.side * PITCH
        return [self.distance + width * ((j + 0.5) / self.planes - 0.5) for j in range(self.planes)]

    @property
    def phase(self) -> Tensor:
        """Random phase of each ray, float32 [r, r]."""
        generator = torch.Generator().manual_seed(1)
        return 2 * math.pi * torch.rand(self.side // 2, self.side // 2, generator=generator)

    def amplitudes(self) -> Iterator[Tensor]:
        """Amplitudes of each plane in turn, real [r, r]; the noise repeats after eight planes."""
        rays = self.side // 2
        generator = torch.Generator().manual_seed(2)
        noise = torch.rand(8, rays, rays, generator=generator)
        position = (torch.arange(rays) - rays // 2) / (rays / 2)
        square = position[:, None].square() + position.square()
        for j in range(self.planes):
            inside = square <= 1 - (2 * (j + 0.5) / self.planes - 1) ** 2
            yield noise[j % 8] * inside

    def layers(self, dtype: torch.dtype = torch.complex64) -> Tensor:
        """Complex amplitudes of all planes [D, r, r]."""
        phasor = torch.polar(torch.ones_like(self.phase), self.phase).to(dtype)
        return torch.stack([amplitude.to(dtype) * phasor for amplitude in self.amplitudes()])


class ThesisConvolution:
    """Algorithm 5 of the thesis: for each plane, transforms of sources and spherical wave, and an inverse transform.

    For H pixels along an axis and a spherical wave of K samples, the transforms have H + K samples. K is at most 2 V
    for a volume of V samples; here V = H. The wave is evaluated anew for each plane; with ``ready``, one wave is
    transformed in advance and used for all planes. Phases are float64 (the thesis does not specify this); waves are
    clipped to the sharp cone of its Sec. 5.6.1.
    """

    def __init__(self, scene: Scene, wavelength: float, *, ready: bool = False):
        self.scene, self.wavelength = scene, wavelength
        half = cone_samples(scene.grid, wavelength, max(scene.depths))[0]
        self.length = good_length(math.ceil(scene.side + min(2 * half, 2 * scene.side)))
        self.ready = self._wave(scene.depths[0]) if ready else None

    def _wave(self, depth: float) -> Tensor:
        position = torch.fft.fftfreq(self.length, 1 / self.length, dtype=torch.float64) * PITCH
        wave = spherical_wave(position[:, None], position[None], (PITCH, PITCH), self.wavelength, depth, "box")
        return fft2(wave.to(torch.complex64))

    def __call__(self, planes: int | None = None) -> Tensor:
        """The hologram of the first ``planes``; of all planes by default."""
        side, total = self.scene.side, torch.zeros(self.scene.side, self.scene.side, dtype=torch.complex64)
        phasor = torch.polar(torch.ones_like(self.scene.phase), self.scene.phase)
        for j, amplitude in enumerate(self.scene.amplitudes()):
            if j == planes:
                break
            spread = torch.zeros(self.length, self.length, dtype=torch.complex64)
            spread[:side:2, :side:2] = amplitude * phasor
            wave = self._wave(self.scene.depths[j]) if self.ready is None else self.ready
            total += ifft2(fft2(spread) * wave, (side, side))
        return total


def volume() -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Rows of methods, rows of scaling, pictures by name, and the verdict."""
    rows = _methods()
    scaling = _scaling()
    return rows, scaling, {"chart": _draw(rows, scaling)}, _verdict(rows, scaling)


def _calls(scene: Scene, wavelength: float) -> dict[str, Callable[[], Any]]:
    """Calls that compute the hologram of a colour; the operators are built in advance, as for a sequence of frames."""
    layers, planes, phase = scene.layers(), torch.stack([*scene.amplitudes()]), scene.phase
    exact = ConvolutionHologram(scene.grid, wavelength, scene.depths, stride=2)
    soft, fine = (AxialHologram(scene.grid, wavelength, scene.depths, stride=2, tolerance=t) for t in (3e-3, 1e-4))
    for operator in (soft, fine):
        operator.design((scene.side // 2, scene.side // 2))
    thesis, ready = ThesisConvolution(scene, wavelength), ThesisConvolution(scene, wavelength, ready=True)
    return {
        BASE: thesis,
        "the same, waves at hand": ready,
        "convolutions, exact": lambda: exact(layers),
        "axial nodes, 3e-3": lambda: soft.accumulate(planes, phase),
        "axial nodes, 1e-4": lambda: fine.accumulate(planes, phase),
    }


def _methods() -> list[dict]:
    """Every scene of Table 5.2 at a quarter of its size in three colours; some with all planes in one colour."""
    rows = []
    cases = [(name, mm / 4e3, planes // 4, WAVELENGTHS) for name, (mm, planes, _) in TABLE.items()]
    cases += [(f"{name}, all planes", TABLE[name][0] / 4e3, TABLE[name][1], WAVELENGTHS[:1]) for name in ALL_PLANES]
    for name, distance, planes, wavelengths in tqdm(cases, desc="volume, methods", unit="scene"):
        scene = Scene(SMALL, distance, planes)
        times: dict[str, float] = {}
        rounds = 3 if len(wavelengths) > 1 else 1
        for wavelength in wavelengths:
            for method, seconds in interleaved(_calls(scene, wavelength), rounds).items():
                times[method] = times.get(method, 0.0) + seconds
        errors = _errors(scene, wavelengths[0])
        pairs, direct = _direct(scene, wavelengths[0])
        for method, seconds in times.items():
            rows.append(
                {
                    "scene": name,
                    "distance_mm": distance * 1e3,
                    "planes": planes,
                    "colours": len(wavelengths),
                    "method": method,
                    "seconds": f"{seconds:.4f}",
                    "error": "" if math.isnan(errors[method]) else f"{errors[method]:.1e}",
                    "over_thesis": round(times[BASE] / seconds, 2),
                    "over_direct": round(direct * len(wavelengths) / seconds),
                    "direct_pairs_per_s": f"{pairs:.2e}",
                }
            )
    return rows


def _errors(scene: Scene, wavelength: float) -> dict[str, float]:
    """Relative L2 error of each method with respect to the same cone of light computed in complex128."""
    layers = scene.layers(torch.complex128)
    box = ConvolutionHologram(scene.grid, wavelength, scene.depths, stride=2)(layers)
    soft = AxialHologram(scene.grid, wavelength, scene.depths, stride=2, tolerance=1e-6)(layers)
    errors = {}
    for method, work in _calls(scene, wavelength).items():
        wanted = soft if method.startswith("axial") else box
        errors[method] = math.nan if "at hand" in method else _relative(work(), wanted)
    return errors


def _relative(got: Tensor, wanted: Tensor) -> float:
    return ((got.to(wanted.dtype) - wanted).norm() / wanted.norm()).item()


def _direct(scene: Scene, wavelength: float) -> tuple[float, float]:
    """Pairs of source and pixel per second of the direct sum on one plane, and the seconds for all planes."""
    middle = scene.planes // 2
    plane = scene.layers(torch.complex128)[middle : middle + 1]
    operator = DirectHologram(scene.grid, wavelength, [scene.depths[middle]], stride=2)
    _, seconds = timed(lambda: operator(plane))
    rate = operator.pairs(plane) / seconds
    lit = sum(int((amplitude > 0).sum()) for amplitude in scene.amplitudes())
    per_source = operator.pairs(plane) / max(1, int((plane != 0).sum()))
    return rate, lit * per_source / rate


def _scaling() -> list[dict]:
    """Time of one colour against planes, pixels and distance (Fig. 5.10).

    The thesis's method is measured on three planes, and its time is scaled to all planes.
    """
    groups = {
        "planes": [Scene(SMALL, 7.5e-3, planes) for planes in (58, 145, 290, 580, 1160)],
        "pixels": [Scene(side, 30e-3 * side / WHOLE, 232) for side in (256, 512, 1024, 2048)],
        "distance": [Scene(SMALL, distance / 4e3, 63) for distance in (20, 40, 60, 80, 120, 160)],
    }
    groups |= {f"whole: {name}": [Scene(WHOLE, TABLE[name][0] / 1e3, TABLE[name][1])] for name in ALL_PLANES}
    rows = []
    for what, scenes in tqdm(groups.items(), desc="volume, scaling", unit="series"):
        operators = [AxialHologram(s.grid, WAVELENGTHS[0], s.depths, stride=2, tolerance=3e-3) for s in scenes]
        calls = {
            str(scene): partial(operator.accumulate, torch.stack([*scene.amplitudes()]), scene.phase)
            for scene, operator in zip(scenes, operators, strict=True)
        }
        times = interleaved(calls, rounds=1 if scenes[-1].side == WHOLE else 15)
        for scene, operator in zip(scenes, operators, strict=True):
            thesis = ThesisConvolution(scene, WAVELENGTHS[0])
            thesis(1)  # warms up
            _, base = timed(lambda thesis=thesis: thesis(3))
            base *= scene.planes / 3
            design = operator.design((scene.side // 2, scene.side // 2))
            seconds = times[str(scene)]
            rows.append(
                {
                    "against": what,
                    "side": scene.side,
                    "distance_mm": round(scene.distance * 1e3, 3),
                    "planes": scene.planes,
                    "nodes": design.nodes.count,
                    "samples": design.size[0],
                    "thesis_samples": thesis.length,
                    "thesis_seconds": f"{base:.3f}",
                    "seconds": f"{seconds:.4f}",
                    "over_thesis": round(base / seconds, 2),
                    "predicted_error": f"{design.predicted_error:.1e}",
                }
            )
    return rows


def _verdict(rows: list[dict], scaling: list[dict]) -> list[str]:
    lines = [
        f"torch {torch.__version__}, {torch.get_num_threads()} threads; random sources in a ball as wide as the "
        f"hologram, rays on every second pixel; "
        f"speed relative to {BASE} in the same process (relative L2 error to the same cone of light in complex128)"
    ]
    for name in TABLE:
        selected = [row for row in rows if row["scene"] == name]
        parts = [
            f"{row['method']} {row['over_thesis']}" + (f" ({row['error']})" if row["error"] else "")
            for row in selected
            if row["method"] != BASE
        ]
        lines.append(f"{name}, {SMALL} px, {selected[0]['planes']} planes, 3 colours: " + "; ".join(parts))
    for name in ALL_PLANES:
        small = next(r for r in rows if r["scene"] == f"{name}, all planes" and r["method"] == "axial nodes, 3e-3")
        big = next(row for row in scaling if row["against"] == f"whole: {name}")
        lines.append(
            f"{name}, all {big['planes']} planes: {small['over_thesis']} at {SMALL} px, {big['over_thesis']} at "
            f"{WHOLE} px ({big['seconds']} s a colour, {big['nodes']} nodes); thesis on its GPU "
            f"{TABLE[name][2] / 3:.1f} s a colour"
        )
    cost = {row["planes"]: float(row["seconds"]) for row in scaling if row["against"] == "planes"}
    lines.append(f"1160 planes cost {cost[1160] / cost[290]:.2f} times as much as 290 (4 with the thesis's method)")
    rates = [float(row["direct_pairs_per_s"]) for row in rows]
    lines.append(f"direct sum, float64: {min(rates):.1e} to {max(rates):.1e} pairs per second")
    return lines


def _draw(rows: list[dict], scaling: list[dict]) -> bytes:
    figure = Figure(figsize=(15, 7.5), layout="constrained")
    axes = figure.add_subplot(2, 2, 1)
    for k, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        selected = [row for row in rows if row["method"] == method and row["colours"] == 3 and row["error"]]
        if selected:
            points = [float(row["seconds"]) for row in selected], [float(row["error"]) for row in selected]
            axes.loglog(*points, "os^vD"[k], label=method, color=f"C{k}")
    axes.set_xlabel(f"seconds, three colours at {SMALL} px")
    axes.set_ylabel("relative L2 error")
    axes.legend(fontsize=8)
    series = ("planes", "planes"), ("pixels", "side"), ("distance", "distance_mm")
    for position, (against, key) in enumerate(series, 2):
        axes = figure.add_subplot(2, 2, position)
        selected = [row for row in scaling if row["against"] == against]
        values = [float(row[key]) for row in selected]
        axes.loglog(values, [float(row["thesis_seconds"]) for row in selected], "o-", label=BASE)
        axes.loglog(values, [float(row["seconds"]) for row in selected], "^-", label="axial nodes, 3e-3")
        axes.set_xlabel({"side": "pixels a side", "distance_mm": "distance (mm)"}.get(key, key))
        axes.set_ylabel("seconds a colour")
        axes.legend(fontsize=8)
    for axes in figure.axes:
        axes.grid(alpha=0.3, which="both")
    return figure_png(figure)
