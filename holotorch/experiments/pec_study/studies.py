"""Studies of proximity effect correction as tables: comparisons of the thesis, and further ones.

Every study yields table rows with the same keys. Its arguments are the bench, the values of ``sweep`` (sigmas in
pixels unless stated otherwise), the largest number of solver steps, and the :class:`Cases` that store the progress.
The chart ``pec`` compares the committed tables with the thesis.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from holotorch.correction import Solution
from holotorch.experiments.pec_study.bench import Bench, Track
from holotorch.experiments.pec_study.cases import Cases
from holotorch.experiments.pec_study.volume import SLICES, focal_sweep
from holotorch.experiments.timing import timed
from holotorch.metrics import dark_spots
from holotorch.modulator import quantised

Row = dict[str, Any]
PI = math.pi
SIZES = (64, 128, 256, 512)  # pixels of the array along each axis in the study of times
ROUNDS = 3  # measurements of each time
DRAWS = 12  # random starts of each kind, and as many for a second attempt
VOLUME = f"synthetic volume, {SLICES} slices in turn"
DEPTHS = (0.08, 0.10, 0.12)  # distances in metres of the three depths of a scene


def reproduction(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Thesis Sec. 4.4.3.3, 4.4.5.3, 4.5.2.2: SSIM of every method by sigma, in far field and periodic near field."""
    for kind in ("fourier", "fresnel"):
        for sigma in cases.each(sigmas, desc=f"reproduction, {kind}", unit="sigma"):
            setup = replace(bench, sigma_px=sigma, kind=kind)
            more = ("PPEC, cool start",) if kind == "fresnel" else ()
            yield from _methods(setup, steps, ("none", *_CORRECTED, *more))


