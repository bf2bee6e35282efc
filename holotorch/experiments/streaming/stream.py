"""``holotorch stream``: sends recorded or tracked poses, or prints statistics of received poses."""

import asyncio
import csv
import errno
import itertools
import math
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking.devices import build_headset, headset_covariance, load_headset
from holotorch.experiments.tracking.report import COLUMNS
from holotorch.io.recording import is_recording, open_recording
from holotorch.tracking.pose.alignment import in_frame
from holotorch.tracking.pose.smoothing import OneEuro
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.igtl import TransformServer
from holotorch.tracking.streaming.packet import FRAME, PosePacket, encode, now
from holotorch.tracking.streaming.stream import PORT, PoseReceiver, PoseSender

if TYPE_CHECKING:
    from holotorch.experiments.streaming.aligning import Aligner
    from holotorch.experiments.streaming.page import PageServer

_NUMBERS = COLUMNS[5:19]  # tip, direction, covariance of the tip, chi-square and degrees of freedom
_COLUMNS = ("time_s", "status", "reason", *_NUMBERS)

Show = Callable[[str], None]  # prints a line
_at_once = partial(print, flush=True)  # into a pipe too: what waits for a browser must be read before one opens
TimedPose = tuple[float, Pose]  # capture time in seconds, and pose


@dataclass(frozen=True, eq=False)
class Frame:
    """The frame in which a receiver gets its poses."""

    name: str = FRAME  # of the matrix in the packets
    transform: str = "ToolToCamera"  # of the OpenIGTLink message
    matrix: torch.Tensor | None = None  # from the camera's frame, [4, 4]; None for the camera's frame itself
    covariance: torch.Tensor | None = None  # of ``matrix``, [6, 6]

    @classmethod
    def of(cls, path: Path | None) -> "Frame":
        """The frame of a headset file. ConfigError for a file that cannot be read."""
        if path is None:
            return cls()
        settings = load_headset(path)
        names = f"{settings.frame}_from_tool", f"ToolTo{settings.frame.capitalize()}"
        return cls(*names, build_headset(settings), headset_covariance(settings))

    def __call__(self, pose: Pose) -> Pose:
        """A pose of the camera's frame in this one."""
        return pose if self.matrix is None else in_frame(pose, self.matrix, self.covariance)


class Streamed(NamedTuple):
    """Result of a stream."""

    frames: int  # number of poses and refusals sent
    complete: bool  # whether all poses were sent; False if the user interrupted the stream
    delivered: bool  # False if all packets to all receivers failed and there was no OpenIGTLink server


def read_poses(path: Path) -> list[TimedPose]:
    """Read capture times in seconds and poses from a poses.csv of ``holotorch track``.

    The table has no covariance of the direction. The returned poses therefore state a variance of 1 for each component
    of the direction, as for an unknown unit vector.

    Raises:
        ConfigError: The file is not a poses.csv, a line cannot be read or sent, or the times do not increase.
    """
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            table = csv.DictReader(stream)
            if missing := [name for name in _COLUMNS if name not in (table.fieldnames or ())]:
                raise ConfigError([f"{path}: not a table of poses, columns {', '.join(missing[:4])} ... are missing"])
            poses: list[TimedPose] = []
            for row in table:
                try:
                    poses.append(_pose(row))
                except (KeyError, TypeError, ValueError) as error:
                    raise ConfigError([f"{path}:{table.line_num}: cannot be read as a pose: {error}"]) from None
                if len(poses) > 1 and poses[-1][0] <= poses[-2][0]:
                    raise ConfigError([f"{path}:{table.line_num}: time_s must rise from line to line"])
    except (UnicodeDecodeError, csv.Error):
        raise ConfigError([f"{path}: no poses.csv as holotorch track writes it: not a text file"]) from None
    except OSError as error:
        raise ConfigError([f"{path}: {error.strerror or error}"]) from None
    if not poses:
        raise ConfigError([f"{path}: no poses in it"])
    return poses


def _pose(row: dict[str, str]) -> TimedPose:
    if None in row.values():
        raise ValueError("the line is cut off")
    captured, status, reason = float(row["time_s"]), Status[row["status"]], row["reason"]
    if not math.isfinite(captured):
        raise ValueError(f"time_s is {captured}")
    if not status.answered:
        return captured, Pose.refused(status, reason)
    values = torch.tensor([float(row[name]) for name in _NUMBERS], dtype=torch.float64)
    if not bool(values[:12].isfinite().all()):
        raise ValueError(f"{status.name}, but not all its numbers are finite")
    covariance, (i, j) = torch.eye(6, dtype=torch.float64), torch.triu_indices(3, 3)
    covariance[i, j] = covariance[j, i] = values[6:12]
    pose = Pose(values[:3], values[3:6], covariance, values[12], values[13], status, reason)
    encode(PosePacket(pose, 0.0, 0.0, 0))  # raises for a pose that cannot be sent, so that the error names its line
    return captured, pose


