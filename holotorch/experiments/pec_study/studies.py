"""Studies of proximity effect correction: the thesis's comparisons, and what goes beyond them, as tables.

Every study returns rows that share their keys. ``thesis`` is the number printed there where there is one, ``verdict``
says reproduced, exceeded or not reproduced, and why.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from holotorch.experiments.pec_study.bench import Bench, Track
from holotorch.experiments.pec_study.cases import Cases
from holotorch.experiments.pec_study.volume import SLICES, focal_sweep
from holotorch.modulator import ThermalCrosstalk, quantised

Row = dict[str, Any]
PI = math.pi
SIZES = (64, 128, 256, 512)  # pixels along a side, whose times are compared
VOLUME = f"synthetic volume, {SLICES} slices in turn"


def reproduction(bench: Bench, sigmas: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """Sec. 4.4.3.3, 4.4.5.3, 4.5.2.2: every method against sigma, in the far field and in the periodic near field."""
    rows = done.rows
    printed = {("fourier", "PPEC", 1.5): 0.48, ("fourier", "PPEC", 2.0): 0.30}
    # FPEC; the thesis does not say where it starts, and only nearly flat phases, which need less heat, come so far.
    printed |= {("fresnel", "PPEC, cool start", 1.5): 0.57, ("fresnel", "PPEC, cool start", 2.0): 0.34}
    for kind in ("fourier", "fresnel"):
        for sigma in done.each(sigmas, desc=f"reproduction, {kind}", unit="sigma"):
            own = replace(bench, sigma_px=sigma, kind=kind)
            more = ("PPEC, cool start",) if kind == "fresnel" else ()
            for name, phase, seconds in _methods(own, steps, (*_ALL, *more)):
                scores = own.scores(phase)
                thesis = printed.get((kind, name, sigma))
                rows.append(_row(own, name, scores, seconds, thesis, _against(scores["ssim"], thesis, 0.04)))
    rows += _gains(rows)
    return rows


def lowpass(bench: Bench, cutoffs: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """Fig. 4.12: low-pass targets; the thesis's claim is that IPEC gains from them and PPEC needs none."""
    rows = done.rows
    for cutoff in done.each(cutoffs, desc="low-pass targets", unit="cut-off"):
        own = replace(bench, lowpass=cutoff)
        for name, phase, seconds in _methods(own, steps, ("basic IPEC", "IPEC", "PPEC", "ours")):
            rows.append(_row(own, name, own.scores(phase), seconds) | {"setting": f"cut-off {cutoff:g} cycles/px"})
    return rows


