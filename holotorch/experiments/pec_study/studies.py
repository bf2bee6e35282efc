"""Studies of proximity effect correction as tables: the comparisons of the thesis, and further ones.

Every study returns rows with the same keys. The chart ``pec`` compares the committed tables with the thesis.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from holotorch.correction import Solution
from holotorch.experiments.pec_study.bench import Bench, Track
from holotorch.experiments.pec_study.cases import Cases
from holotorch.experiments.pec_study.volume import SLICES, focal_sweep
from holotorch.modulator import ThermalCrosstalk, quantised

Row = dict[str, Any]
PI = math.pi
SIZES = (64, 128, 256, 512)  # pixels along a side of the arrays in the study of the time
VOLUME = f"synthetic volume, {SLICES} slices in turn"


def reproduction(bench: Bench, sigmas: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """Sec. 4.4.3.3, 4.4.5.3, 4.5.2.2: SSIM of every method by sigma, in the far field and the periodic near field."""
    rows = store.rows
    for kind in ("fourier", "fresnel"):
        for sigma in store.each(sigmas, desc=f"reproduction, {kind}", unit="sigma"):
            setup = replace(bench, sigma_px=sigma, kind=kind)
            more = ("PPEC, cool start",) if kind == "fresnel" else ()
            for name, phase, seconds in _methods(setup, steps, (*_ALL, *more)):
                rows.append(_row(setup, name, setup.scores(phase), seconds))
    return rows


def lowpass(bench: Bench, cutoffs: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """Fig. 4.12: targets of which a low-pass filter has removed the fine detail."""
    rows = store.rows
    for cutoff in store.each(cutoffs, desc="low-pass targets", unit="cut-off"):
        rows += _corrected(replace(bench, lowpass=cutoff), steps, f"cut-off {cutoff:g} cycles/px")
    return rows


def multiplexing(bench: Bench, sigmas: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """Figs. 4.13, 4.14: ten IPEC holograms shown one after another, a signal region, and jointly solved frames."""
    rows = store.rows
    for sigma in store.each(sigmas, desc="multiplexing", unit="sigma"):
        setup = replace(bench, sigma_px=sigma)
        region = replace(setup, region=setup.size // 2)
        for count in (1, 10):
            started = time.perf_counter()
            frames = [setup.retrieved("ipec", passes=30, seed=k).x for k in range(count)]
            scores = setup.scores(torch.stack(frames))
            rows.append(_row(setup, f"IPEC, {count} runs", scores, time.perf_counter() - started))
        for name, where, work in (
            ("IPEC, signal region", region, partial(region.retrieved, "ipec", passes=30)),
            ("PPEC", setup, partial(setup.algorithm2, setup.start("hot"), steps=steps)),
            ("ours, signal region", region, partial(region.lbfgs, region.start("hot"), steps=steps)),
            ("2 joint frames", setup, partial(setup.lbfgs, setup.start("hot", 2), steps=steps)),
            ("4 joint frames", setup, partial(setup.lbfgs, setup.start("hot", 4), steps=steps)),
        ):
            phase, seconds = _timed(work)
            rows.append(_row(where, name, where.scores(phase), seconds))
    return rows


def iterations(bench: Bench, sigmas: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """Fig. 4.15: SSIM by the number of steps, of Algorithm 2 and of L-BFGS ("ours")."""
    rows = store.rows
    for sigma in store.each(sigmas, desc="iterations", unit="sigma"):
        setup = replace(bench, sigma_px=sigma)
        for name in ("PPEC", "ours"):
            every = max(1, steps // 40)
            track = Track(setup, every)
            start = setup.start("hot")
            solver = setup.algorithm2 if name == "PPEC" else setup.lbfgs
            solver(start, steps=steps, callback=track)
            for k, (seconds, evaluations, quality, _) in enumerate(track.rows):
                setting = f"step {every * (k + 1)}"
                rows.append(_row(setup, name, {"ssim": quality}, seconds) | {"setting": setting, "count": evaluations})
    return rows


def scaling(bench: Bench, sigmas: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """Figs. 4.10, 4.11: seconds by sigma and by resolution, in one process."""
    rows = store.rows
    cases = [(bench.size, sigma) for sigma in sigmas] + [(size, bench.sigma_px) for size in SIZES]
    for size, sigma in store.each(cases, desc="time", unit="case"):
        rows += _corrected(replace(bench, size=size, sigma_px=sigma), steps, f"{size} px")
    return rows


def focus(bench: Bench, sigmas: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """Fig. 4.18 and Sec. 6.3.2: a scene at three depths, as one hologram per slice (thesis) and as one hologram."""
    rows = store.rows
    depths = (0.08, 0.10, 0.12)
    for sigma in store.each(sigmas, desc="depths", unit="sigma"):
        setup = replace(bench, kind="fresnel", distances=depths, sigma_px=sigma)
        started = time.perf_counter()
        stack, weights = _slices(setup, steps)
        formed = _formed_of_slices(setup, stack, weights)
        scores = setup.scores(stack[0], formed * (setup.wanted.mean() / formed.mean()))
        rows.append(_row(setup, "stack of 3 slices", scores, time.perf_counter() - started))
        for name, frames in (("one hologram", 1), ("4 joint frames", 4)):
            phase, seconds = _timed(setup.lbfgs, setup.start("cool", frames), steps=steps)
            rows.append(_row(setup, name, setup.scores(phase), seconds))
            for plane in (0.07, 0.08, 0.09, 0.10, 0.11, 0.12, 0.13):
                image = replace(setup, distances=(plane,)).formed(phase)
                for band, depth in enumerate(depths):
                    part = slice(band * setup.size // 3, (band + 1) * setup.size // 3)
                    error = (image - setup.wanted)[..., part].square().mean().sqrt() / setup.wanted[..., part].std()
                    where = f"focus {plane * 1e3:g} mm, band of {depth * 1e3:g} mm"
                    rows.append(_row(setup, name, {"error": error.item()}, 0.0) | {"setting": where})
        for plane, depth, error in focal_sweep(replace(bench, sigma_px=sigma), min(steps, 100)):
            where = f"focus {plane * 1e3:.3g} mm, part of {depth * 1e3:.3g} mm"
            rows.append(_row(setup, VOLUME, {"error": error}, 0.0) | {"setting": where})
    return rows


def limits(bench: Bench, sigmas: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """SSIM under a limit on the temperature, a wrong sigma, a weight on heating power, and heaters of few bits."""
    rows = store.rows
    for sigma in store.each(sigmas, desc="limits", unit="sigma"):
        setup = replace(bench, sigma_px=sigma)
        for multiple in (1, 2, 4, 8):
            for frames in (1, 4):
                phase, seconds = _timed(setup.lbfgs, setup.start("hot", frames), steps=steps, limit=multiple * PI)
                row = _row(setup, f"{frames} frame(s)", setup.scores(phase), seconds)
                rows.append(row | {"setting": f"P <= {multiple} pi ({multiple * 175} degC at 630 nm)"})
        phase = setup.lbfgs(setup.start("hot"), steps=steps).x
        for error in (-0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05):
            true = ThermalCrosstalk(sigma * (1 + error), 7)
            row = _row(setup, "1 frame", setup.scores(phase, setup.formed(phase, true)), 0.0)
            rows.append(row | {"setting": f"true sigma {100 * error:+.0f} %"})
        for weight in (0.01, 0.1, 1.0):
            cooler = setup.lbfgs(setup.start("hot"), steps=steps, power_weight=weight).x
            rows.append(_row(setup, "1 frame", setup.scores(cooler), 0.0) | {"setting": f"weight on power {weight:g}"})
        for bits in (4, 6, 8, 10, 12):
            rows.append(_row(setup, "1 frame", setup.scores(quantised(phase, bits)), 0.0) | {"setting": f"{bits} bits"})
    return rows


def targets(bench: Bench, sigmas: Sequence[float], steps: int, store: Cases) -> list[Row]:
    """Quality of holograms with a limit on the heat, frames, a region or depths; ``sigmas`` is not used."""
    rows = store.rows
    near, alone = replace(bench, kind="fresnel"), replace(bench, kind="isolated")
    depths, region = replace(near, distances=(0.08, 0.10, 0.12)), replace(bench, region=bench.size // 2)
    every = (0.66, 1.0, 1.5, 2.0)
    # Method as in the table, bench, sigmas, start, frames, limit as a multiple of pi.
    cases: list[tuple[str, Bench, Sequence[float], str, int, float | None]] = [
        ("4 joint frames, P <= 4 pi", bench, (0.66, 1.0), "hot", 4, 4),
        ("4 joint frames, P <= 4 pi", near, every, "cool", 4, 4),
        ("4 joint frames, P <= 2 pi", bench, every, "hot", 4, 2),
        ("4 joint frames, P <= 2 pi", near, every, "cool", 4, 2),
        ("1 frame, P <= 4 pi", bench, (0.66, 1.0), "hot", 1, 4),
        ("1 frame, P <= 2 pi", near, every, "cool", 1, 2),
        ("2 joint frames, no limit", bench, (0.66, 1.0, 1.5), "hot", 2, None),
        ("4 joint frames, no limit", bench, (1.5, 2.0), "hot", 4, None),
        ("1 frame, no limit, quadratic", bench, (1.0, 1.5, 2.0), "quadratic", 1, None),
        ("signal region", region, every, "hot", 1, None),
        ("chip that stands alone", alone, (0.66, 1.0), "flat", 1, None),
        ("three depths, one hologram", depths, (0.66, 1.0, 1.5), "cool", 1, None),
        ("three depths, 4 joint frames", depths, (0.66, 1.0, 1.5), "cool", 4, None),
    ]
    for method, base, widths, start, frames, limit in store.each(cases, desc="targets", unit="case"):
        for sigma in widths:
            setup = replace(base, sigma_px=sigma)
            started = time.perf_counter()
            solution = setup.lbfgs(setup.start(start, frames), steps=steps, limit=limit and limit * PI)
            seconds = time.perf_counter() - started
            # The solver's model of a single chip is paraxial; its scores are taken with the exact kernel.
            formed = setup.formed(solution.x, propagator=setup.exact) if setup.kind == "isolated" else None
            row = _row(setup, method, setup.scores(solution.x, formed), seconds)
            rows.append(row | {"count": solution.evaluations})
    return rows


STUDIES: dict[str, Callable[[Bench, Sequence[float], int, Cases], list[Row]]] = {
    "reproduction": reproduction,
    "lowpass": lowpass,
    "multiplexing": multiplexing,
    "iterations": iterations,
    "time": scaling,
    "focus": focus,
    "limits": limits,
    "targets": targets,
}


_ALL = ("none", "basic IPEC", "IPEC", "PPEC", "ours")


def _methods(bench: Bench, steps: int, names: Sequence[str]) -> Iterator[tuple[str, Tensor, float]]:
    """Heater phases and seconds of each method; solvers use the thesis's hot start unless their name states another."""
    work: dict[str, Callable[[], Solution]] = {
        "none": lambda: bench.retrieved("none"),
        "basic IPEC": lambda: bench.retrieved("basic"),
        "IPEC": lambda: bench.retrieved("ipec", passes=30),
        "PPEC": lambda: bench.algorithm2(bench.start("hot"), steps=steps),
        "PPEC, cool start": lambda: bench.algorithm2(bench.start("cool"), steps=steps),
        "ours": lambda: bench.lbfgs(bench.start("hot"), steps=steps),
    }
    for name in names:
        yield name, *_timed(work[name])