def replay(poses: Sequence[TimedPose], rate: float | None = None) -> Iterator[TimedPose]:
    """Yield recorded poses, shifted in time so that the first is due now. ``rate`` in Hz replaces the recorded pace."""
    start, first = now(), poses[0][0]
    for i, (captured, pose) in enumerate(poses):
        yield start + (captured - first if rate is None else i / rate), pose


def recording_of(run: Path) -> Path | None:
    """Folder of the frames that a run of ``holotorch track`` has recorded or rendered; None without one."""
    return next((folder for folder in (run / "recording", run / "synthetic") if is_recording(folder)), None)


def _with_frames(poses: Iterable[TimedPose], recording: Path, page: "PageServer") -> Iterator[TimedPose]:
    """The poses of a replay; the page sees the recorded frame of each. ConfigError for a damaged recording."""
    try:
        frames = open_recording(recording)
    except ValueError as error:
        raise ConfigError([str(error)]) from None
    with frames:
        pictures = iter(frames)
        for captured, pose in poses:
            frame = next(pictures, None)  # the recording of an interrupted run may be shorter than its table of poses
            yield captured, pose
            if frame is not None and frame.pixels is not None:  # when it is due
                page.see(frame.pixels, pose, captured)


def stream(
    sources: Sequence[str],
    to: Sequence[str] = (),
    *,
    headset: Path | None = None,
    igtl: int | None = None,
    page: "PageServer | None" = None,
    await_browser: bool = False,
    rate: float | None = None,
    repeat: bool = False,
    smooth: bool = False,
    track: Callable[[Sequence[str]], Iterable[TimedPose]] | None = None,
    show: Show = _at_once,
) -> Streamed:
    """Send poses until the sources end or the user interrupts the stream.

    Args:
        sources: One poses.csv, or sources of ``track``: videos, folders, the index of a camera.
        to: Receivers, each ``HOST`` or ``HOST:PORT``, followed by ``=FILE`` if it has a headset file of its own.
        headset: File of a camera's position on a headset, see ``devices.HeadsetSettings``: poses are sent in its frame,
            with its covariance added. By default they are in the frame of the camera.
        igtl: Port of an OpenIGTLink server, to which Slicer connects; None for no server.
        page: Server of a page that shows the poses in a browser; it opens and closes with the stream. Beside a
            poses.csv, it shows the frames that the run has recorded.
        await_browser: Begin when the first browser opens the page.
        rate: Poses per second of a poses.csv, instead of the recorded pace.
        repeat: Begin a poses.csv again at its end, until the user interrupts the stream.
        smooth: Smooth the poses by :class:`OneEuro`; the packets then state the lag of the filter.
        track: Function that yields capture times (by ``packet.now``) and poses of the sources, as frames arrive. A pose
            with a future time is sent at that time.
        show: Function that prints a line.

    Raises:
        ConfigError: There is no source or no receiver, an address or file cannot be read, or pyigtl is missing.
    """
    receivers, frames = receivers_of(to, headset)
    if not receivers and igtl is None and page is None:
        raise ConfigError([f"say to whom: --to HOST:PORT, such as --to 127.0.0.1:{PORT}, or --igtl 18944 for Slicer"])
    if rate is not None and not (math.isfinite(rate) and rate > 0):
        raise ConfigError([f"rate must be above 0 Hz, got {rate}"])
    if len(sources) == 1 and sources[0].lower().endswith(".csv"):
        recorded = read_poses(Path(sources[0]))
        repetitions = itertools.count() if repeat else range(1)
        rounds: Iterator[Iterable[TimedPose]] = (replay(recorded, rate) for _ in repetitions)
        if page is not None and (folder := recording_of(Path(sources[0]).parent)):
            rounds = (_with_frames(once, folder, page) for once in rounds)
        poses: Iterable[TimedPose] = itertools.chain.from_iterable(rounds)
    elif sources and track is not None:
        poses = track(sources)
    else:
        raise ConfigError([f"expected one poses.csv or videos to track, got {' '.join(sources) or 'nothing'}"])
    try:
        server = None if igtl is None else TransformServer(igtl, name=frames[headset].transform)
    except ImportError as error:
        raise ConfigError([str(error)]) from None
    senders = [(frames[file], PoseSender(to, frame=frames[file].name)) for file, to in receivers.items()]
    servers = [] if server is None else [(frames[headset], server)]
    pages = [] if page is None else [(page.aligner or frames[headset], page)]
    count, complete = [0], True
    try:
        asyncio.run(_send(iter(poses), [*senders, *pages], servers, smooth, count, show, await_browser=await_browser))
    except KeyboardInterrupt:
        show("interrupted")
        complete = False
    except OSError as error:
        raise _config_error(error) from None
    if page is not None and complete:
        show("The page has ended with its source; holotorch stream --view --replay RUN repeats a run of track")
    links = [link for _, sender in senders for link in sender.links]
    delivered = (
        page is not None or not links or server is not None or any(link.sent or not link.errors for link in links)
    )
    return Streamed(count[0], complete, delivered)


