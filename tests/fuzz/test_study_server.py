"""Requests that no page sends, at a study that goes on meanwhile; ``run`` for as long as is asked."""

import asyncio
import gc
import os
import random
import socket
import sys
import tempfile
import time
from collections import Counter, deque
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path

import pytest
from fuzz.requests import PORT, TOKEN
from fuzz.targets import TARGETS
from study_client import Runner

from holotorch.experiments.perception.study import server as perception_server
from holotorch.experiments.perception.study.log import read_log

PAUSE = 0.4  # seconds that the server gives a connection here
OPEN = 48  # connections that wait for an answer meanwhile
STUDY = TARGETS["server-study"]


def make_input(rng: random.Random, token: str, port: int) -> bytes:
    """What one connection sends: four times in five with faults."""
    made = rng.choice(STUDY.samples(Path()))
    data = (STUDY.mutate(rng, made, made) if rng.random() < 0.8 else made)["sent.bin"]
    return data.replace(TOKEN, token.encode()).replace(PORT, str(port).encode())


def answer(link: socket.socket) -> int:
    """Status of a connection's first response, 0 for none; TimeoutError where it does not end."""
    data = b""
    try:
        while part := link.recv(65536):
            data += part
    except ConnectionError:
        pass  # closed before it was done
    link.close()
    return int(data[9:12]) if data else 0


def resident() -> float:
    """Memory of this process in MB."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(seconds: float, seed: int) -> Counter[int]:
    """Send faulty requests for so long, and give how many ended with which status; AssertionError for any failure."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(perception_server, "_SECONDS", PAUSE)
        study = Runner(Path(folder))
        before = {path.name for path in Path(folder).iterdir()}
        errors: list[dict] = []
        study.loop.set_exception_handler(lambda _, context: errors.append(context))
        statuses, memory = _attack(study, random.Random(seed), seconds)
        time.sleep(2 * PAUSE)
        assert len(asyncio.all_tasks(study.loop)) == 1  # nothing is left of any connection but the study itself
        assert study.thread.is_alive() and study.stop() == 130 and not errors, errors
        assert len(read_log(study.log).trials) == 1
        assert {path.name for path in Path(folder).iterdir()} == before
    assert not statuses[500] and memory < 50, (statuses, memory)
    return statuses


def _attack(study: Runner, rng: random.Random, seconds: float) -> tuple[Counter[int], float]:
    """Statuses, and by how many MB memory has grown since a third of the time."""
    statuses: Counter[int] = Counter()
    waiting: deque[socket.socket] = deque()
    begin, start, number = time.monotonic(), 0.0, 0
    while (now := time.monotonic() - begin) < seconds:
        number += 1
        link = study.connect()
        try:
            link.sendall(make_input(rng, study.token, study.port))
        except ConnectionError:
            statuses[0] += 1  # closed before it had sent all
        waiting.append(link)
        if rng.random() < 0.2:
            waiting.pop().close()  # does not wait for an answer
        if len(waiting) > OPEN:
            statuses[answer(waiting.popleft())] += 1
        if number % 100 == 1:
            _take_trial(study)
        if not start and now > seconds / 3:
            start = resident()
    while waiting:
        statuses[answer(waiting.popleft())] += 1
    _take_trial(study)
    return statuses, resident() - start


def _take_trial(study: Runner) -> None:
    """As the participant's own page does, in the midst of it."""
    status = None
    for _ in range(5):  # a request that bears the token may take the session over in between
        with suppress(ConnectionError, HTTPException):  # a slow machine may take longer than PAUSE
            assert study.ask("POST", "/session", {"window": "w"})[0] == 200
            if (status := study.send(0)) == (200, {"next": 1}):
                return
    raise AssertionError(f"the session does not go on: {status}")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_study_outlives_faulty_requests(capfd):
    statuses = run(1.0, 1)
    assert {400, 403, 404, 409} <= set(statuses)  # the faults neither miss the server nor end at its first check
    assert capfd.readouterr().err == ""
