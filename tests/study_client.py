"""A small study, its server in a thread, and a client of it."""

import asyncio
import http.client
import json
import socket
import threading
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from holotorch.experiments.perception.study import run as perception_run

TINY = """
seed: 1
screen: {kind: flat, shape: [600, 800], size: [0.3, 0.4], distance: 0.25}
patterns: [{eccentricities_deg: 20, sizes_deg: 6}]
repeats: {target: 1, distraction: 0}
practice: 1
"""


class Client:
    """What asks a study server, with the token of the address that was printed."""

    def __init__(self, address: str):
        page, _, self.token = address.partition("#")
        self.port = int(page.rsplit(":", 1)[1].strip("/"))

    def ask(self, method: str, path: str, value=None, **headers) -> tuple[int, dict]:
        """Status and JSON of a response; a page is {"text": ...}."""
        body = None if value is None else value if isinstance(value, bytes) else json.dumps(value).encode()
        link = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        usual = {"Content-Type": "application/json", "Authorization": f"Bearer {self.token}"}
        link.request(method, path, body, usual | headers)
        answer = link.getresponse()
        text = answer.read()
        link.close()
        return answer.status, json.loads(text) if text.startswith(b"{") else {"text": text.decode()}

    def send(self, number: int, window="w", **change) -> tuple[int, dict]:
        """Send the result of a trial."""
        facts = {"index": number, "window": window, "onset_s": 1.0, "response_s": 1.25, "frame_s": 0.0167}
        return self.ask("POST", "/trial", facts | {"early": 1, "dropped_frames": 0, "device": "key"} | change)

    def connect(self, data: bytes = b"") -> socket.socket:
        """A connection that has sent so much."""
        link = socket.create_connection(("127.0.0.1", self.port), timeout=10)
        link.sendall(data)
        return link


class Runner(Client):
    """The study in a thread, and a client of it."""

    server: perception_run.StudyServer
    loop: asyncio.AbstractEventLoop

    def __init__(self, folder: Path, participant: int = 1, text: str = TINY):
        ready = threading.Event()

        class Server(perception_run.StudyServer):
            @asynccontextmanager
            async def listening(server, port=0):
                async with super().listening(port):
                    self.server, self.loop = server, asyncio.get_running_loop()
                    ready.set()
                    yield

        config = folder / "tiny.yaml"
        config.write_text(text)
        self.status: int | None = None
        self.error: Exception | None = None

        def run():
            try:
                self.status = perception_run.run_study_server(config, participant=participant, out=folder)
            except Exception as error:
                self.error = error
                ready.set()

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(perception_run, "StudyServer", Server)
            self.thread = threading.Thread(target=run, daemon=True)
            self.thread.start()
            assert ready.wait(30) and self.error is None, self.error
        super().__init__(f"{self.server.address}#{self.server.token}")
        self.log = folder / f"participant-{participant:03d}.jsonl"

    def stop(self) -> int | None:
        """End the study, as a signal does, and give its exit status."""
        self.loop.call_soon_threadsafe(self.server.stop.set)
        self.thread.join(10)
        return self.status


def closed(link: socket.socket) -> bool:
    """Whether the server has closed the connection."""
    link.setblocking(False)
    try:
        return link.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True
