"""What ``holotorch stream`` calls: addresses, recorded poses, the self-test."""

import asyncio
import csv
import io
import signal
import socket
import threading
import time

import pytest
import torch

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.streaming import stream as module
from holotorch.experiments.streaming.check import check
from holotorch.experiments.streaming.stream import address, read_poses, replay, statistics_text, stream, view
from holotorch.experiments.tracking.report import COLUMNS, Tracked, row
from holotorch.io.video import Frame
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import PosePacket, decode, now
from holotorch.tracking.streaming.stream import PoseReceiver


def pose(x: float, status: Status = Status.OK) -> Pose:
    chi, freedom = torch.tensor([0.5, 1.0], dtype=torch.float64)
    tip, direction = torch.tensor([[x, -1 / 3, 0.5], [0.6, 0, -0.8]], dtype=torch.float64)
    half = torch.arange(36, dtype=torch.float64).reshape(6, 6) * 1e-9
    return Pose(tip, direction, half + half.T, chi, freedom, status, "" if status is Status.OK else 'no, "check"')


REFUSED = Pose.refused(Status.NO_CATHETER, "no bands")
POSES = [(10.0, pose(0.1)), (10.02, REFUSED), (10.04, pose(0.2, Status.UNVERIFIED)), (10.06, pose(0.3))]


def write(path, poses=POSES):
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for i, (seconds, each) in enumerate(poses):
        table.writerow(row(Tracked(i, Frame(seconds, None, ""), each, 0.0, {})))
    path.write_text(text.getvalue())
    return path


def test_recorded_poses_come_back_to_the_last_digit(tmp_path):
    found = read_poses(write(tmp_path / "poses.csv"))
    assert [time for time, _ in found] == [time for time, _ in POSES]
    for (_, before), (_, after) in zip(POSES, found, strict=True):
        assert (after.status, after.reason) == (before.status, before.reason)
        for name in ("tip", "direction", "chi_square"):
            torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=0, atol=0, equal_nan=True)
        known, unknown = after.covariance[:3, :3], after.covariance[3:]
        torch.testing.assert_close(known, before.covariance[:3, :3], rtol=0, atol=0, equal_nan=True)
        if after.answered:
            assert torch.equal(unknown, torch.eye(6, dtype=torch.float64)[3:])


def test_what_is_wrong_in_a_file_is_said_with_its_line(tmp_path):
    path = write(tmp_path / "poses.csv")
    lines = path.read_text().splitlines()

    def refused(message, *changed):
        path.write_text("\n".join(changed))
        with pytest.raises(ConfigError, match=message):
            read_poses(path)

    refused("poses.csv: not a table of poses, columns status", lines[0].replace("status", "state"))
    refused("poses.csv: no poses in it", lines[0])
    refused("poses.csv:3: time_s must rise", lines[0], lines[1], lines[1])
    refused("poses.csv:2: cannot be read as a pose: 'FINE'", lines[0], lines[1].replace("OK", "FINE"))
    refused("poses.csv:2: .* time_s is nan", lines[0], lines[1].replace("10.0", "nan", 1))
    refused("poses.csv:2: .* could not convert", lines[0], lines[1].replace("0.6", "left"))
    refused("poses.csv:2: .* not all its numbers are finite", lines[0], lines[1].replace("0.6", "nan"))
    refused("poses.csv:2: cannot be read", lines[0], "10.0,OK,1")
    refused("poses.csv:3: .* the line is cut off", *lines[:2], lines[2][: lines[2].index("bands")])
    refused("poses.csv:2: .* a unit direction", lines[0], lines[1].replace("0.6", "0.5"))
    refused("poses.csv:2: .* within 100 m", lines[0], lines[1].replace(",0.1,", ",100.1,"))
    with pytest.raises(ConfigError, match="No such file"):
        read_poses(tmp_path / "none.csv")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="poses.csv: no poses.csv as holotorch track writes it: not a text file"):
        read_poses(path)


