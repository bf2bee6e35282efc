"""Chart of the joint correction: two volumes, three seeds, every method, scarce heat, parallax and heat that is left.

Scores of half pupils and circles are those of views that no method is given: directions of corrected edges differ by at
least 15 degrees from those of the left and right halves, and centres of corrected circles by 0.15 radii of the pupil.

Volumes are taken from the catalogue, or from the folder that ``HOLOTORCH_VOLUMES`` names; without either, phantoms
stand in for them, and the verdict says so.
"""

import os
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.joint.config import JointSettings
from holotorch.experiments.joint.evaluation import evaluate
from holotorch.experiments.joint.experiment import JointExperiment, build
from holotorch.experiments.joint.methods import Shown, baseline, show
from holotorch.experiments.joint.names import NAMES
from holotorch.experiments.joint.views.pupils import APART, TURNED_DEG
from holotorch.experiments.joint.views.sampled import STEPS_OF_ADAM
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs.figures import figure_png, mark_choice, pareto_front
from holotorch.io.bundled import find_config

VOLUMES = "HOLOTORCH_VOLUMES"  # variable that names a folder with the two volumes
FILES = {"teapot": "boston_teapot.nrrd", "bonsai": "bonsai.nrrd"}
DEFAULT_STEPS = 60  # of a configuration that does not state another number

# What each case changes in the configuration, and the methods besides the joint correction.
ALWAYS = "random", "afterwards", "unheated", "light_field"
RETRIEVED = "retrieved", "retrieved_pec"  # from the whole pupil; neither knows a limit on the phase
PARALLAX = "eye={parallax: 200, per_step: 6}"
CASES: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "8 frames": ([], (*ALWAYS, *RETRIEVED, "slabs")),
    "24 frames": (["frames=24"], ALWAYS),
    "8 frames, parallax": ([PARALLAX], ALWAYS),
    "8 frames, parallax, occlusion per pupil": ([PARALLAX, "eye.occlusion=pupil"], ALWAYS),
    "24 frames, parallax": (["frames=24", PARALLAX], ALWAYS),
    "8 frames, sigma 1.0": (["display.sigma_px=1.0"], (*ALWAYS, *RETRIEVED)),
    "8 frames, limit 2 pi": (["display.max_phase=6.2832"], ALWAYS),
}
MEMORY = "heat={frame_us: 20, time_constant_us: 10}"  # a time constant of half a frame


@dataclass(frozen=True)
class Amount:
    """Size of the measurement."""

    scenes: tuple[str, ...] = ("teapot", "bonsai")
    seeds: tuple[int, ...] = (7, 8, 9)
    cases: tuple[str, ...] = tuple(CASES)
    size: int = 128  # pixels along each side of the array
    steps: int = 100
    frames: tuple[int, ...] = (8, 24)  # of the chart of speed against accuracy
    budgets: tuple[int, ...] = (5, 10, 20, 40, DEFAULT_STEPS, 80, 160)  # steps of that chart
    bits: tuple[int, ...] = (4, 6, 8)  # of the heaters
    light: tuple[float, ...] = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3)  # weights of the light that misses the pupil
    wrong: tuple[float, ...] = (0.01, 0.05, 0.1)  # relative errors of sigma in the model
    samples: int | None = 1  # of the volume for each plane, 1 as in the thesis; None for as many as needed


FULL = Amount()
QUICK = Amount(
    scenes=("teapot",),
    seeds=(7,),
    cases=("8 frames", "8 frames, parallax"),
    size=64,
    steps=15,
    frames=(8,),
    budgets=(5, 10, 20),
    bits=(6,),
    light=(0.0, 0.03),
    wrong=(0.05,),
)


# Rows of the table, further tables by name, PNG figures by name, and lines of the verdict.
Chart = tuple[list[dict], dict[str, list[dict]], dict[str, bytes], list[str]]


def joint(quick: bool = False) -> Chart:
    """Table rows of all cases, further tables by name, PNG figures by name, and lines of text."""
    return drawn(QUICK if quick else FULL)


