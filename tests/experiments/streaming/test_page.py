"""The server of the page: what it sends, whom it refuses, and what a bad page cannot do to it."""

import asyncio
import csv
import json
import math
import re
import threading
from pathlib import Path

import aiohttp
import pytest
import torch
from hypothesis import example, given, strategies

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.streaming import page as module
from holotorch.experiments.streaming import stream as streaming
from holotorch.experiments.streaming.aligning import Aligner
from holotorch.experiments.streaming.opening import open_page
from holotorch.experiments.streaming.page import PageServer
from holotorch.experiments.streaming.stream import stream
from holotorch.experiments.tracking.devices import save_camera
from holotorch.experiments.tracking.report import COLUMNS, Tracked, row
from holotorch.io.recording import Recorder
from holotorch.io.video import Frame
from holotorch.tracking import THESIS, Camera
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now

MATRIX = torch.tensor([[800.0, 0, 319.5], [0, 790, 239.5], [0, 0, 1]], dtype=torch.float64)
CAMERA = Camera(MATRIX, torch.zeros(5, dtype=torch.float64), "srgb", (480, 640))


def pose(x: float, status: Status = Status.OK) -> Pose:
    tip, direction = torch.tensor([[x, -0.02, 0.5], [0.6, 0, -0.8]], dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    return Pose(tip, direction, torch.eye(6, dtype=torch.float64) * 1e-6, zero, zero, status)


REFUSED = Pose.refused(Status.NO_CATHETER, 'no "bands" <b>')


def served(test, **options):
    """Run ``test(server, session)`` beside an open server."""

    async def run():
        async with PageServer(THESIS, CAMERA, port=0, **options) as server, aiohttp.ClientSession() as session:
            await asyncio.wait_for(test(server, session), 30)

    asyncio.run(run())


async def next_pose(socket) -> dict:
    while (message := json.loads(await socket.receive_str()))["kind"] != "pose":
        pass
    return message


def test_a_page_gets_the_catheter_the_newest_pose_and_the_clock():
    async def test(server, session):
        async with session.get(server.address) as answer:
            text = await answer.text()
            assert answer.status == 200 and re.findall(r"src=\S+", text) == ['src="view.js"></script>']
            assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        scripts, seen = ["view.js"], set()
        while scripts:  # all scripts are our own, and each that is imported is served
            name = scripts.pop()
            async with session.get(server.address + name) as answer:
                assert answer.status == 200 and answer.content_type == "text/javascript"
                text += await answer.text()
            seen.add(name)
            scripts += set(re.findall(r'from "\./(\w+\.js)"', text)) - seen
        assert len(seen) > 5 and not re.search(r"https?://|@import|import\(", text)
        server.send(pose(0.1), 10.0)
        server.send(pose(0.2), 10.1)
        async with session.ws_connect(server.address + "poses") as socket:
            setup = json.loads(await socket.receive_str())
            assert setup["kind"] == "setup" and setup["frame"] == "camera_from_tool"
            assert setup["camera"] == {"fx": 800, "fy": 790, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
            assert setup["catheter"]["edges"] == list(THESIS.edges) and len(setup["catheter"]["colours"]) == 3
            first = await next_pose(socket)  # an old page begins with what is newest
            assert (first["sequence"], first["tip"][0], first["captured"]) == (1, 0.2, 10.1)
            server.send(REFUSED, 10.2)
            second = await next_pose(socket)
            assert (second["status"], second["answered"], second["reason"]) == ("NO_CATHETER", False, 'no "bands" <b>')
            assert "tip" not in second
            before = now()
            await socket.send_str(json.dumps({"kind": "clock", "asked": 5.0}))
            reply = json.loads(await socket.receive_str())
            assert reply["asked"] == 5.0 and before <= reply["now"] <= now()
            assert server.clients == 1
        with pytest.raises(ValueError, match="JSON compliant"):
            server.send(pose(math.nan), 10.3)
        with pytest.raises(TypeError, match="one pose at a time"):
            tensors = [torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2, 6, 6), torch.zeros(2), torch.zeros(2)]
            server.send(Pose(tensors[0], tensors[1], tensors[2], tensors[3], tensors[4], (Status.OK,) * 2), 1.0)

    served(test)


def test_other_hosts_other_sites_and_other_paths_are_refused():
    async def test(server, session):
        for headers, status in (
            ({"Host": "evil.example"}, 403),  # a name that its owner points at this computer
            ({"Origin": "http://evil.example"}, 403),
            ({"Origin": f"http://127.0.0.1:{server.port}"}, 200),
            ({"Host": f"localhost:{server.port}"}, 200),
        ):
            async with session.get(server.address, headers=headers) as answer:
                assert answer.status == status
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await session.ws_connect(server.address + "poses", headers={"Origin": "http://evil.example"})
        for path in ("../../../etc/passwd", "..%2f..%2fetc%2fpasswd", "page.py", "static/page.html"):
            async with session.get(server.address + path) as answer:
                assert answer.status == 404
        async with session.post(server.address, data=b"x") as answer:
            assert answer.status == 405

    served(test)


def test_other_computers_need_the_token():
    async def test(server, session):
        bare = f"http://127.0.0.1:{server.port}/"
        async with session.get(bare + "view.js") as answer:
            assert answer.status == 200  # browsers ask for scripts without the token; there is nothing secret in them
        async with session.get(bare + "volume") as answer:
            assert answer.status == 403
        assert len(server.token) > 20 and server.address.endswith(f"?token={server.token}")
        for query, status in (("", 403), ("?token=", 403), ("?token=%00é", 403), (f"?token={server.token}", 200)):
            async with session.get(bare + query) as answer:
                assert answer.status == status
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await session.ws_connect(bare + "poses")
        async with session.ws_connect(f"{bare}poses?token={server.token}") as socket:
            assert json.loads(await socket.receive_str())["kind"] == "setup"

    served(test, host="0.0.0.0")


def test_nonsense_is_dropped_and_counted_and_too_much_ends_the_connection():
    nonsense = ["", "{", "[1]", "null", "7", '{"kind": "clock"}', '{"kind": "clock", "asked": NaN}', '{"asked": 1}',
                '{"kind": "clock", "asked": "x"}', '{"kind": "pose", "asked": 1}', "[" * 3000, "\\ud800"]  # fmt: skip

    async def test(server, session):
        async with session.ws_connect(server.address + "poses") as socket:
            await socket.receive_str()
            for text in nonsense:
                await socket.send_str(text)
            await socket.send_bytes(b"\x00\xff")
            await socket.send_str(json.dumps({"kind": "clock", "asked": 1.0}))
            assert json.loads(await socket.receive_str())["kind"] == "clock"
            assert server.malformed == len(nonsense) + 1
            await socket.send_str("x" * 5000)
            assert (await socket.receive()).type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED)
        while server.clients:
            await asyncio.sleep(0.01)

    served(test)


