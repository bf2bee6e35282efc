"""The study in the browser: a server of the standard library on this machine, and the log it keeps.

The page (perception_page.html) gets the design once and sends one result per trial; the trial is on the disk before the
answer goes back. Nothing but the page is served, and only to this machine.

``onset_s`` is the stamp of the first frame after the one that drew the pattern, the earliest moment at which it can be
on the screen; ``response_s`` that of the key's event, on the same clock, or of the frame for a gamepad, which is asked
once per frame. What the screen and the keyboard add is theirs, much the same in every trial, and not known here.
"""

import json
import os
import sys
import threading
from dataclasses import asdict
from datetime import UTC, datetime
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

from holotorch.experiments.config_study import StudySettings, beyond_screen, build_screen, load_study
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.perception_design import Design
from holotorch.experiments.perception_frames import quantisation
from holotorch.experiments.perception_log import TrialLog
from holotorch.experiments.perception_result import checked_result
from holotorch.io.files import write_json

_LARGEST = 10_000  # bytes of a request; a result has about 200
_CONNECTIONS = 64  # at once, each a thread; a browser opens six


class StudyServer(ThreadingHTTPServer):
    """Serves the page and the session of one participant, and appends results to the log.

    Args:
        settings: The study.
        design: The participant's trials.
        log: Open; what it holds already is not asked again.
        port: 0 for any free one.
        script: JavaScript to put into the page: the scripted participant of a test.

    Raises:
        ConfigError: The port is taken or may not be used.
    """

    daemon_threads = True
    request_queue_size = 128  # 5 by default: those beyond wait a second and more until they ask again
    # On Linux it lets a server restart on a port that was just used; on Windows it would let two share it.
    allow_reuse_address = os.name != "nt"

    def __init__(
        self, settings: StudySettings, design: Design, log: TrialLog, port: int = 0, script: str | None = None
    ):
        self.settings, self.design, self.log = settings, design, log
        self.script = script
        self.holder: str | None = None  # the window that asked last
        self.guard = threading.Lock()
        self._free = threading.BoundedSemaphore(_CONNECTIONS)
        try:
            super().__init__(("127.0.0.1", port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ConfigError([f"port {port}: {reason}; choose another with --port, or leave it out"]) from None

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give the connection a thread, or close it where there are too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve the connection until it ends or says nothing for ``_Handler.timeout``."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://127.0.0.1:{self.server_address[1]}/"

    @property
    def complete(self) -> bool:
        """Whether every trial is in the log."""
        return len(self.log.trials) >= len(self.design.trials)

    def session(self, window: str) -> dict[str, Any]:
        """What the page needs; ``window`` becomes the only one whose results count."""
        with self.guard:
            self.holder = window
            return {
                "participant": self.design.participant,
                "screen": self.settings.screen.model_dump(mode="json"),
                "timing": self.settings.timing.model_dump(mode="json"),
                "trials": [asdict(trial) | {"goal": trial.goal} for trial in self.design.trials],
                "next": len(self.log.trials),
            }

    def record(self, result: Any) -> tuple[HTTPStatus, dict[str, Any]]:
        """Append a result of the page, and say which trial is next; a result that came before is not written again."""
        with self.guard:
            try:
                index, window, values = checked_result(result)
            except ValueError as error:
                return HTTPStatus.BAD_REQUEST, {"error": str(error)}
            # After a restart the window that is there goes on.
            self.holder = self.holder or window
            if window != self.holder:
                return HTTPStatus.CONFLICT, {"error": "the study was opened in another window; close this one"}
            done = len(self.log.trials)
            if index > done or index >= len(self.design.trials):
                return HTTPStatus.BAD_REQUEST, {
                    "error": f"trial {index} is not the next one, {done}; load the page again"
                }
            if index == done:
                try:
                    self.log.append(self._line(index, values))
                except OSError as error:
                    reason = f"{error.filename}: {error.strerror}"
                    print(f"cannot write a trial: {reason}", file=sys.stderr)
                    return HTTPStatus.SERVICE_UNAVAILABLE, {"error": reason}  # the page tries again
            following = len(self.log.trials)
        return HTTPStatus.OK, {"next": following}

    def _line(self, index: int, values: dict[str, Any]) -> dict[str, Any]:
        trial = self.design.trials[index]
        planned = asdict(trial)
        del planned["wait_s"]
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        facts = {"practice": trial.practice, **values, "design": self.design.name, "time_utc": now}
        return {"participant": self.design.participant, **planned, **facts}


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 10.0  # seconds without a byte, after which a connection is closed
    server: StudyServer  # type: ignore[assignment]

    def do_GET(self) -> None:
        """The page."""
        if not self._local():
            return
        if self.path.partition("?")[0] == "/":
            self._send(HTTPStatus.OK, page(self.server.script).encode(), "text/html; charset=utf-8")
        else:
            self._json(HTTPStatus.NOT_FOUND, {"error": f"nothing at {self.path}"})

    def do_POST(self) -> None:
        """The session of a window, or a result."""
        length = self.headers.get("Content-Length", "")
        if not self._local() or not self._same_origin():
            return
        # Other pages may send forms here unasked, but JSON only by permission, which is not given.
        if self.path not in ("/session", "/trial") or self.headers.get_content_type() != "application/json":
            self.close_connection = True
            return self._json(HTTPStatus.NOT_FOUND, {"error": "expected JSON at /session or /trial"})
        if not length.isdecimal() or int(length) > _LARGEST:
            self.close_connection = True
            return self._json(HTTPStatus.BAD_REQUEST, {"error": f"expected at most {_LARGEST} bytes"})
        try:
            value = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            return self._json(HTTPStatus.BAD_REQUEST, {"error": "not JSON"})
        if self.path == "/session":
            window = value.get("window") if isinstance(value, dict) else None
            if not isinstance(window, str) or not window:
                return self._json(HTTPStatus.BAD_REQUEST, {"error": "expected the name of the window"})
            return self._json(HTTPStatus.OK, self.server.session(window))
        self._json(*self.server.record(value))
        if self.server.complete:  # only after the answer; and not in here, as shutdown waits for the serving loop
            threading.Thread(target=self.server.shutdown, daemon=True).start()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing per request."""

    def _local(self) -> bool:
        """Whether the page was asked for by this machine's name: a foreign name that points here is refused."""
        name = self.headers.get("Host", "").partition(":")[0]  # browsers leave out the port 80
        if name in ("127.0.0.1", "localhost"):
            return True
        self.close_connection = True
        self._json(HTTPStatus.FORBIDDEN, {"error": f"open {self.server.address}"})
        return False

    def _same_origin(self) -> bool:
        """Whether the study's own page asks, as far as the browser says; programs that are no browser say nothing."""
        origin = self.headers.get("Origin")
        site = self.headers.get("Sec-Fetch-Site", "same-origin")
        if site == "same-origin" and origin in (None, f"http://{self.headers.get('Host', '')}"):
            return True
        self.close_connection = True
        self._json(HTTPStatus.FORBIDDEN, {"error": f"another page asks; open {self.server.address}"})
        return False

    def _json(self, status: HTTPStatus, value: dict[str, Any]) -> None:
        self._send(status, json.dumps(value).encode(), "application/json")

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.end_headers()
        self.wfile.write(body)


def page(script: str | None = None) -> str:
    """The page, with ``script`` at its end."""
    text = resources.files("holotorch.experiments").joinpath("perception_page.html").read_text(encoding="utf-8")
    return text.replace("</body>", f"<script>{script}</script></body>") if script else text


def run_study_server(
    config: str | Path,
    *,
    port: int | None = None,
    participant: int = 1,
    out: Path | None = None,
    script: str | None = None,
) -> int:
    """Run the study of one participant in a browser, from where the log ends, until it is complete or interrupted.

    Args:
        config: File of the study.
        port: Of the server; None for any free one.
        participant: 1, 2, ...
        out: Folder of the logs and designs of all participants; runs/CONFIG by default.
        script: See ``StudyServer``.

    Returns:
        0 when every trial is recorded, 130 when it was interrupted before; what was recorded is on the disk.

    Raises:
        ConfigError: A mistake in the file; a number that is in use, complete, or was begun with another configuration;
            a port that is taken; a log that cannot be read.
    """
    settings = load_study(config)
    try:
        design = settings.design(participant)
    except ValueError as error:
        raise ConfigError([f"{config}: {error}"]) from None
    folder = out or Path("runs") / Path(config).stem
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"participant-{participant:03d}.jsonl"
    cuts = beyond_screen(settings)
    header = {
        "participant": participant,
        "design": design.name,
        "screen": settings.screen.model_dump(mode="json"),
        "timing": settings.timing.model_dump(mode="json"),
        "cut": [[cut.eccentricity_deg, cut.size_deg] for cut in cuts],
    }
    with TrialLog(path, header) as log:
        total, done = len(design.trials), len(log.trials)
        if done >= total:
            text = f"{path}: participant {participant} is complete; choose another number, or another folder with --out"
            raise ConfigError([text])
        write_json(folder / f"participant-{participant:03d}.design.json", design.to_json())
        with StudyServer(settings, design, log, port or 0, script) as server:
            for cut in cuts:
                print(f"cut at the edge of the screen: {cut.text}")
            field = build_screen(settings.screen).field_deg[1]
            print(f"screen: {field:.1f} deg wide, {settings.screen.distance:g} m away")
            rows, columns = settings.screen.shape
            if done:
                print(
                    f"participant {participant} goes on at trial {done + 1} of {total}; a new person needs a new number"
                )
            print(f"open in full screen ({columns} x {rows} pixels): {server.address}", flush=True)
            try:
                server.serve_forever(poll_interval=0.1)
            except KeyboardInterrupt:
                print("interrupted")
            # The lock waits for a trial that is being written.
            with server.guard:
                print(_summary(path, log, total), flush=True)
                return 0 if server.complete else 130


def _summary(path: Path, log: TrialLog, total: int) -> str:
    trials = [trial for trial in log.trials if not trial["practice"]]
    right = sum(trial["responded"] == trial["target"] for trial in trials)
    lines = [f"{len(log.trials)} of {total} trials in {path}; without practice {right} of {len(trials)} right"]
    steps = quantisation([trial["frame_s"] for trial in log.trials])
    return "\n".join(lines + ([str(steps)] if steps else []))
