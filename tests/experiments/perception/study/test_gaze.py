"""Gaze samples, the check of the fixation, and the study with an eye tracker that is a program of the test."""

import json
import math
import random
import time

import pytest
from pydantic import ValidationError
from study_client import TINY, Runner

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.analysis.curves import read_responses
from holotorch.experiments.perception.study.design import make_design
from holotorch.experiments.perception.study.gaze import GazeFile, GazeSample, GazeSettings, GazeTrack, read_gaze
from holotorch.experiments.perception.study.log import read_log
from holotorch.experiments.perception.study.order import Order

SETTINGS = GazeSettings(source="tracker")


def sample(moment, x: object = 0.0, y: object = 0.0, valid=True):
    return {"time": moment, "x_deg": x, "y_deg": y, "valid": valid}


def track(samples, settings=SETTINGS):
    made = GazeTrack(settings)
    made.add([sample(*each) for each in samples])
    return made


def test_the_angle_is_that_between_two_directions():
    for x, y in ((0, 0), (3, 0), (0, -3), (40, 25), (-120, 60), (1e-9, 0)):
        a, e = math.radians(x), math.radians(y)
        direction = (math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a))
        across, ahead = math.hypot(direction[0], direction[1]), direction[2]
        expected = math.degrees(math.acos(ahead)) if abs(ahead) < 0.9 else math.degrees(math.asin(across))
        assert GazeSample(0, x, y, True).angle_deg == pytest.approx(expected, abs=1e-9)
    assert GazeSample(0, 0, 0, False).angle_deg == math.inf


def test_what_is_no_sample_is_dropped_and_counted():
    made, now, huge = GazeTrack(SETTINGS), 1000.0, 10**400
    good = made.add([sample(999.5), sample(999.6, 4, -2), {**sample(999.7), "valid": False, "x_deg": None}], now)
    assert len(good) == 3 and made.accepted == 3 and not made.dropped
    malformed = [None, 3, "x", [], {}, {"time": 1}, sample("1"), sample(True), sample(999.8, "0"), sample(999.8, None)]
    malformed += [{**sample(999.8), "valid": 1}, sample(999.8, 181), sample(999.8, 0, 91)]
    nan = float("nan")
    infinite = [sample(nan), sample(999.8, nan), sample(999.8, 0, math.inf), sample(huge)]
    disordered = [sample(999.7), sample(999.2)]
    foreign = [sample(5.0), sample(1002.0), sample(-1e300)]
    assert made.add(malformed + infinite + disordered + foreign, now) == []
    assert made.dropped == {"malformed": len(malformed), "not finite": 4, "out of order": 2, "clock": 3}
    assert made.add(sample(999.9), now) and made.accepted == 4  # one alone, and the good ones go on
    assert "4 gaze samples; dropped: 3 clock" in str(made)


def test_random_json_never_raises():
    generator = random.Random(4)

    def value(depth=0):
        simple = [None, True, -1, 2.5, float("nan"), 10**500, "time", "", -math.inf]
        if depth > 3 or generator.random() < 0.4:
            return generator.choice(simple)
        if generator.random() < 0.3:
            return [value(depth + 1) for _ in range(3)]
        keys = generator.sample(["time", "x_deg", "y_deg", "valid", "x"], 4)
        return {key: value(depth + 1) for key in keys}

    made = GazeTrack(SETTINGS)
    for _ in range(5000):
        made.add(value(), 2.0)
    assert sum(made.dropped.values()) > 1000
    made.check(0, 1)


def steady(start, end, x=0.0, step=0.01):
    return [(start + k * step, x) for k in range(round((end - start) / step) + 1)]


def test_fixation_before_and_during_is_judged_apart():
    held = track(steady(9, 12)).check(10, 11)
    assert held.held and (held.before, held.during) == (1, 1) and held.samples == 31 + 101
    # A glance away for a quarter of the time of the pattern, and the same glance before it.
    during = track([*steady(9, 10.5), *steady(10.51, 10.76, 8), *steady(10.77, 12)]).check(10, 11)
    assert not during.held and during.before == 1 and during.during == pytest.approx(75 / 101)
    before = track([*steady(9, 9.79), *steady(9.8, 9.89, 8), *steady(9.9, 12)]).check(10, 11)
    assert not before.held and before.before == pytest.approx(21 / 31) and before.during == 1
    # The share and the radius are those of the settings.
    for change in ({"share": 0.7}, {"radius_deg": 8.5}):
        assert track([*steady(9, 10.5), *steady(10.51, 10.76, 8), *steady(10.77, 12)],
                     GazeSettings.model_validate({"source": "tracker"} | change)).check(10, 11).held  # fmt: skip
    # A saccade after the answer is nobody's business.
    assert track([*steady(9, 10.4), *steady(10.41, 12, 50)]).check(10, 10.4).held


