"""The engines that carry out the runs of a sweep: this process, joblib's processes, or a cluster through submitit."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.signals import handling
from holotorch.experiments.sweep.one import FAILED, INTERRUPTED, STOP, Outcome, carry_out, threads_of_each

Task = tuple[str, tuple[str, ...], Path]  # configuration, overrides, folder


def here(tasks: Sequence[Task]) -> Iterator[Outcome]:
    """One run after the other in this process; an interruption ends all of them."""
    for task in tasks:
        outcome = carry_out(*task, None)
        yield outcome
        if outcome.status == INTERRUPTED:
            return


def side_by_side(tasks: Sequence[Task], jobs: int) -> Iterator[Outcome]:
    """``jobs`` runs at a time in processes of joblib, which share the cores. A signal is passed on to all of them."""
    from concurrent.futures import as_completed

    from joblib.externals.loky import get_reusable_executor

    threads, stop = threads_of_each(jobs), tasks[0][2].parent / STOP
    stop.unlink(missing_ok=True)
    executor = get_reusable_executor(max_workers=jobs, env={"OMP_NUM_THREADS": str(threads)}, reuse=False)  # type: ignore[arg-type]

    def pass_on(number: int, _: Any) -> None:
        """Active runs save their results and end; waiting ones find the file STOP and do not begin."""
        first = not stop.exists()
        stop.touch()
        for process in list(executor._processes) if first else ():  # the terminal sends Ctrl-C to them as well
            with contextlib.suppress(OSError):
                os.kill(process, signal.SIGTERM if number != signal.SIGINT else signal.SIGINT)

    try:
        with handling(pass_on):
            futures = {executor.submit(carry_out, *task, threads): task[2].name for task in tasks}
            for future in as_completed(futures):
                try:
                    yield future.result()
                except Exception as error:  # if a process is killed, the waiting runs fail as well
                    status = INTERRUPTED if stop.exists() else FAILED
                    yield Outcome(futures[future], status, f"its process ended: {type(error).__name__}")
    finally:
        stop.unlink(missing_ok=True)
        executor.shutdown(wait=True, kill_workers=False)


def on_a_cluster(tasks: Sequence[Task], options: Sequence[str]) -> Iterator[Outcome]:
    """A Slurm job for each run, through submitit; ``options`` are its parameters, key=value, such as timeout_min=60.

    ``cluster=local`` runs the jobs on this computer instead. After an interruption, the jobs go on.
    """
    try:
        import submitit
    except ImportError:
        raise ConfigError(["--slurm needs submitit; install it with: pip install 'holotorch[cluster]'"]) from None
    parameters = {}
    for option in options:
        key, equals, value = option.partition("=")
        if not equals:
            raise ConfigError(
                [f"--slurm: expected key=value such as timeout_min=60 or slurm_partition=gpu, got {option!r}"]
            )
        parameters[key] = int(value) if value.isdigit() else value
    folder = tasks[0][2].parent / "jobs"
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=parameters.pop("cluster", None))
        executor.update_parameters(**parameters)
    except (RuntimeError, NameError, ValueError, AssertionError) as error:
        raise ConfigError([f"--slurm: {error}"]) from None
    with executor.batch():
        jobs = [executor.submit(carry_out, *task, None) for task in tasks]
    for job in submitit.helpers.as_completed(jobs, poll_frequency=1):
        try:
            yield job.result()
        except Exception as error:
            yield Outcome(
                tasks[jobs.index(job)][2].name, FAILED, f"its job ended: {type(error).__name__}: {error}"[:300]
            )


def engine(jobs: int, slurm: Sequence[str] | None) -> Callable[[Sequence[Task]], Iterator[Outcome]]:
    """The engine for the options of the command."""
    if slurm is not None:
        return partial(on_a_cluster, options=slurm)
    return here if jobs == 1 else partial(side_by_side, jobs=jobs)
