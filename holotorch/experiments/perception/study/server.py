"""Server of the study page, reachable only from the machine that it runs on.

The page (page.html) requests the design once and sends one result per trial; a trial is saved before its request
is answered. The page itself contains no data of the study. All other requests need the participant's token, which is
in the fragment of the printed address: browsers never send fragments to a server, whereas a cookie would go to all
servers on the machine.

``onset_s`` is the time stamp of the first frame after the one that drew the pattern, the earliest moment at which the
pattern can be visible. ``response_s`` is the time stamp of the key event on the same clock or, for a gamepad, which is
polled once per frame, the time stamp of the frame. The delays of the screen and the keyboard, which vary little between
trials, are not measured.

With an eye tracker (see gaze.py), its program sends samples to ``/gaze``, and the page asks ``/fixation`` whether the
participant looks at the fixation point.
"""

import asyncio
import json
import logging
import socket
import time
import traceback
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import resources
from typing import Any

from aiohttp import web

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.records import FixationRequest, SessionRequest, parse_record
from holotorch.experiments.perception.study.session import StudySession
from holotorch.experiments.web.guard import check_host, check_origin, check_token, headers

_LARGEST = 10_000  # largest body of a request in bytes; a result has about 200
_CONNECTIONS = 64  # largest number of simultaneous connections; a browser opens six
_SECONDS = 10.0  # longest duration of a connection; an answer takes milliseconds, one about the fixation a second
_LATEST_S = 0.3  # how long the check of a trial waits for gaze samples that are still on their way
_STEP_S = 0.01  # interval between the checks of a waiting request
_HEADERS = headers("")
# aiohttp would log every malformed request with a traceback; StudyServer prints the errors of its own code.
_QUIET = logging.getLogger(f"{__name__}.requests")
_QUIET.addFilter(lambda _: False)  # unlike ``disabled``, it outlives a configuration of logging by others


