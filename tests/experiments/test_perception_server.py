import http.client
import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from holotorch.experiments import perception_server
from holotorch.experiments.config_study import beyond_screen, build_screen, load_study
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.perception_design import THESIS_CONDITIONS, Design
from holotorch.experiments.perception_log import read_log
from holotorch.experiments.perception_server import page, run_study_server

CONFIG = Path(__file__).parents[2] / "configs" / "perception" / "study.yaml"
TINY = """
seed: 1
screen: {kind: flat, shape: [600, 800], size: [0.3, 0.4], distance: 0.25}
patterns: [{eccentricities_deg: 20, sizes_deg: 6}]
repeats: {target: 1, distraction: 0}
practice: 1
"""


class Runner:
    """The study in a thread, and a client of it."""

    def __init__(self, folder: Path, monkeypatch, participant: int = 1):
        ready = threading.Event()

        servers: list[perception_server.StudyServer] = []

        class Server(perception_server.StudyServer):
            def __init__(self, *words):
                super().__init__(*words)
                servers.append(self)
                ready.set()

        monkeypatch.setattr(perception_server, "StudyServer", Server)
        (folder / "tiny.yaml").write_text(TINY)
        self.status: int | None = None
        self.error: Exception | None = None

        def run():
            try:
                self.status = run_study_server(folder / "tiny.yaml", participant=participant, out=folder)
            except Exception as error:
                self.error = error
                ready.set()

        self.thread = threading.Thread(target=run, daemon=True)
        self.thread.start()
        assert ready.wait(30) and self.error is None, self.error
        (self.server,) = servers
        self.log = folder / f"participant-{participant:03d}.jsonl"

    def ask(self, method: str, path: str, value=None, **headers) -> tuple[int, dict]:
        body = None if value is None else value if isinstance(value, bytes) else json.dumps(value).encode()
        link = http.client.HTTPConnection("127.0.0.1", self.server.server_address[1], timeout=10)
        link.request(method, path, body, {"Content-Type": "application/json", **headers})
        answer = link.getresponse()
        text = answer.read()
        link.close()
        return answer.status, json.loads(text) if text.startswith(b"{") else {"text": text.decode()}

    def send(self, number: int, window="w", **change) -> tuple[int, dict]:
        facts = {"index": number, "window": window, "onset_s": 1.0, "response_s": 1.25, "frame_s": 0.0167}
        return self.ask("POST", "/trial", facts | {"early": 1, "dropped_frames": 0, "device": "key"} | change)

    def stop(self) -> int | None:
        self.server.shutdown()
        self.thread.join(10)
        return self.status


def test_a_session_is_recorded_goes_on_and_ends(tmp_path, monkeypatch, capsys):
    first = Runner(tmp_path, monkeypatch)
    status, session = first.ask("POST", "/session", {"window": "w"})
    assert status == 200 and session["next"] == 0 and len(session["trials"]) == 1 + 2
    assert session["participant"] == 1 and session["screen"]["kind"] == "flat"
    assert first.send(0) == (200, {"next": 1})
    assert first.send(0, response_s=None) == (200, {"next": 1})  # sent again: written once
    assert first.send(1) == (200, {"next": 2})
    assert first.stop() == 130
    design = Design.from_json(json.loads((tmp_path / "participant-001.design.json").read_text()))
    lines = read_log(first.log).trials
    assert len(lines) == 2
    assert lines[1]["eccentricity_deg"] == 20 and lines[1]["side"] == design.trials[1].side and lines[1]["early"] == 1
    assert lines[1]["reaction_s"] == 0.25 and lines[0]["practice"] and lines[1]["design"] == design.name

    second = Runner(tmp_path, monkeypatch)
    assert second.send(2, window="kept its page open") == (200, {"next": 3})
    second.thread.join(10)
    assert second.status == 0
    said = capsys.readouterr().out
    assert "goes on at trial 3 of 3; a new person needs a new number" in said
    assert "3 of 3 trials" in said and "16.7 ms (60 Hz) over 3 trials" in said
    with pytest.raises(ConfigError, match="participant 1 is complete; choose another number"):
        run_study_server(tmp_path / "tiny.yaml", participant=1, out=tmp_path)


