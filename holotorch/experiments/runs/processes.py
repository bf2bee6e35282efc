"""Sharing of a run between several processes that ``torchrun`` has started."""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from holotorch.core.complex import intensity

Value = TypeVar("Value")


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


def from_first(value: Value) -> Value:
    """The value of the first process, returned by all processes. ConnectionError if a process has ended."""
    values = [value]
    if process_count()[1] > 1:
        with _connected():
            torch.distributed.broadcast_object_list(values, 0)
    return values[0]


def collected(value: Value) -> list[Value]:
    """The values of all processes, in the first one; an empty list in the others. ConnectionError if one has ended."""
    rank, count = process_count()
    if count == 1:
        return [value]
    values: list[Any] = [None] * count
    with _connected():
        torch.distributed.gather_object(value, values if rank == 0 else None)
    return values if rank == 0 else []


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


def share(frames: int, colours: int, rank: int, count: int) -> tuple[range, range]:
    """Frames and colours that a process computes. An idle process has no frames.

    The frames are divided into groups, and the colours into others, so that the largest share is as small as possible.
    """
    groups = [(first, min(count // first, colours)) for first in range(1, min(frames, count) + 1)]
    over_frames, over_colours = min(groups, key=lambda pair: math.ceil(frames / pair[0]) * math.ceil(colours / pair[1]))
    if rank >= over_frames * over_colours:
        return range(0), range(1)
    one, other = divmod(rank, over_colours)
    return _block(frames, one, over_frames), _block(colours, other, over_colours)


def _block(size: int, index: int, count: int) -> range:
    return range(index * size // count, (index + 1) * size // count)


class SharedIntensity(nn.Module):
    """Intensities real [..., C, *image] of fields [..., C, H, W]; each process computes some frames and colours.

    This replaces the propagator of a ``PECProblem`` whose solver runs in every process. All processes receive the
    intensities of all, and the gradient with respect to the whole field. Nothing is summed in another order than in one
    process; only transforms of fewer fields at a time may round differently.

    Args:
        make: Function that makes the propagator of some colours, given by their indices.
        colours: Number of colours C.
        frames: Number of frames; the product of the axes in front of C.

    Raises ConnectionError in a call if a process has ended, or if the fields of the processes differ, as they may on
    processors of different types.
    """

    divides_frames = True

    def __init__(self, make: Callable[[Sequence[int]], nn.Module], colours: int, frames: int):
        super().__init__()
        self.frames, self.colours = share(frames, colours, *process_count())
        self.propagator = make(self.colours)
        self.image_axes: int = getattr(self.propagator, "image_axes", 2)

    def forward(self, field: Tensor) -> Tensor:
        """Intensities of ``field``, which must be the same in all processes."""
        mean = field.detach().real.mean().double()
        extremes = torch.stack([mean, -mean])
        with _connected():
            torch.distributed.all_reduce(extremes, torch.distributed.ReduceOp.MAX)
        if extremes.sum() > 0:
            raise ConnectionError("the fields of the processes differ; start the run on processors of one type")
        return _Shared.apply(field, self)

    def local(self, values: Tensor) -> Tensor:
        """The part [f, c, ...] of values [F, C, ...] that this process computes."""
        return values[self.frames.start : self.frames.stop, self.colours.start : self.colours.stop]


class _Shared(torch.autograd.Function):
    """The calculation of :class:`SharedIntensity`, with a gradient that the processes compute in the same parts."""

    @staticmethod
    def forward(ctx: Any, field: Tensor, shared: SharedIntensity) -> Tensor:
        with torch.enable_grad():
            part = shared.local(field.reshape(-1, *field.shape[-3:])).detach().requires_grad_(ctx.needs_input_grad[0])
            image = intensity(shared.propagator(part))
        ctx.shared, ctx.part, ctx.image, ctx.shape = shared, part, image, field.shape
        whole = image.new_zeros(math.prod(field.shape[:-3]), field.shape[-3], *image.shape[2:])
        shared.local(whole).copy_(image.detach())
        return added(whole).reshape(*field.shape[:-2], *image.shape[2:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        shared, image = ctx.shared, ctx.image
        part = shared.local(gradient.reshape(-1, ctx.shape[-3], *image.shape[2:]))
        whole = ctx.part.new_zeros(math.prod(ctx.shape[:-3]), *ctx.shape[-3:])
        shared.local(whole).copy_(torch.autograd.grad(image, ctx.part, part)[0])
        return added(whole).reshape(ctx.shape), None