class _Connections(web.Server):
    """Connections for one request each, which last ``_SECONDS`` at most; beyond ``_CONNECTIONS``, the oldest is closed.

    A complete request is answered immediately, so that the oldest connection is one whose request is incomplete, or one
    that waits for a change of the fixation, which the page asks for again.
    """

    def __init__(self, handler: Any):
        # Without handler_cancellation, aiohttp waits 10 s for the rest of a request whose connection is closed.
        super().__init__(handler, handler_cancellation=True, auto_decompress=False, logger=_QUIET, access_log=None)
        self._ends: dict[web.RequestHandler, tuple[asyncio.Transport, asyncio.TimerHandle]] = {}

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Start the time limit of the connection."""
        super().connection_made(handler, transport)
        if len(self._ends) >= _CONNECTIONS:
            self._end(next(iter(self._ends)))
        self._ends[handler] = transport, asyncio.get_running_loop().call_later(_SECONDS, self._end, handler)

    def connection_lost(self, handler: web.RequestHandler, exc: BaseException | None = None) -> None:
        """Remove the connection from the list of open ones."""
        super().connection_lost(handler, exc)
        self._end(handler)

    def _end(self, handler: web.RequestHandler) -> None:
        if handler in self._ends:
            transport, timer = self._ends.pop(handler)
            timer.cancel()
            transport.abort()


class StudyServer:
    """Serves the page and the session of one participant.

    Every request must contain ``token``, except the one for the page. ``script`` is JavaScript to add to the page, such
    as the scripted participant of a test.

    Attributes:
        stop: Event that ends the server; set when the study is complete.
        address: Address of the page, once the server is listening.
    """

    def __init__(self, session: StudySession, token: str, script: str | None = None):
        self.session, self.token = session, token
        self.stop = asyncio.Event()
        self.address = ""
        self._page = page(script)

    @asynccontextmanager
    async def listening(self, port: int = 0) -> AsyncIterator[None]:
        """Answer requests at ``port``, 0 for any free port. ConfigError if the port cannot be used."""
        try:
            listener = socket.create_server(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ConfigError([f"port {port}: {reason}; choose another with --port, or leave it out"]) from None
        self.address = f"http://127.0.0.1:{listener.getsockname()[1]}/"
        runner = web.ServerRunner(_Connections(self._handle), shutdown_timeout=1.0)
        await runner.setup()
        try:
            # asyncio accepts up to ``backlog`` connections at a time, and each uses a file descriptor of the process.
            await web.SockSite(runner, listener, backlog=_CONNECTIONS // 4).start()
            listener.listen(16 * _CONNECTIONS)  # further clients retry after a second or more
            yield
        finally:
            await runner.cleanup()

    async def _handle(self, request: web.BaseRequest) -> web.Response:
        try:
            response = await self._answer(request)
        except web.HTTPException as refusal:
            response = web.json_response({"error": refusal.text}, status=refusal.status)
        except Exception:
            traceback.print_exc()
            response = web.json_response({"error": "the recording program failed"}, status=500)
        response.headers.update(_HEADERS)
        response.force_close()
        return response

    async def _answer(self, request: web.BaseRequest) -> web.Response:
        """Answer with the page, the session of a window, or the status of a result."""
        # A foreign host name may resolve to this machine (DNS rebinding).
        check_host(request, f"open {self.address}")
        if request.method == "GET" and request.path == "/":
            return web.Response(text=self._page, content_type="text/html")
        self._check_sender(request)
        # Pages of other origins can send forms here, but JSON only with a CORS permission, which is not given.
        paths = ("/session", "/trial", "/gaze", "/fixation") if self.session.gaze else ("/session", "/trial")
        accepted = request.method == "POST" and request.path in paths
        kind = request.headers.get("Content-Type", "").partition(";")[0]  # Python's parser recurses into comments
        if not accepted or kind.strip().lower() != "application/json":
            raise web.HTTPNotFound(text=f"expected JSON at {', '.join(paths[:-1])} or {paths[-1]}")
        value = await _read_json(request)
        if request.path == "/gaze":
            return web.json_response(self.session.look(value))
        if request.path == "/fixation":
            return web.json_response({"fixated": await self._fixation(value)})
        if request.path == "/session":
            try:
                window = parse_record(SessionRequest, value).window
            except ValueError as error:
                raise web.HTTPBadRequest(text=str(error)) from None
            return web.json_response(self.session.open(window))
        await self._samples_until(self.session.end_of(value))
        status, answer = self.session.record(value)
        if self.session.complete:
            self.stop.set()  # pending requests are answered before the server ends
        return web.json_response(answer, status=status)

    async def _fixation(self, value: Any) -> bool:
        """Whether the participant looks at the fixation point; waits up to 1 s for this to change."""
        try:
            known = parse_record(FixationRequest, value).fixated
        except ValueError as error:
            raise web.HTTPBadRequest(text=str(error)) from None
        assert self.session.gaze is not None
        end = time.monotonic() + 1
        while (fixated := self.session.gaze.fixated(time.time())) == known and time.monotonic() < end:
            if self.stop.is_set():
                break
            await asyncio.sleep(_STEP_S)
        return fixated

    async def _samples_until(self, moment: float | None) -> None:
        """Wait until gaze samples of this Unix time have come, at most ``_LATEST_S``."""
        end = time.monotonic() + _LATEST_S
        while moment is not None and self.session.gaze and self.session.gaze.last < moment and time.monotonic() < end:
            await asyncio.sleep(_STEP_S)

    def _check_sender(self, request: web.BaseRequest) -> None:
        """Refuse requests from other pages, which the headers of the browser identify, and those without the token."""
        another = f"another page asks; open {self.address}"
        if request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            raise web.HTTPForbidden(text=another)
        check_origin(request, another)
        refusal = "open the whole address that the recording program has printed, with its end"
        check_token(request.headers.get("Authorization", ""), f"Bearer {self.token}", refusal)


async def _read_json(request: web.BaseRequest) -> Any:
    length = request.content_length
    if length is None or length > _LARGEST:
        raise web.HTTPBadRequest(text=f"expected at most {_LARGEST} bytes, and their number")
    try:
        return json.loads(await request.read())
    except (ValueError, RecursionError):
        raise web.HTTPBadRequest(text="not JSON") from None
    except (OSError, web.RequestPayloadError):  # the connection was closed, by the client or by its time limit
        raise web.HTTPBadRequest(text="the request was cut off") from None


def page(script: str | None = None) -> str:
    """The HTML of the page, with ``script`` at the end of the body."""
    text = resources.files("holotorch.experiments.perception.study").joinpath("page.html").read_text(encoding="utf-8")
    return text.replace("</body>", f"<script>{script}</script></body>") if script else text