def drawn(amount: Amount) -> Chart:
    """Measure the cases of ``amount``; returns the same as :func:`joint`."""
    cases = {name: CASES[name] for name in amount.cases}
    rows: list[dict[str, Any]] = []
    memory: list[dict[str, Any]] = []
    synthetic = ""
    total = len(amount.scenes) * len(amount.seeds) * (len(cases) + 1)
    with tqdm(total=total, desc="joint", unit="case", dynamic_ncols=True) as bar:
        for scene in amount.scenes:
            for seed in amount.seeds:
                for case, (changes, methods) in cases.items():
                    experiment = _experiment(scene, seed, changes, amount)
                    synthetic = synthetic or experiment.scene.synthetic
                    rows += [{"scene": scene, "seed": seed, "case": case} | row for row in _case(experiment, methods)]
                    bar.update()
                memory += [{"scene": scene, "seed": seed} | row for row in _with_memory(scene, seed, amount)]
                bar.update()
    speed, device, light = list(_speed(amount)), list(_device(amount)), list(_light(amount))
    text = _verdict(rows, memory, amount)
    text[1:1] = [f"Synthetic volumes: {synthetic}"] if synthetic else []
    tables = {"memory": memory, "speed": speed, "device": device, "light": light}
    return rows, tables, {"chart": _draw(rows, speed, light, amount)}, text


def _experiment(scene: str, seed: int, changes: list[str], amount: Amount) -> JointExperiment:
    """The bundled configuration for one wavelength, without files where a folder of volumes is not given."""
    path = find_config(f"configs/joint/{scene}.yaml")
    assert path is not None
    steps = amount.steps * (STEPS_OF_ADAM if PARALLAX in changes else 1)
    words = ["wavelengths=[520 nm]", f"seed={seed}", f"steps={steps}"]
    words += [f"display.shape=[{amount.size},{amount.size}]", "eye={}", *changes]
    words += [] if amount.samples is None else [f"view.samples={amount.samples}"]
    settings = load_config(path, words + volume_file(scene))
    assert isinstance(settings, JointSettings)
    return build(settings)


def _first(amount: Amount, *changes: str) -> JointExperiment:
    """The experiment of the first scene and seed."""
    return _experiment(amount.scenes[0], amount.seeds[0], list(changes), amount)


def volume_file(scene: str) -> list[str]:
    """The setting that names the file of a scene, if a folder of volumes is given."""
    if not (folder := os.environ.get(VOLUMES)):
        return []
    file = Path(folder) / FILES[scene]
    if not file.is_file():
        raise ConfigError([f"{VOLUMES} must name a folder with {FILES[scene]}, got {folder}"])
    return [f"volume.path={file}"]


