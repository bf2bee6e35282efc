"""A few mutated inputs of the quick parsers; ``scripts/fuzz.py`` runs every target for as long as is asked."""

import os
import sys
from pathlib import Path

import pytest
from fuzz.engine import Target, fuzz
from fuzz.targets import TARGETS

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks and reads /proc")


QUICK = ["volume-nrrd", "volume-metaimage", "image-png", "image-bmp", "config-camera", "packets", "poses", "logs"]
FOLDERS = ["report", "resume", "export"]
SERVERS = ["server-view", "server-page", "server-study"]


@pytest.mark.parametrize("name", FOLDERS)
def test_mutated_folders_of_runs_are_used_or_refused(name, tmp_path):
    count = fuzz(TARGETS[name], tmp_path, seconds=60, inputs=20)
    assert not count.failures
    assert count.accepted and count.refused


@pytest.mark.parametrize("name", SERVERS)
def test_servers_outlive_what_no_page_sends(name, tmp_path):
    count = fuzz(TARGETS[name], tmp_path, seconds=60, inputs=40)
    assert not count.failures
    assert count.accepted and count.refused


@pytest.mark.parametrize("name", QUICK)
def test_mutated_files_are_read_or_refused(name, tmp_path):
    count = fuzz(TARGETS[name], tmp_path, seconds=60, inputs=30)
    assert not count.failures
    assert count.accepted and count.refused  # the mutations neither miss the parser nor break everything


def _fails(folder: Path) -> None:
    data = (folder / "a").read_bytes()
    if data == b"1":
        raise KeyError("an exception that is no refusal")
    if data == b"2":
        os.abort()
    if data == b"3":
        raise UnicodeDecodeError("utf-8", b"x", 0, 1, "derived from a refusal, leaked through")
    if data == b"4":
        raise ValueError("expected 0")


def test_an_input_that_cannot_be_made_is_a_failure_and_no_end(tmp_path):
    def mutate(rng, made, other):
        assert rng.random() < 0.8
        return made

    target = Target("toy", lambda _: [{"a": b"0"}], mutate, lambda _: None)
    count = fuzz(target, tmp_path, seconds=60, inputs=40)
    assert count.inputs == 40 and 0 < len(count.failures) < 20
    assert all("the input cannot be made" in text for text in count.failures.values())


def test_failures_are_counted_and_kept(tmp_path):
    numbers = iter(range(1, 10))
    made = {number: str(number % 5).encode() for number in numbers}
    target = Target("toy", lambda _: [{"a": b"0"}], lambda rng, a, b: {"a": made[rng.randrange(1, 5)]}, _fails)
    count = fuzz(target, tmp_path, seconds=60, inputs=40)
    assert count.inputs == 40 and count.accepted >= 1 and count.refused >= 1
    kinds = {text.strip().splitlines()[-1].split(":")[0].split(".")[-1] for text in count.failures.values()}
    assert {"KeyError", "UnicodeDecodeError"} <= kinds
    assert any("SIGABRT" in text for text in count.failures.values())
    kept = sorted((tmp_path / "failures").iterdir())
    assert len(kept) == len(count.failures) and (kept[0] / "SYMPTOM.txt").is_file()
