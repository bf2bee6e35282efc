"""Chart of the joint correction through a whole display: eyepiece, eye and light source, in three colours."""

import math
import statistics
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
from holotorch.correction import LBFGS, PECProblem, Solution, limit_peak_phase, spread_preconditioner
from holotorch.correction.problem import best_scale
from holotorch.experiments.eye.experiment import PRESETS, Observer, observer
from holotorch.experiments.joint.charts.chart import volume_file
from holotorch.experiments.joint.experiment import deconvolved
from holotorch.experiments.joint.names import NAMES
from holotorch.experiments.joint.views.sampled import STEPS_OF_ADAM, Group, SampledViews, adam
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs.environment import device_name
from holotorch.experiments.runs.figures import picture_table
from holotorch.experiments.runs.memory import peak_memory
from holotorch.io.bundled import find_config
from holotorch.metrics import ssim
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Retina, RetinaViews, SpectralRetina, propagate, tone_map
from holotorch.optics.viewing.imaging import retinal_scale

PITCH, DISTANCE, PLANES = "3.74 um", "30 mm", 5
SIGMA, LIMIT = 0.66, 4 * math.pi
SOURCES = {None: "one wavelength", "sled": "SLED"}
_MEANS = "ssim", "psnr", "contrast", "light_on_retina"
TRAINED = 5  # wavelengths of each SLED in the problem; the scores use 9 to 15, of which 3 are propagated


@dataclass(frozen=True)
class Amount:
    """Size of the measurement."""

    size: int = 512  # pixels along each side of the array
    frames: int = 8
    steps: int = 30
    seeds: tuple[int, ...] = (7, 8, 9)
    checked: int = 32  # random-phase holograms whose mean the wanted images are compared with


FULL = Amount()
QUICK = Amount(size=128, frames=2, steps=4, seeds=(7,), checked=4)


@dataclass(frozen=True)
class _Setup:
    """Display, eye and light sources of the chart, and what is wanted on the retina."""

    eye: Observer
    foci: list[float]
    views: RetinaViews  # for one wavelength of each colour
    spectral: RetinaViews  # for the light of the SLED
    wanted: Tensor  # [C, V, H, W]
    crosstalk: ThermalCrosstalk