def test_a_silent_tracker_and_a_closed_eye_do_not_hold_fixation():
    gap = track([*steady(9, 10.3), *steady(10.6, 12)]).check(10, 11)
    assert not gap.held and gap.during == 1 and gap.gap_s == pytest.approx(0.3)
    none = track([]).check(10, 11)
    assert not none.held and none.before is None and none.samples == 0
    assert not track(steady(9, 10.4)).check(10, 11).held  # it fell silent
    blink = GazeTrack(SETTINGS)
    blink.add([sample(moment, valid=not 10.2 < moment < 10.5) for moment, _ in steady(9, 12)])
    assert not blink.check(10, 11).held and blink.check(10.6, 11.6).before == pytest.approx(11 / 31, abs=0.04)


def test_the_cross_hair_follows_the_newest_samples():
    looks = track(steady(9, 10))
    assert looks.fixated(10.1) and not looks.fixated(10.2)  # gap_s is 0.15
    looks.add([sample(10 + k / 100, 20) for k in range(1, 11)])
    assert not looks.fixated(10.1)
    assert not GazeTrack(SETTINGS).fixated(10)


def test_files_of_samples(tmp_path):
    path = tmp_path / "gaze.csv"
    file = GazeFile(path)
    file.write([GazeSample(1.0, 2.5, -1, True), GazeSample(2.0, math.nan, math.nan, False)])
    file.close()
    GazeFile(path).close()  # goes on without a second header
    with open(path, "a") as stream:
        stream.write(
            "3.0,0,0,1\n2.5,0,0,1\nnan,0,0,1\n4.0,0,1\n4.0,a,0,1\n\n5.0,,,0\n6.0,0,0,maybe\n7.0,0,0,1,9\n\0,0,0,1\n8.0,0"
        )
    made = read_gaze(path, SETTINGS)
    assert made.accepted == 4
    assert made.dropped == {"out of order": 1, "not finite": 1, "malformed": 7}
    for text in ("", "t,x,y,v\n", "time,x_deg,y_deg\n"):
        path.write_text(text)
        with pytest.raises(ConfigError, match="expected a first line time,x_deg,y_deg,valid"):
            read_gaze(path, SETTINGS)
    with pytest.raises(ConfigError, match="cannot read the gaze samples: No such file"):
        read_gaze(tmp_path / "none.csv", SETTINGS)


def test_settings_of_the_gaze():
    for wrong in ({"source": "eye"}, {"radius_deg": 0}, {"share": 1.2}, {"before_s": 300}, {"attempts": 0}, {}):
        with pytest.raises(ValidationError):
            GazeSettings.model_validate({"source": "tracker"} | wrong if wrong else {})


def test_broken_trials_come_again_at_the_end_of_their_round():
    design = make_design(1, [(50.0, 8.0)], target_repeats=2, distraction_repeats=0, practice=1, seed=1)
    order = Order(design, attempts=2)
    assert [a.trial.round for a in order.appearances] == [0, 1, 2, 3, 4]
    order.record(0, False)  # practice
    order.record(1, False)
    assert [(a.trial.round, a.attempt) for a in order.appearances] == [(0, 1), (1, 1), (1, 2), (2, 1), (3, 1), (4, 1)]
    assert order.repeat_of(0) is None and order.repeat_of(1) == 2
    order.record(2, False)  # the last attempt
    order.record(3, True)
    assert len(order.appearances) == 6


GAZE = TINY + "gaze: {source: tracker, attempts: 2, gap_s: 0.5}\n"


