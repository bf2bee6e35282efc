"""Targets: datagrams of poses and clocks, the table of poses that is sent again, and logs of studies.

OpenIGTLink has no target: its server sends, and reads nothing of what a client says.
"""

import json
import math
import struct
import zlib
from pathlib import Path
from random import Random

import torch
from fuzz.commands import command
from fuzz.engine import Input, Refused, Target
from fuzz.mutate import mutated
from fuzz.mutate_tree import json_mutated, table_mutated
from paths import CONFIGS

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.log import TrialLog, read_log
from holotorch.experiments.streaming.stream import _line, read_poses, statistics_text
from holotorch.experiments.tracking.report import COLUMNS, Tracked, row
from holotorch.io.video import Frame
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import Echo, PosePacket, encode
from holotorch.tracking.streaming.stream import PoseReceiver

_START = 1.7e9  # seconds since 1970
_SENDER = ("127.0.0.1", 9)
_STREAM = 7
_DOUBLES = (math.nan, math.inf, -math.inf, -0.0, 1e308, -1e308, 5e-324, 1.0, 100.1, _START, _START + 1, _START + 1e9)
_WHOLE = (0, 1, 2, 255, 2**15, 2**16 - 1, 2**31, 2**32 - 1, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
# Offset and format of the fields of a pose's datagram, from the table in ``holotorch.tracking.streaming.packet``.
_FIELDS = (
    *((4, "<H"), (6, "<B"), (7, "<B"), (8, "<Q"), (16, "<Q"), (24, "<d"), (32, "<d"), (80, "<H"), (82, "<H")),
    *((84, "<f"), (384, "<d")),
    *((place, "<d") for place in range(88, 384, 8)),
)


def _pose(depth: float = 0.5) -> Pose:
    one = torch.ones((), dtype=torch.float64)
    tip, direction = torch.tensor([[0, 0, depth], [0.6, 0, -0.8]], dtype=torch.float64)
    return Pose(tip, direction, torch.eye(6, dtype=torch.float64) * 1e-8, one, one, Status.OK)


def _sent(number: int, stream: int, at: float, pose: Pose) -> bytes:
    return encode(PosePacket(pose, at - 0.01, at, number, stream))


def _packets(_: Path) -> list[Input]:
    refusal = Pose.refused(Status.NO_CATHETER, "nothing of the bands' colours")
    stream = [_sent(n, _STREAM, _START + n / 50, _pose() if n != 2 else refusal) for n in range(6)]
    clocks = [encode(Echo(3, 4, _START)), encode(Echo(3, 4, _START, _START + 1, _START + 1.001, reply=True))]
    other = [_sent(n, 8, _START + n / 50, _pose(0.7)) for n in range(3)]
    return [{f"{n}.bin": data for n, data in enumerate(part)} for part in (stream, stream[:2] + clocks, other + stream)]


def _packet_mutated(rng: Random, made: Input, other: Input) -> Input:
    """Some of the datagrams changed, mostly with a checksum that fits; some lost, repeated or out of order."""
    packets = [data for _, data in sorted(made.items(), key=lambda item: int(item[0][:-4]))]
    for _ in range(rng.choice((1, 1, 2, 4))):
        place = rng.randrange(len(packets))
        data = packets[place]
        data = _field_changed(rng, data) if rng.random() < 0.6 else mutated(rng, data, rng.choice(list(other.values())))
        packets[place] = data[:-4] + struct.pack("<I", zlib.crc32(data[:-4])) if rng.random() < 0.85 else data
        if rng.random() < 0.3:
            packets.insert(rng.randrange(len(packets)), rng.choice(packets))
        if rng.random() < 0.2:
            rng.shuffle(packets)
    return {f"{n}.bin": data[:70_000] for n, data in enumerate(packets)}


def _field_changed(rng: Random, data: bytes) -> bytes:
    place, form = rng.choice(_FIELDS)
    size = struct.calcsize(form)
    if place + size > len(data):
        return data
    if form[1] in "df":
        value = rng.choice(_DOUBLES)
        value = value if form == "<d" or not abs(value) > 1e38 else math.inf
    else:
        value = rng.choice(_WHOLE) % 2 ** (8 * size)
    return data[:place] + struct.pack(form, value) + data[place + size :]


class _Transport:
    def sendto(self, data: bytes, _: object) -> None:
        assert len(data) == 52, "a receiver sends nothing but requests of a clock"


def _received(folder: Path) -> None:
    """What a receiver makes of the datagrams; a genuine sender is followed again after them, whatever they said."""
    time = [_START]
    receiver = PoseReceiver(0, clock=lambda: time[0])
    receiver.connection_made(_Transport())
    for path in sorted(folder.glob("*.bin"), key=lambda path: int(path.stem)):
        time[0] += 0.02
        receiver.datagram_received(path.read_bytes(), _SENDER)
        age, newest = receiver.age(), receiver.latest()  # in this order: time passes between them
        assert newest is None or (newest.answered and 0 <= age <= receiver.oldest)
        _told(receiver)
    invalid, last = receiver.statistics.invalid, receiver.statistics.last_error
    # Five, as a sender's own clock is compared while it sends: three are needed to be followed.
    receiver._arrived_monotonic -= 60.0
    for number in range(1000, 1005):
        time[0] += 0.02 if number > 1000 else 60.0
        receiver.datagram_received(_sent(number, 99, time[0], _pose()), _SENDER)
    newest = receiver.latest()
    assert newest is not None and newest.sequence == 1004, "a genuine sender is locked out"
    _told(receiver)
    if invalid:
        raise Refused(last)


def _told(receiver: PoseReceiver) -> None:
    text = "\n".join([_line(receiver), *statistics_text(receiver)])
    assert text.replace("\n", "").isprintable()  # nothing of a packet commands a terminal
    assert receiver.statistics.lost >= 0 and math.isfinite(receiver.statistics.jitter)


_SEEN = {"size_deg": 5.0, "eccentricity_deg": 0.0, "reaction_s": 0.5, "response_s": 2.0}


def _table(_: Path) -> list[Input]:
    poses = [_pose(), Pose.refused(Status.NO_AXIS, 'a "reason", with a comma'), _pose(0.6)]
    rows = [row(Tracked(n, Frame(n / 25, None), pose, 0.0, {})) for n, pose in enumerate(poses)]
    text = "\n".join(",".join(f'"{cell.replace(chr(34), chr(34) * 2)}"' for cell in line) for line in [COLUMNS, *rows])
    return [{"poses.csv": text.encode() + b"\n"}]


def _poses(folder: Path) -> None:
    for captured, pose in read_poses(folder / "poses.csv"):
        encode(PosePacket(pose, max(captured, 0.0), max(captured, 0.0), 0))


HEADER = {"participant": 3, "design": "ab12", "simulated": True}
_TRIAL = {
    **{"participant": 3, "round": 1, "target": True, "practice": False, "responded": True, "design": "ab12"},
    **{"time_utc": "2020-01-01T00:00:00Z", "pattern": "cross", "onset_s": 1.0, "frame_s": 1 / 60, "side": "left"},
}


def _logs(_: Path) -> list[Input]:
    """Logs of three participants, with targets of three sizes at two eccentricities."""
    made: Input = {}
    for person in (1, 2, 3):
        lines = [{"format": "holotorch-trials", "version": 1, **HEADER, "participant": person}]
        shown = [(e, s) for _ in range(4) for e in (10.0, 40.0, 55.0, 70.0) for s in (5.0, 10.0, 20.0)]
        for n, (eccentricity, size) in enumerate(shown):
            time = 0.4 + eccentricity / 400 - size / 200 + 0.01 * (n % 5) + 0.02 * person
            where = {"trial": n + 1, "eccentricity_deg": eccentricity, "size_deg": size, "participant": person}
            lines.append(_TRIAL | where | {"reaction_s": time, "response_s": 1 + time})
        made[f"participant-{person:03}.jsonl"] = "".join(json.dumps(line) + "\n" for line in lines).encode()
    return [made]


def _log_mutated(rng: Random, made: Input, other: Input) -> Input:
    """Values of one line, numbers that a trial may hold in some of them, or bytes of the file."""
    name = rng.choice(list(made))
    if (kind := rng.random()) < 0.5:
        return made | {name: _renumbered(rng, made[name])}
    if kind < 0.7:
        return made | {name: mutated(rng, made[name], other[name], (b"NaN", b"1e999", b"\\ud800", b"[" * 100_000))}
    lines = made[name].split(b"\n")
    place = rng.randrange(len(lines) - 1)
    lines[place] = json_mutated(rng, lines[place], lines[-2]).replace(b"\n", b" ")
    return made | {name: b"\n".join(lines)}


def _renumbered(rng: Random, data: bytes) -> bytes:
    """One field of one, some or all trials as another number, or true for false."""
    head, *lines = data.splitlines()
    trials = [json.loads(line) for line in lines]
    field = rng.choice(("reaction_s", "frame_s", "eccentricity_deg", "size_deg", "onset_s", "participant", "trial"))
    field = rng.choice((field, field, "target", "practice", "responded"))
    values = (0, 1, -1, 1e-300, 1e-9, 0.1, 0.3, 2.0, 90, 180.0, 1e9, 1e299, 10**18, 10**400, True, False, None)
    share, value = rng.choice((0.01, 0.1, 1.0)), rng.choice(values)
    for trial in trials:
        if rng.random() < share:
            trial[field] = value
            if field == "responded" and not value:
                trial |= {"reaction_s": None, "response_s": None}
    return b"\n".join([head, *(json.dumps(trial).encode() for trial in trials), b""])


def _log(folder: Path) -> None:
    path = folder / "participant-003.jsonl"
    for each in folder.iterdir():
        read_log(each)
    with TrialLog(path, HEADER) as log:
        log.append(_TRIAL | _SEEN | {"trial": 999})
    assert read_log(path).trials[-1]["trial"] == 999


def _analysed(folder: Path) -> None:
    words = [f"logs=['{folder}']", "resamples=100", "power=null", "targets=[{seconds: 0.45}]"]
    command("run", str(CONFIGS / "perception/analysis.yaml"), *words, "--out", str(folder / "out"))


TARGETS = [
    Target("packets", _packets, _packet_mutated, _received, (Refused,)),
    Target(
        "poses",
        _table,
        lambda rng, made, other: {"poses.csv": table_mutated(rng, made["poses.csv"], other["poses.csv"])},
        _poses,
        (ConfigError,),
    ),
    Target("logs", _logs, _log_mutated, _log, (ConfigError,)),
    Target("analysis", _logs, _log_mutated, _analysed, (Refused,)),
]