def _case(experiment: JointExperiment, methods: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """A table row for the joint correction and for each of the other methods."""
    _ = experiment.trained, experiment.stack  # the inputs of all methods
    begin = time.perf_counter()
    yield _row(experiment, "joint", show(experiment, experiment.solve().x), begin)
    for name in methods:
        begin = time.perf_counter()
        yield _row(experiment, name, baseline(experiment, name), begin)


def _row(experiment: JointExperiment, method: str, shown: Shown, begin: float) -> dict[str, Any]:
    seconds = time.perf_counter() - begin
    numbers = evaluate(experiment, shown)[0]
    return {"method": method, **{key: round(value, 4) for key, value in numbers.items()}, "seconds": round(seconds, 2)}


def _with_memory(scene: str, seed: int, amount: Amount) -> Iterator[dict[str, Any]]:
    """Heat that is left from earlier frames: corrected frame by frame, and as a cycle."""
    cold, warm = (_experiment(scene, seed, changes, amount) for changes in ([], [MEMORY]))
    begin = time.perf_counter()
    phase = cold.solve().x
    yield _row(cold, "no heat is left", show(cold, phase), begin)
    yield _row(warm, "heat is left, frames corrected independently", show(warm, phase), begin)
    begin = time.perf_counter()
    yield _row(warm, "heat is left, cycle corrected", show(warm, warm.solve().x), begin)


def _speed(amount: Amount) -> Iterator[dict[str, Any]]:
    """Accuracy by time of the solver, for the first scene and seed."""
    for frames in amount.frames:
        experiment = _first(amount, f"frames={frames}")
        _ = experiment.trained
        for steps in amount.budgets:
            budget = replace(experiment, settings=experiment.settings.model_copy(update={"steps": steps}))
            begin = time.perf_counter()
            phase = budget.solve().x
            row = _row(experiment, "joint", show(experiment, phase), begin)
            yield {"frames": frames, "steps": steps} | row
        for name in ("random", "slabs"):
            begin = time.perf_counter()
            yield {"frames": frames, "steps": ""} | _row(experiment, name, baseline(experiment, name), begin)


def _device(amount: Amount) -> Iterator[dict[str, Any]]:
    """What coarse heaters and a wrong model of the heat cost, for the first scene and seed."""
    experiment = _first(amount)
    phase = show(experiment, experiment.solve().x).phase
    assert phase is not None
    yield {"case": "as modelled"} | _row(experiment, "joint", show(experiment, phase), time.perf_counter())
    for bits in amount.bits:
        level = phase.max() / (2**bits - 1)
        rounded = (phase / level).round() * level
        yield {"case": f"{bits} bits"} | _row(experiment, "joint", show(experiment, rounded), time.perf_counter())
    for wrong in amount.wrong:
        sigma = experiment.settings.display.sigma_px * (1 + wrong)
        other = _first(amount, f"display.sigma_px={sigma}")
        yield {"case": f"sigma {wrong:.0%} larger"} | _row(other, "joint", show(other, phase), time.perf_counter())


def _light(amount: Amount) -> Iterator[dict[str, Any]]:
    """What more light in the pupil costs, for the first scene and seed."""
    for weight in amount.light:
        experiment = _first(amount, f"light_weight={weight}")
        begin = time.perf_counter()
        yield {"weight": weight} | _row(experiment, "joint", show(experiment, experiment.solve().x), begin)


def _verdict(rows: list[dict[str, Any]], memory: list[dict[str, Any]], amount: Amount) -> list[str]:
    setup = f"One colour (520 nm), {amount.size} px, {amount.steps} steps; mean (worst) of {len(amount.seeds)} seed(s)"
    apart = (
        f"half pupils and circles are given to no method: corrected edges are at least {TURNED_DEG} degrees from those "
        f"of the halves, centres of corrected circles {APART:g} radii of the pupil from theirs; Gerchberg-Saxton is "
        "left out with 24 frames, which it retrieves one by one, with parts of a pupil, and at 2 pi: it knows no limit"
    )
    lines = []
    for scene in amount.scenes:
        for case in amount.cases:
            for method in ("joint", *CASES[case][1]):
                chosen = [row for row in rows if (row["scene"], row["case"], row["method"]) == (scene, case, method)]
                words = [f"stack {_spread(chosen, 'stack_psnr')} dB, SSIM {_spread(chosen, 'stack_ssim', 4)}"]
                words.append(f"contrast {statistics.mean(row['stack_contrast'] for row in chosen):.3f}")
                if "held_psnr" in chosen[0]:
                    words.append(f"held-back foci {_spread(chosen, 'held_psnr')} dB")
                for key, name in ("half", "half pupils"), ("part", "circles within the pupil"):
                    psnr, ssim = _spread(chosen, f"{key}_psnr"), _spread(chosen, f"{key}_ssim", 3)
                    words.append(f"{name} {psnr} dB, SSIM {ssim}")
                words.append(f"light {statistics.mean(row['light_in_pupil'] for row in chosen):.1%}")
                words.append(f"{statistics.median(row['seconds'] for row in chosen):.1f} s (median)")
                lines.append(f"{scene}, {case}, {NAMES[method]}: {'; '.join(words)}")
        for method in dict.fromkeys(row["method"] for row in memory):
            chosen = [row for row in memory if (row["scene"], row["method"]) == (scene, method)]
            lines.append(f"{scene}, {method} (time constant of half a frame): stack {_spread(chosen, 'stack_psnr')} dB")
    return [lines[0], f"{setup}; PSNR of intensity; {apart}:", *lines[1:]]


def _spread(rows: list[dict[str, Any]], key: str, digits: int = 1) -> str:
    values = [row[key] for row in rows]
    return f"{statistics.mean(values):.{digits}f} ({min(values):.{digits}f})"


def _draw(
    rows: list[dict[str, Any]], speed: list[dict[str, Any]], light: list[dict[str, Any]], amount: Amount
) -> bytes:
    """Accuracy against time, and what parallax and light in the pupil cost."""
    scenes = amount.scenes
    figure = Figure(figsize=(14, 5.8), layout="constrained")
    left, right, last = figure.subplots(1, 3)
    for frames, colour in zip(amount.frames, ("#2867b2", "#c0392b"), strict=False):
        curve = [row for row in speed if row["frames"] == frames and row["method"] == "joint"]
        left.semilogx(
            [row["seconds"] for row in curve],
            [row["stack_psnr"] for row in curve],
            "o-",
            color=colour,
            label=f"joint correction, {frames} frames, {curve[0]['steps']} to {curve[-1]['steps']} steps",
        )
        for row in speed:
            if row["frames"] == frames and row["method"] != "joint":
                marker = {"random": "s", "slabs": "^"}[row["method"]]
                label = f"{NAMES[row['method']]}, {frames} frames"
                left.semilogx(max(row["seconds"], 1e-2), row["stack_psnr"], marker, color=colour, label=label)
    # The front is of the fastest and the most accurate, and a larger PSNR is more accurate.
    front = pareto_front((max(row["seconds"], 1e-2), -row["stack_psnr"]) for row in speed)
    steps = [(seconds, -negative) for seconds, negative in front]
    left.step(*zip(*steps, strict=True), where="post", color="0.6", linewidth=1, zorder=0, label="Pareto front")
    default = [(row["seconds"], row["stack_psnr"]) for row in speed if row["steps"] == DEFAULT_STEPS]
    if default:
        mark_choice(left, default, "default steps")
    left.set(xlabel="seconds", ylabel="PSNR of the focal stack (dB)", title=f"{scenes[0]}, {amount.size} px")
    shown = [case for case in amount.cases if "sigma" not in case and "limit" not in case]
    for scene, marker in zip(scenes, "os", strict=False):
        for k, case in enumerate(shown):
            chosen = [r for r in rows if (r["scene"], r["case"], r["method"]) == (scene, case, "joint")]
            x, y = (statistics.mean(row[key] for row in chosen) for key in ("stack_psnr", "half_psnr"))
            right.plot(x, y, marker, color=f"C{k}", fillstyle=_fill(case), label=f"{scene}, {case}")
    right.set(xlabel="PSNR of the focal stack (dB)", ylabel="PSNR through half pupils (dB)", title="Parallax costs")
    last.plot([row["light_in_pupil"] for row in light], [row["stack_psnr"] for row in light], "o-", color="#2867b2")
    for row in light:
        place = {"xytext": (4, 4), "textcoords": "offset points", "fontsize": 6}
        last.annotate(f"weight {row['weight']:g}", (row["light_in_pupil"], row["stack_psnr"]), **place)
    last.set(xlabel="fraction of the light in pupil and window", ylabel="PSNR of the focal stack (dB)")
    last.set(title=f"Light costs; {scenes[0]}, 8 frames")
    last.margins(x=0.16)  # for the words beside the points
    for axes in (left, right, last):
        axes.grid(alpha=0.3)
    for axes in (left, right):
        axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.15), frameon=False)
    return figure_png(figure)


def _fill(case: str) -> str:
    return "full" if "parallax" in case else "none"
