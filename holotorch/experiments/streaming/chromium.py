"""A headless Chromium, driven through its DevTools protocol by aiohttp: for screenshots, and tests of pages."""

import asyncio
import itertools
import os
import shutil
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import aiohttp

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# WebGL without a graphics card.
_FLAGS = ("--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--mute-audio", "--no-first-run",
          "--disable-dev-shm-usage", "--remote-debugging-port=0")  # fmt: skip
_LONGEST = 30.0  # seconds until the browser has started


class BrowserError(RuntimeError):
    """The browser refused a command, a script failed, or nothing happened in time."""


class Tab:
    """One page of the browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse):
        self._socket, self._numbers = socket, itertools.count(1)

    async def call(self, method: str, **values: Any) -> dict[str, Any]:
        """Result of a method of the DevTools protocol. BrowserError if the browser refuses it."""
        number = next(self._numbers)
        await self._socket.send_json({"id": number, "method": method, "params": values})
        while (answer := await self._socket.receive_json()).get("id") != number:
            pass
        if "error" in answer:
            raise BrowserError(f"{method}: {answer['error']}")
        return answer["result"]

    async def value(self, expression: str) -> Any:
        """Value of a JavaScript expression, which may be a promise. BrowserError if it throws."""
        answer = await self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise BrowserError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    async def until(self, expression: str, seconds: float = 20.0) -> Any:
        """Wait until the expression is true and return its value. BrowserError if it is not in time."""
        end = asyncio.get_running_loop().time() + seconds
        while not (value := await self.value(expression)):
            if asyncio.get_running_loop().time() > end:
                raise BrowserError(f"not true within {seconds:g} s: {expression}")
            await asyncio.sleep(0.02)
        return value


@asynccontextmanager
async def browser(folder: Path, size: tuple[int, int] = (800, 600)) -> AsyncIterator[Callable[..., Awaitable[Tab]]]:
    """Start ``CHROMIUM`` and yield a coroutine function ``open_tab(address, before)``.

    Args:
        folder: Empty folder for the profile of the browser.
        size: Width and height of the tabs in pixels.

    ``before`` is JavaScript that runs ahead of the page. BrowserError if there is no Chromium, or it does not start.
    """
    if CHROMIUM is None:
        raise BrowserError("no chromium, chromium-browser or google-chrome on the path")
    profile = folder / "profile"
    # A sandbox does not start for root, as in most containers; the pages are our own.
    root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    flags = (*_FLAGS, *root, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={profile}")
    nothing = asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(
        CHROMIUM, *flags, "about:blank", stdout=nothing, stderr=nothing, start_new_session=True
    )
    try:
        port = await _port(profile / "DevToolsActivePort")
        async with aiohttp.ClientSession() as session:

            async def open_tab(address: str, before: str = "") -> Tab:
                async with session.put(f"http://127.0.0.1:{port}/json/new?about:blank") as answer:
                    target = await answer.json()
                tab = Tab(await session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0))
                await tab.call("Page.enable")
                if before:
                    await tab.call("Page.addScriptToEvaluateOnNewDocument", source=before)
                await tab.call("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1],
                               deviceScaleFactor=1, mobile=False)  # fmt: skip
                await tab.call("Page.navigate", url=address)
                await tab.until("document.readyState !== 'loading' && Boolean(window.view)")
                return tab

            yield open_tab
    finally:
        with suppress(ProcessLookupError):  # its helpers, too, which would go on writing into the profile
            os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
        await process.wait()


async def _port(file: Path) -> int:
    """Port of the DevTools, which the browser writes to a file once it has started."""
    end = asyncio.get_running_loop().time() + _LONGEST
    while not (file.is_file() and len(file.read_text().split()) > 1):
        if asyncio.get_running_loop().time() > end:
            raise BrowserError(f"{CHROMIUM} did not start within {_LONGEST:g} s")
        await asyncio.sleep(0.02)
    return int(file.read_text().split()[0])
