"""Server of the page of a run: pages ask for pictures, and one thread computes what each has asked for last.

A page sends JSON: ``number``, ``values`` by the names of the controls, and ``coarse`` while the user moves a control.
It gets the controls at first, and for each request that it has not replaced in the meantime a picture, or a refusal in
one line. A picture is binary: the length of a JSON header as 4 bytes, little-endian, the header, and the PNG files one
after another. The header has ``number``, ``coarse``, ``seconds``, ``numbers``, and name, caption and size of each file.
"""

import asyncio
import json
import secrets
import struct
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from aiohttp import WSMsgType, web

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.view.controls import checked
from holotorch.experiments.view.viewer import Outdated, Shown, Viewer
from holotorch.experiments.web.guard import Guard, headers
from holotorch.experiments.web.site import file_routes, listening, open_socket

_HOST = "127.0.0.1"
_FOLDER = Path(__file__).with_name("browser")
_LONGEST = 4096  # bytes of a message from a page
_PAGES = 8  # largest number of pages that are open at the same time
_PATIENCE = 10.0  # seconds that a page may take to accept a message
_HEADERS = headers(
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; base-uri 'none'"
)


class ViewServer:
    """Serves the page of a run on this computer: ``async with ViewServer(viewer) as server: ... server.address``.

    Args:
        viewer: The run.
        port: 0 for any free port, which the attribute ``port`` names once the server is open.

    Raises OSError if the port cannot be used; by ``async with``.
    """

    def __init__(self, viewer: Viewer, port: int = 0):
        self.port, self.token = port, secrets.token_urlsafe(16)
        self._viewer, self._pages, self._closing = viewer, set[_Page](), False
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="pictures")
        self._runner: web.AppRunner | None = None

    @property
    def address(self) -> str:
        """Address of the page, with its token."""
        return f"http://{_HOST}:{self.port}/?token={self.token}"

    async def __aenter__(self) -> "ViewServer":
        app = web.Application(middlewares=[Guard(local=True, token=self.token).middleware])
        app.add_routes([*file_routes(_FOLDER, _HEADERS), web.get("/pictures", self._serve)])
        self._runner, self.port = await listening(app, _HOST, self.port)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._closing = True
        for page in list(self._pages):
            await page.close()
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._runner is not None:
            await self._runner.cleanup()

    async def _serve(self, request: web.Request) -> web.WebSocketResponse:
        if len(self._pages) >= _PAGES:
            raise web.HTTPServiceUnavailable(text=f"{_PAGES} pages are open already; close one")
        socket = web.WebSocketResponse(max_msg_size=_LONGEST, heartbeat=10.0, compress=False)
        page = _Page(socket, request)
        self._pages.add(page)
        try:
            await open_socket(socket, request)
            controls = [control.described() for control in self._viewer.controls]
            setup = {"kind": "setup", "title": self._viewer.title, "note": self._viewer.note, "controls": controls}
            await socket.send_str(json.dumps(setup, allow_nan=False))
            worker = asyncio.create_task(self._work(page))
            try:
                async for message in socket:
                    page.ask(message.data if message.type is WSMsgType.TEXT else "")
            finally:
                page.gone = True
                worker.cancel()
        finally:
            self._pages.discard(page)
        return socket

    async def _work(self, page: "_Page") -> None:
        """Answer the newest request of a page, again and again."""
        loop = asyncio.get_running_loop()
        while True:
            request = await page.next()

            def proceed(request: dict[str, Any] = request) -> None:
                # Coarse pictures are always finished, as otherwise none would appear while a control moves.
                if self._closing or page.gone or (page.waiting and not request["coarse"]):
                    raise Outdated

            try:
                message = await loop.run_in_executor(self._thread, self._answer, request, proceed)
                if not await page.send(message):
                    return
            except Outdated:
                continue

    def _answer(self, request: dict[str, Any], proceed: Callable[[], None]) -> bytes | str:
        """The message for a request; in the thread of the pictures."""
        number, started = request["number"], time.perf_counter()
        try:
            proceed()
            values = checked(self._viewer.controls, request["values"])
            with torch.no_grad():
                shown = self._viewer.show(values, request["coarse"], proceed)
            return encoded(number, shown, time.perf_counter() - started)
        except Outdated:
            raise
        except (ValueError, MemoryError, ConfigError) as error:
            text = str(error).replace("\n", " ")
        except Exception:
            traceback.print_exc()
            text = "this picture could not be computed; the terminal says why"
        return json.dumps({"kind": "refused", "number": number, "text": text})


def encoded(number: int, shown: Shown, seconds: float) -> bytes:
    """The binary message of pictures."""
    files = [{"name": each.name, "caption": each.caption, "bytes": len(each.png)} for each in shown.pictures]
    header = {"number": number, "coarse": shown.coarse, "seconds": seconds, "pictures": files}
    text = json.dumps(header | {"numbers": list(shown.numbers.items())}, allow_nan=False).encode()
    return struct.pack("<I", len(text)) + text + b"".join(picture.png for picture in shown.pictures)


class _Page:
    """An open page, and its newest request that has not been taken yet."""

    def __init__(self, socket: web.WebSocketResponse, request: web.Request):
        self.gone = False
        self._socket, self._request = socket, request
        self._newest: dict[str, Any] | None = None
        self._wake = asyncio.Event()

    @property
    def waiting(self) -> bool:
        """Whether there is a request that has not been taken yet."""
        return self._newest is not None

    def ask(self, text: str) -> None:
        """Take a message of the page; one that is no request is dropped."""
        try:
            message = json.loads(text)
            if not isinstance(message["number"], int) or not isinstance(message["values"], dict):
                return
            coarse = message.get("coarse") is True
            self._newest = {"number": message["number"], "values": message["values"], "coarse": coarse}
            self._wake.set()
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            pass

    async def next(self) -> dict[str, Any]:
        """The newest request, once there is one."""
        while self._newest is None:
            self._wake.clear()
            await self._wake.wait()
        request, self._newest = self._newest, None
        return request

    async def send(self, message: bytes | str) -> bool:
        """Send a message; False if the page is gone, or takes it for too long and is cut off."""
        send = self._socket.send_str(message) if isinstance(message, str) else self._socket.send_bytes(message)
        try:
            await asyncio.wait_for(send, _PATIENCE)
        except (TimeoutError, ConnectionError, RuntimeError):
            if isinstance(self._request.transport, asyncio.WriteTransport):
                self._request.transport.abort()
            return False
        return True

    async def close(self) -> None:
        """Close the connection."""
        with suppress(TimeoutError, ConnectionError, RuntimeError):
            await asyncio.wait_for(self._socket.close(), 1.0)
