"""Sharing of a run between several processes that ``torchrun`` has started."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


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


def from_first(counts: list[int]) -> list[int]:
    """The numbers of the first process, returned by all processes. ConnectionError if a process has ended."""
    values = torch.tensor(counts)
    if process_count()[1] > 1:
        with _connected():
            torch.distributed.broadcast(values, 0)
    return values.tolist()


def added(part: Tensor) -> Tensor:
    """Sum of the tensors of all processes, written to ``part`` in each. ConnectionError if a process has ended."""
    if process_count()[1] > 1:
        with _connected():
            torch.distributed.all_reduce(part)
    return part


@contextmanager
def _connected() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:  # raised by torch if the connection is lost
        raise ConnectionError("another process of this run has ended") from error
