"""Pictures for the page: the tracked frames without distortion, and the panel, any video source that OpenCV opens."""

import itertools
import threading
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import Any, Literal

import torch
from torch import Tensor

from holotorch.io.video import Frame, encode_jpeg, open_frames
from holotorch.tracking.streaming.packet import now

# Sources of a panel beside files and cameras: a test pattern, and the tracked frames with their poses.
PATTERN: Literal["pattern"] = "pattern"
OVERLAY: Literal["overlay"] = "overlay"
_BAR = 64  # width in pixels of the bar that moves through the test pattern


class Channel(IntEnum):
    """What a picture shows; the first byte of its message."""

    CAMERA = 0  # the tracked frame, without distortion
    PANEL = 1


class Encoder:
    """Encodes the newest picture as JPEG, in a thread of its own; pictures that arrive in the meantime replace it.

    Args:
        deliver: Called in that thread with the JPEG of each encoded picture and what :meth:`put` was given with it.
        prepare: Applied to the picture first.
    """

    def __init__(self, deliver: Callable[[bytes, Any], None], prepare: Callable[[Tensor], Tensor] | None = None):
        self._deliver, self._prepare = deliver, prepare
        self._newest: tuple[Tensor, Any] | None = None
        self._wake, self._over = threading.Event(), False
        self._thread = threading.Thread(target=self._work, daemon=True, name="pictures for the page")
        self._thread.start()

    def put(self, picture: Tensor, known: Any) -> None:
        """Offer a picture, uint8 [3, H, W], and what is known of it, such as its time of capture; never waits."""
        self._newest = picture, known
        self._wake.set()

    def close(self) -> None:
        """End the thread after the picture that it works on."""
        self._over = True
        self._wake.set()
        self._thread.join(5.0)

    def _work(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            if self._over:
                return
            item, self._newest = self._newest, None
            if item is not None:
                picture, known = item
                self._deliver(encode_jpeg(self._prepare(picture) if self._prepare else picture), known)


class PanelSource:
    """Plays a video source at its frame rate, a file repeatedly, and passes on each picture with its capture time.

    Args:
        source: A video, a folder of pictures, the number of a camera, or ``PATTERN``, a bar that moves through 1920 x
            1080 pixels at 30 frames per second.

    Raises:
        ValueError: There is no such source, or it cannot be read.
    """

    def __init__(self, source: str):
        self._source, self._over = source, threading.Event()
        self._first = None if source == PATTERN else open_frames(source)  # so that mistakes are found at once
        self._thread: threading.Thread | None = None

    def start(self, put: Callable[[Tensor, float], None]) -> None:
        """Begin to call ``put``, in a thread, with each picture, uint8 [3, H, W], and its time by ``packet.now``."""
        self._put = put
        self._thread = threading.Thread(target=self._play, daemon=True, name="panel of the page")
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(5.0)

    def _play(self) -> None:
        for turn in itertools.count():
            if self._first is None:
                if not self._paced(_pattern()):
                    return
                continue
            frames = self._first if turn == 0 else open_frames(self._source)
            with frames:
                if not self._paced(iter(frames), frames.live) or frames.live:
                    return

    def _paced(self, frames: Iterator[Frame], live: bool = False) -> bool:
        """Hand on all frames when they are due; returns whether to go on."""
        start = None
        for frame in frames:
            start = now() - frame.seconds if start is None else start
            if not live and self._over.wait(max(0.0, start + frame.seconds - now())):
                return False
            if self._over.is_set():
                return False
            if frame.pixels is not None:
                self._put(frame.pixels, now() if live else start + frame.seconds)
        return not self._over.is_set()


def _pattern() -> Iterator[Frame]:
    """Frames of the test pattern: grey steps, and a white bar that crosses them in four seconds."""
    steps = (torch.arange(1920) // 120 * 15 + 15).to(torch.uint8).expand(3, 1080, 1920)
    for number in range(120):
        picture, left = steps.clone(), number * (1920 - _BAR) // 119
        picture[:, :, left : left + _BAR] = 255
        yield Frame(number / 30, picture)
