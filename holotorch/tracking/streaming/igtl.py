"""Poses for 3D Slicer and other clients of OpenIGTLink, encoded by pyigtl (``pip install 'holotorch[slicer]'``).

Each frame gives one STRING, ``<name>Status``: ``OK``, ``UNVERIFIED: ...`` or, for a refusal, its status and reason such
as ``NO_CATHETER: ...``. A frame with a pose also gives a TRANSFORM, ``<name>``, before it. Both are stamped with the
capture time. After a refusal a client keeps its last transform, so show the status beside it, and hide the tool when
the stamps stop advancing, since a sender that has crashed sends nothing. A pose captured in the future is sent as a
refusal, because its age is unknown.

The matrix is camera_from_tool (``ToolToCamera`` in PLUS) with its translation in MILLIMETRES. Its axes are those of the
camera (x right, y down, z forward), neither RAS nor LPS. Slicer takes the numbers of a TRANSFORM as RAS, without the
change of signs that it applies to files; so put the node below a registration ``CameraToRas``. The tool's +z axis runs
from the tip to the rear; the roll about it is not observed.

Source: openigtlink.org, protocol version 2, messages TRANSFORM and STRING.
"""

import asyncio
import importlib
import socket
from typing import Any

from holotorch.core import checks
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now
from holotorch.tracking.streaming.stream import Newest

PORT = 18944
_AHEAD = 0.05  # seconds that a capture time may lie in the future, because of errors of the clocks


def messages(pose: Pose, captured: float | None = None, *, name: str = "ToolToCamera") -> bytes:
    """TRANSFORM and STRING of one frame, or the STRING alone for a refusal.

    Args:
        pose: A single pose, not a batch.
        captured: Time at which the camera took the frame, in seconds since 1970; now by default. It becomes the
            time stamp, even if it lies in the future.
        name: Name of the transform, 1 to 14 ASCII characters: OpenIGTLink allows 20, and ``Status`` is appended.

    Raises:
        ImportError: pyigtl is not installed.
        ValueError: A name that does not fit, a time before 1970, or NaN in an answered pose.
    """
    igtl = _pyigtl()
    if not 1 <= len(name) <= 14 or not name.isascii():
        raise ValueError(f"name must be 1 to 14 ASCII characters, got {name!r}")
    stamp = checks.finite("captured", now() if captured is None else captured, "seconds")
    if not 0 <= stamp < 2**32:
        raise ValueError(f"captured must be in seconds since 1970, got {captured!r}")
    status = pose.status
    if not isinstance(status, Status):
        raise TypeError(f"one frame at a time, got {len(status)} poses; index the batch")
    # pyigtl can only encode ASCII.
    reason = pose.reason.encode("ascii", "replace").decode()[:200]
    text = f"{status.name}: {reason}" if reason else status.name
    string = igtl.StringMessage(text, timestamp=stamp, device_name=f"{name}Status").pack()
    if not status.answered:
        return string
    matrix = pose.camera_from_tool.detach().cpu().double().clone()
    checks.all_finite("camera_from_tool", matrix)
    matrix[:3, 3] *= 1e3
    return igtl.TransformMessage(matrix.numpy(), timestamp=stamp, device_name=name).pack() + string


class TransformServer:
    """TCP server to which Slicer connects (OpenIGTLinkIF, a connector of type client); it can serve several clients.

    ``async with TransformServer() as server: server.send(pose, captured)``. Sending never waits. For a client that does
    not read, only the newest frame is kept, besides a few kilobytes in the TCP buffers of both systems. A new client
    gets nothing until the next frame.

    Args:
        port: 18944 is OpenIGTLink's; 0 picks a free one, which the attribute ``port`` names once the server is open.
        host: Address to listen on; by default all addresses of this computer, ``127.0.0.1`` for local clients only.
        name: As in :func:`messages`.

    Attributes:
        future: Number of frames whose pose was not sent, since its capture time lay more than 50 ms in the future.

    Raises:
        ImportError: pyigtl is not installed.
        OSError: The port is in use; raised by ``async with``.
    """

    def __init__(self, port: int = PORT, *, host: str = "0.0.0.0", name: str = "ToolToCamera"):
        _pyigtl()
        self.port, self.host, self.name = checks.port(port), host, name
        self.future = 0
        self._clients: set[_Client] = set()
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> "TransformServer":
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Client(self._clients), self.host, self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._server is not None:
            self._server.close()
        for client in list(self._clients):
            client.transport.abort()
        await asyncio.sleep(0)  # lets the connections close before the event loop may end

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    def send(self, pose: Pose, captured: float | None = None) -> None:
        """Send a frame to every client, as a refusal if ``captured`` lies in the future; errors as :func:`messages`."""
        if captured is not None and (ahead := captured - now()) > _AHEAD:
            self.future += 1
            pose = Pose.refused(Status.UNCERTAIN, f"capture time {ahead:.3g} s in the future: age unknown")
            captured = None
        data = messages(pose, captured, name=self.name)
        for client in self._clients:
            client.offer(data)


class _Client(Newest, asyncio.Protocol):
    def __init__(self, clients: set["_Client"]):
        super().__init__()
        self._clients = clients

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        # A small buffer, so that old frames do not queue in the system; asyncio has set TCP_NODELAY.
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        self._clients.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._clients.discard(self)


def _pyigtl() -> Any:
    try:
        return importlib.import_module("pyigtl")
    except ImportError as error:
        raise ImportError("OpenIGTLink needs pyigtl; run: pip install 'holotorch[slicer]'", name="pyigtl") from error
