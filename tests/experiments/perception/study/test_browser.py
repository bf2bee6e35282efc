"""The study in a real browser, with a participant that is a script: skipped where there is no Chromium."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from study_client import Client

from holotorch.experiments.perception.study.config import CurvedSettings, FlatSettings, build_screen, load_study
from holotorch.experiments.perception.study.log import read_log

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PARTICIPANT = Path(__file__).with_name("participant.js")
DISTANCE, WIDTH = 0.25, 0.4  # metres, on 800 pixels
STUDY = f"""
seed: 5
screen: {{kind: flat, shape: [600, 800], size: [0.3, {WIDTH}], distance: {DISTANCE}}}
patterns: [{{eccentricities_deg: 0, sizes_deg: 12}}, {{eccentricities_deg: 25, sizes_deg: [6, 10]}}]
repeats: {{target: 1, distraction: 1}}
practice: 2
timing: {{wait_s: [0.04, 0.08], show_s: 0.25, feedback_s: 0.04}}
"""
SERVE = """
import sys
from pathlib import Path
from holotorch.experiments.perception.study.run import run_study_server
config, port, out, script = sys.argv[1:]
sys.exit(run_study_server(config, port=int(port), participant=2, out=Path(out), script=Path(script).read_text()))
"""


def angles(azimuth: float, elevation: float) -> tuple[float, float, float]:
    a, e = math.radians(azimuth), math.radians(elevation)
    return math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)


CURVED = {"kind": "curved", "shape": [2100, 6400], "size": [2.433, 7.4142], "distance": 2.36, "radius": 2.36}
OFF = {"kind": "curved", "shape": [1000, 4000], "size": [1.0, 4.0], "distance": 1.2, "radius": 1.5}
FLAT = {"kind": "flat", "shape": [1080, 1920], "size": [0.3, 0.55], "distance": 0.4}
SEEN = [(CURVED, 80, 13), (CURVED, -45, 0), (OFF, 70, -8), (OFF, 0, 0), (FLAT, 30, 10), (FLAT, -12, -7)]
SCREENS = [(screen, *angles(azimuth, elevation)) for screen, azimuth, elevation in SEEN]


def place(screen: dict, x: float, y: float, z: float) -> tuple[float, float]:
    """Pixels of a direction, by walking along it until it leaves the screen's front."""

    def past(reach: float) -> bool:
        if screen["kind"] == "flat":
            return reach * z > screen["distance"]
        return math.hypot(reach * x, reach * z - screen["distance"] + screen["radius"]) > screen["radius"]

    near, far = 0.0, 100.0
    for _ in range(80):
        middle = (near + far) / 2
        near, far = (near, middle) if past(middle) else (middle, far)
    across, up, ahead = near * x, near * y, near * z
    if screen["kind"] == "curved":  # the arc by its chord from the screen's middle
        chord = math.hypot(across, ahead - screen["distance"])
        across = math.copysign(2 * screen["radius"] * math.asin(chord / 2 / screen["radius"]), across)
    (rows, columns), (height, width) = screen["shape"], screen["size"]
    return columns * (0.5 + across / width), rows * (0.5 - up / height)


@pytest.fixture
def collector():
    told: list[dict] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            told.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format, *args):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/", told
        server.shutdown()


@pytest.fixture
def start():
    """Start programs in groups of their own, and end them with the test."""
    running: list[subprocess.Popen] = []

    def popen(*words, **options) -> subprocess.Popen:
        running.append(subprocess.Popen([*map(str, words)], start_new_session=True, **options))
        return running[-1]

    yield popen
    for process in running:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def wait_for(what, seconds: float = 60):
    end = time.monotonic() + seconds
    while not (value := what()):
        assert time.monotonic() < end, "the study does not go on"
        time.sleep(0.02)
    return value


@pytest.mark.parametrize(("screen", "azimuth", "elevation"), SEEN)
def test_the_library_places_directions_where_the_page_does(screen, azimuth, elevation):
    kind = FlatSettings if screen is FLAT else CurvedSettings
    y, x = build_screen(kind.model_validate(screen)).pixels(elevation, azimuth)
    # The library counts from the middle of the first pixel, the page from its corner.
    assert (x.item() + 0.5, y.item() + 0.5) == pytest.approx(place(screen, *angles(azimuth, elevation)), abs=1e-6)


