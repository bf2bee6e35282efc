import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import asynccontextmanager

import pytest
from paths import ROOT
from study_client import TINY, Client, Runner, closed

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study import log as perception_log
from holotorch.experiments.perception.study import run as perception_run
from holotorch.experiments.perception.study import server as perception_server
from holotorch.experiments.perception.study.config import beyond_screen, build_screen, load_study
from holotorch.experiments.perception.study.design import THESIS_CONDITIONS, Design
from holotorch.experiments.perception.study.log import read_log
from holotorch.experiments.perception.study.run import run_study_server
from holotorch.experiments.perception.study.server import page

CONFIG = ROOT / "configs" / "perception" / "study.yaml"


def test_a_session_is_recorded_goes_on_and_ends(tmp_path, capsys):
    first = Runner(tmp_path)
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

    second = Runner(tmp_path)
    assert second.send(2, window="kept its page open") == (200, {"next": 3})
    second.thread.join(10)
    assert second.status == 0
    said = capsys.readouterr().out
    assert "goes on at trial 3 of 3; a new person needs a new number" in said
    assert "3 of 3 trials" in said and "16.7 ms (60 Hz) over 3 trials" in said
    with pytest.raises(ConfigError, match="participant 1 is complete; choose another number"):
        run_study_server(tmp_path / "tiny.yaml", participant=1, out=tmp_path)


def test_a_changed_study_does_not_go_on(tmp_path):
    Runner(tmp_path).stop()
    for change, name in ((("seed: 1", "seed: 2"), "design"), (("0.25", "0.3"), "screen")):
        (tmp_path / "tiny.yaml").write_text(TINY.replace(*change))
        with pytest.raises(ConfigError, match=f"begun with another {name}.*restore the configuration"):
            run_study_server(tmp_path / "tiny.yaml", participant=1, out=tmp_path)


def test_two_programs_and_two_windows_for_one_participant(tmp_path):
    runner = Runner(tmp_path)
    pytest.importorskip("fcntl")
    with pytest.raises(ConfigError, match="participant 1 is being recorded by another program"):
        run_study_server(tmp_path / "tiny.yaml", participant=1, out=tmp_path)
    runner.ask("POST", "/session", {"window": "one"})
    runner.ask("POST", "/session", {"window": "two"})
    assert runner.send(0, "one") == (409, {"error": "the study was opened in another window; close this one"})
    assert runner.send(0, "two")[0] == 200
    runner.stop()
    assert len(read_log(runner.log).trials) == 1