JSON = strategies.recursive(
    strategies.none() | strategies.booleans() | strategies.integers()
    | strategies.floats() | strategies.text(),
    lambda inner: strategies.lists(inner) | strategies.dictionaries(
        strategies.sampled_from(["kind", "asked", "tip", "direction"]),
        inner | strategies.sampled_from(["clock", "aligned", "undo", "save"]),
    ),
)  # fmt: skip


@given(strategies.text() | JSON.map(json.dumps))
@example('{"kind": "clock", "asked": 1' + 400 * "0" + "}")
@example('{"kind": "aligned", "tip": [0, 0, 1e400], "direction": [0, 0, 1]}')
@example('{"kind": "aligned", "tip": [0, 0, 1], "direction": [0, 0, 0]}')
@example('{"kind": "aligned", "tip": "abc", "direction": [0, 0, 1]}')
@example('{"kind": "aligned", "tip": [[0], 0, 1], "direction": [0, 0, 1]}')
@example('{"kind": ["save"]}')
@example('{"kind": "save"}')
def test_no_message_of_a_page_raises(text):
    for aligner in (None, Aligner(Path("/nonexistent/headset.yaml"))):
        reply = PageServer(THESIS, aligner=aligner)._reply(text)
        if reply is not None:
            answer = json.loads(reply)
            assert answer["kind"] == "clock" or (aligner is not None and answer["kind"] == "alignment")
            assert answer["kind"] != "clock" or (math.isfinite(answer["asked"]) and math.isfinite(answer["now"]))


