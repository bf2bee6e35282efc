"""Sharing of a run between several processes that ``torchrun`` has started."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def joined_processes(parallel: bool = True) -> Iterator[int]:
    """Context manager that connects the processes and yields the rank of this process.

    With ``parallel`` False, the processes do not share a run, and each has rank 0.
    """
    if not parallel or int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield 0
        return
    torch.distributed.init_process_group("gloo")
    try:
        yield torch.distributed.get_rank()
    finally:
        torch.distributed.destroy_process_group()


def process_count() -> tuple[int, int]:
    """Rank of this process, and number of processes that share the run."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1