def test_results_that_cannot_be_are_refused(tmp_path):
    runner = Runner(tmp_path)
    cases = [
        ({"onset_s": None}, "onset_s: expected seconds"),
        ({"onset_s": True}, "onset_s: expected seconds"),
        ({"onset_s": float("nan")}, "onset_s: expected seconds"),
        ({"onset_s": 10**400}, "onset_s: expected seconds"),
        ({"frame_s": 0}, "frame_s: expected more than 0"),
        ({"response_s": 0.5}, "response_s: expected a time after onset_s"),
        ({"early": -1}, "early: expected a count, 0 or more, got -1"),
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
    assert (
        runner.ask("POST", "/session", {"window": "w"}, **{"Content-Type": "Application/JSON; charset=utf-8"})[0] == 200
    )
    assert runner.ask("POST", "/trial", {}, **{"Content-Type": "(" * 3000})[0] == 404  # a find of fuzzing
    assert runner.ask("GET", "/../secrets")[0] == 404
    for foreign in ("evil.example:80", "evil.example", ""):
        assert runner.ask("POST", "/session", {"window": "x"}, Host=foreign)[0] == 403
    assert runner.ask("GET", "/", Host="127.0.0.1")[0] == 200  # as a browser asks at port 80
    runner.stop()
    assert read_log(runner.log).trials == []


def test_no_other_page_takes_the_session_over(tmp_path):
    runner = Runner(tmp_path)
    own = f"127.0.0.1:{runner.port}"
    assert runner.ask("POST", "/session", {"window": "mine"}, Origin=f"http://{own}", Host=own)[0] == 200
    assert runner.ask("GET", "/session?theirs")[0] == 404
    for headers in ({"Origin": "http://example.org"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}):
        assert runner.ask("POST", "/session", {"window": "theirs"}, **headers)[0] == 403
        assert runner.ask("POST", "/trial", {"window": "theirs"}, **headers)[0] == 403
    assert runner.ask("POST", "/session", {"window": "theirs"}, **{"Content-Type": "text/plain"})[0] == 404
    assert runner.ask("POST", "/session", {"window": 3})[0] == 400
    assert runner.send(0, "mine")[0] == 200  # still the window whose results count
    runner.stop()


def test_all_but_the_page_needs_the_token(tmp_path):
    runner = Runner(tmp_path)
    runner.ask("POST", "/session", {"window": "w"})
    token = runner.token
    for wrong in ("", token, f"Bearer {token[:-1]}", f"Bearer {token}x", f"bearer {token}", "Bearer ", "Bearer \xe9"):
        for method, path in (("POST", "/session"), ("POST", "/trial"), ("GET", "/trial"), ("GET", "/x"), ("PUT", "/")):
            assert runner.ask(method, path, {"window": "other"}, Authorization=wrong)[0] == 403
    assert token not in runner.ask("GET", "/", Authorization="")[1]["text"]
    assert runner.ask("GET", f"/?{token}", Authorization="", Cookie=f"token={token}")[0] == 200
    assert runner.send(0)[0] == 200  # still the window whose results count
    runner.stop()
    other = Runner(tmp_path, participant=2)
    assert other.token != token
    other.stop()


def test_an_open_page_goes_on_after_a_restart_until_the_study_is_complete(tmp_path, capsys):
    first, file = Runner(tmp_path), tmp_path / "participant-001.token"
    first.send(0)
    first.stop()
    assert f"pixels): {first.server.address}#{file.read_text()}\n" in capsys.readouterr().out
    second = Runner(tmp_path)
    assert second.token == first.token
    second.stop()
    for spoiled in ("", "x", "\xe9" * 43):
        file.write_text(spoiled)
        third = Runner(tmp_path)
        assert len(third.token) == 43 and third.token == file.read_text()
        third.stop()
    if os.name != "nt":  # others may have read it
        file.chmod(0o644)
        Runner(tmp_path).stop()
        assert file.read_text() != third.token and file.stat().st_mode & 0o777 == 0o600
    last = Runner(tmp_path)
    last.send(1)
    last.send(2)
    last.thread.join(10)
    assert last.status == 0 and not file.exists()


def test_eight_hundred_idle_connections_keep_nobody_from_answering(tmp_path):
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(limits[0], min(2000, limits[1])), limits[1]))
    runner = Runner(tmp_path)
    threads = threading.active_count()
    idle = [runner.connect(data) for data in 400 * [b"", b"POST /trial HTTP/1.1\r\n"]]
    assert runner.send(0) == (200, {"next": 1})
    assert runner.ask("GET", "/")[0] == 200
    assert sum(not closed(link) for link in idle) <= 64 and threading.active_count() == threads
    for link in idle:
        link.close()
    assert runner.stop() == 130
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_no_connection_lasts_however_slowly_it_sends(tmp_path, monkeypatch):
    monkeypatch.setattr(perception_server, "_SECONDS", 0.5)
    runner = Runner(tmp_path)
    bearer = f"Content-Type: application/json\r\nAuthorization: Bearer {runner.token}"
    start = f"POST /trial HTTP/1.1\r\nHost: localhost:{runner.port}\r\n{bearer}\r\nContent-Length: 300\r\n"
    links = [runner.connect(), runner.connect(start.encode()), runner.connect(f"{start}\r\n".encode())]
    links.append(runner.connect(f"{start.replace('Bearer', 'wrong')}\r\n".encode()))  # answered, body to come
    begin = time.monotonic()
    slow = set(links[1:])
    while slow and time.monotonic() - begin < 5:
        time.sleep(0.05)
        for link in list(slow):
            try:
                link.sendall(b" ")
            except OSError:
                slow.discard(link)
    assert 0.4 < time.monotonic() - begin < 3 and closed(links[0])
    assert runner.send(0) == (200, {"next": 1})
    for link in links:
        link.close()
    runner.stop()


def test_the_end_waits_for_no_connection(tmp_path):
    runner = Runner(tmp_path)
    links = [runner.connect(), runner.connect(b"GET / HTTP/1.1\r\n")]
    assert runner.send(0)[0] == 200
    begin = time.monotonic()
    assert runner.stop() == 130 and time.monotonic() - begin < 2
    for link in links:
        link.close()


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_the_answers_of_a_person_are_readable_by_the_owner_only(tmp_path):
    runner = Runner(tmp_path)
    for suffix in (".jsonl", ".token"):
        assert runner.log.with_suffix(suffix).stat().st_mode & 0o777 == 0o600
    runner.stop()


