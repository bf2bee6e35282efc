"""A local server that shows poses in a browser: one page, and one WebSocket for each page that is open.

A page asks for the clock of this computer and gets the newest pose only; one that does not keep up misses poses, and
one that takes none for five seconds is cut off. Poses are JSON: kind, sequence, captured, sent, status, answered,
reason, lag, and for an answer tip [3] in metres, direction [3] and covariance [9] of the tip in m^2. Pictures are
binary: a byte for the ``Channel``, the time of capture as a little-endian double, the length of the next part as a
little-endian uint16, the pose of the catheter in the picture (captured, status and so on, as above) or nothing, and a
JPEG; again the newest only. The pose is sent with its picture, which arrives later than the newest pose.

On the loopback interface only programs of this computer can connect; requests for other host names, and WebSockets that
another web site opens, are refused. On any other interface a random token in the address of the page is demanded, and
the page should be served by TLS, which headsets need for WebXR.
"""

import asyncio
import itertools
import json
import math
import secrets
import ssl
import struct
from collections import deque
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from aiohttp import WSMsgType, web
from torch import Tensor

from holotorch.core import checks
from holotorch.experiments.streaming.aligning import Aligner
from holotorch.experiments.streaming.pictures import Channel, Encoder, PanelSource
from holotorch.experiments.streaming.registered import RegisteredVolume
from holotorch.experiments.web.guard import Guard, headers, is_loopback
from holotorch.experiments.web.site import file_routes, listening, open_socket
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.pose.overlay import Undistorter, overlay
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import FRAME, now

PORT = 8765
_FOLDER = Path(__file__).with_name("browser")
_LONGEST = 4096  # bytes of a message from a page, and characters of a reason sent to it
_ENDED = b"ended"  # tells a page that there will be no more poses
_REPLIES = 16  # answers that wait for a page
_PATIENCE = 5.0  # seconds that a page may take to accept a message
_HEADERS = headers(
    "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; connect-src 'self'; base-uri 'none'"
)


