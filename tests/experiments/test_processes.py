"""One run on several processes that ``torchrun`` starts: the same result, and nothing lost if one of them is killed."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import several_runs
import torch
from paths import CONFIGS
from tiny_runs import RUNS, without
from two_processes import run_in_two_processes

from holotorch.cli import main
from holotorch.core.grid import Grid
from holotorch.experiments.runs.environment import find_device
from holotorch.experiments.runs.processes import SharedIntensity, share
from holotorch.optics import Fraunhofer

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
PEC = [str(CONFIGS / "pec" / "fourier.yaml"), "grid.shape=[24,20]", "device=cpu"]
FRAMES = [str(CONFIGS / "pec" / "capped.yaml"), *PEC[1:], "frames=3", "solver.max_steps=8"]
WEIGHTED = [str(CONFIGS / "pec" / "peripheral.yaml"), *PEC[1:], "solver.max_steps=8"]
JOINT = [str(CONFIGS / RUNS["joint"][0]), *RUNS["joint"][1:]]
COLOURS = [*JOINT, "frames=1", "display.planes=1", "report.baselines=[unheated]"]
HEATED = [*JOINT, "heat={frame_us: 20, time_constant_us: 10}", "report.baselines=[afterwards, slabs]"]
SAMPLED = [*JOINT, "eye={parallax: 4, per_step: 2}", "report.baselines=[unheated, light_field]"]
SHARED = {
    "volume": ([*VOLUME, "device=cpu"], ["hologram", "refocused"]),
    "eye": ([*EYE, "seeds=1"], ["retina", "reference"]),
    "pec, colours": ([*PEC, "solver={kind: lbfgs, max_steps: 8}", "solver.reruns=1"], ["phase", "intensity"]),
    "pec, frames": (FRAMES, ["phase", "intensity"]),
    "pec, weighted": (WEIGHTED, ["phase", "intensity"]),
    "joint, colours": (COLOURS, ["phase", "shown"]),
    "joint, frames": (HEATED, ["phase", "shown"]),
    "joint, random views": (SAMPLED, ["phase", "shown"]),
}
STEPS = {  # long enough to be interrupted
    "pec": [*PEC, "solver.max_steps=400", "solver.patience=400", "report.baselines=[]"],
    "joint": [*JOINT, "steps=100", "report.baselines=[slabs]"],
}


def started(*words: str) -> "subprocess.Popen[str]":
    """Two processes that run a script or a module."""
    return subprocess.Popen(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


@pytest.fixture(scope="module")
def run_by_two(tmp_path_factory) -> Path:
    """Folder with the run of each kind in ``SHARED``, all by one pair of processes."""
    folder = tmp_path_factory.mktemp("two")
    runs = [["run", *words, "--out", str(folder / kind)] for kind, (words, _) in SHARED.items()]
    (folder / "runs.json").write_text(json.dumps(runs))
    job = started(str(Path(several_runs.__file__)), str(folder / "runs.json"))
    text = job.communicate()[0]
    assert job.returncode == 0, text[-2000:]
    for kind in SHARED:
        assert text.count(f"status 0 of {folder / kind}\n") == 2, text[-2000:]
        assert text.count(f"{folder / kind / 'report.html'}\n") == 1, text[-2000:]
    assert text.count("Result     ") == len(SHARED) and "\n.\n" not in text and os.devnull not in text
    return folder


@pytest.mark.parametrize("kind", SHARED)
def test_several_processes_give_what_one_gives(kind, run_by_two, tmp_path):
    words, arrays = SHARED[kind]
    folders = tmp_path / "one", run_by_two / kind
    assert main(["run", *words, "--out", str(folders[0])]) == 0
    for name in arrays:
        one, two = (np.load(folder / "arrays" / f"{name}.npy") for folder in folders)
        assert np.linalg.norm(one - two) < 1e-6 * np.linalg.norm(one)
    one, two = (json.loads((folder / "summary.json").read_text()) for folder in folders)
    assert without(two.get("methods", {})) == nearly(without(one.get("methods", {})))


def nearly(value):
    """Nested values whose numbers may differ by rounding."""
    if isinstance(value, dict):
        return {key: nearly(each) for key, each in value.items()}
    if isinstance(value, list):
        return [nearly(each) for each in value]
    return value if value is None or isinstance(value, str | bool) else pytest.approx(value, rel=1e-4, abs=1e-6)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_killed_process_is_reported_and_the_run_goes_on_where_it_was(tmp_path):
    out, words = tmp_path / "run", [*VOLUME, "device=cpu", "report.seeds=100"]
    job = started("-m", "holotorch", "run", *words, "--out", str(out))
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


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("kind", STEPS)
def test_a_solver_goes_on_where_another_process_was_killed(kind, tmp_path):
    out, words = tmp_path / "run", STEPS[kind]
    job, text = started("-m", "holotorch", "run", *words, "--out", str(out)), ""
    assert job.stdout
    while not re.search(r"\| [1-9]\d*/\d+ \[", text):  # the first steps in the progress bar
        text += (more := job.stdout.read(1))
        assert more, text[-2000:]
    (helper,) = [pid for pid in workers(job.pid) if b"RANK=1" in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")]
    os.kill(helper, signal.SIGKILL)
    text += job.communicate(timeout=120)[0]
    assert job.returncode == 1 and f"with: holotorch resume {out}" in text, text[-2000:]
    assert "another process of this run has ended" in text or "interrupted" in text
    assert (out / "checkpoint.pt").is_file()
    assert main(["resume", str(out)]) == 0 and not (out / "checkpoint.pt").exists()
    assert main(["run", *words, "--out", str(tmp_path / "whole")]) == 0
    one, other = (np.load(folder / "arrays" / "phase.npy") for folder in (out, tmp_path / "whole"))
    assert np.linalg.norm(one - other) < 1e-6 * np.linalg.norm(other)


@pytest.mark.parametrize(("frames", "colours"), [(1, 1), (1, 3), (4, 3), (8, 3), (7, 1)])
def test_the_shares_of_all_processes_are_the_whole_work(frames, colours):
    for count in range(1, 40):
        parts = [list(itertools.product(*share(frames, colours, rank, count))) for rank in range(count)]
        assert sorted(itertools.chain(*parts)) == list(itertools.product(range(frames), range(colours)))
        # With as many processes as there is work, each has one unit at most.
        assert max(map(len, parts)) == 1 or count < frames * colours


def divided(rank: int) -> list[torch.Tensor]:
    """Intensities and gradient in a process, and what it says to fields that differ."""
    lengths, grid = [630e-9, 530e-9, 445e-9], Grid((12, 10), 8e-6)
    shared = SharedIntensity(lambda part: Fraunhofer(grid, [lengths[c] for c in part]), 3, 2)
    field = torch.randn(2, 3, 12, 10, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    field.requires_grad_()
    formed = shared(field)
    (gradient,) = torch.autograd.grad(formed.square().sum(), field)
    with pytest.raises(ConnectionError, match="fields of the processes differ"):
        shared(field.detach() + rank)
    return [field.detach(), formed.detach(), gradient, torch.tensor(shared.local(field).numel())]


def test_two_processes_form_the_intensities_of_one(tmp_path):
    field, formed, gradient, part = run_in_two_processes(divided, tmp_path)
    whole = Fraunhofer(Grid((12, 10), 8e-6), [630e-9, 530e-9, 445e-9])
    field.requires_grad_()
    alone = whole(field).real.square() + whole(field).imag.square()
    assert torch.equal(formed, alone.detach()) and 2 * part == field.numel()
    torch.testing.assert_close(gradient, torch.autograd.grad(alone.square().sum(), field)[0])


def test_each_process_of_a_machine_has_a_gpu_of_its_own(monkeypatch):
    chosen: list[int] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    assert find_device("auto") == torch.device("cuda") and not chosen
    for local_rank in ("0", "3", "5"):
        monkeypatch.setenv("LOCAL_RANK", local_rank)
        assert find_device("auto") == torch.device("cuda") and find_device("cpu") == torch.device("cpu")
    assert chosen == [0, 3, 1]


def workers(parent: int) -> list[int]:
    """Processes that a process has started."""
    return [int(pid) for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]
