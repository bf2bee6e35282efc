"""Ctrl-C, SIGTERM and SIGHUP of a run: they end its work, and never the saving of what it has found."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Pressed(list[int]):
    """Numbers of the signals that have come.

    Attributes:
        settled: The outcome is on the disk, so that a signal no longer changes it.
    """

    settled = False


_current: Pressed | None = None  # of the outermost block that is open in the main thread


@contextmanager
def interruptible() -> Iterator[Pressed]:
    """Let SIGTERM and SIGHUP (a closed terminal) act as Ctrl-C, and note in the list which have come.

    Only the first raises KeyboardInterrupt: another would come while what was found is being saved, and end that. Once
    the list is ``settled`` none raises. A block within another one shares its list; it begins with KeyboardInterrupt
    where a signal came before it.
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
    """Only note that one of the signals has come."""
    with handling(lambda number, _: pressed.append(number)):
        yield


@contextmanager
def handling(handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Have ``handler`` called for each of the signals, with its number first."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    hangup = getattr(signal, "SIGHUP", None)  # not on Windows
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:  # under nohup a run goes on
        numbers.append(hangup)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)
