"""Handling of Ctrl-C, SIGTERM and SIGHUP: they end the computation of a run, but not the saving of its results."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Pressed(list[int]):
    """Numbers of the signals that have been received.

    Attributes:
        settled: The results are on the disk, so signals are ignored.
    """

    settled = False


_current: Pressed | None = None  # the list of the outermost open block of the main thread


@contextmanager
def interruptible() -> Iterator[Pressed]:
    """Treat SIGTERM and SIGHUP (a closed terminal) like Ctrl-C within this block, and record the signals in a list.

    Only the first signal raises KeyboardInterrupt, so that a second one does not interrupt saving. No signal raises it
    once the list is ``settled``. A nested block shares the list of the outer one, and raises KeyboardInterrupt at its
    start if a signal has been received before.
    """
    global _current
    if threading.current_thread() is not threading.main_thread():  # signals reach the main thread only
        yield Pressed()
        return
    outer, pressed = _current, Pressed() if _current is None else _current
    pressed.settled = False
    if pressed:
        raise KeyboardInterrupt

    def note(number: int, _: Any) -> None:
        pressed.append(number)
        if len(pressed) == 1 and not pressed.settled:
            raise KeyboardInterrupt

    _current = pressed
    try:
        with handling(note):
            yield pressed
    finally:
        _current = outer


@contextmanager
def deferred(pressed: list[int]) -> Iterator[None]:
    """Record signals within this block without raising KeyboardInterrupt."""
    with handling(lambda number, _: pressed.append(number)):
        yield


@contextmanager
def handling(handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Call ``handler`` for each signal within this block, with its number as first argument."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    hangup = getattr(signal, "SIGHUP", None)  # does not exist on Windows
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:  # nohup ignores it, so the run continues
        numbers.append(hangup)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)