def test_a_changed_study_does_not_go_on(tmp_path, monkeypatch):
    Runner(tmp_path, monkeypatch).stop()
    for change, name in ((("seed: 1", "seed: 2"), "design"), (("0.25", "0.3"), "screen")):
        (tmp_path / "tiny.yaml").write_text(TINY.replace(*change))
        with pytest.raises(ConfigError, match=f"begun with another {name}.*restore the configuration"):
            run_study_server(tmp_path / "tiny.yaml", participant=1, out=tmp_path)


def test_two_programs_and_two_windows_for_one_participant(tmp_path, monkeypatch):
    runner = Runner(tmp_path, monkeypatch)
    pytest.importorskip("fcntl")
    with pytest.raises(ConfigError, match="participant 1 is being recorded by another program"):
        run_study_server(tmp_path / "tiny.yaml", participant=1, out=tmp_path)
    runner.ask("POST", "/session", {"window": "one"})
    runner.ask("POST", "/session", {"window": "two"})
    assert runner.send(0, "one") == (409, {"error": "the study was opened in another window; close this one"})
    assert runner.send(0, "two")[0] == 200
    runner.stop()
    assert len(read_log(runner.log).trials) == 1


def test_results_that_cannot_be_are_refused(tmp_path, monkeypatch):
    runner = Runner(tmp_path, monkeypatch)
    cases = [
        ({"onset_s": None}, "onset_s: expected seconds"),
        ({"onset_s": True}, "onset_s: expected seconds"),
        ({"onset_s": float("nan")}, "onset_s: expected seconds"),
        ({"onset_s": 10**400}, "onset_s: expected seconds"),
        ({"frame_s": 0}, "frame_s: expected more than 0"),
        ({"response_s": 0.5}, "response_s: expected a time after onset_s"),
        ({"early": -1}, "expected counts"),
        ({"device": "voice"}, "device: expected key"),
        ({"window": 3}, "window"),
        ({"index": 1}, "trial 1 is not the next one, 0"),
        ({"index": "0"}, "index"),
    ]
    for change, message in cases:
        status, answer = runner.send(0, **change)
        assert status == 400 and message in answer["error"], change
    assert runner.ask("POST", "/trial", b"{")[0] == 400
    assert runner.ask("POST", "/trial", b"[" * 9000)[0] == 400
    assert runner.ask("POST", "/trial", [1])[0] == 400
    assert runner.ask("POST", "/trial", b" " * 10_001)[0] == 400
    assert runner.ask("POST", "/trial", {}, **{"Content-Type": "text/plain"})[0] == 404  # what a foreign page can send
    assert runner.ask("GET", "/../secrets")[0] == 404
    for foreign in ("evil.example:80", "evil.example", ""):
        assert runner.ask("POST", "/session", {"window": "x"}, Host=foreign)[0] == 403
    assert runner.ask("GET", "/", Host="127.0.0.1")[0] == 200  # as a browser asks at port 80
    runner.stop()
    assert read_log(runner.log).trials == []


def test_no_other_page_takes_the_session_over(tmp_path, monkeypatch):
    runner = Runner(tmp_path, monkeypatch)
    own = f"127.0.0.1:{runner.server.server_address[1]}"
    assert runner.ask("POST", "/session", {"window": "mine"}, Origin=f"http://{own}", Host=own)[0] == 200
    assert runner.ask("GET", "/session?theirs")[0] == 404
    for headers in ({"Origin": "http://example.org"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}):
        assert runner.ask("POST", "/session", {"window": "theirs"}, **headers)[0] == 403
        assert runner.ask("POST", "/trial", {"window": "theirs"}, **headers)[0] == 403
    assert runner.ask("POST", "/session", {"window": "theirs"}, **{"Content-Type": "text/plain"})[0] == 404
    assert runner.ask("POST", "/session", {"window": 3})[0] == 400
    assert runner.send(0, "mine")[0] == 200  # still the window whose results count
    runner.stop()


def test_idle_connections_end_and_hold_few_threads(tmp_path, monkeypatch):
    monkeypatch.setattr(perception_server._Handler, "timeout", 1.0)
    runner = Runner(tmp_path, monkeypatch)
    before = threading.active_count()
    idle = [socket.create_connection(("127.0.0.1", runner.server.server_address[1])) for _ in range(200)]
    time.sleep(0.5)
    assert threading.active_count() - before <= 64
    time.sleep(1.5)
    assert threading.active_count() - before <= 2
    assert runner.ask("GET", "/")[0] == 200
    for link in idle:
        link.close()
    runner.stop()


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_the_answers_of_a_person_are_readable_by_the_owner_only(tmp_path, monkeypatch):
    runner = Runner(tmp_path, monkeypatch)
    assert runner.log.stat().st_mode & 0o777 == 0o600
    runner.stop()


