"""One run of a sweep, in any process."""

import contextlib
import os
import traceback
from pathlib import Path
from typing import NamedTuple

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.signals import interruptible

STOP = ".stop"  # a file in the folder of the sweep: runs that have not begun do not begin
COMPLETE, INTERRUPTED, FAILED = "complete", "interrupted", "failed"


class Outcome(NamedTuple):
    """Result of a run."""

    name: str
    status: str  # "complete", "interrupted" or "failed"
    problem: str = ""


def carry_out(config: str, overrides: tuple[str, ...], folder: Path, threads: int | None) -> Outcome:
    """Carry out a run in ``folder``, or go on with it; what it prints goes to a log beside the folder. Never raises."""
    if (folder.parent / STOP).exists():
        return Outcome(folder.name, INTERRUPTED)
    with contextlib.ExitStack() as stack:
        log = stack.enter_context(open(folder.with_name(f"{folder.name}.log"), "a", encoding="utf-8"))
        stack.enter_context(contextlib.redirect_stdout(log))
        stack.enter_context(contextlib.redirect_stderr(log))
        try:
            stack.enter_context(interruptible())
            if threads is not None:
                import torch

                torch.set_num_threads(threads)
            else:
                from holotorch.experiments.planning.threads import undisturbed

                stack.enter_context(undisturbed(resumed=folder))
            from holotorch.experiments.execute import execute
            from holotorch.experiments.registry import load_config

            done = execute(load_config(config, list(overrides)), folder, Path(config).stem)[1]
            return Outcome(folder.name, COMPLETE if done else INTERRUPTED)
        except KeyboardInterrupt:
            return Outcome(folder.name, INTERRUPTED)
        except ConfigError as error:
            return Outcome(folder.name, FAILED, str(error))
        except Exception as error:
            traceback.print_exc(file=log)
            return Outcome(folder.name, FAILED, f"{type(error).__name__}: {error}")


def threads_of_each(jobs: int) -> int:
    """Threads of torch for each of ``jobs`` processes on this computer."""
    return max(1, (os.cpu_count() or 1) // jobs)
