"""The study in the browser: a server that only this machine reaches.

The page (page.html) gets the design once and sends one result per trial; the trial is on the disk before the
answer goes back. Nothing but the page is served. All but the page, which holds nothing of the study, is for those who
know the participant's token. It is in the fragment of the printed address, which browsers send to no server, and not in
a cookie, which all servers on this machine would get.

``onset_s`` is the stamp of the first frame after the one that drew the pattern, the earliest moment at which it can be
on the screen; ``response_s`` that of the key's event, on the same clock, or of the frame for a gamepad, which is asked
once per frame. What the screen and the keyboard add is theirs, much the same in every trial, and not known here.
"""

import asyncio
import hmac
import json
import logging
import socket
import traceback
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus
from importlib import resources
from typing import Any

from aiohttp import web

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.records import SessionRequest, parse_record
from holotorch.experiments.perception.study.session import StudySession

_LARGEST = 10_000  # bytes of a request's body; a result has about 200
_CONNECTIONS = 64  # at once; a browser opens six
_SECONDS = 10.0  # of a connection, in which a request is read and answered; an answer takes milliseconds
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "frame-ancestors 'none'",
}
# aiohttp logs every malformed request with a traceback; what fails in here is printed by StudyServer.
_QUIET = logging.getLogger(f"{__name__}.requests")
_QUIET.disabled = True


class _Connections(web.Server):
    """The connections: each for one request and ``_SECONDS`` at most; where there are too many, the oldest is closed.

    A request that has come in whole is answered at once, so that the oldest is one that keeps the server waiting.
    """

    def __init__(self, handler: Any):
        # handler_cancellation: aiohttp would wait 10 s for the rest of a request whose connection is gone.
        super().__init__(handler, handler_cancellation=True, auto_decompress=False, logger=_QUIET, access_log=None)
        self._ends: dict[web.RequestHandler, tuple[asyncio.Transport, asyncio.TimerHandle]] = {}

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Start the connection's time."""
        super().connection_made(handler, transport)
        if len(self._ends) >= _CONNECTIONS:
            self._end(next(iter(self._ends)))
        self._ends[handler] = transport, asyncio.get_running_loop().call_later(_SECONDS, self._end, handler)

    def connection_lost(self, handler: web.RequestHandler, exc: BaseException | None = None) -> None:
        """Forget the connection."""
        super().connection_lost(handler, exc)
        self._end(handler)

    def _end(self, handler: web.RequestHandler) -> None:
        if handler in self._ends:
            transport, timer = self._ends.pop(handler)
            timer.cancel()
            transport.abort()


class StudyServer:
    """Serves the page and the session of one participant.

    Args:
        session: Of the participant.
        token: What every request but the one for the page must bear.
        script: JavaScript to put into the page: the scripted participant of a test.

    Attributes:
        stop: Set when the study is complete, or to end the server.
        address: Where the page is, once the server is listening.
    """

    def __init__(self, session: StudySession, token: str, script: str | None = None):
        self.session, self.token = session, token
        self.stop = asyncio.Event()
        self.address = ""
        self._page = page(script)

    @asynccontextmanager
    async def listening(self, port: int = 0) -> AsyncIterator[None]:
        """Answer requests at ``port``, 0 for any free one; ConfigError where it is taken or may not be used."""
        try:
            listener = socket.create_server(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ConfigError([f"port {port}: {reason}; choose another with --port, or leave it out"]) from None
        self.address = f"http://127.0.0.1:{listener.getsockname()[1]}/"
        runner = web.ServerRunner(_Connections(self._handle), shutdown_timeout=1.0)
        await runner.setup()
        try:
            # asyncio accepts as many at a time as it lets wait, and each takes one of the process's open files.
            await web.SockSite(runner, listener, backlog=_CONNECTIONS // 4).start()
            listener.listen(16 * _CONNECTIONS)  # those beyond wait a second and more until they ask again
            yield
        finally:
            await runner.cleanup()

    async def _handle(self, request: web.BaseRequest) -> web.Response:
        try:
            response = await self._answer(request)
        except web.HTTPException as refusal:
            response = _json(refusal.status, {"error": refusal.text})
        except Exception:
            traceback.print_exc()
            response = _json(HTTPStatus.INTERNAL_SERVER_ERROR, {"error": "the recording program failed"})
        response.headers.update(_HEADERS)
        response.force_close()
        return response

    async def _answer(self, request: web.BaseRequest) -> web.Response:
        """The page, the session of a window, or what became of a result."""
        self._check_host(request)
        if request.method == "GET" and request.path == "/":
            return web.Response(text=self._page, content_type="text/html")
        self._check_sender(request)
        # Other pages may send forms here unasked, but JSON only by permission, which is not given.
        known = request.method == "POST" and request.path in ("/session", "/trial")
        if not known or request.content_type != "application/json":
            raise web.HTTPNotFound(text="expected JSON at /session or /trial")
        value = await _read_json(request)
        if request.path == "/session":
            try:
                window = parse_record(SessionRequest, value).window
            except ValueError as error:
                raise web.HTTPBadRequest(text=str(error)) from None
            return _json(HTTPStatus.OK, self.session.open(window))
        response = _json(*self.session.record(value))
        if self.session.complete:
            self.stop.set()  # requests that are being answered are answered first
        return response

    def _check_host(self, request: web.BaseRequest) -> None:
        """Refuse a page that was asked for by a foreign name that points here."""
        name = request.headers.get("Host", "").partition(":")[0]  # browsers leave out the port 80
        if name not in ("127.0.0.1", "localhost"):
            raise web.HTTPForbidden(text=f"open {self.address}")

    def _check_sender(self, request: web.BaseRequest) -> None:
        """Refuse all but the study's own page, as far as the browser says, and those who do not know the token."""
        origin = request.headers.get("Origin")
        site = request.headers.get("Sec-Fetch-Site", "same-origin")
        if site != "same-origin" or origin not in (None, f"http://{request.headers.get('Host', '')}"):
            raise web.HTTPForbidden(text=f"another page asks; open {self.address}")
        given = request.headers.get("Authorization", "").encode(errors="surrogateescape")
        if not hmac.compare_digest(given, f"Bearer {self.token}".encode()):
            raise web.HTTPForbidden(text="open the whole address that the recording program has printed, with its end")


def _json(status: int, value: dict[str, Any]) -> web.Response:
    return web.json_response(value, status=status)


async def _read_json(request: web.BaseRequest) -> Any:
    length = request.content_length
    if length is None or length > _LARGEST:
        raise web.HTTPBadRequest(text=f"expected at most {_LARGEST} bytes, and their number")
    try:
        return json.loads(await request.read())
    except (ValueError, RecursionError):
        raise web.HTTPBadRequest(text="not JSON") from None
    except (OSError, web.RequestPayloadError):  # the connection is gone, or its time is over
        raise web.HTTPBadRequest(text="the request was cut off") from None


def page(script: str | None = None) -> str:
    """The page, with ``script`` at its end."""
    text = resources.files("holotorch.experiments.perception.study").joinpath("page.html").read_text(encoding="utf-8")
    return text.replace("</body>", f"<script>{script}</script></body>") if script else text