def chain(quick: bool = False) -> tuple[list[dict], dict[str, list[dict]], dict[str, bytes], list[str]]:
    """Table rows of the methods, further tables by name, PNG pictures by name, and lines of text."""
    warnings.simplefilter("ignore", SamplingWarning)  # of the collapsed method, whose error the verdict states
    amount = QUICK if quick else FULL
    eye = _observer(amount.size)
    device = eye.scene.device
    foci = sorted(eye.scene.depths)[:: max(1, (PLANES - 1) // 2)]
    wavelengths, optics = eye.scene.settings.wavelengths, [(eye.display, eye.eye(z)) for z in foci]
    retinas = [
        Retina(eye.scene.grid, wavelengths, *each, plane=z).to(device) for each, z in zip(optics, foci, strict=True)
    ]
    spectra = [PRESETS["sled"](each).samples(TRAINED) for each in wavelengths]
    spectral = [SpectralRetina(eye.scene.grid, spectra, *each, recompute=True).to(device) for each in optics]
    wanted = _wanted(eye, retinas, foci)
    crosstalk = ThermalCrosstalk(SIGMA).to(device)
    setup = _Setup(eye, foci, RetinaViews(retinas), RetinaViews(spectral), wanted, crosstalk)
    rows, cost, largest, shown = [], [], 0.0, {"wanted": wanted}
    for seed in amount.seeds:
        methods, costs, warmest = _methods(setup, seed, amount)
        cost += costs
        largest = max(largest, warmest)
        for name, emitted in methods.items():
            for source, light in SOURCES.items():
                numbers, images = _scores(setup, emitted, source)
                rows.append({"method": name, "light": light, "seed": seed} | numbers)
                shown.setdefault(f"{name}, shown: {light}", images)
    deviation = _deviation(setup, amount)
    text = [_headline(rows), *_conditions(eye, retinas, deviation, largest, amount), *_lines(rows, cost)]
    peak = wanted.amax().cpu()
    pixels = {name: tone_map(each.cpu().movedim(1, 0), peak=peak).movedim(0, 1) for name, each in shown.items()}
    short = {name.replace("joint correction ", "joint, "): each for name, each in pixels.items()}
    drawn = {"chart": picture_table(short, [f"{focus * 1e3:.4g} mm" for focus in foci])}
    return rows, {"cost": cost}, drawn, text


def _methods(setup: _Setup, seed: int, amount: Amount) -> tuple[dict[str, Tensor], list[dict[str, Any]], float]:
    """Fields [F, C, H, W] that each method emits, the cost of the joint corrections, and their largest phase in pi."""
    generator, crosstalk = torch.Generator().manual_seed(seed), setup.crosstalk
    fields = torch.stack([_random_field(setup.eye, generator) for _ in range(amount.frames)])
    kinoform = deconvolved(crosstalk, fields.angle())
    methods, cost, largest = {}, [], 0.0
    for light, operator in ("one wavelength", setup.views), ("SLED", setup.spectral):
        phase, numbers = _corrected(crosstalk, operator, setup.wanted, kinoform, light, amount.steps)
        cost.append(numbers | {"seed": seed})
        largest = max(largest, crosstalk(phase).max().item() / math.pi)
        methods[f"joint correction for {light}"] = phasor(crosstalk(phase))
    light_field = limit_peak_phase(LIMIT, _light_field(setup, fields, seed, amount.steps), crosstalk)
    methods[NAMES["light_field"]] = phasor(crosstalk(light_field))
    methods[NAMES["afterwards"]] = phasor(crosstalk(kinoform))
    methods[NAMES["random"]] = fields
    return methods, cost, largest


def _light_field(setup: _Setup, fields: Tensor, seed: int, steps: int) -> Tensor:
    """Heater phases [F, C, H, W] by one random focus in each step of Adam without heat, corrected afterwards."""
    unheated = ThermalCrosstalk(0.0).to(fields.device)

    def problem(drawn: list[int]) -> PECProblem:
        views = RetinaViews([setup.views.retinas[v] for v in drawn])
        return PECProblem(unheated, views, setup.wanted[:, drawn], frames=True, amplitude=True, scale_free=True)

    loss = SampledViews(problem, [Group(range(len(setup.foci)), 1)], seed)
    steps *= STEPS_OF_ADAM
    with tqdm(total=steps, desc="chain, light field", unit="step", dynamic_ncols=True) as bar:

        def step(_: Solution) -> None:
            bar.update()

        phase = adam(steps)(loss, deconvolved(unheated, fields.angle()), callback=step).x
    return deconvolved(setup.crosstalk, phase)


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
            bar.set_postfix(loss=f"{relative:.2e}", mem=f"{peak_memory(start.device) / 1e9:.2f}GB")
            bar.update()

        solver = LBFGS(max_steps=steps, precondition=spread_preconditioner(crosstalk.kernel), tolerance=0.0)
        phase = limit_peak_phase(LIMIT, solver(problem, start, callback=step).x, crosstalk)
    seconds = round(time.perf_counter() - begin, 1)
    memory = peak_memory(start.device)
    return phase, {"light": light, "steps": steps, "seconds": seconds, "peak_memory_bytes": memory}


def _observer(size: int) -> Observer:
    paths = [find_config(f"configs/{kind}/teapot.yaml") for kind in ("eye", "volume")]
    assert paths[0] is not None and paths[1] is not None
    shape = f"hologram={{shape: [{size}, {size}], pitch: {PITCH}, distance: {DISTANCE}, depths: {PLANES}}}"
    # One sample of the volume for each plane, as in the dissertation.
    scene = load_config(paths[1], [shape, "view.samples=1", *volume_file("teapot")])
    return observer(load_config(paths[0]), scene)


def _light(eye: Observer) -> Tensor:
    """Light of the planes, [D, C, h, w]."""
    with torch.no_grad():
        return torch.stack([intensity(each) for each in eye.scene.sampler()(eye.scene.volume).amplitudes()])


def _random_field(eye: Observer, generator: torch.Generator) -> Tensor:
    """Field [C, H, W] whose light converges to all sources in front of the array, with independent random phases."""
    wavelengths, device = torch.tensor(eye.scene.settings.wavelengths, dtype=torch.float64), eye.scene.device
    total = torch.zeros(len(wavelengths), *eye.scene.grid.shape, dtype=torch.complex64, device=device)
    for depth, light in zip(eye.scene.depths, _light(eye), strict=True):
        sources = light.sqrt() * phasor(2 * math.pi * torch.rand(light.shape, generator=generator).to(device))
        total += propagate(sources, eye.scene.grid, wavelengths, depth, tolerance=3e-3)
    return total.conj().resolve_conj()


def _wanted(eye: Observer, retinas: list[Retina], foci: list[float]) -> Tensor:
    """Incoherent images [C, V, H, W]: the light of each plane, spread as a point on the axis is by the whole chain.

    A plane beside the focus appears at another scale. Images have the mean 1 in each colour.
    """
    grid, wavelengths = eye.scene.grid, torch.tensor(eye.scene.settings.wavelengths, dtype=torch.float64)
    total = torch.zeros(len(wavelengths), len(foci), *grid.shape, device=eye.scene.device)
    point = torch.zeros(len(wavelengths), *grid.shape, dtype=torch.complex64, device=eye.scene.device)
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
    y, x = ((torch.arange(n, device=image.device) - n // 2) / scale + n // 2 for n in (height, width))
    # Coordinates of grid_sample: -1 and 1 are the outer edges of the first and last samples.
    positions = torch.stack(torch.meshgrid((2 * y + 1) / height - 1, (2 * x + 1) / width - 1, indexing="ij")[::-1], -1)
    moved = functional.grid_sample(image[None], positions[None], mode="bicubic", align_corners=False)[0]
    return moved / scale**2


def _deviation(setup: _Setup, amount: Amount) -> float:
    """Relative difference of the wanted images from the mean of random-phase holograms."""
    generator = torch.Generator().manual_seed(amount.seeds[0] + 1)
    total, wanted = torch.zeros_like(setup.wanted), setup.wanted
    with torch.no_grad():
        for _ in tqdm(range(amount.checked), desc="checking the wanted images", unit="hologram", dynamic_ncols=True):
            total += setup.views(_random_field(setup.eye, generator))
    total *= best_scale(total, wanted, -3)[:, None, None, None]
    return ((total - wanted).norm() / wanted.norm()).item()


def _scores(setup: _Setup, emitted: Tensor, source: str | None) -> tuple[dict[str, Any], Tensor]:
    """Scores of fields [F, C, H, W] under a light source, and their images, scaled as wanted."""
    views, wanted = setup.views, setup.wanted
    with torch.no_grad():
        if source is None:
            observed = torch.stack([views(each) for each in emitted]).mean(0)
        else:
            frames = [[setup.eye.image(each.conj(), source, focus) for focus in setup.foci] for each in emitted]
            observed = torch.stack([torch.stack(each, 1) for each in frames]).mean(0).to(wanted.device)
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
    shown = {name: _worst(each) for (name, by), each in _by_method(rows) if by == light}
    joint, ideal = shown[f"joint correction for {light}"], shown[NAMES["random"]]
    return (
        f"shown by {light}, the joint correction for it has at worst SSIM {joint['ssim']:.3f} and {joint['psnr']:.1f} "
        f"dB, ideal complex fields of random phases {ideal['ssim']:.3f} and {ideal['psnr']:.1f} dB"
    )


def _by_method(rows: list[dict]) -> list[tuple[tuple[str, str], list[dict]]]:
    """Rows of all seeds, by method and light."""
    chosen = dict.fromkeys((row["method"], row["light"]) for row in rows)
    return [(key, [row for row in rows if (row["method"], row["light"]) == key]) for key in chosen]


def _worst(rows: list[dict]) -> dict[str, float]:
    return {key: min(row[key] for row in rows) for key in ("ssim", "psnr")}


def _conditions(eye: Observer, retinas: list[Retina], deviation: float, largest: float, amount: Amount) -> list[str]:
    scene = f" (synthetic: {eye.scene.synthetic})" if eye.scene.synthetic else ""
    checked, device = amount.checked, eye.scene.device
    place = f"; computed on {device_name(device)}" if device.type == "cuda" else ""
    return [
        f"Teapot{scene}, {amount.size} px of {PITCH}, {amount.frames} frames, eyepiece and eye of "
        f"configs/eye/teapot.yaml, {len(retinas)} foci; sigma {SIGMA} px, largest phase {largest:.2f} pi; mean (worst) "
        f"of {len(amount.seeds)} seed(s){place}",
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
    for (method, light), each in _by_method(rows):
        worst, mean = _worst(each), {key: statistics.mean(row[key] for row in each) for key in each[0] if key in _MEANS}
        lines.append(
            f"{method}; shown: {light}: SSIM {mean['ssim']:.3f} ({worst['ssim']:.3f}), {mean['psnr']:.1f} "
            f"({worst['psnr']:.1f}) dB, contrast {mean['contrast']:.3f}, {mean['light_on_retina']:.1%} of the light on "
            "the retina"
        )
    return lines
