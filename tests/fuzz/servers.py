"""Targets: what connections send to the servers of the live view, of the headset's page and of a study."""

import asyncio
import json
import logging
import os
import socket
import tempfile
import threading
import traceback
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, suppress
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

import torch
from fuzz.commands import command
from fuzz.engine import Input, Refused, Target
from fuzz.requests import PORT, TOKEN, ending, faulty_frames, faulty_request, frame, handshake, request
from study_client import TINY, Runner
from tiny_runs import command as run_of

from holotorch.experiments.streaming.aligning import Aligner
from holotorch.experiments.streaming.page import PageServer
from holotorch.experiments.view.opening import open_viewer
from holotorch.experiments.view.server import ViewServer
from holotorch.tracking import THESIS
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now

_PARENT = os.getpid()  # the engine's, in which nothing is served
_ANSWERS = 5.0  # seconds within which a page that behaves is answered
_OPEN = 100  # file descriptors and tasks that a process may have between two inputs


def _mistakes() -> list[str]:
    """A list to which every traceback is added that this process would print."""
    mistakes: list[str] = []
    log = logging.Handler(logging.ERROR)
    log.emit = lambda record: mistakes.append(f"{record.name}: {log.format(record)}")
    logging.getLogger().addHandler(log)
    traceback.print_exc = lambda *_, **__: mistakes.append(traceback.format_exc())
    return mistakes


class _Served:
    """A server in a thread of its own, which outlives the inputs, and the mistakes of its loop and its log."""

    quiet = 0.05  # seconds without a part of an answer after which an input closes its connection

    def __init__(self, opened: Callable[[], AbstractAsyncContextManager[Any]]):
        self.mistakes = _mistakes()
        self._ready = threading.Event()
        threading.Thread(target=lambda: asyncio.run(self._serve(opened)), daemon=True).start()
        assert self._ready.wait(30), "the server does not open"

    async def _serve(self, opened: Callable[[], AbstractAsyncContextManager[Any]]) -> None:
        self.loop = asyncio.get_running_loop()
        self.loop.set_exception_handler(lambda _, context: self.mistakes.append(str(context)))
        async with opened() as self.server:
            self.port, self.token = self.server.port, self.server.token
            self._ready.set()
            await asyncio.Event().wait()


class _Study(_Served):
    """The server of a study, which has a loop of its own."""

    quiet = 0.4  # it waits so long for the samples of a trial

    def __init__(self, folder: Path):
        self.mistakes = _mistakes()
        self.study = Runner(folder, text=TINY + "gaze: {source: tracker, attempts: 2, gap_s: 0.5}\n")
        self.loop, self.port, self.token = self.study.loop, self.study.port, self.study.token
        self.loop.set_exception_handler(lambda _, context: self.mistakes.append(str(context)))


@cache
def _served(name: str) -> _Served:
    """The server of a target, in a child of the engine."""
    folder = Path(tempfile.mkdtemp(prefix="served-"))
    if name == "study":
        return _Study(folder)
    if name == "page":
        aligner = Aligner(folder / "headset.yaml")
        return _Served(lambda: PageServer(THESIS, port=0, aligner=aligner))
    viewer = open_viewer(_finished_run())
    return _Served(lambda: ViewServer(viewer))


def _prepare(name: str) -> None:
    """What all children use."""
    if name == "view":
        _finished_run()


@cache
def _finished_run() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="served-")) / "run"
    command(*run_of("volume", folder))
    return folder


def _exchange(served: _Served, data: bytes, *, until: bytes | None = None) -> bytes:
    """Send ``data``, and receive what is answered, or up to ``until``; TimeoutError if that does not come."""
    data = data.replace(TOKEN, served.token.encode()).replace(PORT, str(served.port).encode())
    answer = b""
    ends = (ConnectionError, TimeoutError) if until is None else ()
    with socket.create_connection(("127.0.0.1", served.port), timeout=_ANSWERS) as link, suppress(*ends):
        link.sendall(data)
        if until is None:
            link.settimeout(served.quiet)
        while part := link.recv(65536):
            answer += part
            if until is not None and until in answer:
                break
    return answer


