"""One run on several processes that ``torchrun`` starts: the same result, and nothing lost if one of them is killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from paths import CONFIGS

from holotorch.cli import main

VOLUME = [
    str(CONFIGS / "volume" / "tooth.yaml"),
    "volume={phantom: shells, samples: 24}",
    "transfer={points: [[20, 1, 0.2, 0, 0], [255, 0.2, 0.9, 1, 0.9]], unit_distance: 0.05}",
    "hologram={shape: [64, 64], pitch: 3.74 um, distance: 3 mm, depths: 12, rays: 32}",
]
EYE = [
    str(CONFIGS / "eye" / "teapot.yaml"),
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 32}', "
    "'hologram={shape: [64, 64], pitch: 3.74 um, distance: 12 mm, depths: 8, rays: 32}']}",
    "light={sources: [laser, led]}",
    "focus=[11.9 mm, 12 mm]",
    "tolerance=0.2",
]
SHARED = {
    "volume": ([*VOLUME, "device=cpu"], ["hologram", "refocused"]),
    "eye": ([*EYE, "seeds=1"], ["retina", "reference"]),
}


def started(count: int, words: list[str], out: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
    return subprocess.Popen(
        [*command, "-m", "holotorch", "run", *words, "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


@pytest.mark.parametrize("kind", SHARED)
def test_several_processes_give_what_one_gives(kind, tmp_path):
    words, arrays = SHARED[kind]
    assert main(["run", *words, "--out", str(tmp_path / "one")]) == 0
    job = started(2, words, tmp_path / "two")
    text = job.communicate()[0]
    assert job.returncode == 0, text[-2000:]
    for name in arrays:
        one, two = (np.load(tmp_path / folder / "arrays" / f"{name}.npy") for folder in ("one", "two"))
        assert np.linalg.norm(one - two) < 1e-6 * np.linalg.norm(one)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_killed_process_is_reported_and_the_run_goes_on_where_it_was(tmp_path):
    out, words = tmp_path / "run", [*VOLUME, "device=cpu", "report.seeds=100"]
    job = started(2, words, out)
    while not (out / "checkpoint.pt").is_file():
        assert job.poll() is None, job.communicate()[0][-2000:]
        time.sleep(0.05)
    (helper,) = [pid for pid in workers(job.pid) if b"RANK=1" in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")]
    os.kill(helper, signal.SIGKILL)
    text = job.communicate(timeout=120)[0]
    assert job.returncode == 1 and f"go on with: holotorch resume {out}" in text
    assert "another process of this run has ended" in text or "interrupted" in text
    assert main(["resume", str(out)]) == 0 and not (out / "checkpoint.pt").exists()
    assert main(["run", *words, "--out", str(tmp_path / "whole")]) == 0
    one, other = (np.load(folder / "arrays" / "refocused.npy") for folder in (out, tmp_path / "whole"))
    assert np.linalg.norm(one - other) < 1e-6 * np.linalg.norm(other)


def workers(parent: int) -> list[int]:
    """Processes that a process has started."""
    return [int(pid) for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]
