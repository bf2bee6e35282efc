"""Handling of Ctrl-C, SIGTERM and SIGHUP, which end the computation of a run but not the saving of its results."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_AGAIN = 0.01  # seconds after which a signal comes again whose exception Python has dropped


class Signals(list[int]):
    """Numbers of the signals received. Once all results are on the disk (``settled``), signals are only recorded."""

    settled = False


_current: Signals | None = None  # the list of the outermost open block of the main thread


@contextmanager
def interruptible() -> Iterator[Signals]:
    """Treat SIGTERM and SIGHUP (a closed terminal) like Ctrl-C within this block, and record the signals in a list.

    Only the first signal raises KeyboardInterrupt, and only before the list is ``settled``; a second signal does not
    interrupt saving. Where Python drops the exception, as in callbacks of weak references, the signal comes again a
    moment later. A nested block shares the list of the outer block, and raises KeyboardInterrupt at its start if a
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

    def again(dropped: "sys.UnraisableHookArgs") -> None:
        if signals and issubclass(dropped.exc_type, KeyboardInterrupt):
            threading.Timer(_AGAIN, signal.raise_signal, (signals.pop(),)).start()
        else:
            hook(dropped)

    _current, hook = signals, sys.unraisablehook
    try:
        sys.unraisablehook = again
        with handling(note):
            yield signals
    finally:
        _current, sys.unraisablehook = outer, hook


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
