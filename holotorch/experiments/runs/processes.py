"""Several processes, started by ``torchrun``, that share one run."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def joined_processes(parallel: bool = True) -> Iterator[int]:
    """Join the processes that ``torchrun`` has started, within this block; yields the number of this one.

    Where they do not share a run (``parallel`` False), each is the first.
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
    """Number of this process and of all that share the run."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def from_first(value: Tensor) -> Tensor:
    """The first process's value, in all."""
    torch.distributed.broadcast(value, 0)
    return value