def test_a_disk_that_is_full_keeps_the_trial_for_later(tmp_path, monkeypatch):
    runner = Runner(tmp_path)
    with monkeypatch.context() as full:

        def write(handle, data):
            real(handle, bytes(data[:20]))
            raise OSError(28, "No space left on device")

        real = perception_log.os.write
        full.setattr("os.write", write)
        status, answer = runner.send(0)
    assert status == 503 and "No space left" in answer["error"]
    assert runner.send(0) == (200, {"next": 1})
    runner.stop()
    assert len(read_log(runner.log).trials) == 1


def test_malformed_requests_are_not_logged(tmp_path, caplog, monkeypatch):
    """Nor after other code has configured logging, which may enable all loggers (a find of fuzzing)."""
    monkeypatch.setattr(perception_server._QUIET, "disabled", False)
    runner = Runner(tmp_path)
    with runner.connect(b"GET / HTTP/1.1\r\n: x\r\n\r\n") as link:
        assert link.recv(100).startswith(b"HTTP/1.0 400")
    runner.stop()
    assert not caplog.records


def test_ports(tmp_path):
    runner = Runner(tmp_path)
    taken = runner.port
    for port in (taken, 70_000):
        with pytest.raises(ConfigError, match=f"port {port}: .*--port"):
            run_study_server(tmp_path / "tiny.yaml", participant=2, port=port, out=tmp_path)
    runner.stop()


def test_only_a_test_puts_a_script_into_the_page():
    assert page().count("<script>") == 1 and "http" not in page()  # nothing is fetched from elsewhere
    assert page("ours()").count("<script>") == 2


def test_the_browser_part_is_loaded_by_its_command_only(tmp_path):
    (tmp_path / "tiny.yaml").write_text(TINY)
    code = f"""
import sys, holotorch, holotorch.cli, holotorch.perception
status = holotorch.cli.main(["check", {str(ROOT / "configs" / "demo.yaml")!r}])
print(status, [name for name in sys.modules if "perception_server" in name or name in ("aiohttp", "http.server")])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 []"


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_signals_end_the_study_and_the_next_start_goes_on(tmp_path, monkeypatch, capsys, name):
    def take_a_trial(address):
        assert Client(address).send(0) == (200, {"next": 1})
        for _ in range(2):  # the second changes nothing
            signal.pthread_kill(threading.main_thread().ident or 0, getattr(signal, name))

    class Server(perception_run.StudyServer):
        @asynccontextmanager
        async def listening(self, port=0):
            async with super().listening(port):
                threading.Thread(target=take_a_trial, args=(f"{self.address}#{self.token}",)).start()
                yield

    (tmp_path / "tiny.yaml").write_text(TINY)
    with monkeypatch.context() as patch:
        patch.setattr(perception_run, "StudyServer", Server)
        assert main(["study", str(tmp_path / "tiny.yaml"), "--out", str(tmp_path)]) == 130
    said = capsys.readouterr().out
    assert "interrupted\n1 of 3 trials in" in said and "(60 Hz) over 1 trials" in said
    runner = Runner(tmp_path)
    assert f"#{runner.token}" in said
    assert runner.ask("POST", "/session", {"window": "w"})[1]["next"] == 1
    runner.stop()


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
        (["screen.distance=21"], "usually 50 mm to 5 m, got 21; write 21 cm, or 21 m if metres are meant"),
        (["screen.distance=21 m"], "screen.distance: expected an eye inside the cylinder"),
        (
            ["screen.radius=236"],
            "screen.radius: expected a length .*, got 236; 236 means metres: did you mean '236 mm'",
        ),
        (["screen.size=[2, 20]"], "expected an arc of at most one turn"),
        (["screen={kind: flat, shape: [1080, 1920], size: [0.3, 0.53], distance: 0.5, cut: true}"], "even the middle"),
        (["screen={kind: round}"], "screen.kind: expected one of flat, curved, got 'round'"),
        (
            ["patterns=[{eccentricities_deg: -3, sizes_deg: 5}]"],
            "eccentricities_deg: expected an eccentricity between 0",
        ),
        (["patterns=[{eccentricities_deg: [9, 9], sizes_deg: 5}]"], "9 deg with size 5 deg is there twice"),
        (["patterns=[]"], "patterns: expected at least 1 entry"),
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
