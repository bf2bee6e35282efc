"""Chart of volume holograms: error and time of every method, and time against planes, pixels and distance."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.core.fourier import fft2, good_length, ifft2
from holotorch.core.grid import Grid
from holotorch.experiments.runs.figures import draw_front, figure_png, mark_choice
from holotorch.experiments.timing import interleaved, timed
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram
from holotorch.hologram.cone import cone_samples, spherical_wave

PITCH, WAVELENGTHS = 3.74e-6, (636e-9, 520e-9, 455e-9)  # metres
# Thesis Table 5.2: distance in mm, number of planes, and seconds that its convolution method takes for three colours.
TABLE = {
    "Tooth": (20, 90, 5.09),
    "C60": (30, 58, 11.56),
    "Teapot": (40, 253, 64.20),
    "Engine": (50, 116, 27.73),
    "Hand": (60, 290, 82.95),
    "Bonsai": (70, 232, 129.93),
}
WHOLE = 2048  # pixels along each side of a hologram of the thesis
BASE, READY = "thesis's convolutions (Algorithm 5)", "the same, waves at hand"
AXIAL = "axial nodes, 3e-3"


@dataclass(frozen=True)
class Amount:
    """Size of the measurement. With fewer pixels than WHOLE, the scene is nearer and has fewer planes."""

    side: int = 512  # pixels along each side of a hologram
    scenes: tuple[str, ...] = tuple(TABLE)
    all_planes: tuple[str, ...] = ("Tooth", "Teapot", "Hand", "Bonsai")  # measured with all planes and WHOLE pixels too
    planes: tuple[int, ...] = (58, 145, 290, 580, 1160)
    sides: tuple[int, ...] = (256, 512, 1024, 2048)
    distances: tuple[int, ...] = (20, 40, 60, 80, 120, 160)  # mm, of a hologram of WHOLE pixels
    rounds: int = 15  # repetitions of a measurement of scaling


FULL = Amount()
QUICK = Amount(128, ("Tooth", "Bonsai"), (), (58, 290), (128, 256), (20, 80), rounds=3)


@dataclass(frozen=True)
class Scene:
    """Planes of random sources that fill a ball as wide as the hologram; a ray for every second pixel of an axis."""

    side: int  # pixels along each side of the hologram
    distance: float  # of the ball's centre from the hologram, in metres
    planes: int
    device: torch.device = torch.device("cpu")

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
        """Random phase of each ray, float32 [r, r] for r rays along each side."""
        generator = torch.Generator().manual_seed(1)
        return 2 * math.pi * torch.rand(self.side // 2, self.side // 2, generator=generator).to(self.device)

    def amplitudes(self) -> Iterator[Tensor]:
        """Amplitudes of each plane in turn, real [r, r]; the noise repeats after eight planes."""
        rays = self.side // 2
        generator = torch.Generator().manual_seed(2)
        noise = torch.rand(8, rays, rays, generator=generator).to(self.device)
        position = (torch.arange(rays, device=self.device) - rays // 2) / (rays / 2)
        square = position[:, None].square() + position.square()
        for j in range(self.planes):
            inside = square <= 1 - (2 * (j + 0.5) / self.planes - 1) ** 2
            yield noise[j % 8] * inside

    def layers(self, dtype: torch.dtype = torch.complex64) -> Tensor:
        """Complex amplitudes of all planes [D, r, r]."""
        phasor = torch.polar(torch.ones_like(self.phase), self.phase).to(dtype)
        return torch.stack([amplitude.to(dtype) * phasor for amplitude in self.amplitudes()])


class ThesisConvolution:
    """Algorithm 5 of the thesis: each plane is convolved with a spherical wave by transforms of H + K samples per axis.

    H is the number of pixels of the hologram and K that of samples of the wave, at most 2 H for a volume as wide as the
    hologram. The wave is computed and transformed for each plane; with ``ready``, one wave is transformed in advance
    and used for all planes. The phase of the wave is float64 (the thesis does not specify this), and the wave is
    clipped to the sharp cone of thesis Sec. 5.6.1.
    """

    def __init__(self, scene: Scene, wavelength: float, *, ready: bool = False):
        self.scene, self.wavelength = scene, wavelength
        half = cone_samples(scene.grid, wavelength, max(scene.depths))[0]
        self.length = good_length(math.ceil(scene.side + min(2 * half, 2 * scene.side)))
        self.ready = self._wave(scene.depths[0]) if ready else None

    def _wave(self, depth: float) -> Tensor:
        spacing, device = 1 / self.length, self.scene.device
        position = torch.fft.fftfreq(self.length, spacing, dtype=torch.float64, device=device) * PITCH
        wave = spherical_wave(position[:, None], position[None], (PITCH, PITCH), self.wavelength, depth, "box")
        return fft2(wave.to(torch.complex64))

    def __call__(self, planes: int | None = None) -> Tensor:
        """The hologram of the first ``planes`` planes; of all planes by default."""
        side, phase = self.scene.side, self.scene.phase
        phasor = torch.polar(torch.ones_like(phase), phase)
        total = torch.zeros(side, side, dtype=torch.complex64, device=phase.device)
        for j, amplitude in enumerate(islice(self.scene.amplitudes(), planes)):
            spread = total.new_zeros(self.length, self.length)
            spread[:side:2, :side:2] = amplitude * phasor
            wave = self._wave(self.scene.depths[j]) if self.ready is None else self.ready
            total += ifft2(fft2(spread) * wave, (side, side))
        return total


def volume(quick: bool = False) -> tuple[list[dict], list[dict], dict[str, bytes], list[str]]:
    """Rows of methods, rows of scaling, pictures by name, and the verdict."""
    amount = QUICK if quick else FULL
    rows, scaling = _methods(amount), _scaling(amount)
    return rows, scaling, {"chart": _draw(rows, scaling, amount)}, _verdict(rows, scaling, amount)


def _calls(scene: Scene, wavelength: float) -> dict[str, Callable[[], Any]]:
    """Calls that compute the hologram of a colour; the operators are built in advance, as for a sequence of frames."""
    layers, planes, phase = scene.layers(), torch.stack([*scene.amplitudes()]), scene.phase
    exact = ConvolutionHologram(scene.grid, wavelength, scene.depths, stride=2)
    calls = {
        BASE: ThesisConvolution(scene, wavelength),
        READY: ThesisConvolution(scene, wavelength, ready=True),
        "convolutions, exact": lambda: exact(layers),
    }
    for name, tolerance in (("3e-3", 3e-3), ("1e-4", 1e-4)):
        axial = AxialHologram(scene.grid, wavelength, scene.depths, stride=2, tolerance=tolerance)
        axial.design((scene.side // 2, scene.side // 2))
        calls[f"axial nodes, {name}"] = partial(axial.accumulate, planes, phase)
    return calls


def _methods(amount: Amount) -> list[dict]:
    """Rows of every scene, reduced in size and planes, in 3 colours; of some with all planes in one colour."""
    rows, part = [], WHOLE // amount.side
    near = {name: mm / 1e3 / part for name, (mm, _, _) in TABLE.items()}
    cases = [(name, near[name], TABLE[name][1] // part, WAVELENGTHS) for name in amount.scenes]
    cases += [(f"{name}, all planes", near[name], TABLE[name][1], WAVELENGTHS[:1]) for name in amount.all_planes]
    for name, distance, planes, wavelengths in tqdm(cases, desc="volume, methods", unit="scene"):
        scene = Scene(amount.side, distance, planes)
        times: dict[str, float] = {}
        rounds = 3 if len(wavelengths) > 1 else 1
        for wavelength in wavelengths:
            for method, seconds in interleaved(_calls(scene, wavelength), rounds).items():
                times[method] = times.get(method, 0.0) + seconds
        errors = _errors(scene, wavelengths[0])
        pairs, direct = _direct(scene, wavelengths[0])
        rows += [
            {
                "scene": name,
                "distance_mm": distance * 1e3,
                "planes": planes,
                "colours": len(wavelengths),
                "method": method,
                "seconds": f"{seconds:.4f}",
                "error": f"{errors[method]:.1e}" if method in errors else "",
                "over_thesis": round(times[BASE] / seconds, 2),
                "over_direct": round(direct * len(wavelengths) / seconds),
                "direct_pairs_per_s": f"{pairs:.2e}",
            }
            for method, seconds in times.items()
        ]
    return rows


def _errors(scene: Scene, wavelength: float) -> dict[str, float]:
    """Relative L2 error of each method but READY, compared with the same cone of light computed in complex128."""
    layers = scene.layers(torch.complex128)
    box = ConvolutionHologram(scene.grid, wavelength, scene.depths, stride=2)(layers)
    soft = AxialHologram(scene.grid, wavelength, scene.depths, stride=2, tolerance=1e-6)(layers)
    errors = {}
    for method, call in _calls(scene, wavelength).items():
        if method != READY:
            reference = soft if method.startswith("axial") else box
            errors[method] = ((call().to(reference.dtype) - reference).norm() / reference.norm()).item()
    return errors


def _direct(scene: Scene, wavelength: float) -> tuple[float, float]:
    """Pairs of source and pixel per second of the direct sum, measured on one plane, and its seconds for all planes."""
    middle = scene.planes // 2
    plane = scene.layers(torch.complex128)[middle : middle + 1]
    operator = DirectHologram(scene.grid, wavelength, [scene.depths[middle]], stride=2)
    rate = operator.pairs(plane) / timed(lambda: operator(plane))[1]
    sources = sum(int((amplitude > 0).sum()) for amplitude in scene.amplitudes())
    pairs_per_source = operator.pairs(plane) / max(1, int((plane != 0).sum()))
    return rate, sources * pairs_per_source / rate


def _scaling(amount: Amount) -> list[dict]:
    """Rows of the time of one colour against planes, pixels and distance (thesis Fig. 5.10).

    The thesis's method is timed on three planes, and the time is scaled to all planes.
    """
    side = amount.side
    groups = {
        "planes": [Scene(side, 30e-3 * side / WHOLE, planes) for planes in amount.planes],
        "pixels": [Scene(pixels, 30e-3 * pixels / WHOLE, 232) for pixels in amount.sides],
        "distance": [Scene(side, distance / 1e3 * side / WHOLE, 63) for distance in amount.distances],
    }
    groups |= {f"whole: {name}": [Scene(WHOLE, TABLE[name][0] / 1e3, TABLE[name][1])] for name in amount.all_planes}
    rows = []
    for what, scenes in tqdm(groups.items(), desc="volume, scaling", unit="series"):
        operators = {s: AxialHologram(s.grid, WAVELENGTHS[0], s.depths, stride=2, tolerance=3e-3) for s in scenes}
        calls = {
            str(scene): partial(operator.accumulate, torch.stack([*scene.amplitudes()]), scene.phase)
            for scene, operator in operators.items()
        }
        times = interleaved(calls, rounds=1 if scenes[-1].side == WHOLE else amount.rounds)
        for scene, operator in operators.items():
            thesis = ThesisConvolution(scene, WAVELENGTHS[0])
            thesis(1)  # warms up
            base = timed(partial(thesis, 3))[1] * scene.planes / 3
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


def _verdict(rows: list[dict], scaling: list[dict], amount: Amount) -> list[str]:
    lines = []
    for name in amount.scenes:
        base, *others = (row for row in rows if row["scene"] == name)
        errors = [f" ({row['error']})" if row["error"] else "" for row in others]
        parts = [f"{row['method']} {row['over_thesis']}{error}" for row, error in zip(others, errors, strict=True)]
        lines.append(f"{name}, {amount.side} px, {base['planes']} planes, 3 colours: " + "; ".join(parts))
    lines[0] += f"; times as fast as {BASE} in the same process (relative L2 error)"
    lines.insert(
        1,
        f"torch {torch.__version__}, {torch.get_num_threads()} threads; random sources in a ball as wide as the "
        "hologram, rays on every second pixel; errors to the same cone of light in complex128",
    )
    for name in amount.all_planes:
        small = next(r for r in rows if r["scene"] == f"{name}, all planes" and r["method"] == AXIAL)
        big = next(row for row in scaling if row["against"] == f"whole: {name}")
        lines.append(
            f"{name}, all {big['planes']} planes: {small['over_thesis']} at {amount.side} px, {big['over_thesis']} at "
            f"{WHOLE} px ({big['seconds']} s a colour, {big['nodes']} nodes); thesis on its GPU "
            f"{TABLE[name][2] / 3:.1f} s a colour"
        )
    cost = {row["planes"]: float(row["seconds"]) for row in scaling if row["against"] == "planes"}
    few, most = amount.planes[-3:][0], amount.planes[-1]
    ratio = f"{cost[most] / cost[few]:.2f} times as much as {few} ({most / few:g} with the thesis's method)"
    lines.append(f"{most} planes cost {ratio}")
    rates = [float(row["direct_pairs_per_s"]) for row in rows]
    lines.append(f"direct sum, float64: {min(rates):.1e} to {max(rates):.1e} pairs per second")
    return lines


def _draw(rows: list[dict], scaling: list[dict], amount: Amount) -> bytes:
    figure = Figure(figsize=(15, 7.5), layout="constrained")
    axes, *others = figure.subplots(2, 2).flat
    for k, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        selected = [row for row in rows if row["method"] == method and row["colours"] == 3 and row["error"]]
        if selected:
            points = [float(row["seconds"]) for row in selected], [float(row["error"]) for row in selected]
            axes.loglog(*points, "os^vD"[k], label=method, color=f"C{k}")
            if method == AXIAL:
                mark_choice(axes, zip(*points, strict=True), "automatic choice for 3e-3")
    for i, scene in enumerate(amount.scenes):
        selected = [row for row in rows if row["scene"] == scene and row["error"]]
        front = [(float(row["seconds"]), float(row["error"])) for row in selected]
        draw_front(axes, front, "" if i else "Pareto front of each scene")
    axes.set(xlabel=f"seconds, three colours at {amount.side} px", ylabel="relative L2 error")
    keys = {"planes": "planes", "pixels": "side", "distance": "distance_mm"}
    labels = ("planes", "pixels a side", "distance (mm)")
    for axes, (against, key), label in zip(others, keys.items(), labels, strict=True):
        selected = [row for row in scaling if row["against"] == against]
        values = [float(row[key]) for row in selected]
        axes.loglog(values, [float(row["thesis_seconds"]) for row in selected], "o-", label=BASE)
        axes.loglog(values, [float(row["seconds"]) for row in selected], "^-", label=AXIAL)
        axes.set(xlabel=label, ylabel="seconds a colour")
    for axes in figure.axes:
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3, which="both")
    return figure_png(figure)
