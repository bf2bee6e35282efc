"""OpenIGTLink as pyigtl's own client reads it, and against the bytes of the specification."""

import asyncio
import importlib
import struct
import subprocess
import sys
import time

import pytest
import torch

from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.igtl import TransformServer, _Client, messages

HOME = "127.0.0.1"


def pose(x: float = 0.01, status: Status = Status.OK, reason: str = "") -> Pose:
    one = torch.ones((), dtype=torch.float64)
    tip, direction = torch.tensor([[x, -0.02, 0.52], [0.6, 0, -0.8]], dtype=torch.float64)
    return Pose(tip, direction, torch.eye(6, dtype=torch.float64) * 1e-8, one, one, status, reason)


@pytest.fixture
def pyigtl():
    return pytest.importorskip("pyigtl", reason="pip install 'holotorch[slicer]'")


def parts(data: bytes) -> list[tuple]:
    """Type, name, stamp in seconds and body of each message, from the table of the specification."""
    found = []
    while data:
        version, kind, name, stamp, size, _ = struct.unpack_from(">H12s20sQQQ", data)
        assert version == 1
        found.append((kind.rstrip(b"\0"), name.rstrip(b"\0"), stamp / 2**32, data[58 : 58 + size]))
        data = data[58 + size :]
    return found


def test_bytes_are_those_of_the_specification(pyigtl):
    given = pose(status=Status.UNVERIFIED, reason="two bands – no check")
    (kind, name, stamp, body), (kind2, name2, _, text) = parts(messages(given, 1.7e9 + 0.25))
    assert (kind, name, kind2, name2) == (b"TRANSFORM", b"ToolToCamera", b"STRING", b"ToolToCameraStatus")
    assert stamp == pytest.approx(1.7e9 + 0.25, abs=1e-8 + 2**-23)  # of the capture
    columns = struct.unpack(">12f", body)  # R11, R21, R31, R12, ...: column by column
    assert columns[9:] == pytest.approx((10, -20, 520), abs=1e-4)  # millimetres, in float32
    assert columns[6:9] == pytest.approx((0.6, 0, -0.8), abs=1e-7)  # the tool's z axis, from the tip to the rear
    turn = torch.tensor(columns[:9], dtype=torch.float64).reshape(3, 3).T
    torch.testing.assert_close(turn, given.camera_from_tool[:3, :3].double(), rtol=0, atol=1e-7)
    assert text == struct.pack(">HH", 3, 32) + b"UNVERIFIED: two bands ? no check"


def test_a_refusal_has_a_status_and_no_transform(pyigtl):
    ((kind, name, _, body),) = parts(messages(Pose.refused(Status.NO_CATHETER, "no bands"), 5.0, name="Drain"))
    assert (kind, name, body[4:]) == (b"STRING", b"DrainStatus", b"NO_CATHETER: no bands")


def test_pyigtl_reads_the_stream(pyigtl):
    async def work():
        async with TransformServer(0, host=HOME) as server:
            server.send(pose(0.9), 1.0)  # before anyone listens: nobody shall get it
            client = pyigtl.OpenIGTLinkClient(HOME, server.port)
            try:
                while not server.clients:
                    await asyncio.sleep(0.005)
                for x in (0.01, 0.02):
                    server.send(pose(x), 1.7e9 + x)
                    said = await asyncio.to_thread(client.wait_for_message, "ToolToCameraStatus", 10)
                    moved = await asyncio.to_thread(client.wait_for_message, "ToolToCamera", 10)
                    assert moved.matrix[:3, 3] == pytest.approx([x * 1e3, -20, 520], abs=1e-4)
                    assert moved.timestamp == pytest.approx(1.7e9 + x, abs=1e-6) and said.string == "OK"
                server.send(Pose.refused(Status.BANDS_MISSING, "one band"), 1.7e9 + 1)
                said = await asyncio.to_thread(client.wait_for_message, "ToolToCameraStatus", 10)
                assert said.string == "BANDS_MISSING: one band"
                assert await asyncio.to_thread(client.wait_for_message, "ToolToCamera", 0) is None
            finally:
                await asyncio.to_thread(client.stop)
            deadline = time.monotonic() + 10
            while server.clients and time.monotonic() < deadline:
                server.send(pose(), 1.7e9)  # a client that has gone harms nobody
                await asyncio.sleep(0.005)
            assert server.clients == 0

    asyncio.run(asyncio.wait_for(work(), 60))


def test_a_client_that_does_not_read_delays_nobody_and_gets_the_newest(pyigtl):
    async def work():
        async with TransformServer(0, host=HOME) as server:
            lazy = await asyncio.open_connection(HOME, server.port, limit=2**10)
            quick = await asyncio.open_connection(HOME, server.port)
            while server.clients < 2:
                await asyncio.sleep(0.005)
            # pyigtl reads into memory at once; a reader of asyncio stops at its limit, and TCP then waits.
            frame, count = len(messages(pose(), 1.0)), 0
            while not any(client._waiting for client in server._clients):
                server.send(pose(), float(count))
                count += 1
                await quick[0].readexactly(frame)
                assert count < 500_000
            for _ in range(2):  # without a pause, so that the one that waits is replaced
                server.send(pose(), float(count))
                count += 1
                assert {len(client._waiting) for client in server._clients} <= {0, frame}
            await quick[0].readexactly(2 * frame)
            stamps = []
            while not stamps or stamps[-1] != count - 1:
                data = await lazy[0].readexactly(frame)
                stamps.append(parts(data)[0][2])
            assert stamps == sorted(stamps) and len(stamps) < count  # the newest came, some between did not
            for _, writer in (lazy, quick):
                writer.close()

    asyncio.run(asyncio.wait_for(work(), 60))


def test_a_waiting_transform_is_replaced_by_a_refusal():
    class Transport:
        taken: list[bytes] = []

        def is_closing(self):
            return False

        def write(self, data):
            self.taken.append(data)

    client = _Client(set())
    client.transport = Transport()
    client.pause_writing()
    client.offer(b"transform")
    client.offer(b"refusal")
    client.resume_writing()
    assert Transport.taken == [b"refusal"]


def test_impossible_input(pyigtl):
    with pytest.raises(ValueError, match="1 to 14 ASCII characters"):
        messages(pose(), 1.0, name="AToolOf15Letter")
    with pytest.raises(ValueError, match="seconds since 1970"):
        messages(pose(), -1.0)
    with pytest.raises(ValueError, match="camera_from_tool must be finite"):
        messages(pose(float("nan")), 1.0)


def test_without_pyigtl_the_line_that_installs_it_is_said(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r"pip install 'holotorch\[slicer\]'"):
        TransformServer()


def test_pyigtl_is_loaded_when_used():
    code = "import sys; import holotorch.tracking.streaming.igtl; sys.exit('pyigtl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
