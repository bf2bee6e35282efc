"""Full disks: results stay, files that cannot be written are reported, and the exit status is right."""

import errno
import json
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.pec import progress
from holotorch.experiments.pec import run as run_module
from holotorch.experiments.pec.progress import Log
from holotorch.experiments.volume import run as volume_run
from holotorch.io import files

pytestmark = pytest.mark.usefixtures("tiny")
PEC = [CONFIGS / "pec" / "fourier.yaml", "grid.shape=[24,20]", "device=cpu", "report.baselines=[]"]
PEC += ["solver={kind: lbfgs, max_steps: 8}"]
VOLUME = [
    CONFIGS / "volume" / "tooth.yaml",
    "volume={phantom: shells, samples: 8}",
    "transfer={points: [[20, 1, 0.2, 0, 0], [255, 0.2, 0.9, 1, 0.9]], unit_distance: 0.05}",
    "hologram={shape: [32, 32], pitch: 3.74 um, distance: 3 mm, depths: 2, rays: 16}",
    *("device=cpu", "report.seeds=3"),
]
KINDS = {"pec": PEC, "volume": VOLUME}


class Full:
    """A file on a disk that takes nothing more."""

    def __init__(self, stream):
        self.stream = stream

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stream.close()

    def write(self, _):
        raise OSError(errno.ENOSPC, "No space left on device")

    def __getattr__(self, name: str):
        return getattr(self.stream, name)


@contextmanager
def full(pattern: str):
    """No file whose name matches can be written."""

    def opened(path, *words, **more):
        stream = open(path, *words, **more)  # noqa: SIM115
        return Full(stream) if re.fullmatch(rf"\.({pattern})\.\d+\.partial", Path(path).name) else stream

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "open", opened, raising=False)
        yield


def command(kind: str, folder: Path) -> list[str]:
    return ["run", *map(str, KINDS[kind]), "--out", str(folder)]


def arrays(folder: Path) -> dict[str, bytes]:
    return {path.name: np.load(path).tobytes() for path in (folder / "arrays").iterdir()}


@pytest.fixture(scope="module")
def whole(tiny, tmp_path_factory):
    """A run of each kind on a disk with room."""
    folders = {kind: tmp_path_factory.mktemp(kind) / "a" for kind in KINDS}
    for kind, folder in folders.items():
        assert main(command(kind, folder)) == 0
    return folders


@pytest.fixture
def often(monkeypatch):
    """A checkpoint after every step."""
    monkeypatch.setattr(progress, "_SAVE_EVERY", -1.0)


def press(monkeypatch, kind: str) -> None:
    """Ctrl-C in the third step, or in the third realisation."""
    calls = []

    def noted(function):
        def called(*words, **more):
            calls.append(1)
            if len(calls) == 3:
                signal.raise_signal(signal.SIGINT)
            return function(*words, **more)

        return called

    owner, name = (Log, "__call__") if kind == "pec" else (volume_run.VolumeExperiment, "hologram")
    monkeypatch.setattr(owner, name, noted(getattr(owner, name)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_that_cannot_be_written_is_told_once_and_the_run_goes_on(kind, whole, tmp_path, often, capsys):
    with full("checkpoint.pt"):
        assert main(command(kind, tmp_path / "a")) == 0
    assert arrays(tmp_path / "a") == arrays(whole[kind])
    (told,) = (line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert re.search(
        r"checkpoint.pt cannot be written: No space left on device \(0\.\d+ MB needed, [\d.]+ MB free\); "
        "there is no previous one, and the run goes on$",
        told,
    )


@pytest.mark.parametrize("kind", KINDS)
def test_an_interrupted_run_that_cannot_be_saved_says_so(kind, whole, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "a"
    with full("checkpoint.pt"), monkeypatch.context() as patch:
        press(patch, kind)
        assert main(command(kind, folder)) == 1
    error = capsys.readouterr().err
    hint = f"once the cause is removed, go on with: holotorch resume {folder}"
    assert f"failed; the results so far are in {folder}; {hint}" in error
    assert f"{folder / 'checkpoint.pt'}: No space left on device" in error and "saved what" not in error
    assert "checkpoint.pt: No space" in json.loads((folder / "interrupted.json").read_text())["failure"]
    assert main(["resume", str(folder)]) == 0
    assert arrays(folder) == arrays(whole[kind])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("pattern", [r".*\.png", "(depth|intensity).npy", "metrics.csv", "summary.json", "report.html"])
def test_what_can_be_written_is_kept_and_the_rest_is_made_later(kind, pattern, whole, tmp_path, capsys):
    folder, main_array = tmp_path / "a", {"pec": "phase.npy", "volume": "hologram.npy"}[kind]
    with full(pattern):
        assert main(command(kind, folder)) == 1
    error = capsys.readouterr().err
    assert error.count("warning: ") == 1 and "Traceback" not in error and "No space left on device (0." in error
    assert arrays(folder)[main_array] == arrays(whole[kind])[main_array]
    if pattern == "report.html":
        assert f"make its page with: holotorch report {folder}" in error
        assert main(["report", str(folder)]) == 0
    else:
        assert not (folder / "summary.json").exists() and f"go on with: holotorch resume {folder}" in error
        with pytest.MonkeyPatch.context() as patch:  # nothing is computed again
            patch.setattr(Log, "__call__", lambda *_: pytest.fail("a step was taken again"))
            patch.setattr(volume_run.VolumeExperiment, "hologram", lambda *_: pytest.fail("rendered again"))
            assert main(["resume", str(folder)]) == 0
    names = sorted(path.relative_to(folder) for path in folder.rglob("*"))
    assert names == sorted(path.relative_to(whole[kind]) for path in whole[kind].rglob("*"))
    assert arrays(folder) == arrays(whole[kind])


def test_a_failure_after_the_solver_loses_no_step(whole, tmp_path, monkeypatch):
    def fails(*_):
        raise RuntimeError("CUDA out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "evaluate", fails)
        assert main(command("pec", tmp_path / "a")) == 1
    monkeypatch.setattr(Log, "__call__", lambda *_: pytest.fail("a step was taken again"))
    assert main(["resume", str(tmp_path / "a")]) == 0
    assert arrays(tmp_path / "a") == arrays(whole["pec"])


def test_a_real_disk_that_fills_up(tmp_path, whole):
    """The whole program on a file system of 60 kB, which holds the phases, and neither checkpoints nor figures."""
    disk, words = tmp_path / "disk", ["-t", "tmpfs", "-o", "size=60k", "none"]
    disk.mkdir()
    if shutil.which("mount") is None or subprocess.run(["mount", *words, disk], capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        code = (
            "from holotorch.experiments.pec import progress; progress._SAVE_EVERY = -1.0; import sys, holotorch.cli; "
        )
        start = [sys.executable, "-c", code + "sys.exit(holotorch.cli.main())"]
        done = subprocess.run([*start, *command("pec", disk / "a")], capture_output=True, text=True)
        assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
        assert done.stderr.count("checkpoint.pt cannot be written: No space left on device") == 1
        assert arrays(disk / "a")["phase.npy"] == arrays(whole["pec"])["phase.npy"]
    finally:
        subprocess.run(["umount", disk], check=True)
