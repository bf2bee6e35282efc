"""Chart of the joint correction through a whole display: eyepiece, eye and light source, in three colours."""

import math
import time
import warnings
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity, phasor
from holotorch.core.fourier import convolve
from holotorch.correction import LBFGS, PECProblem, Solution, deconvolve, limit_peak_phase, spread_preconditioner
from holotorch.correction.problem import best_scale
from holotorch.experiments.eye.experiment import PRESETS, Observer, observer
from holotorch.experiments.joint.charts.chart import volume_file
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs.figures import picture_table
from holotorch.experiments.runs.memory import peak_memory
from holotorch.io.bundled import find_config
from holotorch.metrics import ssim
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Retina, RetinaViews, SpectralRetina, propagate, tone_map
from holotorch.optics.viewing.imaging import retinal_scale

PITCH, DISTANCE, PLANES = "3.74 um", "30 mm", 5
SIGMA, LIMIT = 0.66, 4 * math.pi
SEED = 7
SOURCES = {None: "one wavelength", "sled": "SLED"}
TRAINED = 5  # wavelengths of each SLED in the problem; the scores use 9 to 15, of which 3 are propagated


@dataclass(frozen=True)
class Amount:
    """Size of the measurement."""

    size: int = 512  # pixels along each side of the array
    frames: int = 8
    steps: int = 30
    checked: int = 32  # random-phase holograms whose mean the wanted images are compared with


FULL = Amount()
QUICK = Amount(size=128, frames=2, steps=4, checked=4)