def test_addresses():
    assert address("10.0.0.7:5005") == ("10.0.0.7", 5005)
    assert address("headset") == ("headset", 18950)
    assert address("[::1]:7") == ("::1", 7) and address("[::1]") == ("::1", 18950)
    for bad in ("", ":5", "host:", "host:0", "host:port", "::1", "::1:7"):
        with pytest.raises(ConfigError, match="expected HOST:PORT"):
            address(bad)
    assert address("host:65535") == ("host", 65535)
    with pytest.raises(ConfigError, match="expected a port from 1 to 65535, got 65536 in 'host:65536'"):
        address("host:65536")
    assert socket.inet_aton(module.own_address())


def test_replay_keeps_order_and_distances_in_time():
    start = now()
    found = list(replay(POSES))
    assert [pose for _, pose in found] == [pose for _, pose in POSES]
    times = [time for time, _ in found]
    assert start <= times[0] <= now()
    # Multiples of 2.4e-7 s, the spacing of numbers near 1.7e9.
    assert [time - times[0] for time in times] == pytest.approx([0, 0.02, 0.04, 0.06], abs=1e-6)
    times = [time for time, _ in replay(POSES, rate=200.0)]
    assert [time - times[0] for time in times] == pytest.approx([0, 0.005, 0.01, 0.015], abs=1e-6)


def test_ctrl_c_does_not_wait_for_the_next_pose(tmp_path, monkeypatch):
    """It is due in a quarter of an hour; whoever waits for it in a thread is waited for."""

    def asleep(_):
        raise AssertionError("a thread cannot be woken")

    monkeypatch.setattr(time, "sleep", asleep)
    sent = []

    def send(self, pose, captured, **_):
        assert captured <= now()
        sent.append(captured)
        asyncio.get_running_loop().call_later(0.01, signal.raise_signal, signal.SIGINT)

    monkeypatch.setattr(module.PoseSender, "send", send)
    lines: list[str] = []
    path = write(tmp_path / "poses.csv", [(10.0, pose(0.1)), (910.0, pose(0.2))])
    found = stream([str(path)], ["127.0.0.1:9"], show=lines.append)
    assert (found.frames, found.complete) == (1, False)
    assert len(sent) == 1 and lines[-1] == "interrupted"


class Listener(threading.Thread):
    """A receiver in a thread of its own, as another program would be."""

    def __init__(self, wanted: int):
        super().__init__(daemon=True)
        self.wanted, self.ready, self.packets, self.lines = wanted, threading.Event(), [], []

    def run(self):
        asyncio.run(asyncio.wait_for(self.listen(), 20))

    async def listen(self):
        async with PoseReceiver(0, host="127.0.0.1") as receiver:
            taken = receiver.datagram_received

            def every(data, addr):  # next() gives the newest only
                taken(data, addr)
                self.packets += [each for each in [decode(data)] if isinstance(each, PosePacket)]

            receiver.datagram_received, self.port = every, receiver.port
            self.ready.set()
            while len(self.packets) < self.wanted:
                await asyncio.sleep(0.005)
            self.lines = [module._line(receiver), *statistics_text(receiver)]
            await asyncio.sleep(0.3)  # a reply to a clock request still finds the socket open


def heard(sources, wanted, **options):
    listener, lines = Listener(wanted), []
    listener.start()
    listener.ready.wait(20)
    found = stream(sources, [f"127.0.0.1:{listener.port}"], show=lines.append, **options)
    listener.join(20)
    assert not listener.is_alive()
    assert found.complete and found.delivered
    return found.frames, listener, lines