class PageServer:
    """Serves the page: ``async with PageServer(catheter) as server: server.send(pose, captured)``.

    Args:
        catheter: The catheter that is drawn.
        camera: Camera whose picture the page can show, without its distortion; None for poses of another frame.
        frame: Name of the frame of the poses.
        port: 0 picks a free one, which the attribute ``port`` names once the server is open.
        host: Address to listen on; by default only this computer can connect.
        certificate: Files of a certificate and of its key, for TLS.
        aligner: Fits the place of the camera on a headset to the alignments that pages send; it names the frame then.
        volume: A volume whose slice at the tip the pages can show.
        panel: Video that the pages can show beside the catheter; "overlay" for the tracked frames with the pose drawn.
        empty: Why there are no tracked frames to show, which pages say in their place.

    Attributes:
        malformed: Number of messages of pages that were dropped.

    Raises OSError if the port is in use or the certificate cannot be read; by ``async with``.
    """

    def __init__(
        self,
        catheter: Catheter,
        camera: Camera | None = None,
        *,
        frame: str = "camera_from_tool",
        port: int = PORT,
        host: str = "127.0.0.1",
        certificate: tuple[Path, Path] | None = None,
        aligner: Aligner | None = None,
        volume: RegisteredVolume | None = None,
        panel: PanelSource | Literal["overlay"] | None = None,
        empty: str = "",
    ):
        self.port, self.host, self.certificate = checks.port(port), host, certificate
        self.token = "" if is_loopback(host) else secrets.token_urlsafe(16)
        self.malformed = 0
        self.aligner, self._volume, self._panel, self._empty = aligner, volume, panel, empty
        self._catheter, self._camera, self._frame = catheter, camera, frame if aligner is None else aligner.name
        self._encoders: dict[Channel, Encoder] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._sequence = itertools.count()
        self._clients: set[_Client] = set()
        self._newest = ""
        self._runner: web.AppRunner | None = None

    @property
    def address(self) -> str:
        """Address of the page."""
        name = f"[{self.host}]" if ":" in self.host else self.host
        scheme = "http" if self.certificate is None else "https"
        return f"{scheme}://{name}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    @property
    def clients(self) -> int:
        """Number of pages that are open."""
        return len(self._clients)

    async def __aenter__(self) -> "PageServer":
        context = None
        if self.certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*self.certificate)
        guard = Guard(local=not self.token, token=self.token)
        app = web.Application(middlewares=[guard.middleware])
        files = file_routes(_FOLDER, _HEADERS)
        app.add_routes([*files, web.get("/poses", self._poses), web.get("/volume", self._samples)])
        self._runner, self.port = await listening(app, self.host, self.port, context)
        self._loop = asyncio.get_running_loop()
        if isinstance(self._panel, PanelSource):
            self._panel.start(partial(self.picture, Channel.PANEL))
        return self

    async def __aexit__(self, *_: object) -> None:
        threads = [*self._encoders.values(), *([self._panel] if isinstance(self._panel, PanelSource) else [])]
        self._loop = None  # nothing more is delivered
        for thread in threads:
            await asyncio.to_thread(thread.close)
        for client in list(self._clients):
            with suppress(TimeoutError):
                await asyncio.wait_for(client.socket.close(message=_ENDED), 1.0)
        if self._runner is not None:
            await self._runner.cleanup()

    def send(self, pose: Pose, captured: float, *, lag: float = 0.0) -> int:
        """Offer a pose or refusal to all pages and return its sequence number; never waits.

        TypeError for a batch of poses, ValueError for one that is answered and not finite.
        """
        if not isinstance(pose.status, Status):
            raise TypeError(f"one pose at a time, got {len(pose)}; index the batch")
        if self.aligner is not None and self.aligner.name != self._frame:
            self._frame = self.aligner.name
            for client in self._clients:
                client.reply(self._setup())
        number = next(self._sequence)
        message = {"kind": "pose", "sequence": number, "sent": now(), "lag": lag} | _words(pose, captured)
        self._newest = json.dumps(message, allow_nan=False)
        for client in self._clients:
            client.offer(self._newest)
        return number

    def see(self, pixels: Tensor, pose: Pose, captured: float) -> None:
        """Show a tracked frame, uint8 [3, H, W], and its pose in the camera's frame; from any thread, never waits."""
        pose = replace(pose, reason=pose.reason[:_LONGEST])
        self.picture(Channel.CAMERA, pixels, captured, json.dumps(_words(pose, captured)))
        if self._panel == "overlay" and self._camera is not None and self._clients:
            self.picture(Channel.PANEL, overlay(pixels, pose, self._camera, self._catheter), captured)

    def picture(self, channel: Channel, pixels: Tensor, captured: float, pose: str = "") -> None:
        """Offer a picture, uint8 [3, H, W], and its pose in JSON to all pages; from any thread, never waits."""
        if not self._clients or self._loop is None:
            return
        if channel not in self._encoders:
            prepare = Undistorter(self._camera) if channel is Channel.CAMERA and self._camera is not None else None
            self._encoders[channel] = Encoder(partial(self._deliver, channel), prepare)
        self._encoders[channel].put(pixels, (captured, pose.encode()))

    def _deliver(self, channel: Channel, jpeg: bytes, of: tuple[float, bytes]) -> None:
        """Hand an encoded picture to the clients, from the thread of an encoder."""
        captured, pose = of
        message = struct.pack("<BdH", channel, captured, len(pose)) + pose + jpeg

        def offer() -> None:
            for client in self._clients:
                client.offer_picture(channel, message)

        if (loop := self._loop) is not None:
            with suppress(RuntimeError):  # the loop has closed in the meantime
                loop.call_soon_threadsafe(offer)

    def _setup(self) -> str:
        message: dict[str, Any] = {"kind": "setup", "frame": self._frame, "catheter": _tool(self._catheter)}
        message["camera"] = _lens(self._camera) if self._frame == FRAME else None
        message |= {"align": self.aligner is not None, "panel": self._panel is not None, "empty": self._empty}
        message["volume"] = None if self._volume is None else self._volume.setup()
        return json.dumps(message, allow_nan=False)

    async def _samples(self, request: web.Request) -> web.Response:
        if self._volume is None:
            raise web.HTTPNotFound(text="there is no volume")
        data = self._volume.samples.numpy().tobytes()
        return web.Response(body=data, content_type="application/octet-stream", headers=_HEADERS)

    async def _poses(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(max_msg_size=_LONGEST, heartbeat=10.0, compress=False)
        await open_socket(socket, request)
        client = _Client(socket, request)
        await socket.send_str(self._setup())
        if self._newest:
            client.offer(self._newest)
        self._clients.add(client)
        writer = asyncio.create_task(client.write())
        try:
            async for message in socket:
                reply = self._reply(message.data) if message.type is WSMsgType.TEXT else None
                if reply is None:
                    self.malformed += 1
                else:
                    client.reply(reply)
        finally:
            self._clients.discard(client)
            writer.cancel()
        return socket

    def _reply(self, text: str) -> str | None:
        """The answer to a message of a page; None for one that is not understood."""
        try:
            message = json.loads(text)
            if message["kind"] == "clock":
                asked = float(message["asked"])
                return json.dumps({"kind": "clock", "asked": asked, "now": now()}) if math.isfinite(asked) else None
            return None if self.aligner is None else json.dumps(self.aligner.answer(message), allow_nan=False)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            return None


class _Client:
    """One page: the newest pose and pictures, and the last replies, that it has not been sent yet."""

    def __init__(self, socket: web.WebSocketResponse, request: web.Request):
        self.socket, self.request = socket, request
        self._pose, self._replies = "", deque[str](maxlen=_REPLIES)
        self._pictures: dict[Channel, bytes] = {}
        self._wake = asyncio.Event()

    def offer(self, pose: str) -> None:
        self._pose = pose
        self._wake.set()

    def offer_picture(self, channel: Channel, picture: bytes) -> None:
        self._pictures[channel] = picture
        self._wake.set()

    def reply(self, text: str) -> None:
        self._replies.append(text)
        self._wake.set()

    async def write(self) -> None:
        """Send until the page closes, or accepts nothing for too long."""
        while not self.socket.closed:
            await self._wake.wait()
            self._wake.clear()
            messages: list[str | bytes] = [*self._replies, *([self._pose] if self._pose else [])]
            messages += self._pictures.values()
            self._replies.clear()
            self._pictures.clear()
            self._pose = ""
            for message in messages:
                try:
                    if isinstance(message, str):
                        await asyncio.wait_for(self.socket.send_str(message), _PATIENCE)
                    else:
                        await asyncio.wait_for(self.socket.send_bytes(message), _PATIENCE)
                except (TimeoutError, ConnectionError, RuntimeError):
                    if isinstance(self.request.transport, asyncio.WriteTransport):
                        self.request.transport.abort()
                    return


def _words(pose: Pose, captured: float) -> dict[str, Any]:
    """A pose or refusal as pages get it: tip [3] in metres, direction [3], covariance [9] of the tip in m^2."""
    assert isinstance(pose.status, Status)  # one pose
    said = {"captured": captured, "status": pose.status.name, "answered": pose.answered, "reason": pose.reason}
    if pose.answered:
        covariance = pose.covariance[:3, :3].flatten().tolist()
        said |= {"tip": pose.tip.tolist(), "direction": pose.direction.tolist(), "covariance": covariance}
    return said


def _tool(catheter: Catheter) -> dict[str, Any]:
    return {
        "edges": [float(edge) for edge in catheter.edges],
        "colours": [list(map(int, colour)) for colour in catheter.colours],
        "radius": float(catheter.radius),
        "length": float(catheter.length),
    }


def _lens(camera: Camera | None) -> dict[str, float] | None:
    if camera is None or camera.size is None:
        return None
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": camera.size[1], "height": camera.size[0]}
