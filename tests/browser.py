"""A headless Chromium that a test drives through the DevTools protocol, with aiohttp alone."""

import asyncio
import itertools
import shutil
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# WebGL without a graphics card; a sandbox does not start inside most containers.
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--mute-audio",
         "--no-first-run", "--disable-dev-shm-usage", "--remote-debugging-port=0")  # fmt: skip


class Tab:
    """One page of the browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse):
        self._socket, self._numbers = socket, itertools.count(1)

    async def call(self, method: str, **values: Any) -> dict:
        number = next(self._numbers)
        await self._socket.send_json({"id": number, "method": method, "params": values})
        while (answer := await self._socket.receive_json()).get("id") != number:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    async def value(self, expression: str) -> Any:
        """Value of a JavaScript expression, which may be a promise."""
        found = await self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    async def until(self, expression: str, seconds: float = 20.0) -> Any:
        """Wait until the expression is true."""
        end = asyncio.get_running_loop().time() + seconds
        while not (found := await self.value(expression)):
            assert asyncio.get_running_loop().time() < end, f"never true: {expression}"
            await asyncio.sleep(0.02)
        return found


@asynccontextmanager
async def browser(folder: Path, size: tuple[int, int] = (800, 600)):
    """Yield a function that opens an address in a new tab; ``before`` is JavaScript that runs ahead of the page."""
    assert CHROMIUM is not None
    flags = (*FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={folder / 'profile'}")
    nothing = asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(CHROMIUM, *flags, "about:blank", stdout=nothing, stderr=nothing)
    try:
        told = folder / "profile" / "DevToolsActivePort"
        for _ in range(1500):
            if told.exists() and len(told.read_text().split()) > 1:
                break
            await asyncio.sleep(0.02)
        port = int(told.read_text().split()[0])
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
                await tab.until("Boolean(window.view)")
                return tab

            yield open_tab
    finally:
        process.kill()
        await process.wait()