def test_a_disk_that_is_full_keeps_the_trial_for_later(tmp_path, monkeypatch):
    runner = Runner(tmp_path, monkeypatch)
    with monkeypatch.context() as full:

        def write(handle, data):
            real(handle, bytes(data[:20]))
            raise OSError(28, "No space left on device")

        real = perception_server.os.write
        full.setattr("os.write", write)
        status, answer = runner.send(0)
    assert status == 503 and "No space left" in answer["error"]
    assert runner.send(0) == (200, {"next": 1})
    runner.stop()
    assert len(read_log(runner.log).trials) == 1


def test_ports(tmp_path, monkeypatch):
    runner = Runner(tmp_path, monkeypatch)
    taken = runner.server.server_address[1]
    for port in (taken, 70_000):
        with pytest.raises(ConfigError, match=f"port {port}: .*--port"):
            run_study_server(tmp_path / "tiny.yaml", participant=2, port=port, out=tmp_path)
    runner.stop()


def test_only_a_test_puts_a_script_into_the_page():
    assert page().count("<script>") == 1 and "http" not in page()  # nothing is fetched from elsewhere
    assert page("ours()").count("<script>") == 2


def test_the_browser_part_is_loaded_by_its_command_only():
    code = "import sys, holotorch, holotorch.cli, holotorch.perception;"
    code += "print([name for name in sys.modules if 'perception_server' in name or name == 'http.server'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_study_of_the_thesis():
    settings = load_study(CONFIG)
    assert sorted(settings.conditions) == sorted(THESIS_CONDITIONS)
    assert len([t for t in settings.design(1).trials if not t.practice]) == 728
    assert build_screen(settings.screen).field_deg[1] == pytest.approx(180, abs=0.01)
    assert [(c.eccentricity_deg, c.size_deg) for c in beyond_screen(settings)] == [(80, 23), (80, 26)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["screen.cut=false"], "23 deg at 80 deg reaches 91.5 deg and the screen 90.0 deg.*cut: true"),
        (["screen.size=[0.9, 7.4142]"], "23 deg at 40 deg takes 2241 pixels in height and the screen has 2100"),
        (["screen.distance=5 m"], "screen.distance: expected an eye inside the cylinder"),
        (["screen.size=[2, 20]"], "expected an arc of one turn"),
        (["screen={kind: flat, shape: [1080, 1920], size: [0.3, 0.53], distance: 0.5, cut: true}"], "even the middle"),
        (["screen={kind: round}"], "screen.kind: expected one of flat, curved, got 'round'"),
        (
            ["patterns=[{eccentricities_deg: -3, sizes_deg: 5}]"],
            "eccentricities_deg: expected an eccentricity between 0",
        ),
        (["patterns=[{eccentricities_deg: [9, 9], sizes_deg: 5}]"], "9 deg with size 5 deg is there twice"),
        (["patterns=[]"], "patterns: expected at least one"),
        (["timing={wait_s: [800, 1600]}"], "seconds, not milliseconds"),
        (["timing={wait_s: [2, 1]}"], "the shortest wait, then the longest"),
        (["ordr=thesis"], "did you mean 'order'"),
    ],
)
def test_mistakes_in_the_file(change, message):
    if "0.9" in change[0]:  # 2 * 2.36 m * tan(11.5 deg) * 2100 / 0.9 m = 2240.7
        change = [*change, "screen.cut=false", "patterns=[{eccentricities_deg: 40, sizes_deg: 23}]"]
    with pytest.raises(ConfigError, match=message):
        load_study(CONFIG, change)


def test_mistakes_have_their_place(tmp_path):
    (tmp_path / "study.yaml").write_text(TINY.replace("sizes_deg: 6", "sizes_deg: 90"))
    with pytest.raises(ConfigError, match=r"study.yaml:4:37: patterns.0.sizes_deg: expected a size between"):
        load_study(tmp_path / "study.yaml")
    with pytest.raises(ConfigError, match="participant: expected a number from 1, got 0"):
        (tmp_path / "study.yaml").write_text(TINY)
        run_study_server(tmp_path / "study.yaml", participant=0, out=tmp_path)
