"""Requests that no page sends, at a study that goes on meanwhile; ``run`` for as long as is asked."""

import asyncio
import gc
import json
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
from study_client import Runner

from holotorch.experiments.perception.study import server as perception_server
from holotorch.experiments.perception.study.log import read_log

PAUSE = 0.4  # seconds that the server gives a connection here
OPEN = 48  # connections that wait for an answer meanwhile
# Not the next trial, also where a fault has made its window the one that holds the session.
RESULT = {"index": 1000, "window": "other", "onset_s": 1.0, "response_s": 1.2, "frame_s": 0.01, "device": "key"}
VALUES = [
    *("NaN", "Infinity", "-Infinity", "1e999", "-1", "0", "null", "true", '""', '"\\ud800"', "[]", "{}", "-0.0"),
    *("1" * 4000, "[" * 900 + "]" * 900, "[" * 3000, '{"a":' * 500 + "1" + "}" * 500, '"' + "x" * 9000 + '"', "1e300"),
]
METHODS = ["GET", "POST", "PUT", "HEAD", "OPTIONS", "DELETE", "CONNECT", "TRACE", "PATCH", "PRI", "get", "\x01", ""]
PATHS = [
    *("/", "/session", "/trial", "/../participant-001.jsonl", "/..%2f..%2fetc/passwd", "//", "*", "", "/%00", "/\xff"),
    *("http://example.org/session", "/session?x=1", "/trial#x", "/./trial", "/" + "a" * 9000, "/%", "example.org:80"),
]
HEADERS = [
    *("Transfer-Encoding: chunked", "Transfer-Encoding: gzip, chunked", "Content-Encoding: gzip", "Upgrade: websocket"),
    *("Expect: 100-continue", "Content-Length: 5", "Content-Length: -1", "Content-Length: 1e3", "Host: example.org"),
    *("Connection: upgrade", "Connection: keep-alive", "Cookie: " + "c" * 9000, "X: " + "y" * 70_000, ": x", "a b: c"),
    *("Origin: null", "Sec-Fetch-Site: cross-site", "Content-Type: ;;;=", "X: \r\n folded", "\xe9: \xe9", "X: \x00"),
]


def make_request(rng: random.Random, token: str, port: int) -> bytes:
    """A request of the page with one to three faults, or one in five times none."""
    faults = rng.choices(range(8), k=rng.randrange(1, 4)) if rng.random() < 0.8 else []
    path = rng.choice(["/trial", "/session"])
    fields = {name: json.dumps(value) for name, value in RESULT.items()}
    if path == "/session":
        fields = {"window": '"third"'}
    if 0 in faults:
        fields[rng.choice([*fields, "x"])] = rng.choice(VALUES)
    body = ("{" + ",".join(f'"{name}":{value}' for name, value in fields.items()) + "}").encode()
    if 1 in faults:
        body = rng.choice([*(value.encode() for value in VALUES), body[: rng.randrange(len(body))], rng.randbytes(200)])
    method = "POST"
    if 2 in faults:
        method, path = rng.choice(METHODS), rng.choice(PATHS)
    if 3 in faults:
        token = rng.choice(["", token[:-1], token + "x", "\xff", token.swapcase(), "x" * 8000])
    length = str(len(body))
    if 4 in faults:
        length = rng.choice(["0", "3", "10000", "10001", "99999999999999999999", "x", "", "-3", "+3", "0x10", "1, 1"])
    lines = [f"{method} {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Content-Type: application/json"]
    lines += [f"Authorization: Bearer {token}", f"Content-Length: {length}"]
    if 5 in faults:
        lines[1:1] = rng.choices(HEADERS, k=rng.choice([1, 2, 300]))
    data = "\r\n".join([*lines, "", ""]).encode("latin-1") + body
    if 6 in faults:
        wrong = bytearray(data)
        for _ in range(rng.randrange(1, 6)):
            wrong[rng.randrange(len(wrong))] = rng.randrange(256)
        data = bytes(wrong)
    if 7 in faults:
        data = data[: rng.randrange(len(data))]
    return data


def make_input(rng: random.Random, token: str, port: int) -> bytes:
    """What one connection sends: a request, up to 50 together, or random bytes."""
    kind = rng.random()
    if kind < 0.05:
        return rng.randbytes(rng.choice([1, 10, 1000, 100_000]))
    return b"".join(make_request(rng, token, port) for _ in range(1 if kind < 0.9 else rng.randrange(2, 50)))


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
