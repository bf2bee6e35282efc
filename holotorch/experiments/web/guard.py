"""Whom a server of a page answers: checks of the host name, the origin and the token of a request.

A server on the loopback interface is reached by programs of this computer only. Two ways around this remain: another
web site that is open in the same browser sends requests, which its origin shows; and a foreign host name that resolves
to this computer (DNS rebinding), which the host name shows. The token keeps out other users of this computer.
"""

import hmac
import ipaddress
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

_LOCAL = ("localhost", "127.0.0.1", "::1")
_PUBLIC = (".js", ".css")  # our own scripts and style, which browsers fetch without the token of the page


def headers(policy: str) -> dict[str, str]:
    """Headers of all answers; ``policy`` is added to the content security policy, which forbids frames."""
    return {
        "Content-Security-Policy": "; ".join(filter(None, [policy, "frame-ancestors 'none'"])),
        "Cache-Control": "no-store",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
    }


def is_loopback(host: str) -> bool:
    """Whether only this computer reaches a server that listens on ``host``."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def check_host(request: web.BaseRequest, refusal: str) -> None:
    """Raise HTTPForbidden with the text ``refusal`` if the request is not for a name of this computer itself."""
    name = None
    with suppress(ValueError):  # no host name at all
        name = urlsplit(f"//{request.headers.get('Host', '')}").hostname
    if name not in _LOCAL:
        raise web.HTTPForbidden(text=refusal)


def check_origin(request: web.BaseRequest, refusal: str) -> None:
    """Raise HTTPForbidden with the text ``refusal`` if a page of another site sends the request."""
    expected = f"{request.scheme}://{request.headers.get('Host', '')}"
    if request.headers.get("Origin", expected) != expected:
        raise web.HTTPForbidden(text=refusal)


def check_token(given: str, token: str, refusal: str) -> None:
    """Raise HTTPForbidden with the text ``refusal`` unless the given token is the right one."""
    if not hmac.compare_digest(given.encode(errors="surrogateescape"), token.encode()):
        raise web.HTTPForbidden(text=refusal)


class Guard:
    """Middleware of a server of a page: refuses foreign host names and origins, and requests without the token.

    Args:
        local: Whether the server listens on the loopback interface; otherwise any host name is accepted.
        token: Token that the address of the page has as ``?token=...``; empty if there is none.
    """

    def __init__(self, *, local: bool, token: str):
        self._local, self._token = local, token

    @property
    def middleware(self) -> Any:
        """For ``web.Application(middlewares=[...])``."""

        @web.middleware
        async def check(request: web.Request, handler: Any) -> web.StreamResponse:
            if self._local:
                check_host(request, "this server answers to localhost only")
            check_origin(request, "this page is not for other sites")
            if self._token and not request.path.endswith(_PUBLIC):
                refusal = "the address lacks its token; copy it whole from the terminal"
                check_token(request.query.get("token", ""), self._token, refusal)
            return await handler(request)

        return check