def multiplexing(bench: Bench, sigmas: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """Figs. 4.13, 4.14: ten IPEC runs shown in turn, a signal region, and frames that are solved for together."""
    rows = done.rows
    for sigma in done.each(sigmas, desc="multiplexing", unit="sigma"):
        own = replace(bench, sigma_px=sigma)
        region = replace(own, region=own.size // 2)
        for count in (1, 10):
            started = time.perf_counter()
            frames = [own.retrieved("ipec", passes=30, seed=k).x for k in range(count)]
            scores = own.scores(torch.stack(frames, 1))
            rows.append(_row(own, f"IPEC, {count} runs", scores, time.perf_counter() - started))
        for name, where, work in (
            ("IPEC, signal region", region, partial(region.retrieved, "ipec", passes=30)),
            ("PPEC", own, partial(own.algorithm2, own.start("hot"), steps=steps)),
            ("ours, signal region", region, partial(region.lbfgs, region.start("hot"), steps=steps)),
            ("2 joint frames", own, partial(own.lbfgs, own.start("hot", 2), steps=steps)),
            ("4 joint frames", own, partial(own.lbfgs, own.start("hot", 4), steps=steps)),
        ):
            started = time.perf_counter()
            phase = work().x
            rows.append(_row(where, name, where.scores(phase), time.perf_counter() - started))
    return rows


def iterations(bench: Bench, sigmas: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """Fig. 4.15: SSIM after so many steps, by Algorithm 2 and by ours."""
    rows = done.rows
    for sigma in done.each(sigmas, desc="iterations", unit="sigma"):
        own = replace(bench, sigma_px=sigma)
        for name in ("PPEC", "ours"):
            every = max(1, steps // 40)
            track = Track(own, every)
            start = own.start("hot")
            own.algorithm2(start, steps=steps, callback=track) if name == "PPEC" else own.lbfgs(
                start, steps=steps, callback=track
            )
            for k, (seconds, evaluations, quality, _) in enumerate(track.rows):
                setting = f"step {every * (k + 1)}"
                rows.append(_row(own, name, {"ssim": quality}, seconds) | {"setting": setting, "count": evaluations})
    return rows


def scaling(bench: Bench, sigmas: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """Figs. 4.10, 4.11: seconds against sigma and against resolution, in one process."""
    rows = done.rows
    cases = [(bench.size, sigma) for sigma in sigmas] + [(size, bench.sigma_px) for size in SIZES]
    for size, sigma in done.each(cases, desc="time", unit="case"):
        own = replace(bench, size=size, sigma_px=sigma)
        for name, phase, seconds in _methods(own, steps, ("basic IPEC", "IPEC", "PPEC", "ours")):
            rows.append(_row(own, name, own.scores(phase), seconds) | {"setting": f"{size} px"})
    return rows


def focus(bench: Bench, sigmas: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """Fig. 4.18 and Sec. 6.3.2: a scene at three depths, as the thesis's stack of slices and as one hologram."""
    rows = done.rows
    depths = (0.08, 0.10, 0.12)
    for sigma in done.each(sigmas, desc="depths", unit="sigma"):
        own = replace(bench, kind="fresnel", distances=depths, sigma_px=sigma)
        started = time.perf_counter()
        stack, weights = _slices(own, steps)
        formed = _formed_of_slices(own, stack, weights)
        scores = own.scores(stack[:, 0], formed * (own.wanted.mean() / formed.mean()))
        rows.append(_row(own, "stack of 3 slices", scores, time.perf_counter() - started))
        for name, frames in (("one hologram", 1), ("4 joint frames", 4)):
            started = time.perf_counter()
            phase = own.lbfgs(own.start("cool", frames), steps=steps).x
            rows.append(_row(own, name, own.scores(phase), time.perf_counter() - started))
            for plane in (0.07, 0.08, 0.09, 0.10, 0.11, 0.12, 0.13):
                seen = replace(own, distances=(plane,)).formed(phase)
                for band, depth in enumerate(depths):
                    part = slice(band * own.size // 3, (band + 1) * own.size // 3)
                    error = (seen - own.wanted)[..., part].square().mean().sqrt() / own.wanted[..., part].std()
                    where = f"focus {plane * 1e3:g} mm, band of {depth * 1e3:g} mm"
                    rows.append(_row(own, name, {"error": error.item()}, 0.0) | {"setting": where})
        for plane, depth, error in focal_sweep(replace(bench, sigma_px=sigma), min(steps, 100)):
            where = f"focus {plane * 1e3:.3g} mm, part of {depth * 1e3:.3g} mm"
            rows.append(_row(own, VOLUME, {"error": error}, 0.0) | {"setting": where})
    return rows


def limits(bench: Bench, sigmas: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """SSIM against the temperature allowed, a wrong sigma, a weight on heating power, and the heaters' bits."""
    rows = done.rows
    for sigma in done.each(sigmas, desc="limits", unit="sigma"):
        own = replace(bench, sigma_px=sigma)
        for turns in (1, 2, 4, 8):
            for frames in (1, 4):
                started = time.perf_counter()
                phase = own.lbfgs(own.start("hot", frames), steps=steps, limit=turns * PI).x
                row = _row(own, f"{frames} frame(s)", own.scores(phase), time.perf_counter() - started)
                rows.append(row | {"setting": f"P <= {turns} pi ({turns * 175} degC at 630 nm)"})
        phase = own.lbfgs(own.start("hot"), steps=steps).x
        for error in (-0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05):
            true = ThermalCrosstalk(sigma * (1 + error), 7)
            row = _row(own, "1 frame", own.scores(phase, own.formed(phase, true)), 0.0)
            rows.append(row | {"setting": f"true sigma {100 * error:+.0f} %"})
        for weight in (0.01, 0.1, 1.0):
            found = own.lbfgs(own.start("hot"), steps=steps, power_weight=weight)
            rows.append(_row(own, "1 frame", own.scores(found.x), 0.0) | {"setting": f"weight on power {weight:g}"})
        for bits in (4, 6, 8, 10, 12):
            rows.append(_row(own, "1 frame", own.scores(quantised(phase, bits)), 0.0) | {"setting": f"{bits} bits"})
    return rows


def targets(bench: Bench, sigmas: Sequence[float], steps: int, done: Cases) -> list[Row]:
    """What a device can show: cases with a limit on the heat, frames, a region or depths; ``sigmas`` is not used."""
    rows = done.rows
    near, alone = replace(bench, kind="fresnel"), replace(bench, kind="isolated")
    depths, region = replace(near, distances=(0.08, 0.10, 0.12)), replace(bench, region=bench.size // 2)
    # (what, bench, sigmas, start, frames, limit in pi, SSIM that research/prototypes reached)
    cases: list[tuple[str, Bench, Sequence[float], str, int, float | None, Sequence[float]]] = [
        ("4 joint frames, P <= 4 pi", bench, (0.66, 1.0), "hot", 4, 4, (0.99, 0.99)),
        ("4 joint frames, P <= 4 pi", near, (0.66, 1.0, 1.5, 2.0), "cool", 4, 4, (0.99, 0.99, 0.99, 0.96)),
        ("4 joint frames, P <= 2 pi", bench, (0.66, 1.0, 1.5, 2.0), "hot", 4, 2, ()),
        ("4 joint frames, P <= 2 pi", near, (0.66, 1.0, 1.5, 2.0), "cool", 4, 2, ()),
        ("1 frame, P <= 4 pi", bench, (0.66, 1.0), "hot", 1, 4, (0.98, 0.80)),
        ("1 frame, P <= 2 pi", near, (0.66, 1.0, 1.5, 2.0), "cool", 1, 2, (0.94, 0.79, 0.59, 0.52)),
        ("2 joint frames, no limit", bench, (0.66, 1.0, 1.5), "hot", 2, None, (0.99, 0.99, 0.93)),
        ("4 joint frames, no limit", bench, (1.5, 2.0), "hot", 4, None, (0.98, 0.92)),
        ("1 frame, no limit, quadratic", bench, (1.0, 1.5, 2.0), "quadratic", 1, None, (0.98, 0.64, 0.44)),
        ("signal region", region, (0.66, 1.0, 1.5, 2.0), "hot", 1, None, (0.98,) * 4),
        ("chip that stands alone", alone, (0.66, 1.0), "flat", 1, None, (0.86, 0.86)),
        ("three depths, one hologram", depths, (0.66, 1.0, 1.5), "cool", 1, None, (0.95, 0.82, 0.44)),
        ("three depths, 4 joint frames", depths, (0.66, 1.0, 1.5), "cool", 4, None, (0.97,) * 3),
    ]
    for what, where, widths, start, frames, limit, goals in done.each(cases, desc="targets", unit="case"):
        for i, sigma in enumerate(widths):
            own = replace(where, sigma_px=sigma)
            started = time.perf_counter()
            found = own.lbfgs(own.start(start, frames), steps=steps, limit=limit and limit * PI)
            seconds = time.perf_counter() - started
            # A chip that stands alone is judged by the exact kernel, not by the paraxial one of the solver.
            formed = own.formed(found.x, propagator=own.exact) if own.kind == "isolated" else None
            scores = own.scores(found.x, formed)
            goal = goals[i] if i < len(goals) else None
            verdict = "" if goal is None else "reached" if scores["ssim"] >= goal else "not reached"
            row = _row(own, what, scores, seconds, None, verdict)
            rows.append(row | {"setting": "" if goal is None else f"goal {goal:g}", "count": found.evaluations})
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
    """Heater phases and seconds of each method; the hot start is the thesis's, and ours takes it too."""
    work: dict[str, Callable[[], Tensor]] = {
        "none": lambda: bench.retrieved("none").x,
        "basic IPEC": lambda: bench.retrieved("basic").x,
        "IPEC": lambda: bench.retrieved("ipec", passes=30).x,
        "PPEC": lambda: bench.algorithm2(bench.start("hot"), steps=steps).x,
        "PPEC, cool start": lambda: bench.algorithm2(bench.start("cool"), steps=steps).x,
        "ours": lambda: bench.lbfgs(bench.start("hot"), steps=steps).x,
    }
    for name in names:
        started = time.perf_counter()
        phase = work[name]()
        yield name, phase, time.perf_counter() - started


def _slices(bench: Bench, steps: int) -> tuple[Tensor, Tensor]:
    """The thesis's stack: a hologram per depth of its slice alone [C, D, H, W], and the light of each slice [C, D]."""
    phases, weights = [], []
    for i, distance in enumerate(bench.distances):
        mask = bench.mask
        assert mask is not None
        single = replace(bench, distances=(distance,))
        part = bench.wanted * mask[0, i]
        weights.append(part.mean((-2, -1)))
        # Not through the cached property: this slice is another picture.
        single.__dict__["wanted"] = part / part.mean((-2, -1), keepdim=True)
        phases.append(single.algorithm2(single.start("cool", seed=i), steps=steps).x)
    return torch.stack(phases, 1), torch.stack(weights, 1)


def _formed_of_slices(bench: Bench, phases: Tensor, weights: Tensor) -> Tensor:
    """What is in focus of the stack, each hologram lit by the light of its slice."""
    parts = [bench.formed(phases[:, i]) * weights[:, i, None, None] for i in range(phases.shape[1])]
    return torch.stack(parts).sum(0)


def _row(
    bench: Bench, method: str, scores: dict[str, float], seconds: float, thesis: float | None = None, verdict: str = ""
) -> Row:
    keys = ("ssim", "psnr", "perceptual", "error", "efficiency", "peak_rad", "power_rad")
    numbers = {key: round(scores[key], 4) if key in scores else "" for key in keys}
    kind = {"kind": bench.kind, "sigma_px": bench.sigma_px, "setting": "", "method": method}
    kelvin = round(scores["peak_rad"] * 175 / PI) if "peak_rad" in scores else ""
    more = {"peak_degC_at_630nm": kelvin, "seconds": round(seconds, 3), "count": ""}
    return {**kind, **numbers, **more, "thesis": "" if thesis is None else thesis, "verdict": verdict}


def _against(value: float, thesis: float | None, slack: float) -> str:
    if thesis is None:
        return ""
    if value > thesis + slack:
        return "exceeded"
    return "reproduced" if value >= thesis - slack else "not reproduced"


def _gains(rows: list[Row]) -> list[Row]:
    """The thesis's gains at sigma 0.66 in the far field: IPEC +121 %, PPEC +250 % over basic IPEC."""
    found = {row["method"]: row for row in rows if row["kind"] == "fourier" and row["sigma_px"] == 0.66}
    gains = []
    for name, thesis in (("IPEC", 121.0), ("PPEC", 250.0)) if "basic IPEC" in found else ():
        gain = 100 * (found[name]["ssim"] / found["basic IPEC"]["ssim"] - 1)
        row = dict.fromkeys(found[name], "")
        verdict = "reproduced" if abs(gain - thesis) <= 30 else "exceeded" if gain > thesis else "not reproduced"
        row |= {"kind": "fourier", "sigma_px": 0.66, "method": name, "setting": f"gain {gain:.0f} % over basic IPEC"}
        gains.append(row | {"thesis": thesis, "verdict": verdict})
    return gains