def _read(name: str, behaved: Callable[[_Served], None], folder: Path) -> None:
    """Send an input: the server must make no mistake, and go on to answer a page that behaves."""
    if os.getpid() == _PARENT:
        _prepare(name)
        return
    served = _served(name)
    if name == "page":  # a tracker that goes on
        tip, direction = torch.tensor([[0, 0, 0.5], [0.6, 0, -0.8]], dtype=torch.float64)
        one = torch.ones((), dtype=torch.float64)
        pose = served.server.aligner(Pose(tip, direction, torch.eye(6).double() * 1e-8, one, one, Status.OK))
        served.loop.call_soon_threadsafe(served.server.send, pose, now())
    answer = _exchange(served, (folder / "sent.bin").read_bytes())
    status = int(answer[9:12]) if answer[:5] == b"HTTP/" else 0
    behaved(served)
    assert not served.mistakes, served.mistakes.pop()
    assert status != 500, answer[:2000]
    assert len(os.listdir("/proc/self/fd")) < _OPEN and len(asyncio.all_tasks(served.loop)) < _OPEN
    if not (100 <= status < 300 or status == 409):  # which a study says of a trial that is not the next
        raise Refused(f"status {status}")


def _view_behaves(served: _Served) -> None:
    message = json.dumps({"number": 77, "values": {}, "coarse": True}).encode()
    sent = handshake("/pictures?token=@TOKEN@") + frame(message)
    assert b'"number": 77' in _exchange(served, sent, until=b'"number": 77'), "no picture"


def _page_behaves(served: _Served) -> None:
    sent = handshake("/poses") + frame(b'{"kind": "clock", "asked": 77.5}')
    assert b'"asked": 77.5' in _exchange(served, sent, until=b'"asked": 77.5'), "no answer of the clock"


def _study_behaves(served: _Served) -> None:
    assert isinstance(served, _Study)
    assert served.study.ask("POST", "/session", {"window": "w"})[0] == 200 and served.study.thread.is_alive()


def _mutate(target: str, rng: Random, made: Input, other: Input) -> Input:
    """Faults of the request, or of what follows it on a WebSocket."""
    data, messages = made["sent.bin"], _MESSAGES[target]
    kind = rng.random()
    if kind < 0.03:
        return {"sent.bin": rng.randbytes(rng.choice((1, 10, 1000, 100_000)))}
    if kind < 0.4 or target == "study":
        several = 1 if rng.random() < 0.9 else rng.randrange(2, 50)
        return {"sent.bin": b"".join(faulty_request(rng, data) for _ in range(several))}
    return {
        "sent.bin": handshake(_SOCKETS[target])
        + faulty_frames(rng, messages)
        + (ending() if rng.random() < 0.3 else b"")
    }


_SOCKETS = {"view": "/pictures?token=@TOKEN@", "page": "/poses"}
_TRIAL = {
    **{"index": 1000, "window": "other", "onset_s": 1.0, "response_s": 1.25, "frame_s": 0.0167, "early": 1},
    **{"onset_unix_s": 1.7e9, "dropped_frames": 0, "device": "key"},
}
_MESSAGES: dict[str, list[bytes]] = {
    "view": [
        json.dumps({"number": n, "values": values, "coarse": bool(n % 2)}).encode()
        for n, values in enumerate(
            [{}, {"focus": 3.0, "azimuth": 40, "elevation": 100}, {"seed": 1}, {"colour": "all"}]
        )
    ],
    "page": [
        b'{"kind": "clock", "asked": 12.5}',
        b'{"kind": "aligned", "tip": [0.1, 0.2, -0.6], "direction": [0.6, 0, 0.8]}',
        b'{"kind": "aligned", "tip": [0.3, 0.1, -0.5], "direction": [0, 0.6, 0.8]}',
        b'{"kind": "undo"}',
        b'{"kind": "save"}',
    ],
    "study": [],
}


def _samples(target: str, _: Path) -> list[Input]:
    token = "?token=@TOKEN@" if target == "view" else ""
    if target == "study":
        bearer = "Content-Type: application/json", "Authorization: Bearer @TOKEN@"
        bodies = {
            "/session": {"window": "third"},
            "/trial": _TRIAL,
            "/fixation": {"window": "third", "fixated": True},
            "/gaze": [{"time": 1.7e9, "x_deg": 0.5, "y_deg": 0.5, "valid": True}],
        }
        sent = [request("POST", path, *bearer, body=json.dumps(body).encode()) for path, body in bodies.items()]
        return [{"sent.bin": data} for data in [request("GET", "/"), *sent]]
    pages = [request("GET", f"/{token}"), request("GET", "/view.js")]
    opened = [handshake(_SOCKETS[target]) + frame(message) + ending() for message in _MESSAGES[target]]
    return [{"sent.bin": data} for data in pages + opened]


TARGETS = [
    Target(f"server-{name}", partial(_samples, name), partial(_mutate, name), partial(_read, name, behaves), (Refused,))
    for name, behaves in (("view", _view_behaves), ("page", _page_behaves), ("study", _study_behaves))
]