def _timed(work: Callable[..., Solution], *arguments: Any, **options: Any) -> tuple[Tensor, float]:
    """Heater phases that ``work`` returns for the arguments, and the seconds that it takes."""
    started = time.perf_counter()
    return work(*arguments, **options).x, time.perf_counter() - started


def _corrected(bench: Bench, steps: int, setting: str) -> list[Row]:
    """Rows of the methods with a correction at one setting."""
    methods = _methods(bench, steps, _ALL[1:])
    return [_row(bench, name, bench.scores(phase), seconds) | {"setting": setting} for name, phase, seconds in methods]


def _slices(bench: Bench, steps: int) -> tuple[Tensor, Tensor]:
    """The thesis's stack: one hologram per depth for that slice alone, [D, C, H, W], and the light of each, [D, C]."""
    phases, weights = [], []
    for i, distance in enumerate(bench.distances):
        mask = bench.mask
        assert mask is not None
        part = bench.wanted * mask[0, i]
        single = replace(bench, distances=(distance,), pictures=part)
        weights.append(part.mean((-2, -1)))
        phases.append(single.algorithm2(single.start("cool", seed=i), steps=steps).x)
    return torch.stack(phases), torch.stack(weights)


def _formed_of_slices(bench: Bench, phases: Tensor, weights: Tensor) -> Tensor:
    """Sum of the pictures that the holograms of the slices form, each scaled by the light of its slice."""
    return torch.stack([bench.formed(p) * w[:, None, None] for p, w in zip(phases, weights, strict=True)]).sum(0)


def _row(bench: Bench, method: str, scores: dict[str, float], seconds: float) -> Row:
    keys = ("ssim", "psnr", "perceptual", "error", "efficiency", "peak_rad", "power_rad")
    numbers = {key: round(scores[key], 4) if key in scores else "" for key in keys}
    kind = {"kind": bench.kind, "sigma_px": bench.sigma_px, "setting": "", "method": method}
    kelvin = round(scores["peak_rad"] * 175 / PI) if "peak_rad" in scores else ""
    more = {"peak_degC_at_630nm": kelvin, "seconds": round(seconds, 3), "count": ""}
    return {**kind, **numbers, **more}