def receivers_of(
    to: Sequence[str], headset: Path | None
) -> tuple[dict[Path | None, list[tuple[str, int]]], dict[Path | None, Frame]]:
    """Addresses of the receivers by headset file (None: no file), and the frame of each file.

    Raises:
        ConfigError: An address or a file cannot be read, or no computer has the name of a receiver.
    """
    receivers: dict[Path | None, list[tuple[str, int]]] = {}
    for text in to:
        place, _, file = text.partition("=")
        host, port = address(place)
        try:
            socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise ConfigError([f"no way to {host}:{port}: {error.strerror or error}"]) from None
        receivers.setdefault(Path(file) if file else headset, []).append((host, port))
    return receivers, {file: Frame.of(file) for file in {*receivers, headset}}


def _config_error(error: OSError) -> Exception:
    """Convert an error about an address or port to ConfigError; an error about a file stays unchanged."""
    other = "; end the other program, or choose another port (--page HOST:PORT for a page, otherwise --port or --igtl)"
    cure = other if error.errno == errno.EADDRINUSE else ""
    return ConfigError([f"{error.strerror or error}{cure}"]) if error.filename is None else error


async def _send(
    poses: Iterator[TimedPose],
    senders: Sequence[tuple["Frame | Aligner", "PoseSender | PageServer"]],
    servers: Sequence[tuple["Frame", TransformServer]],
    smooth: bool,
    count: list[int],
    show: Show,
    *,
    await_browser: bool,
) -> None:
    """Send all poses; ``count[0]`` becomes the number of poses sent, even if the call is interrupted."""
    links = [link for _, sender in senders if isinstance(sender, PoseSender) for link in sender.links]
    pages, smoother = [each for _, each in senders if not isinstance(each, PoseSender)], OneEuro() if smooth else None
    async with AsyncExitStack() as stack:
        for _, connection in (*senders, *servers):
            await stack.enter_async_context(connection)
        show(f"Sending    to {', '.join(f'{link.host}:{link.port}' for link in links) or 'clients that connect'}")
        for page in pages:
            show(f"Page       {page.address}")
        for frame in dict.fromkeys(frame for frame, _ in (*senders, *servers) if frame.matrix is not None):
            show(f"Frame      {frame.name}{'' if frame.covariance is not None else ', of unknown accuracy'}")
        for _, server in servers:
            show(f"Slicer     connects to {own_address()}, port {server.port}")
        if await_browser and pages:
            show("Waiting    for a browser that opens the page")
            while not any(page.clients for page in pages):
                await asyncio.sleep(0.05)
        try:
            # Tracking runs in a thread, so that clock requests are answered in the meantime.
            while (item := await asyncio.to_thread(next, poses, None)) is not None:
                captured, pose = item
                await asyncio.sleep(max(0.0, captured - now()))  # unlike sleep in a thread, Ctrl-C ends it at once
                pose = smoother(pose, captured) if smoother else pose
                for frame, sender in senders:
                    sender.send(frame(pose), captured, lag=smoother.lag if smoother else 0.0)
                for frame, server in servers:
                    server.send(frame(pose), captured)
                count[0] += 1
        finally:
            show(f"Frames     {count[0]}")
            for _, server in servers:
                if server.future:
                    show(f"Slicer     {server.future} sent as refusals: captured in the future")
            for link in links:
                text = f", {link.errors} failed: {link.last_error}" if link.errors else ""
                text += "; it may have ended before the stream" if link.errors and link.sent else ""
                show(f"Receiver   {link.host}:{link.port}: {link.sent} sent, {link.dropped} dropped for newer{text}")


