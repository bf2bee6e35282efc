"""The speed of a machine is measured once and cached; a file that cannot be used does no harm."""

import json
import subprocess
import sys
from dataclasses import astuple

import pytest
import torch

from holotorch.experiments.planning import machine
from holotorch.experiments.planning.duration import duration
from holotorch.experiments.planning.machine import Machine, machine_speed, speed_file


@pytest.fixture
def measured(monkeypatch, tmp_path):
    """Counts the measurements, which take no time here; the cache is an empty folder."""
    calls = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(machine, "_measure", lambda device: calls.append(device) or Machine(2.0, 3.0, 4.0, 5.0, 6.0))
    monkeypatch.setattr(machine, "_transform", lambda device: 2.1)
    monkeypatch.setattr(machine, "_known", {})
    return calls


def forgotten(monkeypatch) -> Machine:
    monkeypatch.setattr(machine, "_known", {})
    return machine_speed()


def test_it_is_measured_once_and_read_by_the_next_process(measured, monkeypatch):
    assert machine_speed() == machine_speed() == forgotten(monkeypatch) == Machine(2.0, 3.0, 4.0, 5.0, 6.0)
    assert len(measured) == 1


def test_a_measurement_on_a_busy_machine_is_made_again(measured, monkeypatch):
    machine_speed()
    monkeypatch.setattr(machine, "_transform", lambda device: 0.9)
    assert forgotten(monkeypatch).small_fft == 2.0 and len(measured) == 2


@pytest.mark.parametrize("disturbed", [0, 1, 2, 3, 10])
def test_transforms_that_waited_for_other_programs_are_timed_again(disturbed, monkeypatch):
    """The last measurement counts in any case: a machine may be as slow as it seems."""
    calls, pauses = [], []

    def fastest(call, device, seconds=0.0):
        calls.append(call)
        python = len(calls) % 5 == 0
        return 7.5e-4 if python or len(calls) > 5 * disturbed else 0.1

    monkeypatch.setattr(machine, "_fastest", fastest)
    monkeypatch.setattr(machine.time, "sleep", pauses.append)
    speed = machine._measure(torch.device("cpu"))
    assert len(calls) == 5 * (1 + min(disturbed, 3)) and speed.interpreter == 1
    assert (speed.small_fft > 100) == (disturbed > 3) and len(pauses) == min(disturbed, 3) + 1


@pytest.mark.parametrize(
    "content",
    [
        "", "{", "[]", "null", '{"version": 0}', '{"version": 1, "ratios": {"small_fft": 1}}', "\\x00" * 100,
        json.dumps({"version": 1, "ratios": dict.fromkeys(vars(Machine()), "fast")}),
        json.dumps({"version": 1, "ratios": dict.fromkeys(vars(Machine()), 1e9)}),
        json.dumps({"version": 1, "ratios": dict.fromkeys(vars(Machine()), -1.0)}),
        '{"version": 1, "ratios": {"small_fft": NaN, "large_fft": 1, "elementwise": 1, "copy": 1, "interpreter": 1}}',
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_replaced(content, measured, monkeypatch):
    speed_file().parent.mkdir(parents=True, exist_ok=True)
    speed_file().write_text(content)
    assert machine_speed() == Machine(2.0, 3.0, 4.0, 5.0, 6.0) and len(measured) == 1
    assert forgotten(monkeypatch) == Machine(2.0, 3.0, 4.0, 5.0, 6.0) and len(measured) == 1


def test_a_folder_that_cannot_be_written_costs_only_a_measurement(measured, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert machine_speed() == forgotten(monkeypatch) and len(measured) == 2


def test_another_number_of_threads_is_another_machine(measured):
    here, before = speed_file(), torch.get_num_threads()
    torch.set_num_threads(before + 1)
    try:
        assert speed_file() != here
    finally:
        torch.set_num_threads(before)


def test_ratios_of_transforms_lie_between_those_of_the_two_sizes():
    speed = Machine(small_fft=2.0, large_fft=8.0)
    assert speed.fft(16) == speed.fft(256**2) == 2 and speed.fft(1e9) == pytest.approx(8)
    assert speed.fft(512**2) == pytest.approx(4)
    assert speed.around(3) > speed.around(0) > 0


def test_a_real_measurement_is_plausible_and_leaves_random_numbers_alone():
    before = torch.get_rng_state()
    speed = machine._measure(torch.device("cpu"))
    assert torch.equal(before, torch.get_rng_state())
    assert all(1e-4 < ratio < 1e4 for ratio in astuple(speed))


def test_importing_holotorch_measures_nothing():
    code = "import holotorch, holotorch.optics, sys; assert not any('planning.machine' in m for m in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "0 s"),
        (0.023, "0.023 s"),
        (99.4, "99 s"),
        (100, "1.7 min"),
        (5900, "98 min"),
        (6000, "1.7 h"),
        (4e5, "111 h"),
    ],
)
def test_durations_have_two_digits_in_a_fitting_unit(seconds, words):
    assert duration(seconds) == words
