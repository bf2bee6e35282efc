"""A few runs that a signal ends; ``scripts/kills.py`` takes as many of every kind as are asked for."""

import signal
import sys

import numpy as np
import pytest
from fuzz.kills import Failed, Kills, Shot, _check_end, _check_folder

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks")


@pytest.fixture(scope="module")
def kills(tmp_path_factory):
    return Kills(tmp_path_factory.mktemp("kills"), seed=0)


@pytest.mark.parametrize(("kind", "number"), [("pec", 0), ("pec", 7), ("volume", 1), ("volume", 2), ("track", 3)])
def test_a_run_that_a_signal_ends_can_be_gone_on_with(kills, kind, number):
    assert kills.run(number, kind) is None


def test_a_case_is_made_again_by_its_number(kills):
    first, again = (Kills(kills.folder, seed=5) for _ in range(2))
    first.wholes = again.wholes = kills.wholes
    kills.whole("pec")
    assert [first.case(n, "pec") for n in range(20)] == [again.case(n, "pec") for n in range(20)]
    shots = [shot for n in range(20) for shot in first.case(n, "pec")[1]]
    assert {shot.number for shot in shots} == {signal.SIGTERM, signal.SIGINT, signal.SIGKILL}
    assert any(shot.seconds is None for shot in shots) and any(shot.seconds is not None for shot in shots)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("phase.npy", b"\x93NUMPY", "phase.npy is not whole"),
        ("summary.json", b'{"status":', "summary.json is not whole"),
        ("summary.json", b'{"status": "interrupted"}', "summary.json says interrupted"),
        ("metrics.csv", b"a,b\n1,2\n3", "metrics.csv is not whole"),
        ("a.png", b"\x89PNG", "a.png is not whole"),
        (".a.png.12.partial", b"", "is left behind"),
    ],
)
def test_a_folder_that_is_not_whole_is_a_failure(tmp_path, name, content, message):
    np.save(tmp_path / "before.npy", np.zeros(3))
    before = _check_folder(tmp_path, {}, tidy=True)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(Failed, match=message):
        _check_folder(tmp_path, before, tidy=True)
    (tmp_path / name).unlink()
    (tmp_path / "before.npy").unlink()
    with pytest.raises(Failed, match=r"before.npy is gone"):
        _check_folder(tmp_path, before, tidy=True)


@pytest.mark.parametrize(
    ("status", "log", "message"),
    [
        (1, "", "status 1"),
        (0, "", "status 0 without summary.json"),
        (130, "interrupted", "does not say how to go on"),
        (-signal.SIGTERM, "correcting", "is not handled"),
        (130, "Traceback (most recent call last)", "a traceback"),
    ],
)
def test_a_wrong_end_is_a_failure(tmp_path, status, log, message):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "config.yaml").write_text("experiment: pec")
    (tmp_path / "log.txt").write_text(log)
    with pytest.raises(Failed, match=message):
        _check_end(status, Shot(signal.SIGTERM, seconds=1.0), tmp_path / "a", tmp_path)