def test_a_recording_reaches_a_receiver(tmp_path):
    count, listener, lines = heard([str(write(tmp_path / "poses.csv"))], 4, rate=50.0)
    assert count == 4 and [packet.sequence for packet in listener.packets] == [0, 1, 2, 3]
    for (_, before), packet in zip(POSES, listener.packets, strict=True):
        assert packet.pose.status is before.status and packet.lag == 0
        torch.testing.assert_close(packet.pose.tip, before.tip, rtol=0, atol=0, equal_nan=True)
    assert lines[-2:] == ["Frames     4", f"Receiver   127.0.0.1:{listener.port}: 4 sent, 0 dropped for newer"]
    assert "camera_from_tool tip 300.0, -333.3, 500.0 mm" in listener.lines[0]
    assert listener.lines[1] == "Received   4, lost 0, reordered 0, repeated 0"
    assert listener.lines[2].startswith("Of these   refused 1")


def headset_file(path, shift, frame="headset", covariance=1e-8):
    rows = [[0, 0, 1, shift], [0, 1, 0, -0.05], [-1, 0, 0, 0.02], [0, 0, 0, 1]]
    lines = [f"headset_from_camera: {rows}", f"frame: {frame}"]
    if covariance:
        lines.append(f"covariance: {[[covariance * (i == j) for j in range(6)] for i in range(6)]}")
    path.write_text("\n".join(lines))
    return path


def test_every_receiver_gets_poses_in_the_frame_of_its_own_headset(tmp_path):
    path, listeners, lines = str(write(tmp_path / "poses.csv")), [Listener(4) for _ in range(3)], []
    own, all_ = headset_file(tmp_path / "own.yaml", 0.1), headset_file(tmp_path / "all.yaml", 0.2, "world", 0)
    for listener in listeners:
        listener.start()
        listener.ready.wait(20)
    first, second, third = (f"127.0.0.1:{listener.port}" for listener in listeners)
    assert stream([path], [first, f"{second}={own}", third], rate=50.0, headset=all_, show=lines.append).delivered
    for listener in listeners:
        listener.join(20)
    for listener, name, shift in zip(listeners, ("world", "headset", "world"), (0.2, 0.1, 0.2), strict=True):
        assert [packet.frame for packet in listener.packets] == [f"{name}_from_tool"] * 4
        for (_, before), packet in zip(POSES, listener.packets, strict=True):
            assert packet.pose.status is before.status and packet.pose.reason == before.reason
            x, y, z = before.tip
            torch.testing.assert_close(packet.pose.tip, torch.stack([z + shift, y - 0.05, 0.02 - x]), equal_nan=True)
            if before.answered:
                added = 3e-8 * (1 + float(2 / 3 * packet.pose.tip.square().sum())) if name == "headset" else 0
                known = before.covariance[:3, :3].trace() + added
                torch.testing.assert_close(packet.pose.covariance[:3, :3].trace(), known)
    assert "Frame      world_from_tool, of unknown accuracy" in lines and "Frame      headset_from_tool" in lines


def test_a_headset_file_that_is_none_is_said(tmp_path):
    path = str(write(tmp_path / "poses.csv"))
    with pytest.raises(ConfigError, match="nothing.yaml"):
        stream([path], ["127.0.0.1:9"], headset=tmp_path / "nothing.yaml")
    bad = headset_file(tmp_path / "bad.yaml", 0.1, covariance=-1e-8)
    with pytest.raises(ConfigError, match="bad.yaml:3:1: covariance: must be symmetric"):
        stream([path], [f"127.0.0.1:9={bad}"])


def nobody() -> int:
    """A UDP port of this computer on which nobody listens."""
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_packets_that_are_refused_are_not_said_to_be_sent(tmp_path):
    path, dead, lines = str(write(tmp_path / "poses.csv")), nobody(), []
    found = stream([path], [f"127.0.0.1:{dead}"], rate=50.0, show=lines.append)
    assert (found.frames, found.complete, found.delivered) == (4, True, False)
    assert lines[-1] == f"Receiver   127.0.0.1:{dead}: 0 sent, 0 dropped for newer, 4 failed: Connection refused"
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        to = [f"127.0.0.1:{dead}", f"127.0.0.1:{other.getsockname()[1]}"]
        assert stream([path], to, rate=50.0, show=lines.append).delivered
        assert lines[-1].endswith(": 4 sent, 0 dropped for newer")