def test_the_study_with_an_eye_tracker(tmp_path, capsys):
    """Trial 1 is broken, its repeat is held; the server is stopped and goes on between them."""
    runner = Runner(tmp_path, text=GAZE)

    def answer(number, x, on=runner):
        onset = time.time() - 0.4
        samples = [sample(onset - 0.5 + k / 100, x) for k in range(90)]
        assert on.ask("POST", "/gaze", samples)[1]["accepted"] == 90
        assert on.ask("POST", "/fixation", {"window": "w", "fixated": x != 0}) == (200, {"fixated": x == 0})
        status, said = on.send(number, onset_unix_s=onset)
        time.sleep(0.9)  # samples of the next trial are later
        return status, said

    status, session = runner.ask("POST", "/session", {"window": "w"})
    assert status == 200 and session["gaze"]["radius_deg"] == 3 and [t["attempt"] for t in session["trials"]] == [1] * 3
    assert runner.send(0)[0] == 400  # without onset_unix_s
    assert answer(0, 0.0) == (200, {"next": 1})
    status, said = answer(1, 20.0)
    assert status == 200 and said["next"] == 2 and said["repeat_at"] == 2 and said["repeat"]["attempt"] == 2
    assert runner.send(1, onset_unix_s=5.0)[1] == said  # sent again
    for bad in (b"[1, {}", {"time": "x"}, [[]], None, b"null", b"[" * 5000):
        assert runner.ask("POST", "/gaze", bad)[0] in (200, 400)
    assert runner.ask("POST", "/gaze", [sample(time.time())] * 300)[0] == 400  # too large
    assert runner.ask("POST", "/gaze", sample(1.0), Authorization="")[0] == 403
    assert runner.ask("POST", "/fixation", {"window": "w"})[0] == 400
    runner.stop()
    said = capsys.readouterr().out
    assert "waiting for samples of the eye tracker" in said and "fixation broken in 1 of 1 trials" in said
    assert "malformed" in said and "180 gaze samples" in said

    second = Runner(tmp_path, text=GAZE)
    _, session = second.ask("POST", "/session", {"window": "w"})
    assert session["next"] == 2 and [(t["round"], t["attempt"]) for t in session["trials"]] == [
        (0, 1), (1, 1), (1, 2), (2, 1)]  # fmt: skip
    answer(2, 0.0, second)
    answer(3, 0.0, second)
    second.thread.join(10)
    assert second.status == 0
    lines = read_log(second.log).trials
    assert [(t["round"], t["attempt"], t["fixated"]) for t in lines] == [
        (0, 1, True), (1, 1, False), (1, 2, True), (2, 1, True)]  # fmt: skip
    assert lines[1]["fixation"]["during"] == 0 and lines[1]["fixation"]["source"] == "tracker"
    assert read_gaze(second.log.with_suffix(".gaze.csv"), SETTINGS).accepted == 360
    made = read_responses([str(second.log)])
    assert len(made.target) == 2 and made.broken == 1


def test_without_an_eye_tracker_nothing_is_taken_or_written(tmp_path):
    runner = Runner(tmp_path)
    _, session = runner.ask("POST", "/session", {"window": "w"})
    assert "gaze" not in session
    assert runner.ask("POST", "/gaze", sample(time.time()))[0] == 404
    runner.send(0)
    runner.stop()
    log = read_log(runner.log)
    assert "gaze" not in log.header and not {"fixated", "attempt", "onset_unix_s"} & log.trials[0].keys()
    assert not list(tmp_path.glob("*.gaze.csv"))


def test_samples_in_a_file_are_checked_by_the_analysis(tmp_path):
    runner = Runner(tmp_path, text=TINY + "gaze: {source: file}\n")
    for number in range(3):
        runner.send(number, onset_unix_s=100.0 + 10 * number)
    runner.thread.join(10)
    assert runner.status == 0
    with pytest.raises(ConfigError, match=r"participant-001.gaze.csv: cannot read the gaze samples"):
        read_responses([str(runner.log)])
    file = GazeFile(runner.log.with_suffix(".gaze.csv"))
    for onset, x in ((100.0, 0), (110.0, 20), (120.0, 1)):  # practice, broken, held
        file.write([GazeSample(moment, x, 0, True) for moment, _ in steady(onset - 0.5, onset + 0.5)])
    file.close()
    made = read_responses([str(runner.log)])
    assert len(made.target) == 1 and made.broken == 1
    assert made.reaction_s.tolist() == [0.25]


def test_results_with_the_mouse_are_refused_by_the_analysis(tmp_path):
    runner = Runner(tmp_path, text=TINY + "gaze: {source: mouse}\n")
    runner.stop()
    header, *_ = runner.log.read_text().splitlines()
    assert json.loads(header)["gaze"]["source"] == "mouse"
    with pytest.raises(ConfigError, match="mouse stood in for an eye tracker.*leave this log out"):
        read_responses([str(runner.log)])
    other = tmp_path / "other.jsonl"
    other.write_text(header.replace('"mouse"', '"nose"') + "\n")
    with pytest.raises(ConfigError, match="settings of the gaze cannot be read: source"):
        read_responses([str(other)])
