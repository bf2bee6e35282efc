"""One run: a folder that is complete, or one that says it was interrupted; never half a file."""

import re
import resource
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from tqdm import tqdm

from holotorch.correction import Solution
from holotorch.experiments import pictures
from holotorch.experiments.config import PECSettings
from holotorch.experiments.environment import environment
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.judge import Result, judge, quality
from holotorch.experiments.pec import PECExperiment, build
from holotorch.experiments.plan import plan, plan_text, shortage
from holotorch.experiments.report import write_report
from holotorch.io.files import save_array, write_bytes, write_json, write_text
from holotorch.io.images import encode_png

_CHECK_EVERY = 10  # steps between two measurements of quality, which cost about as much as a step
_CAPTIONS = {"none": "No correction", "basic_ipec": "Basic iterative correction", "corrected": "Corrected"}


def run(settings: PECSettings, out: Path | None, name: str = "run") -> tuple[Path, bool]:
    """Carry a run out and fill a folder: ``out``, or the next free ``runs/NAME-001``.

    Returns:
        The folder, and whether the run is complete; if it was interrupted, what it had found is in the folder.

    Raises:
        ConfigError: The folder holds files already or cannot be written, the picture cannot be used, the run does not
            fit into memory, or the solver cannot start.
    """
    experiment = build(settings)
    values = plan(experiment)
    print(plan_text(experiment, values), flush=True)
    if text := shortage(values):
        raise ConfigError([text])
    folder = claim(out, name)
    try:
        return folder, _fill(folder, experiment, values)
    except KeyboardInterrupt:
        raise
    except BaseException:
        shutil.rmtree(folder)  # claimed empty a moment ago: only this run's own files are in it
        raise


def claim(out: Path | None, name: str) -> Path:
    """Make the folder of a run so that no other run can have it too. ConfigError where that is not possible."""
    if out is None:
        parent = Path("runs")
        pattern = re.compile(re.escape(name) + r"-(\d+)")
        try:
            parent.mkdir(exist_ok=True)
            while True:
                matches = [pattern.fullmatch(path.name) for path in parent.iterdir()]
                folder = parent / f"{name}-{max((int(match[1]) for match in matches if match), default=0) + 1:03d}"
                try:
                    folder.mkdir()
                    return folder
                except FileExistsError:
                    continue  # another run was faster
        except OSError as error:
            raise ConfigError([f"cannot write to {parent}: {error.strerror}; choose a place with --out"]) from None
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise ConfigError([f"{out} holds files already; choose another --out or delete it"])
        (out / "images").mkdir()  # the claim: of two runs only one can make it
    except FileExistsError:
        raise ConfigError([f"{out} is a file, or in use by another run; choose another --out"]) from None
    except OSError as error:
        raise ConfigError([f"cannot write to {out}: {error.strerror}; choose another place with --out"]) from None
    return out


