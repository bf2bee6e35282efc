"""The server of the page: whom it refuses, and that it computes what a page has asked for last."""

import asyncio
import json
import logging
import os
import signal
import struct
import threading
import time
from typing import Any

import aiohttp
import pytest
import torch

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.view.controls import Slider
from holotorch.experiments.view.run import run_view
from holotorch.experiments.view.server import ViewServer
from holotorch.experiments.view.viewer import Picture, Shown, Viewer


class Slow(Viewer):
    """Grey pictures of the value of the only control, each of which takes a while."""

    title, note, transforms = "Grey", "", (1, 1)
    controls = (Slider("grey", "Grey", "", 0.0, 1.0, 0.01, 0.5, ""),)

    def __init__(self, seconds: float = 0.0):
        self.seconds, self.begun, self.ended = seconds, 0, 0

    def show(self, values, coarse, proceed) -> Shown:
        self.begun += 1
        if values["grey"] == 1.0:
            raise MemoryError("too\nlarge")
        if values["grey"] == 0.99:
            raise RuntimeError("a mistake of ours")
        end = time.monotonic() + self.seconds
        while time.monotonic() < end:
            time.sleep(0.01)
            proceed()
        self.ended += 1
        return Shown([Picture.of("shown", "grey", torch.full((1, 8, 8), values["grey"]))], {"a": "b"}, coarse)


def served(test, viewer: Viewer | None = None):
    async def run():
        async with ViewServer(viewer or Slow()) as server, aiohttp.ClientSession() as session:
            await asyncio.wait_for(test(server, session), 20)

    asyncio.run(run())


def pictures(server: ViewServer) -> str:
    return server.address.replace("/?", "/pictures?")


async def answer(socket) -> dict[str, Any]:
    """The header of the next picture, or the next message."""
    message = await socket.receive()
    if message.type is aiohttp.WSMsgType.TEXT:
        return json.loads(message.data)
    (length,) = struct.unpack_from("<I", message.data)
    header = json.loads(message.data[4 : 4 + length])
    assert sum(each["bytes"] for each in header["pictures"]) == len(message.data) - 4 - length
    return header


def request(number: int, grey: Any = 0.5, coarse: bool = False) -> str:
    return json.dumps({"number": number, "values": {"grey": grey}, "coarse": coarse})


def test_only_the_page_with_its_token_is_answered():
    async def test(server, session):
        bare = f"http://127.0.0.1:{server.port}/"
        assert len(server.token) > 20 and server.address == f"{bare}?token={server.token}"
        for query, headers, status in (
            ("", {}, 403),
            ("?token=", {}, 403),
            ("?token=%00é", {}, 403),
            (f"?token={server.token}", {"Host": "evil.example"}, 403),
            (f"?token={server.token}", {"Host": "["}, 403),
            (f"?token={server.token}", {"Origin": "http://evil.example"}, 403),
            (f"?token={server.token}", {"Host": f"localhost:{server.port}"}, 200),
            (f"?token={server.token}", {}, 200),
        ):
            async with session.get(bare + query, headers=headers) as reply:
                assert reply.status == status, (query, headers)
        assert "unsafe" not in reply.headers["Content-Security-Policy"]
        for path, status in (("view.js", 200), ("style.css", 200), ("server.py", 403), ("..%2fserver.py", 403)):
            async with session.get(bare + path) as reply:
                assert reply.status == status, path
        for address, headers in ((bare + "pictures", {}), (pictures(server), {"Origin": "http://evil.example"})):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await session.ws_connect(address, headers=headers)

    served(test)


def test_only_our_own_mistakes_are_logged(caplog):
    """A page that left at once printed a traceback, as did malformed requests (finds of fuzzing)."""

    async def test(server, session):
        key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13"
        opening = f"GET /pictures?token={server.token} HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n"
        opening += f"Upgrade: websocket\r\n{key}\r\n\r\n"
        for data in (opening, "GET //[ HTTP/1.1\r\nHost: localhost\r\n\r\n"):
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            writer.write(data.encode())
            writer.write_eof()
            await reader.read()
            writer.close()
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(opening.replace("NhbX", "NhbÄ").encode())
        assert (await reader.readline()).startswith(b"HTTP/1.1 400")
        writer.close()
        server._viewer.controls = None  # a mistake of ours
        async with session.ws_connect(pictures(server)) as socket:
            await socket.receive()

    served(test)
    (mistake,) = (record.exc_info for record in caplog.records if record.levelno >= logging.ERROR)
    assert isinstance(mistake[1], TypeError)


def test_a_page_gets_the_controls_and_pictures_and_refusals_in_a_line(capfd):
    async def test(server, session):
        async with session.ws_connect(pictures(server)) as socket:
            setup = await answer(socket)
            assert setup["title"] == "Grey" and setup["controls"][0]["high"] == 1.0
            for text in ("", "{", "[1]", "null", '{"number": 1}', '{"number": "1", "values": {}}', "[" * 3000):
                await socket.send_str(text)  # no requests, and therefore not answered
            await socket.send_bytes(b"\x00\xff")
            for number, grey, words in (
                (1, 1.5, "Grey: expected 0 to 1, got 1.5"),
                (2, 1.0, "too large"),
                (3, 0.99, "this picture could not be computed; the terminal says why"),
            ):
                await socket.send_str(request(number, grey))
                assert await answer(socket) == {"kind": "refused", "number": number, "text": words}
            await socket.send_str(request(4))
            header = await answer(socket)
            assert header["number"] == 4 and header["numbers"] == [["a", "b"]] and not header["coarse"]
            await socket.send_str("x" * 5000)
            assert (await socket.receive()).type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED)

    served(test)
    assert "a mistake of ours" in capfd.readouterr().err


@pytest.mark.parametrize("coarse", [True, False])
def test_the_last_request_wins(coarse):
    """Requests that others have replaced are dropped. A coarse picture is finished even so, a fine one is abandoned."""
    viewer = Slow(0.2)

    async def test(server, session):
        async with session.ws_connect(pictures(server)) as socket:
            await answer(socket)
            await socket.send_str(request(1, coarse=coarse))
            while not viewer.begun:
                await asyncio.sleep(0.005)
            for number in range(2, 40):
                await socket.send_str(request(number, coarse=coarse))
            numbers = [(await answer(socket))["number"]]
            while numbers[-1] < 39:
                numbers.append((await answer(socket))["number"])
            assert numbers[0] == (1 if coarse else 39) and len(numbers) <= 4 and viewer.begun <= 5

    served(test, viewer)


def test_a_page_that_closes_leaves_the_server_to_others_and_too_many_pages_are_refused():
    viewer = Slow(0.3)

    async def test(server, session):
        socket = await session.ws_connect(pictures(server))
        await socket.send_str(request(1))
        while not viewer.begun:
            await asyncio.sleep(0.005)
        await socket.close()
        sockets = [await session.ws_connect(pictures(server)) for _ in range(8)]
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            await session.ws_connect(pictures(server))
        await answer(sockets[0])
        await sockets[0].send_str(request(7))
        assert (await answer(sockets[0]))["number"] == 7 and viewer.ended == 1
        await sockets[1].send_str(request(8))  # still at work when the server closes

    served(test, viewer)


def test_ctrl_c_ends_it_and_a_port_in_use_is_said(capsys):
    threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    run_view(Slow())
    assert "Page       http://127.0.0.1:" in capsys.readouterr().out

    async def test(server, _):
        with pytest.raises(ConfigError, match=f"port {server.port} for the page cannot be used.*choose another"):
            await asyncio.to_thread(run_view, Slow(), server.port)

    served(test)
