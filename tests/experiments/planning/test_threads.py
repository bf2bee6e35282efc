"""Threads of a command on a machine that other programs use."""

import json

import pytest
import torch
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments import execute
from holotorch.experiments.planning import threads
from holotorch.experiments.planning.threads import undisturbed
from holotorch.experiments.sweep.one import carry_out

SHARE = threads._share  # the real one
TINY = ("volume={phantom: shells, samples: 16}", "scale=16", "transfer=bone")


@pytest.fixture
def four(monkeypatch):
    """A process with four threads, whose transforms take the seconds in the dictionary that is returned."""
    times = {4: 1.0, 3: 1.0, 2: 1.0, 1: 3.0}
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)

    def timed(count: int) -> float:
        torch.set_num_threads(count)  # as the real one does
        return times[count]

    monkeypatch.setattr(threads, "_mean_seconds", timed)
    monkeypatch.setattr(threads, "_share", lambda: 1.0)
    monkeypatch.setattr(threads.os, "cpu_count", lambda: 4)
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    yield times
    torch.set_num_threads(before)


def used(**words) -> int:
    with undisturbed(**words):
        count = torch.get_num_threads()
    assert torch.get_num_threads() == 4
    return count


def test_all_threads_are_used_on_an_idle_machine(four, capsys):
    assert used() == 4 and capsys.readouterr().out == ""


@pytest.mark.parametrize(("seconds", "count"), [((160, 2, 2.5, 3), 3), ((160, 160, 2, 3), 2), ((160, 160, 160, 3), 1)])
def test_fewer_threads_where_others_hold_processors(seconds, count, four, capsys):
    four.update(zip((4, 3, 2, 1), seconds, strict=True))
    assert used() == count
    assert f"{count}, not 4: other programs use the processors" in capsys.readouterr().out


def test_a_busy_processor_is_announced(four, monkeypatch, capsys):
    clock = iter(range(100))  # each look at the clock is a second later, in which the thread works for 0.4 s
    monkeypatch.setattr(threads, "_share", SHARE)
    monkeypatch.setattr(threads.time, "perf_counter", lambda: float(next(clock)))
    worked = iter((0.0, 0.4))
    monkeypatch.setattr(threads.time, "thread_time", lambda: next(worked))
    assert used() == 4
    assert "this takes about 2.5 times the predicted seconds" in capsys.readouterr().out


def test_a_number_that_is_asked_for_is_followed(four, monkeypatch):
    four[4] = 160.0
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    assert used() == 4


@pytest.mark.parametrize(("device", "count"), [("CPU, 2 threads", 2), ("CPU, 64 threads", 4), ("NVIDIA", 1), (7, 1)])
def test_a_run_goes_on_with_the_threads_it_was_begun_with(device, count, four, tmp_path):
    four[4] = four[3] = four[2] = 160.0
    (tmp_path / "env.json").write_text(json.dumps({"device": device}))
    assert used(resumed=tmp_path) == count
    (tmp_path / "env.json").unlink()
    assert used(resumed=tmp_path) == 1


def test_transforms_are_timed():
    before = torch.get_num_threads()
    assert 0 < threads._mean_seconds(before) < 1
    assert threads._fastest(1) == 1


def test_a_preview_and_the_runs_of_a_sweep_use_them_too(four, monkeypatch, tmp_path, capsys):
    """They say so: a check to the terminal, and the run of a sweep to its log."""
    four[4] = four[3] = four[2] = 160.0
    counts = []

    def counted(*_):
        counts.append(torch.get_num_threads())
        return "look.png"

    monkeypatch.setattr(execute, "write_preview", counted)
    monkeypatch.setattr(execute, "execute", lambda *_: (tmp_path, bool(counted())))
    assert main(["check", str(CONFIGS / "volume" / "hand.yaml"), *TINY, "--preview", str(tmp_path / "look.png")]) == 0
    assert "Threads    1, not 4" in capsys.readouterr().out
    assert carry_out(str(CONFIGS / "volume" / "hand.yaml"), TINY, tmp_path / "one", None).status == "complete"
    assert "Threads    1, not 4" in (tmp_path / "one.log").read_text() and not capsys.readouterr().out
    assert counts == [1, 1] and torch.get_num_threads() == 4
