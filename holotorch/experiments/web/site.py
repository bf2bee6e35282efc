"""The files of a page, and a server that listens."""

import ssl
from collections.abc import Mapping
from pathlib import Path

from aiohttp import web

_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}


def file_routes(folder: Path, headers: Mapping[str, str]) -> list[web.RouteDef]:
    """Routes to the files in a folder, the HTML page at the root; no other file is ever read."""
    files = {"" if file.suffix == ".html" else file.name: file for file in sorted(folder.iterdir())}

    async def answer(request: web.Request) -> web.Response:
        file = files[request.path.removeprefix("/")]
        kind = _TYPES[file.suffix]
        return web.Response(body=file.read_bytes(), content_type=kind, charset="utf-8", headers=headers)

    return [web.get(f"/{name}", answer) for name in files]


async def listening(
    app: web.Application, host: str, port: int, context: ssl.SSLContext | None = None
) -> tuple[web.AppRunner, int]:
    """Serve ``app``; returns the runner, whose ``cleanup()`` ends it, and the port.

    With ``port`` 0 the system chooses one. OSError if the port cannot be used.
    """
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, host, port, ssl_context=context, reuse_address=True).start()
    except OSError as error:
        await runner.cleanup()
        raise OSError(error.errno, f"port {port} for the page cannot be used: {error.strerror}") from None
    return runner, runner.addresses[0][1]