def peak_memory() -> int:
    """Largest resident size of this process so far, in bytes."""
    status = Path("/proc/self/status")
    # On Linux getrusage also counts the program that started this one.
    if status.is_file() and (match := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        return int(match[1]) * 1024
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _fill(out: Path, experiment: PECExperiment, values: dict[str, Any]) -> bool:
    settings = experiment.settings
    for part in ("arrays", "images"):
        (out / part).mkdir(exist_ok=True)
    write_text(out / "config.yaml", yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
    write_json(out / "env.json", environment(settings.seed, experiment.device))
    write_json(out / "plan.json", values)

    log = _Log(experiment)
    started = time.perf_counter()
    with _interruptible() as pressed:
        try:
            solution = experiment.solve(log)
        except KeyboardInterrupt:
            solution = log.last
        finally:
            log.close()
        if solution is None:
            raise KeyboardInterrupt
        seconds = time.perf_counter() - started - log.seconds_spent
        with _deferred(pressed):  # from here on Ctrl-C is remembered; what was found is saved first
            results = {"corrected": _result(experiment, solution, seconds)}
            save_array(out / "arrays" / "phase.npy", results["corrected"].phase.float()[None])  # one frame
        for name in settings.report.baselines:
            try:
                if not pressed:
                    started = time.perf_counter()
                    found = experiment.baseline(name)
                    results[name] = _result(experiment, found, time.perf_counter() - started)
            except KeyboardInterrupt:
                pressed.append(signal.SIGINT)
        with _deferred(pressed):
            _write_results(out, experiment, results, log, solution)
            summary = {
                "experiment": settings.experiment,
                "status": "interrupted" if pressed else "complete",
                "methods": {name: result.numbers for name, result in results.items()},
                "peak_memory_bytes": peak_memory(),
            }
            write_json(out / ("interrupted.json" if pressed else "summary.json"), summary)
            write_report([out], out / "report.html")
    if pressed:
        steps = int(solution.steps.max())
        print(f"interrupted; saved what {steps} steps have found", file=sys.stderr)
    return not pressed


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Let SIGTERM act as Ctrl-C, and note in the list that either has come."""
    pressed: list[int] = []

    def note(number: int, _: Any) -> None:
        pressed.append(number)
        raise KeyboardInterrupt

    with _handling(note):
        yield pressed


@contextmanager
def _deferred(pressed: list[int]) -> Iterator[None]:
    """Only note that Ctrl-C or SIGTERM has come."""
    with _handling(lambda number, _: pressed.append(number)):
        yield


@contextmanager
def _handling(handler) -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        before = [signal.signal(number, handler) for number in numbers]
    except ValueError:  # signals reach the main thread only
        yield
        return
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)


class _Log:
    """Callback of the solver: progress bar, rows of metrics.csv, and the last state for an interrupted run."""

    def __init__(self, experiment: PECExperiment):
        self.experiment, self.last = experiment, None
        self.rows: list[list[str]] = []
        self.checked: list[tuple[int, float]] = []
        self.seconds_spent = 0.0
        self.started = time.perf_counter()
        self.bar = tqdm(total=experiment.settings.solver.max_steps, desc="correcting", unit="step", dynamic_ncols=True)

    @property
    def metric(self) -> str:
        """Name of what is measured on the way."""
        return self.experiment.settings.report.metrics[0]

    def __call__(self, solution: Solution) -> None:
        entered = time.perf_counter()
        self.last = solution
        step = len(solution.losses) - 1
        shown, score = {}, ""
        if step % _CHECK_EVERY == 0:
            self.checked.append((step, quality(self.experiment, solution.x)))
            score = f"{self.checked[-1][1]:.6f}"
        losses = solution.losses[-1].tolist()
        elapsed = entered - self.started - self.seconds_spent
        self.rows.append([str(step), str(solution.evaluations), f"{elapsed:.4f}", score, *map(repr, losses)])
        relative = (solution.losses[-1] / solution.losses[0].clamp(min=1e-30)).mean().item()
        shown |= {"loss": f"{relative:.2e}", "mem": f"{peak_memory() / 1e9:.2f}GB"}
        if self.checked:
            shown[self.metric] = f"{self.checked[-1][1]:.4f}"
        self.bar.set_postfix(shown, refresh=False)
        self.bar.update()
        self.seconds_spent += time.perf_counter() - entered

    def close(self) -> None:
        self.bar.close()

    def table(self) -> str:
        colours = [f"loss_{wave * 1e9:.0f}nm" for wave in self.experiment.wavelengths]
        header = ["step", "evaluations", "seconds", f"{self.metric}_mean", *colours]
        return "\n".join(",".join(row) for row in [header, *self.rows]) + "\n"


def _result(experiment: PECExperiment, solution: Solution, seconds: float) -> Result:
    result = judge(experiment, solution.x)
    result.numbers.update(
        evaluations=solution.evaluations,
        steps=solution.steps.tolist(),
        converged=solution.converged.tolist(),
        stalled=solution.stalled.tolist(),
        seconds=round(seconds, 4),
    )
    return result


def _write_results(
    out: Path, experiment: PECExperiment, results: dict[str, Result], log: _Log, solution: Solution
) -> None:
    corrected = results["corrected"]
    write_text(out / "metrics.csv", log.table())
    save_array(out / "arrays" / "intensity.npy", corrected.picture)
    save_array(out / "arrays" / "target.npy", experiment.image)
    shown = {"target": experiment.image} | {name: results[name].picture for name in _CAPTIONS if name in results}
    captions = ["Target", *(_CAPTIONS[name] + _score(results[name].numbers) for name in shown if name in results)]
    if corrected.isolated is not None and not experiment.isolated:
        shown["isolated"] = corrected.isolated
        captions.append("Corrected, on a chip that stands alone" + _score(corrected.numbers["isolated"]))
    for name, picture in shown.items():
        write_bytes(out / "images" / f"{name}.png", encode_png(picture))
    names = [f"{wave * 1e9:.0f} nm" for wave in experiment.wavelengths]
    phase = corrected.phase[experiment.lit].to(experiment.device)
    warm = experiment.array.temperature(experiment.array.crosstalk(phase)).cpu()
    figures = {
        "comparison": pictures.comparison(list(shown.values()), captions),
        "phase": pictures.channel_maps(phase.cpu(), names, "heater phase (rad)", "viridis"),
        "temperature": pictures.channel_maps(warm, names, "temperature rise (degC)", "inferno", (0, None)),
        "convergence": pictures.convergence(solution.losses, names, log.checked, log.metric),
    }
    for name, data in figures.items():
        write_bytes(out / "images" / f"{name}.png", data)


def _score(numbers: dict[str, Any]) -> str:
    return f", SSIM {numbers['ssim_mean']:.3f}" if "ssim_mean" in numbers else ""