def view(port: int = PORT, *, seconds: float = math.inf, show: Show = _at_once) -> None:
    """Print the newest packet at ``port`` once a second, and finally statistics. ConfigError if the port is in use."""
    receiver = PoseReceiver(port)

    async def listen() -> None:
        async with receiver:
            show(f"Listening  at {own_address()}, UDP port {receiver.port}")
            end = now() + seconds
            while (remaining := end - now()) > 0:
                await asyncio.sleep(min(1.0, remaining))
                show(_line(receiver))

    try:
        with suppress(KeyboardInterrupt):
            asyncio.run(listen())
    except OSError as error:
        raise _config_error(error) from None
    for line in statistics_text(receiver):
        show(line)


def _line(receiver: PoseReceiver) -> str:
    """The newest packet in a line, or what arrived instead."""
    newest, counts, age = receiver.packet, receiver.statistics, receiver.age()
    if newest is None and counts.future:
        return f"{counts.future} packets captured in the future, not used: compare the sender's clock and its camera's"
    if newest is None and counts.invalid:
        return f"{counts.invalid} unreadable packets, the last: {counts.last_error}"
    if newest is None:
        return "nothing yet"
    if not newest.answered:
        assert isinstance(newest.pose.status, Status)
        return f"refused ({newest.pose.status.name}): {newest.pose.reason}; {age * 1e3:.0f} ms old"
    if receiver.latest() is None:
        return f"the newest pose is {age:.1f} s old and no longer given"
    tip = ", ".join(f"{value * 1e3:.1f}" for value in newest.pose.tip.tolist())
    return f"{newest.frame} tip {tip} mm, sd {float(newest.pose.tip_sd) * 1e3:.2f} mm, {age * 1e3:.0f} ms old"


def statistics_text(receiver: PoseReceiver) -> list[str]:
    """Statistics of a receiver as a few lines of text."""
    counts = receiver.statistics
    if not counts.received:
        text = f"Received   nothing; {counts.invalid} unreadable packets {counts.last_error}".rstrip()
        return [f"{text}; {counts.future} captured in the future" if counts.future else text]
    ms = {name: 1e3 * seconds for name, seconds in counts.latency().items()}
    clock = "not measured: transit counted from the fastest packet"
    if counts.offset is not None and counts.round_trip is not None:
        clock = f"sender's is {counts.offset * 1e3:+.3f} ms ahead, within {counts.round_trip * 5e2:.3f} ms"
    return [
        f"Received   {counts.received}, lost {counts.lost}, reordered {counts.reordered}, repeated {counts.duplicated}",
        f"Of these   refused {counts.refused}, late {counts.late}",
        f"Not used   unreadable {counts.invalid}, foreign {counts.foreign}, captured in the future {counts.future}, "
        f"not continuing the stream {counts.jumped}",
        f"Transit    median {ms['transit_median']:.2f} ms, p95 {ms['transit_p95']:.2f} ms, "
        f"jitter {counts.jitter * 1e3:.3f} ms",
        f"Latency    median {ms['latency_median']:.2f} ms, p95 {ms['latency_p95']:.2f} ms since capture",
        f"Clock      {clock}",
    ]


def address(text: str) -> tuple[str, int]:
    """Host and port from ``HOST``, ``HOST:PORT`` or ``[IPv6]:PORT``; ConfigError for other text."""
    host, colon, port = text.rpartition(":") if not text.endswith("]") and text.count(":") else (text, "", "")
    host = host.removeprefix("[").removesuffix("]")
    number = int(port) if port.isascii() and port.isdigit() else 0
    if colon and number > 65535:
        raise ConfigError([f"expected a port from 1 to 65535, got {number} in {text!r}"])
    if not host or (":" in host and not text.startswith("[")) or (colon and not number):
        raise ConfigError([f"expected HOST:PORT, such as 192.168.1.20:{PORT}, got {text!r}"])
    return host, number if colon else PORT


def own_address() -> str:
    """IPv4 address at which other computers reach this one, or 127.0.0.1 if there is no network."""
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        try:
            # Sends nothing, but selects the interface for addresses outside; RFC 5737 reserves this one for examples.
            probe.connect(("192.0.2.1", 9))
            return probe.getsockname()[0]
        except OSError:
            return "127.0.0.1"