def test_tracked_and_smoothed_poses_reach_a_receiver():
    def track(sources):
        assert sources == ["a.mp4", "b.mp4"]
        for i in range(4):
            threading.Event().wait(0.02)
            yield now(), pose(0.1 * i)

    count, listener, _ = heard(["a.mp4", "b.mp4"], 4, smooth=True, track=track)
    assert count == 4 and listener.packets[0].lag == 0 and all(packet.lag > 0 for packet in listener.packets[1:])
    assert 0 < float(listener.packets[1].pose.tip[0]) < 0.1


def test_openigtlink_needs_its_package_or_serves(tmp_path, monkeypatch):
    path, lines = str(write(tmp_path / "poses.csv")), []
    pytest.importorskip("pyigtl")
    assert stream([path], igtl=0, show=lines.append).frames == 4
    assert "Slicer     connects to" in lines[1]

    def missing(*_, **__):
        raise ImportError("OpenIGTLink needs pyigtl; run: pip install 'holotorch[slicer]'")

    monkeypatch.setattr(module, "TransformServer", missing)
    with pytest.raises(ConfigError, match=r"pip install 'holotorch\[slicer\]'"):
        stream([path], igtl=0, show=lines.append)


def test_impossible_orders(tmp_path):
    path = str(write(tmp_path / "poses.csv"))
    with pytest.raises(ConfigError, match="say to whom: --to HOST:PORT"):
        stream([path])
    with pytest.raises(ConfigError, match="rate must be above 0 Hz, got -1"):
        stream([path], ["127.0.0.1:9"], rate=-1.0)
    with pytest.raises(ConfigError, match="expected one poses.csv or videos to track, got nothing"):
        stream([], ["127.0.0.1:9"])
    with pytest.raises(ConfigError, match=r"got a\.mp4"):
        stream(["a.mp4"], ["127.0.0.1:9"])
    with pytest.raises(ConfigError, match="no way to no such host:9"):
        stream([path], ["no such host:9"])
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        with pytest.raises(ConfigError, match="is in use, by another receiver perhaps"):
            view(other.getsockname()[1])

    def unreadable(_):
        raise FileNotFoundError(2, "No such file", "a.mp4")
        yield

    with pytest.raises(FileNotFoundError):
        stream(["a.mp4"], ["127.0.0.1:9"], track=unreadable, show=[].append)


def test_view_says_when_nothing_comes():
    lines: list[str] = []
    view(0, seconds=0.05, show=lines.append)
    assert lines[0].startswith("Listening  at ") and lines[1] == "nothing yet"
    assert lines[-1] == "Received   nothing; 0 unreadable packets"


def test_the_self_test_counts_what_its_bad_network_does():
    lines: list[str] = []
    check(0, packets=150, show=lines.append)
    text = "\n".join(lines)
    # Its verdict on the latency depends on the machine; the counts do not.
    for name in ("receiver 1", "receiver 2"):
        assert f"OK    {name}: 150 of 150 packets, 3 refusals" in text
        assert f"{name}: added latency median " in text and f"OK    {name}: clock offset" in text
    (lossy,) = [line for line in lines if "lossy path" in line]
    assert lossy.startswith("OK    lossy path: of 150 packets ") and "the receiver counted the same" in lossy
    dropped, overtaken = (int(lossy.split(word)[0].split()[-1]) for word in (" lost", " reordered"))
    # 150 draws of 20 %: 30 +- 4.9; of 10 %: 15 +- 3.7, a few of them let go with none in between.
    assert abs(dropped - 30) < 4 * 4.9 and 0 < overtaken <= 15 + 4 * 3.7


def test_the_self_test_names_a_port_that_is_taken():
    lines: list[str] = []
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        assert not check(other.getsockname()[1], packets=2, show=lines.append)
        assert f"FAIL  port: UDP port {other.getsockname()[1]} is in use" in lines[0] and "--port" in lines[0]
