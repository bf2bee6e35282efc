"""Implementation of ``holotorch sweep``."""

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.planning.duration import duration
from holotorch.experiments.registry import find_kind, load_config
from holotorch.experiments.report import outcome_lines
from holotorch.experiments.runs.fingerprint import differences, fingerprint
from holotorch.experiments.sweep.engines import engine
from holotorch.experiments.sweep.one import COMPLETE, FAILED, INTERRUPTED, Outcome
from holotorch.experiments.sweep.points import Point, points
from holotorch.experiments.sweep.results import PAGE, TABLE, finished, write_results

_LISTED = 24  # most runs whose main numbers are printed


def check_sweep(config: str, arguments: Sequence[str]) -> str:
    """The number of runs and their predicted cost in words. ConfigError with the mistakes of all runs."""
    grid = points(arguments)
    settings = _validated(config, grid)
    times, memory, shortages = [], 0.0, []
    for setting in tqdm(settings, desc="planning", unit="run", disable=None):
        kind = find_kind(setting.experiment)
        plan = kind.plan(kind.build(setting))
        times += [plan.values["predicted_seconds"]] if "predicted_seconds" in plan.values else []
        memory = max(memory, plan.values.get("predicted_peak_bytes", 0.0))
        shortages += [plan.shortage] if plan.shortage else []
    if shortages:
        raise ConfigError(list(dict.fromkeys(shortages)))
    cost = f"about {duration(max(1, sum(times)))} one after the other" if times else "the time is not predicted"
    most = f"; at most {memory / 1e9:.2g} GB of memory for each" if memory else ""
    swept = ", ".join(f"{key} ({len({point.values[key] for point in grid})})" for key in grid[0].values)
    return f"{len(grid)} runs of {config} over {swept}: {cost}{most}"


def run_sweep(
    config: str, arguments: Sequence[str], out: Path, *, jobs: int = 1, slurm: Sequence[str] | None = None
) -> int:
    """Carry out the missing runs of a sweep, write its table, picture and page, and return the exit status.

    It is 0 if all runs are complete, 1 if any failed, 130 after an interruption. ConfigError, before any run begins,
    with the mistakes of all runs, or for a folder that holds other runs.
    """
    if jobs < 1:
        raise ConfigError([f"--jobs: expected 1 or more, got {jobs}"])
    grid = points(arguments)
    settings = _validated(config, grid)
    missing = [point for point, each in zip(grid, settings, strict=True) if not _complete(out / point.name, each)]
    out.mkdir(parents=True, exist_ok=True)
    outcomes = {point.name: Outcome(point.name, COMPLETE) for point in grid if point not in missing}
    tasks = [(config, point.overrides, out / point.name) for point in missing]
    interrupted = False
    with tqdm(total=len(grid), initial=len(outcomes), desc="sweep", unit="run", dynamic_ncols=True) as bar:
        try:
            for outcome in engine(jobs, slurm)(tasks) if tasks else ():
                outcomes[outcome.name] = outcome
                bar.update(outcome.status != INTERRUPTED)
                if outcome.problem:
                    bar.write(f"{outcome.name}: {outcome.problem}", file=sys.stderr)
        except KeyboardInterrupt:
            interrupted = True
    statuses = {name: outcome.status for name, outcome in outcomes.items()}
    write_results(out, grid, statuses)
    counts = Counter(statuses.get(point.name, "missing") for point in grid)
    print(f"{len(grid)} runs: " + ", ".join(f"{count} {status}" for status, count in counts.items()))
    for line in _main_numbers(out, [point.name for point in grid if statuses.get(point.name) == COMPLETE]):
        print(line)
    print(out / (PAGE if counts[COMPLETE] else TABLE))
    if interrupted or counts[INTERRUPTED] or counts["missing"]:
        print("interrupted; the same command continues the sweep", file=sys.stderr)
        return 130
    return 1 if counts[FAILED] else 0


def _main_numbers(out: Path, names: Sequence[str]) -> list[str]:
    """A line with the main numbers of each complete run."""
    width = max(map(len, names), default=0)
    lines = [f"{name:{width}}  {next(iter(outcome_lines(out / name)), COMPLETE)}" for name in names[:_LISTED]]
    return [*lines, f"and {len(names) - _LISTED} more in {out / TABLE}"] if len(names) > _LISTED else lines


def _validated(config: str, grid: Sequence[Point]) -> list[Any]:
    """The settings of each point. ConfigError with the mistakes of all of them, each once."""
    settings, mistakes = [], []
    for point in grid:
        try:
            settings.append(load_config(config, list(point.overrides)))
        except ConfigError as error:
            mistakes += str(error).splitlines()
    if mistakes:
        raise ConfigError(list(dict.fromkeys(mistakes)))
    return settings


def _complete(folder: Path, settings: Any) -> bool:
    """Whether a folder holds the complete run of these settings; ConfigError if its run has other ones."""
    if not finished(folder):
        return False
    try:
        previous = load_config(folder / "config.yaml")
        changed = differences(fingerprint(previous, {}), fingerprint(settings, {}))
    except ConfigError as error:
        changed = [str(error)]
    if changed:
        raise ConfigError(
            [f"{folder} holds a run of another configuration: {', '.join(changed)}; choose another --out"]
        )
    return True