def lines(log: Path) -> int:
    return log.read_bytes().count(b"\n") if log.exists() else 0


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on the path")
def test_a_scripted_participant_takes_the_study_and_the_server_is_killed_on_the_way(tmp_path, collector, start):
    address, told = collector
    config, out, script = tmp_path / "study.yaml", tmp_path / "out", tmp_path / "participant.js"
    config.write_text(STUDY)
    design = load_study(config).design(2)
    trials = design.trials
    assert len(trials) == 2 + 3 * 2 * 2
    # Answers 40 to 140 ms after the onset; then a miss and a press at a distraction.
    plan = [40.0 + 25 * (i % 5) if trial.target else None for i, trial in enumerate(trials)]
    miss = next(i for i in range(9, len(trials)) if trials[i].target)
    wrong = next(i for i in range(3, len(trials)) if not trials[i].target)
    plan[miss], plan[wrong] = None, 60.0
    text = PARTICIPANT.read_text()
    for name, value in (("PLAN", plan), ("COLLECTOR", address), ("SCREENS", SCREENS)):
        text = text.replace(f"/*{name}*/ " + ('""' if name == "COLLECTOR" else "[]"), json.dumps(value))
    script.write_text(text)

    def serve(port: int):
        words = (sys.executable, "-c", SERVE, config, port, out, script)
        process = start(*words, stdout=subprocess.PIPE, text=True)
        said = ""
        while "http://" not in said:
            said = process.stdout.readline()
            assert said, "the server ended"
        return process, said[said.index("http://") :].strip()

    server, page = serve(0)
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
    words += [f"--user-data-dir={tmp_path / 'browser'}", "--window-size=800,600", "--screen-info={800x600}", "--kiosk"]
    start(CHROMIUM, *words, page, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    log = out / "participant-002.jsonl"
    wait_for(lambda: lines(log) >= 1 + 7)  # in the middle of round 2
    server.kill()
    server.wait()
    kept = read_log(log).trials
    assert len(kept) >= 7
    with open(log, "ab") as stream:  # as if it had been killed while it was writing
        stream.write(b'{"participant": 2, "round')
    server, _ = serve(Client(page).port)
    assert server.wait(60) == 0
    said = server.stdout.read()

    found = read_log(log)
    assert not found.torn and found.trials[: len(kept)] == kept
    # Every trial of the design once, in its order.
    keys = ("round", "trial", "eccentricity_deg", "size_deg", "side", "pattern", "target", "practice")
    assert [[t[k] for k in keys] for t in found.trials] == [[getattr(t, k) for k in keys] for t in trials]
    assert [t["responded"] for t in found.trials] == [delay is not None for delay in plan]
    wait_for(lambda: {fact["index"] for fact in told if "index" in fact} == set(range(len(trials))), 5)
    seen = {fact["index"]: fact for fact in told if "index" in fact}
    for i, (line, delay) in enumerate(zip(found.trials, plan, strict=True)):
        fact = seen[i]
        # A frame is what the participant's own clock says, the longest in this trial; 1 ms for the clock's grain.
        frame = fact["longest"] + 1
        assert abs(1e3 * line["onset_s"] - fact["seen"]) <= frame
        assert fact["red"] == (i == wrong)
        if delay is None:
            assert line["reaction_s"] is None and line["device"] is None
        else:
            assert line["device"] == "key"
            assert abs(1e3 * line["reaction_s"] - (fact["pressed"] - fact["seen"])) <= frame
            assert 1e3 * line["reaction_s"] >= delay - frame
        assert 0.002 < line["frame_s"] < 0.2
    assert "Hz" in said and f"{len(trials)} of {len(trials)} trials" in said

    where = next(fact["places"] for fact in told if "places" in fact)
    for got, (screen, *direction) in zip(where, SCREENS, strict=True):
        assert got == pytest.approx(place(screen, *direction), abs=1e-6)
    compared = 0
    for i, fact in seen.items():
        if "dark" in fact and trials[i].eccentricity_deg:
            assert fact["dark"] == pytest.approx(extent(trials[i]), abs=1.01)  # edges are shaded: a pixel
            compared += 1
    assert compared >= 4


def extent(trial) -> list[float]:
    """First and last dark pixel of a pattern on the flat screen: left, top, right, bottom."""
    e, half = math.radians(trial.eccentricity_deg), math.radians(trial.size_deg) / 2
    near, far = (DISTANCE * math.tan(e + turn) for turn in (-half, half))
    h = math.tan(half)
    if trial.pattern == "cross":  # the outer corner of the upright bar
        up = DISTANCE * h / (math.cos(e) - 0.2 * h * math.sin(e))
    else:
        turns = [math.radians(k / 10) for k in range(1800)]
        up = max(DISTANCE * h * math.sin(t) / (math.cos(e) - h * math.cos(t) * math.sin(e)) for t in turns)
    left, right = (near, far) if trial.side == "right" else (-far, -near)
    scale = 800 / WIDTH
    return [400 + scale * left, 300 - scale * up, 399 + scale * right, 299 + scale * up]
