"""One run on several processes that ``torchrun`` starts: the same result, and nothing lost if one of them is killed."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import several_runs
import torch
from apart import start_apart
from paths import CONFIGS
from tiny_runs import EYE as SMALL_EYE
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
    *(str(CONFIGS / "eye" / "teapot.yaml"), *SMALL_EYE, "tolerance=0.2"),
    *("light={sources: [laser, led]}", "focus=[2 mm, 2.1 mm]"),
]
PEC = [str(CONFIGS / "pec" / "fourier.yaml"), "grid.shape=[24,20]", "device=cpu"]
FRAMES = [
    *(str(CONFIGS / "pec" / "capped.yaml"), *PEC[1:]),
    *("frames=3", "solver.max_steps=8", "report.baselines=[none, basic_ipec, chopping]"),
]
WEIGHTED = [str(CONFIGS / "pec" / "peripheral.yaml"), *PEC[1:], "solver.max_steps=8"]
JOINT = [str(CONFIGS / RUNS["joint"][0]), *RUNS["joint"][1:]]
COLOURS = [*JOINT, "frames=1", "display.planes=1", "report.baselines=[unheated]"]
HEATED = [*JOINT, "heat={frame_us: 20, time_constant_us: 10}", "report.baselines=[afterwards, slabs]"]
SAMPLED = [*JOINT, "eye={parallax: 4, per_step: 2}", "report.baselines=[unheated, light_field]"]
SHARED = {
    "volume": ([*VOLUME, "device=cpu", "report.seeds=4"], ["hologram", "refocused"]),
    "eye": ([*EYE, "seeds=1"], ["retina", "reference"]),
    "pec, colours": ([*PEC, "solver={kind: lbfgs, max_steps: 8}", "solver.reruns=1"], ["phase", "intensity"]),
    "pec, frames": (FRAMES, ["phase", "intensity"]),
    "pec, weighted": (WEIGHTED, ["phase", "intensity"]),
    "joint, colours": (COLOURS, ["phase", "shown"]),
    "joint, frames": (HEATED, ["phase", "shown"]),
    "joint, random views": (SAMPLED, ["phase", "shown"]),
}
STEPS = {
    "pec": [*PEC, "solver.max_steps=16", "solver.patience=16", "report.baselines=[]"],
    "joint": [*JOINT, "steps=16", "report.baselines=[slabs]"],
}
KILLED_VOLUME = 3  # the sum of the third realisation, before which that of the first is saved
KILLED_STEP = 20  # a sum in the sixth step or later: a step takes two or three


@dataclass(frozen=True)
class Job:
    """What two processes of torchrun have left and said; the last run is cut off, since one of them is killed."""

    folder: Path
    said: str
    status: int


@pytest.fixture(scope="module")
def by_two(tmp_path_factory) -> Job:
    """The run of each kind in ``SHARED``, and that of the volume again in which a process is killed, by one pair."""
    folder = tmp_path_factory.mktemp("two")
    runs = [["run", *words, "--out", str(folder / kind)] for kind, (words, _) in SHARED.items()]
    last = ["run", *SHARED["volume"][0], "--out", str(folder / "killed")]
    (folder / "runs.json").write_text(json.dumps({"runs": runs, "last": last, "killed_at": KILLED_VOLUME}))
    done = subprocess.run(
        [
            *(sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"),
            *(str(Path(several_runs.__file__)), str(folder / "runs.json")),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    for kind in SHARED:  # without the ends of lines, which two processes may write after both of their texts
        assert done.stdout.count(f"status 0 of {folder / kind}") == 2, (kind, done.stdout)
        assert done.stdout.count(f"{folder / kind / 'report.html'}") == 1, (kind, done.stdout)
    assert done.stdout.rpartition("status 0 of")[0].count("Result     ") == len(SHARED)
    assert "\n.\n" not in done.stdout and os.devnull not in done.stdout
    return Job(folder, done.stdout, done.returncode)


@pytest.fixture(scope="module")
def by_one(tiny, tmp_path_factory) -> Callable[[str], Path]:
    """Folder with the run of a kind in ``SHARED`` by one process, done when asked for."""
    place = tmp_path_factory.mktemp("one")

    def of(kind: str) -> Path:
        if not (place / kind).is_dir():
            assert main(["run", *SHARED[kind][0], "--out", str(place / kind)]) == 0
        return place / kind

    return of


@pytest.mark.parametrize("kind", SHARED)
def test_several_processes_give_what_one_gives(kind, by_two, by_one):
    folders = by_one(kind), by_two.folder / kind
    for name in SHARED[kind][1]:
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


def test_a_killed_process_is_reported_and_the_run_goes_on_where_it_was(by_two, by_one):
    out = by_two.folder / "killed"
    assert by_two.status == 1 and f"go on with: holotorch resume {out}" in by_two.said
    assert "another process of this run has ended" in by_two.said or "interrupted" in by_two.said
    assert (out / "checkpoint.pt").is_file()
    assert main(["resume", str(out)]) == 0 and not (out / "checkpoint.pt").exists()
    one, other = (np.load(folder / "arrays" / "refocused.npy") for folder in (out, by_one("volume")))
    assert np.linalg.norm(one - other) < 1e-6 * np.linalg.norm(other)


@pytest.mark.parametrize("kind", STEPS)
def test_a_solver_goes_on_where_another_process_was_killed(kind, tiny, tmp_path):
    out, words, places = tmp_path / "run", STEPS[kind], [{"RANK": f"{rank}", "WORLD_SIZE": "2"} for rank in range(2)]
    asked = ["run", *words, "--out", str(out)], tmp_path / "meeting", KILLED_STEP
    pair = [
        start_apart(several_runs.run_until_killed, *asked, said=tmp_path / place["RANK"], env=place) for place in places
    ]
    for process in pair:
        process.join(120)
    text = (tmp_path / "0").read_text()
    assert [process.exitcode for process in pair] == [1, -signal.SIGKILL], text[-2000:]
    assert f"with: holotorch resume {out}" in text and re.search(r"\| [1-9]\d*/16 \[", text), text[-2000:]
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
