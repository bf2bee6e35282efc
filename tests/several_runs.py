"""Runs that processes share, one after another, so that the processes load torch once for all of them.

``python -m torch.distributed.run ... several_runs.py FILE``: the file holds the words of the command line for each run,
and those of a last run in which the second process is killed, in JSON. The first run alone draws figures.
"""

import json
import os
import signal
import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import torch
from undrawn import without_figures

from holotorch.cli import main


def run_shared(words: list[str], meeting: Path, killed_at: int | None = None) -> int:
    """Exit status of a run that the processes share which meet at a file of their own.

    With ``killed_at``, the second process is killed when it is about to add tensors for that many times.
    """
    connect, add, sums = torch.distributed.init_process_group, torch.distributed.all_reduce, []
    place = {"rank": int(os.environ["RANK"]), "world_size": int(os.environ["WORLD_SIZE"])}

    def counted(*tensors, **more):
        sums.append(1)
        if len(sums) == killed_at and place["rank"] == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return add(*tensors, **more)

    # The store of torchrun joins processes once; each run has a store of its own.
    torch.distributed.init_process_group = partial(connect, init_method=f"file://{meeting}", **place)
    torch.distributed.all_reduce = counted
    try:
        return main(words)
    finally:
        torch.distributed.init_process_group, torch.distributed.all_reduce = connect, add


def run_until_killed(words: list[str], meeting: Path, killed_at: int) -> None:
    """A run of which the second process is killed; this process ends with its exit status."""
    sys.exit(run_shared(words, meeting, killed_at))


if __name__ == "__main__":
    file = Path(sys.argv[1])
    asked = json.loads(file.read_text())
    for number, run in enumerate(asked["runs"]):
        with without_figures() if number else nullcontext():
            print(f"status {run_shared(run, file.with_suffix(f'.{number}'))} of {run[-1]}", flush=True)
    run_until_killed(asked["last"], file.with_suffix(".last"), asked["killed_at"])
