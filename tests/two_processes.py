"""Two processes on this machine that share one job, for tests of distributed training."""

import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from apart import start_apart


def run_in_two_processes(job: Callable[[int], Any], path: Path) -> Any:
    """The result of ``job(rank)`` in the first of two processes that are joined by gloo.

    Args:
        job: A function of a module, since the processes import it.
        path: Folder for the file by which the processes meet, for what they say, and for the result.
    """
    pair = [start_apart(_process, rank, job, str(path), said=path / f"said.{rank}") for rank in range(2)]
    for process in pair:
        process.join(120)
    said = "\n".join((path / f"said.{rank}").read_text() for rank in range(2))
    assert [process.exitcode for process in pair] == [0, 0], said
    return torch.load(path / "result.pt")


def _process(rank: int, job: Callable[[int], Any], path: str) -> None:
    torch.set_num_threads(1)
    # A file, because a port that was free when it was chosen may be taken when it is used.
    torch.distributed.init_process_group("gloo", init_method=f"file://{path}/meeting", rank=rank, world_size=2)
    result = job(rank)
    if rank == 0:
        torch.save(result, f"{path}/result.pt")
    gc.collect()
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
    sys.stdout.flush()
    sys.stderr.flush()
    # Without the interpreter's own end: it may reach the threads of gloo and of the compiler while they
    # still run, which aborts the process ("terminate called without an active exception").
    os._exit(0)
