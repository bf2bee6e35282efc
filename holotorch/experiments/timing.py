"""Timing of one call, or of several calls in alternation, so that the load of the machine affects all calls equally."""

import statistics
import time
from collections.abc import Callable
from typing import Any, TypeVar

import torch

Result = TypeVar("Result")


def timed(call: Callable[[], Result]) -> tuple[Result, float]:
    """The result of a call and its duration in seconds, including work that a GPU finishes after the call returns."""
    _synchronize()
    started = time.perf_counter()
    result = call()
    _synchronize()
    return result, time.perf_counter() - started


def interleaved(calls: dict[str, Callable[[], Any]], rounds: int = 5) -> dict[str, float]:
    """Median seconds of each call over ``rounds`` of one call each, after one round of warming up."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            times[name].append(timed(call)[1])
    return {name: statistics.median(seconds[1:]) for name, seconds in times.items()}


def _synchronize() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
