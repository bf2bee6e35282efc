"""Handling of Ctrl-C, SIGTERM and SIGHUP, which end the computation of a run but not the saving of its results."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Signals(list[int]):
    """Numbers of the signals received. Once all results are on the disk (``settled``), signals are only recorded."""

    settled = False


_current: Signals | None = None  # the list of the outermost open block of the main thread


@contextmanager
def interruptible() -> Iterator[Signals]:
    """Treat SIGTERM and SIGHUP (a closed terminal) like Ctrl-C within this block, and record the signals in a list.

    Only the first signal raises KeyboardInterrupt, and only before the list is ``settled``; a second signal does not
    interrupt saving. A nested block shares the list of the outer block, and raises KeyboardInterrupt at its start if a
    signal has been received before.
    """
    global _current
    if threading.current_thread() is not threading.main_thread():  # signals reach the main thread only
        yield Signals()
        return
    outer, signals = _current, Signals() if _current is None else _current
    signals.settled = False
    if signals:
        raise KeyboardInterrupt

    def note(number: int, _: Any) -> None:
        signals.append(number)
        if len(signals) == 1 and not signals.settled:
            raise KeyboardInterrupt

    _current = signals
    try:
        with handling(note):
            yield signals
    finally:
        _current = outer


@contextmanager
def deferred(signals: list[int]) -> Iterator[None]:
    """Record signals within this block without raising KeyboardInterrupt."""
    with handling(lambda number, _: signals.append(number)):
        yield


@contextmanager
def delayed() -> Iterator[None]:
    """Signals within this block take effect at its end, as while torch writes a file: an exception would abort it."""
    signals: list[int] = []
    with deferred(signals):
        yield
    if signals:
        signal.raise_signal(signals[0])


@contextmanager
def handling(handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Call ``handler`` for each signal within this block, with the number of the signal and the stack frame."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    hangup = getattr(signal, "SIGHUP", None)  # does not exist on Windows
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:  # under nohup, SIGHUP stays ignored
        numbers.append(hangup)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)