def test_a_page_that_reads_nothing_is_cut_off_and_delays_nobody(monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE", 0.3)

    async def test(server, session):
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port, limit=1024)
        request = (
            f"GET /poses HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        )
        writer.write(f"{request}Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n\r\n".encode())
        async with session.ws_connect(server.address + "poses") as socket:
            while server.clients < 2:
                await asyncio.sleep(0.01)
            long = Pose.refused(Status.NO_CATHETER, "x" * 60_000)
            read = 0
            for _ in range(400):
                server.send(long, now())
                await asyncio.sleep(0.005)
                if server.clients == 1:
                    break
                await next_pose(socket)
                read += 1
            assert server.clients == 1 and read > 5
            server.send(pose(0.3), now())
            while not (last := await next_pose(socket))["answered"]:
                pass
            assert last["tip"][0] == 0.3
        reader.feed_eof()
        writer.close()

    served(test)


def test_a_stream_is_shown_on_a_page(tmp_path):
    """From a run folder, whose files of camera and catheter the page takes, in the frame of the camera."""
    save_camera(tmp_path / "camera.yaml", CAMERA, CAMERA.size)
    seen: list[dict] = []

    def track(sources):
        for i in range(300):
            yield now() + 0.02, pose(1e-3 * i)
            if len(seen) > 4:
                return

    server = open_page(str(tmp_path / "poses.csv"), place="127.0.0.1:1")
    assert server.port == 1
    server.port = 0

    async def watch():
        async with aiohttp.ClientSession() as session:
            while len(seen) < 5:
                try:
                    socket = await session.ws_connect(server.address + "poses")
                except (aiohttp.ClientError, OSError):
                    await asyncio.sleep(0.05)
                    continue
                seen.append(json.loads(await socket.receive_str()))
                while len(seen) < 5:
                    seen.append(await next_pose(socket))
                await socket.close()

    watcher = threading.Thread(target=lambda: asyncio.run(asyncio.wait_for(watch(), 20)), daemon=True)
    watcher.start()
    lines: list[str] = []
    found = stream(["video.mp4"], page=server, track=track, show=lines.append)
    watcher.join(20)
    assert found.delivered and lines[1] == f"Page       {server.address}"
    assert seen[0]["camera"]["fx"] == 800 and [message["answered"] for message in seen[1:]] == [True] * 4


def test_a_stream_for_a_page_alone_begins_with_the_first_browser(tmp_path):
    server = replayed(tmp_path, [pose(1e-3 * i) for i in range(5)])
    server.port, events = 0, []

    async def watch():
        async with aiohttp.ClientSession() as session:
            await asyncio.sleep(0.3)
            events.append("browser")
            async with session.ws_connect(server.address + "poses") as socket:
                await socket.receive_str()
                async for _ in socket:  # until the stream ends
                    pass

    send, waiting = server.send, threading.Event()
    server.send = lambda *words, **names: events.append("pose") or send(*words, **names)
    watcher = threading.Thread(target=lambda: waiting.wait(20) and asyncio.run(watch()), daemon=True)
    watcher.start()

    def show(line: str) -> None:
        if line == "Waiting    for a browser that opens the page":
            waiting.set()

    options = {"page": server, "await_browser": True, "rate": 200, "show": show}
    assert stream([str(tmp_path / "poses.csv")], **options).complete
    assert events == ["browser", *["pose"] * 5]


def test_the_command_replays_a_run_on_a_page_until_it_is_interrupted(tmp_path, monkeypatch, capsys):
    given = {}

    def streamed(sources, to, **options):
        given.update(options, sources=sources, to=to)
        return streaming.Streamed(3, True, True)

    monkeypatch.setattr(streaming, "stream", streamed)
    (tmp_path / "poses.csv").touch()
    assert main(["stream", "--view", "--replay", str(tmp_path), "--page", "127.0.0.1:4321"]) == 0
    assert given["sources"] == [str(tmp_path / "poses.csv")] and given["repeat"] and not given["to"]
    assert given["page"].port == 4321 and not given["page"].token
    assert main(["stream", "--view", "--page", "127.0.0.1"]) == 2
    assert "it takes no --page" in capsys.readouterr().err
    assert main(["stream", "a.csv", "--to", "127.0.0.1"]) == 0 and given["page"] is None and not given["repeat"]


def replayed(tmp_path: Path, poses: list[Pose]) -> PageServer:
    """The page of a run of ``track`` with these poses."""
    save_camera(tmp_path / "camera.yaml", CAMERA, CAMERA.size)
    with open(tmp_path / "poses.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for i, each in enumerate(poses):
            frame = Frame(i / 20, torch.zeros(3, 1, 1, dtype=torch.uint8))
            table.writerow(row(Tracked(i, frame, each, 0.0, {})))
    return open_page(str(tmp_path / "poses.csv"))


@pytest.mark.parametrize("folder", ["recording", "synthetic"])
def test_a_replay_shows_each_pose_over_its_recorded_frame(tmp_path, folder):
    given = [pose(0.01), REFUSED, pose(0.03), pose(0.04)]
    with Recorder(tmp_path / folder, (480, 640), 20.0, "a camera") as recorder:
        for i in range(3):  # cut off before the last pose
            recorder.write(Frame(i / 20, torch.full((3, 480, 640), i, dtype=torch.uint8)))
    server = replayed(tmp_path, given)
    server.port, seen, sent = 0, [], []
    server.see = lambda pixels, pose, captured: seen.append((int(pixels[0, 0, 0]), pose.status, captured))
    server.send = lambda pose, captured, **_: sent.append((pose.status, captured)) or 0
    assert stream([str(tmp_path / "poses.csv")], page=server, rate=200, show=lambda _: None).complete
    assert len(sent) == 4 and seen == [(i, *sent[i]) for i in range(3)]
    assert json.loads(server._setup())["empty"] == ""


def test_a_replay_without_frames_says_why_none_are_shown(tmp_path):
    server = replayed(tmp_path, [pose(0.01)])
    server.port = 0
    assert stream([str(tmp_path / "poses.csv")], page=server, show=lambda _: None).complete
    assert "holotorch track with --record keeps them" in json.loads(server._setup())["empty"]


def test_a_replay_of_another_kind_of_run_is_refused(tmp_path, capsys):
    (tmp_path / "summary.json").write_text('{"experiment": "pec"}')
    assert main(["stream", "--view", "--replay", str(tmp_path)]) == 2
    words = "holds a run of kind pec without poses.csv; --replay takes a run of track"
    assert capsys.readouterr().err == f"{tmp_path} {words}\n"


def test_what_a_page_cannot_be_opened_with_is_said(tmp_path):
    with pytest.raises(ConfigError, match="expected HOST:PORT"):
        open_page("a.mp4", place="::1")
    with pytest.raises(ConfigError, match="no file .*cert.pem"):
        open_page("a.mp4", tls=[tmp_path / "cert.pem", tmp_path / "key.pem"])
    assert open_page("a.mp4", place="10.0.0.3").port == 8765