def chain(quick: bool = False) -> tuple[list[dict], dict[str, list[dict]], dict[str, bytes], list[str]]:
    """Table rows of the methods, further tables by name, PNG pictures by name, and lines of text."""
    warnings.simplefilter("ignore", SamplingWarning)  # of the collapsed method, whose error the verdict states
    amount = QUICK if quick else FULL
    eye = _observer(amount.size)
    foci = sorted(eye.scene.depths)[:: max(1, (PLANES - 1) // 2)]
    wavelengths, optics = eye.scene.settings.wavelengths, [(eye.display, eye.eye(z)) for z in foci]
    retinas = [Retina(eye.scene.grid, wavelengths, *each, plane=z) for each, z in zip(optics, foci, strict=True)]
    views, wanted = RetinaViews(retinas), _wanted(eye, retinas, foci)
    spectra = [PRESETS["sled"](each).samples(TRAINED) for each in wavelengths]
    spectral = [SpectralRetina(eye.scene.grid, spectra, *each, recompute=True) for each in optics]
    crosstalk = ThermalCrosstalk(SIGMA)
    generator = torch.Generator().manual_seed(SEED)
    fields = torch.stack([_random_field(eye, generator) for _ in range(amount.frames)])
    start = deconvolve(crosstalk, fields.angle() % (2 * math.pi) + math.pi)
    cost, largest = [], 0.0
    methods = {}
    for light, operator in ("one wavelength", views), ("SLED", RetinaViews(spectral)):
        phase, numbers = _corrected(crosstalk, operator, wanted, start, light, amount.steps)
        cost.append(numbers)
        largest = max(largest, crosstalk(phase).max().item() / math.pi)
        methods[f"joint correction for {light}"] = phasor(crosstalk(phase))
    methods["random phases, corrected afterwards"] = phasor(crosstalk(start))
    methods["ideal complex fields, random phases averaged"] = fields
    rows, shown = [], {"wanted": wanted}
    for name, emitted in methods.items():
        for source, light in SOURCES.items():
            numbers, images = _scores(eye, emitted, source, foci, views, wanted)
            rows.append({"method": name, "light": light} | numbers)
            shown[f"{name}, shown: {light}"] = images
    deviation = _deviation(eye, views, wanted, amount.checked)
    text = [_headline(rows), *_setup(eye, retinas, deviation, largest, amount), *_lines(rows, cost)]
    peak = wanted.amax()
    pixels = {name: tone_map(each.movedim(1, 0), peak=peak).movedim(0, 1) for name, each in shown.items()}
    short = {name.replace("joint correction ", "joint, "): each for name, each in pixels.items()}
    drawn = {"chart": picture_table(short, [f"{focus * 1e3:.4g} mm" for focus in foci])}
    return rows, {"cost": cost}, drawn, text


def _corrected(
    crosstalk: ThermalCrosstalk, views: RetinaViews, wanted: Tensor, start: Tensor, light: str, steps: int
) -> tuple[Tensor, dict[str, Any]]:
    """Heater phases [F, C, H, W] that show the wanted images under the light of ``views``, and what they cost."""
    problem = PECProblem(
        crosstalk, views, wanted, frames=True, amplitude=True, scale_free=True, limit=0.985 * LIMIT, limit_weight=1.0
    )
    begin = time.perf_counter()
    with tqdm(total=steps, desc=f"chain, {light}", unit="step", dynamic_ncols=True) as bar:

        def step(solution: Solution) -> None:
            relative = (solution.losses[-1] / solution.losses[0]).mean().item()
            bar.set_postfix(loss=f"{relative:.2e}", mem=f"{peak_memory() / 1e9:.2f}GB")
            bar.update()

        solver = LBFGS(max_steps=steps, precondition=spread_preconditioner(crosstalk.kernel), tolerance=0.0)
        phase = limit_peak_phase(LIMIT, solver(problem, start, callback=step).x, crosstalk)
    seconds = round(time.perf_counter() - begin, 1)
    return phase, {"light": light, "steps": steps, "seconds": seconds, "peak_memory_bytes": peak_memory()}


def _observer(size: int) -> Observer:
    paths = [find_config(f"configs/{kind}/teapot.yaml") for kind in ("eye", "volume")]
    assert paths[0] is not None and paths[1] is not None
    shape = f"hologram={{shape: [{size}, {size}], pitch: {PITCH}, distance: {DISTANCE}, depths: {PLANES}}}"
    scene = load_config(paths[1], [shape, "device=cpu", *volume_file("teapot")])
    return observer(load_config(paths[0]), scene)


def _light(eye: Observer) -> Tensor:
    """Light of the planes, [D, C, h, w]."""
    with torch.no_grad():
        return torch.stack([intensity(each) for each in eye.scene.sampler()(eye.scene.volume).amplitudes()])


def _random_field(eye: Observer, generator: torch.Generator) -> Tensor:
    """Field [C, H, W] whose light converges to all sources in front of the array, with independent random phases."""
    wavelengths = torch.tensor(eye.scene.settings.wavelengths, dtype=torch.float64)
    total = torch.zeros(len(wavelengths), *eye.scene.grid.shape, dtype=torch.complex64)
    for depth, light in zip(eye.scene.depths, _light(eye), strict=True):
        sources = light.sqrt() * phasor(2 * math.pi * torch.rand(light.shape, generator=generator))
        total += propagate(sources, eye.scene.grid, wavelengths, depth, tolerance=3e-3)
    return total.conj().resolve_conj()


def _wanted(eye: Observer, retinas: list[Retina], foci: list[float]) -> Tensor:
    """Incoherent images [C, V, H, W]: the light of each plane, spread as a point on the axis is by the whole chain.

    A plane beside the focus appears at another scale. Images have the mean 1 in each colour.
    """
    grid, wavelengths = eye.scene.grid, torch.tensor(eye.scene.settings.wavelengths, dtype=torch.float64)
    total = torch.zeros(len(wavelengths), len(foci), *grid.shape)
    point = torch.zeros(len(wavelengths), *grid.shape, dtype=torch.complex64)
    point[:, grid.shape[0] // 2, grid.shape[1] // 2] = 1
    for depth, light in zip(eye.scene.depths, _light(eye), strict=True):
        field = propagate(point, grid, wavelengths, depth, tolerance=3e-3).conj().resolve_conj()
        for v, (retina, focus) in enumerate(zip(retinas, foci, strict=True)):
            setup = eye.display, eye.eye(focus)
            scale = float(retinal_scale(*setup, depth)) / float(retinal_scale(*setup, focus))
            with torch.no_grad():
                total[:, v] += convolve(_scaled(light, scale), retina(field))
    total = total.clamp(min=0)
    return total / total.mean((1, 2, 3), keepdim=True)


def _scaled(image: Tensor, scale: float) -> Tensor:
    """``image`` [C, H, W] magnified about sample n // 2 with the same total light."""
    height, width = image.shape[-2:]
    y, x = ((torch.arange(n) - n // 2) / scale + n // 2 for n in (height, width))
    # Coordinates of grid_sample: -1 and 1 are the outer edges of the first and last samples.
    positions = torch.stack(torch.meshgrid((2 * y + 1) / height - 1, (2 * x + 1) / width - 1, indexing="ij")[::-1], -1)
    moved = functional.grid_sample(image[None], positions[None], mode="bicubic", align_corners=False)[0]
    return moved / scale**2


def _deviation(eye: Observer, views: RetinaViews, wanted: Tensor, checked: int) -> float:
    """Relative difference of the wanted images from the mean of random-phase holograms."""
    generator = torch.Generator().manual_seed(SEED + 1)
    total = torch.zeros_like(wanted)
    with torch.no_grad():
        for _ in tqdm(range(checked), desc="checking the wanted images", unit="hologram", dynamic_ncols=True):
            total += views(_random_field(eye, generator))
    total *= best_scale(total, wanted, -3)[:, None, None, None]
    return ((total - wanted).norm() / wanted.norm()).item()


def _scores(
    eye: Observer, emitted: Tensor, source: str | None, foci: list[float], views: RetinaViews, wanted: Tensor
) -> tuple[dict[str, Any], Tensor]:
    """Scores of fields [F, C, H, W] under a light source, and their images, scaled as wanted."""
    with torch.no_grad():
        if source is None:
            observed = torch.stack([views(each) for each in emitted]).mean(0)
        else:
            frames = [[eye.image(each.conj(), source, focus) for focus in foci] for each in emitted]
            observed = torch.stack([torch.stack(each, 1) for each in frames]).mean(0)
        arrives = views(emitted[0]).sum((-2, -1)).mean(-1) / intensity(emitted[0]).sum((-2, -1))
    observed = observed * best_scale(observed, wanted, -3)[:, None, None, None]
    peak = wanted.amax((1, 2, 3), keepdim=True)
    one, other = observed / peak, wanted / peak
    bright = other > 0.3
    ratio = one[bright] / other[bright]
    quality = ssim(one.clamp(0, 1), other, data_range=1.0)
    numbers = {
        "ssim": quality.mean().item(),
        "psnr": -10 * math.log10((one - other).square().mean().item()),
        "contrast": (ratio.std() / ratio.mean()).item(),
        "light_on_retina": arrives.mean().item(),
    }
    return {key: round(value, 4) for key, value in numbers.items()}, observed


def _headline(rows: list[dict]) -> str:
    light = list(SOURCES.values())[-1]
    shown = {row["method"]: row for row in rows if row["light"] == light}
    joint, ideal = shown[f"joint correction for {light}"], shown["ideal complex fields, random phases averaged"]
    return (
        f"shown by {light}, the joint correction for it has SSIM {joint['ssim']:.3f} and {joint['psnr']:.1f} dB, ideal "
        f"complex fields of random phases {ideal['ssim']:.3f} and {ideal['psnr']:.1f} dB"
    )


def _setup(eye: Observer, retinas: list[Retina], deviation: float, largest: float, amount: Amount) -> list[str]:
    scene = f" (synthetic: {eye.scene.synthetic})" if eye.scene.synthetic else ""
    checked = amount.checked
    return [
        f"Teapot{scene}, {amount.size} px of {PITCH}, {amount.frames} frames, eyepiece and eye of "
        f"configs/eye/teapot.yaml, {len(retinas)} foci; sigma {SIGMA} px, largest phase {largest:.2f} pi",
        f"Wanted: incoherent images in closed form; the mean of {checked} random-phase holograms differs from them by "
        f"{deviation:.3f} (1 / sqrt({checked}) is {checked**-0.5:.3f})",
        f"Predicted error of the collapsed propagation: {max(each.plan.predicted_error for each in retinas):.2f}",
    ]


def _lines(rows: list[dict], cost: list[dict]) -> list[str]:
    lines = []
    for each in cost:
        lines.append(
            f"{each['steps']} steps for {each['light']} in {each['seconds']:.0f} s; at most "
            f"{each['peak_memory_bytes'] / 1e9:.1f} GB of memory so far"
        )
    for row in rows:
        lines.append(
            f"{row['method']}; shown: {row['light']}: SSIM {row['ssim']:.3f}, {row['psnr']:.1f} dB, contrast "
            f"{row['contrast']:.3f}, {row['light_on_retina']:.1%} of the light on the retina"
        )
    return lines
