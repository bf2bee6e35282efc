"""The files of a page, and a server that listens."""

import logging
import ssl
from collections.abc import Mapping
from pathlib import Path

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}


def _ours(record: logging.LogRecord) -> bool:
    """Whether a record is of a mistake of ours: pages that leave, and malformed requests, are not."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, ConnectionError | HttpProcessingError)


_LOG = logging.getLogger(__name__)
_LOG.addFilter(_ours)


def file_routes(folder: Path, headers: Mapping[str, str]) -> list[web.RouteDef]:
    """Routes to the files in a folder, the HTML page at the root; no other file is ever read."""
    files = {"" if file.suffix == ".html" else file.name: file for file in sorted(folder.iterdir())}

    async def answer(request: web.Request) -> web.Response:
        file = files[request.path.removeprefix("/")]
        kind = _TYPES[file.suffix]
        return web.Response(body=file.read_bytes(), content_type=kind, charset="utf-8", headers=headers)

    return [web.get(f"/{name}", answer) for name in files]


async def open_socket(socket: web.WebSocketResponse, request: web.Request) -> None:
    """Open the WebSocket that a page asks for. HTTPBadRequest for a malformed request."""
    try:
        await socket.prepare(request)
    except ValueError as error:  # of a key that is not ASCII, which aiohttp does not expect
        raise web.HTTPBadRequest(text=f"no WebSocket: {error}") from None


async def listening(
    app: web.Application, host: str, port: int, context: ssl.SSLContext | None = None
) -> tuple[web.AppRunner, int]:
    """Serve ``app``; returns the runner, whose ``cleanup()`` ends it, and the port.

    With ``port`` 0 the system chooses one. OSError if the port cannot be used.
    """
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0, logger=_LOG)
    await runner.setup()
    try:
        await web.TCPSite(runner, host, port, ssl_context=context, reuse_address=True).start()
    except OSError as error:
        await runner.cleanup()
        raise OSError(error.errno, f"port {port} for the page cannot be used: {error.strerror}") from None
    return runner, runner.addresses[0][1]
