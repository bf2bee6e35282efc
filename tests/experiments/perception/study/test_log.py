import json
import os
import signal
import subprocess
import sys

import pytest

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.frames import quantisation
from holotorch.experiments.perception.study.log import TrialLog, read_log, read_logs

HEADER = {"participant": 4, "design": "abc", "screen": {"shape": (600, 800)}}


def trial(number: int, **change) -> dict:
    facts = {"participant": 4, "round": 1, "trial": number, "eccentricity_deg": 40.0, "size_deg": 5.0}
    facts |= {"pattern": "cross", "target": True, "practice": False, "responded": True, "onset_s": 2.0}
    facts |= {"response_s": 2.5, "reaction_s": 0.5, "frame_s": 0.0167, "design": "abc", "time_utc": "2026-01-01"}
    return facts | change


@pytest.fixture
def path(tmp_path):
    return tmp_path / "participant-004.jsonl"


def write(path, count: int):
    with TrialLog(path, HEADER) as log:
        for i in range(len(log.trials), len(log.trials) + count):
            log.append(trial(i + 1))


def test_trials_come_back_and_a_log_goes_on(path):
    write(path, 2)
    write(path, 1)
    log = read_log(path)
    assert log.header == {"format": "holotorch-trials", "version": 1, **HEADER, "screen": {"shape": [600, 800]}}
    assert log.trials == [trial(1), trial(2), trial(3)] and not log.torn


@pytest.mark.parametrize("kept", [1, 30, -1])
def test_what_a_crash_left_of_a_line_is_left_out_and_then_cut_off(path, kept):
    write(path, 2)
    whole = path.read_bytes()
    path.write_bytes(whole + json.dumps(trial(3)).encode()[:kept])
    log = read_log(path)
    assert log.torn and log.trials == [trial(1), trial(2)]
    write(path, 1)
    assert path.read_bytes() == whole + json.dumps(trial(3)).encode() + b"\n"


def test_a_crash_within_the_header_costs_nothing(path):
    path.write_bytes(b'{"format": "holo')
    write(path, 1)
    assert read_log(path).trials == [trial(1)]


def test_kill_9_loses_no_trial_that_was_appended(path):
    code = """
import json, os, sys
from pathlib import Path
from holotorch.experiments.perception.study.log import TrialLog
log = TrialLog(Path(sys.argv[1]), json.loads(sys.argv[2]))
for number in range(1, 10**6):
    log.append(json.loads(sys.argv[3]) | {"trial": number})
    print(number, flush=True)
"""
    words = [sys.executable, "-c", code, str(path), json.dumps(HEADER), json.dumps(trial(1))]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    said = [process.stdout.readline() for _ in range(20)]
    os.kill(process.pid, signal.SIGKILL)
    said += process.stdout.readlines()
    process.wait()
    acknowledged = len([line for line in said if line.endswith("\n")])
    # The one that was being written when the signal came may be there or not.
    assert len(read_log(path).trials) in (acknowledged, acknowledged + 1)
    write(path, 1)  # the lock went with the program


def test_broken_lines_are_all_named_with_their_place(path):
    write(path, 3)
    lines = path.read_text().splitlines()
    lines[1] = lines[1].replace('"pattern": "cross"', '"pattern": "square"')
    lines[2] = lines[2][:40]
    wrong = [trial(3), trial(9, participant=5), trial(10, reaction_s=None), trial(11, onset_s=True), [1]]
    lines += [json.dumps(line) for line in wrong] + [json.dumps(trial(12, frame_s=float("nan"))), "\u00ff"]
    path.write_bytes("\n".join([*lines, ""]).encode("latin-1"))
    with pytest.raises(ConfigError) as caught:
        read_log(path)
    found = caught.value.mistakes
    starts = [
        "2:1: not a trial: pattern: expected cross or circle, got 'square'",
        "3:41: not a line of JSON: Expecting value",
    ]
    starts += ["5:1: round 1, trial 3 is already in line 4", "6:1: participant 5 in the log of 4"]
    starts += ["7:1: not a trial: response_s and reaction_s", "8:1: not a trial: onset_s: expected a finite number"]
    starts += ["9:1: expected {...}, got [1]", "10:1: not a trial: frame_s", "11:1: not UTF-8"]
    for start, line in zip(starts, found, strict=True):
        assert line.startswith(f"{path}:{start}")
    with pytest.raises(ConfigError, match="not a line of JSON"):
        TrialLog(path, HEADER)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the log is empty"),
        ('{"format": "other"}\n', "not a log of a study"),
        ('{"format": "holotorch-trials", "version": 2}\n', "version 1"),
        ('{"format": "holotorch-trials", "version": 1, "participant": [4]}\n', "expected a whole number, got \\[4\\]"),
        ("a,b\n1,2\n", ":1:1: not a line of JSON"),
    ],
)
def test_files_that_are_no_logs(path, text, message):
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_log(path)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the log"):
        read_log(tmp_path / "none.jsonl")
    with pytest.raises(ConfigError, match="no logs"):
        read_logs([])


def test_a_number_belongs_to_one_participant(path, tmp_path):
    write(path, 1)
    other = tmp_path / "other.jsonl"
    other.write_bytes(path.read_bytes())
    with pytest.raises(ConfigError, match="participant 4 is in .*; two people need two numbers"):
        read_logs([path, other])
    pytest.importorskip("fcntl")
    with TrialLog(path, HEADER), pytest.raises(ConfigError, match="recorded by another program"):
        TrialLog(path, HEADER)
    with pytest.raises(ConfigError, match="begun with another design: 'abc', now 'xyz'"):
        TrialLog(path, HEADER | {"design": "xyz"})
    assert read_log(path).trials == [trial(1)]


def test_only_trials_are_appended(path):
    with TrialLog(path, HEADER) as log:
        with pytest.raises(ValueError, match="size_deg is missing"):
            log.append({key: value for key, value in trial(1).items() if key != "size_deg"})
        with pytest.raises(ValueError, match="reaction_s: expected a finite number, 0 or more, or null, got -0.1"):
            log.append(trial(1, reaction_s=-0.1))
    with pytest.raises(OSError, match="descriptor"):
        log.append(trial(1))
    assert read_log(path).trials == []


def test_a_line_that_could_not_be_cut_off_is_cut_off_later(path, monkeypatch):
    with TrialLog(path, HEADER) as log:
        log.append(trial(1))
        with monkeypatch.context() as broken:

            def write(handle, data):
                real(handle, bytes(data[:20]))
                raise OSError(5, "Input/output error")

            def cut(handle, size):
                if size < os.fstat(handle).st_size:
                    raise OSError(5, "Input/output error")

            real = os.write
            broken.setattr(os, "write", write)
            broken.setattr(os, "ftruncate", cut)
            with pytest.raises(OSError, match=path.name):
                log.append(trial(2))
        assert read_log(path).torn
        log.append(trial(2))
    assert read_log(path).trials == [trial(1), trial(2)]


def test_quantisation_of_60_hz():
    found = quantisation([1 / 60] * 5)
    assert found is not None
    # A step of 16.67 ms has a deviation of 16.67 / sqrt(12) = 4.81 ms.
    assert found.frame_s == pytest.approx(0.0166667, abs=1e-7) and found.deviation_s == pytest.approx(
        4.811e-3, abs=1e-6
    )
    assert "16.7 ms (60 Hz) over 5 trials" in str(found) and "4.8 ms" in str(found)
    uneven = quantisation([0.01, 0.02, 0.01])
    assert "went from 10.0 to 20.0 ms" in str(uneven)
    assert quantisation([]) is None