def photographs(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Colour photographs of 384 x 256 pixels in the far field, as in thesis Fig. 4.9."""
    for sigma in cases.each(sigmas, desc="photographs", unit="sigma"):
        setup = replace(bench, sigma_px=sigma, height=bench.size * 2 // 3, colour=True)
        yield from _methods(setup, steps, ("none", *_CORRECTED), setting=f"{len(bench.images)} colour photographs")


def photographs_fresnel(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """The same in the near field, as in Fig. 4.17."""
    yield from photographs(replace(bench, kind="fresnel"), sigmas, steps, cases)


def lowpass(bench: Bench, cutoffs: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Thesis Fig. 4.12: targets after a low-pass filter, by the cut-off of the filter in cycles per pixel."""
    for cutoff in cases.each(cutoffs, desc="low-pass targets", unit="cut-off"):
        yield from _methods(replace(bench, lowpass=cutoff), steps, setting=f"cut-off {cutoff:g} cycles/px")


def multiplexing(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Thesis Figs. 4.13, 4.14: ten IPEC holograms shown in turn, a signal region, and jointly solved frames."""
    for sigma in cases.each(sigmas, desc="multiplexing", unit="sigma"):
        setup = replace(bench, sigma_px=sigma)
        region = replace(setup, region=setup.size // 2)
        for count in (1, 10):
            started = time.perf_counter()
            frames = [setup.retrieved("ipec", seed=k).x for k in range(count)]
            scores = setup.scores(torch.stack(frames))
            yield _row(setup, f"IPEC, {count} runs", scores, time.perf_counter() - started)
        for name, base, solve in (
            ("IPEC, signal region", region, partial(region.retrieved, "ipec")),
            ("PPEC", setup, partial(setup.algorithm2, setup.start("hot"), steps=steps)),
            ("ours, signal region", region, partial(region.lbfgs, region.start("hot"), steps=steps)),
            ("2 joint frames", setup, partial(setup.lbfgs, setup.start("hot", 2), steps=steps)),
            ("4 joint frames", setup, partial(setup.lbfgs, setup.start("hot", 4), steps=steps)),
        ):
            yield _timed_row(base, name, solve)


def iterations(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Thesis Fig. 4.15: SSIM by the number of steps, of Algorithm 2 and of L-BFGS ("ours")."""
    every = max(1, steps // 40)
    for sigma in cases.each(sigmas, desc="iterations", unit="sigma"):
        setup = replace(bench, sigma_px=sigma)
        for name, solver in (("PPEC", setup.algorithm2), ("ours", setup.lbfgs)):
            track = Track(setup, every)
            solver(setup.start("hot"), steps=steps, callback=track)
            for k, (seconds, evaluations, quality, _) in enumerate(track.rows):
                setting = f"step {every * (k + 1)}"
                yield _row(setup, name, {"ssim": quality}, seconds, setting=setting, count=evaluations)


def scaling(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Thesis Figs. 4.10, 4.11: seconds by sigma and by resolution, the methods in turn and the median of the rounds."""
    settings = [(bench.size, sigma) for sigma in sigmas] + [(size, bench.sigma_px) for size in SIZES]
    for size, sigma in cases.each(settings, desc="time", unit="case"):
        setup = replace(bench, size=size, sigma_px=sigma)
        rounds = [list(_methods(setup, steps, setting=f"{size} px")) for _ in range(ROUNDS)]
        for row, *others in zip(*rounds, strict=True):
            seconds = sorted(repeat["seconds"] for repeat in (row, *others))
            spread = round(seconds[-1] / max(seconds[0], 1e-3), 2)
            yield row | {"seconds": statistics.median(seconds), "seconds_spread": spread}


def focus(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Thesis Fig. 4.18, Sec. 6.3.2: a scene at three depths as one hologram per depth (thesis) or one hologram."""
    for sigma in cases.each(sigmas, desc="depths", unit="sigma"):
        setup = replace(bench, kind="fresnel", distances=DEPTHS, sigma_px=sigma)
        yield _slices(setup, steps)
        normalised = setup.experiment.normalised
        for name, frames in (("one hologram", 1), ("4 joint frames", 4)):
            solution, seconds = timed(partial(setup.lbfgs, setup.start("cool", frames), steps=steps))
            yield _row(setup, name, setup.scores(solution.x), seconds)
            for plane in (0.07, 0.08, 0.09, 0.10, 0.11, 0.12, 0.13):
                image = replace(setup, distances=(plane,)).formed(solution.x)
                for band, depth in enumerate(DEPTHS):
                    part = slice(band * setup.size // 3, (band + 1) * setup.size // 3)
                    error = (image - normalised)[..., part].square().mean().sqrt() / normalised[..., part].std()
                    setting = f"focus {plane * 1e3:g} mm, band of {depth * 1e3:g} mm"
                    yield _row(setup, name, {"error": error.item()}, setting=setting)
        for plane, depth, error in focal_sweep(replace(bench, sigma_px=sigma), min(steps, 100)):
            setting = f"focus {plane * 1e3:.3g} mm, part of {depth * 1e3:.3g} mm"
            yield _row(setup, VOLUME, {"error": error}, setting=setting)


def starts(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Thesis Sec. 4.4.5.2: ``error`` is the share of ``count`` results with speckle noise, before and after a rerun."""
    settings = [(kind, start) for kind in ("fourier", "fresnel") for start in ("hot", "cool", "flat")]
    for (kind, start), sigma in cases.each(
        [(setting, s) for s in sigmas for setting in settings], desc="starts", unit="case"
    ):
        setup, noisy, scores = replace(bench, kind=kind, sigma_px=sigma), [], []
        for seed in range(2 * DRAWS):
            phase = setup.algorithm2(setup.start(start, seed=seed), steps=steps).x
            formed = setup.formed(phase)
            noisy.append(dark_spots(formed / formed.mean((-2, -1), keepdim=True), setup.experiment.normalised) > 0)
            scores.append(setup.scores(phase, formed)["ssim"])
        before, after = torch.stack(noisy[:DRAWS]), torch.stack(noisy).unflatten(0, (2, DRAWS)).all(0)
        for name, share in (("", before), (", one rerun", after)):
            numbers = {"ssim": sum(scores) / len(scores), "error": share.double().mean().item()}
            yield _row(setup, f"PPEC, {start} start{name}", numbers, count=share.numel())


def limits(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """SSIM with limited temperature, a wrong sigma, a weight on the heating power, or heaters of few bits."""
    for sigma in cases.each(sigmas, desc="limits", unit="sigma"):
        setup = replace(bench, sigma_px=sigma)
        for multiple in (1, 2, 4, 8):
            for frames in (1, 4):
                solve = partial(setup.lbfgs, setup.start("hot", frames), steps=steps, limit=multiple * PI)
                setting = f"P <= {multiple} pi ({multiple * 175} degC at 630 nm)"
                yield _timed_row(setup, "1 frame" if frames == 1 else f"{frames} frames", solve, setting=setting)
        phase = setup.lbfgs(setup.start("hot"), steps=steps).x
        for error in (-0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05):
            formed = replace(setup, sigma_px=sigma * (1 + error)).formed(phase)
            yield _row(setup, "1 frame", setup.scores(phase, formed), setting=f"true sigma {100 * error:+.0f} %")
        for weight in (0.01, 0.1, 1.0):
            cooler = setup.lbfgs(setup.start("hot"), steps=steps, power_weight=weight).x
            yield _row(setup, "1 frame", setup.scores(cooler), setting=f"weight on power {weight:g}")
        for bits in (4, 6, 8, 10, 12):
            yield _row(setup, "1 frame", setup.scores(quantised(phase, bits)), setting=f"{bits} bits")


def targets(bench: Bench, sigmas: Sequence[float], steps: int, cases: Cases) -> Iterator[Row]:
    """Scores with limited heat, joint frames, a signal region or several depths; the argument ``sigmas`` is unused."""
    near, alone = replace(bench, kind="fresnel"), replace(bench, kind="isolated")
    depths, region = replace(near, distances=DEPTHS), replace(bench, region=bench.size // 2)
    every = (0.66, 1.0, 1.5, 2.0)
    # Name of the method in the table, bench, sigmas, start, number of frames, limit as a multiple of pi.
    settings: list[tuple[str, Bench, Sequence[float], str, int, float | None]] = [
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
    for method, base, widths, start, frames, limit in cases.each(settings, desc="targets", unit="case"):
        for sigma in widths:
            setup = replace(base, sigma_px=sigma)
            solve = partial(setup.lbfgs, setup.start(start, frames), steps=steps, limit=limit and limit * PI)
            solution, seconds = timed(solve)
            # The solver's model of a single chip is paraxial; its scores are taken with the exact kernel.
            scored = replace(setup, kind="exact") if setup.kind == "isolated" else setup
            yield _row(setup, method, scored.scores(solution.x), seconds, count=solution.evaluations)


STUDIES: dict[str, Callable[[Bench, Sequence[float], int, Cases], Iterator[Row]]] = {
    "reproduction": reproduction,
    "photographs": photographs,
    "photographs_fresnel": photographs_fresnel,
    "lowpass": lowpass,
    "multiplexing": multiplexing,
    "iterations": iterations,
    "starts": starts,
    "time": scaling,
    "focus": focus,
    "limits": limits,
    "targets": targets,
}
_CORRECTED = ("basic IPEC", "IPEC", "PPEC", "ours")  # all methods with a correction


def _methods(bench: Bench, steps: int, names: Sequence[str] = _CORRECTED, setting: str = "") -> Iterator[Row]:
    """A row for each method. The start of a solver is hot (thesis) unless the name states another."""
    solvers: dict[str, Callable[[], Solution]] = {
        "none": lambda: bench.retrieved("none"),
        "basic IPEC": lambda: bench.retrieved("basic"),
        "IPEC": lambda: bench.retrieved("ipec"),
        "PPEC": lambda: bench.algorithm2(bench.start("hot"), steps=steps),
        "PPEC, cool start": lambda: bench.algorithm2(bench.start("cool"), steps=steps),
        "ours": lambda: bench.lbfgs(bench.start("hot"), steps=steps),
    }
    return (_timed_row(bench, name, solvers[name], setting) for name in names)


def _slices(bench: Bench, steps: int) -> Row:
    """Row of the thesis's method: one hologram for the slice of the picture at each depth, shown in turn."""
    started, mask, normalised = time.perf_counter(), bench.experiment.mask, bench.experiment.normalised
    assert mask is not None
    phases, formed = [], torch.zeros((), dtype=torch.float64)
    for i, distance in enumerate(bench.distances):
        part = normalised * mask[0, i]
        single = replace(bench, distances=(distance,), pictures=part)
        phases.append(single.algorithm2(single.start("cool", seed=i), steps=steps).x)
        formed = formed + bench.formed(phases[-1]) * part.mean((-2, -1), keepdim=True)
    scores = bench.scores(phases[0], formed * (normalised.mean() / formed.mean()))
    return _row(bench, f"stack of {len(phases)} slices", scores, time.perf_counter() - started)


def _timed_row(bench: Bench, method: str, solve: Callable[[], Solution], setting: str = "") -> Row:
    """Row of the heater phases that ``solve`` returns, with the seconds that it takes."""
    solution, seconds = timed(solve)
    return _row(bench, method, bench.scores(solution.x), seconds, setting)


def _row(
    bench: Bench, method: str, scores: dict[str, float], seconds: float = 0.0, setting: str = "", count: int | str = ""
) -> Row:
    keys = ("ssim", "ssim_sd", "psnr", "error", "efficiency", "peak_rad", "power_rad")
    return {
        "kind": bench.kind,
        "sigma_px": bench.sigma_px,
        "setting": setting,
        "method": method,
        **{key: round(scores[key], 4) if key in scores else "" for key in keys},
        "peak_degC_at_630nm": round(scores["peak_rad"] * 175 / PI) if "peak_rad" in scores else "",
        "seconds": round(seconds, 3),
        "seconds_spread": "",  # longest over shortest, of a study that measures several times
        "count": count,
    }
