"""A picture of the page with a pose of a run, taken by a Chromium of this computer."""

import asyncio
import base64
import itertools
import tempfile
from pathlib import Path

from torch import Tensor

from holotorch.experiments.streaming.chromium import CHROMIUM, BrowserError, browser
from holotorch.experiments.streaming.opening import open_page
from holotorch.experiments.streaming.stream import read_poses, recording_of
from holotorch.io.files import write_bytes
from holotorch.io.recording import open_recording
from holotorch.tracking.pose.status import Pose
from holotorch.tracking.streaming.packet import now

_SIZE = 960, 640  # pixels
_LONGEST = 30.0  # seconds


def screenshot(run: Path, out: Path) -> str:
    """Write a PNG of the page with the surest pose of a run of ``holotorch track``.

    The frame lies behind it if the run has rendered or recorded its frames. Returns why there is no picture: no
    Chromium on the path, no pose in the run, or a failure of the browser; otherwise an empty text.
    """
    answered = [(i, pose) for i, (_, pose) in enumerate(read_poses(run / "poses.csv")) if pose.answered]
    if CHROMIUM is None or not answered:
        return "no pose in the run" if CHROMIUM else "no chromium, chromium-browser or google-chrome on the path"
    number, surest = min(answered, key=lambda item: float(item[1].tip_sd))
    try:
        picture = asyncio.run(asyncio.wait_for(_taken(run, surest, _frame(run, number)), _LONGEST))
    except (BrowserError, OSError, TimeoutError) as error:
        return f"the browser failed: {error}"
    write_bytes(out, picture)
    return ""


def _frame(run: Path, number: int) -> Tensor | None:
    """Pixels of a frame of the run's recording; None without one."""
    folder = recording_of(run)
    if folder is None:
        return None
    with open_recording(folder) as frames:
        return next(itertools.islice(frames, number, None)).pixels


async def _taken(run: Path, pose: Pose, frame: Tensor | None) -> bytes:
    page = open_page(str(run / "poses.csv"))
    page.port = 0  # any that is free
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        async with page as server, browser(Path(folder), _SIZE) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.setup !== null && view.state.offset !== null")
            ready = "view.state.drawn && view.state.alpha === 1"
            if frame is not None:
                ready += " && view.pictures.pictures.camera"
            while not await tab.value(ready):
                server.send(pose, now())
                if frame is not None:
                    server.see(frame, pose, now())
                await asyncio.sleep(0.1)
            for _ in range(4):  # the text of the page is updated ten times a second
                server.send(pose, now())
                await asyncio.sleep(0.05)
            taken = await tab.call("Page.captureScreenshot")
    return base64.b64decode(taken["data"])
