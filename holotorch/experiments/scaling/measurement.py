"""Seconds of tasks on one and on two processes of this machine, in alternation."""

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, multiprocessing, nn

from holotorch.core.complex import intensity, phasor
from holotorch.correction.stages import run_stages
from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.registry import find_kind, load_config
from holotorch.experiments.runs.processes import added, process_count
from holotorch.experiments.scaling.model import Link, Work
from holotorch.experiments.scaling.tasks import largest_part, largest_share
from holotorch.experiments.volume.experiment import Part, VolumeExperiment
from holotorch.io.files import read_json, write_json

COUNT = 2  # processes
_LARGE, _SMALL = 1 << 21, 2  # float32 values that are added up to measure bandwidth and latency
_PATIENCE = timedelta(minutes=30)  # for a process that waits while the other one measures alone


@dataclass(frozen=True)
class Case:
    """A task: a configuration with its changes. ``rounds`` are realisations, or steps of the solver."""

    name: str
    config: str
    changes: tuple[str, ...]
    rounds: int


@dataclass(frozen=True)
class Measured:
    """Times of a task.

    Attributes:
        work: The task, with the seconds that the processor worked for one process.
        alone: Seconds of one process, in each repetition.
        together: Seconds of two processes, in each repetition.
        working: Median seconds that a processor worked for one process, and for the busier one of two; other programs
            on the machine do not lengthen them.
        error: Relative L2 difference of the results.
    """

    work: Work
    alone: list[float]
    together: list[float]
    working: tuple[float, float]
    error: float

    @property
    def speedup(self) -> float:
        """Median over the repetitions of the ratio of one to two processes."""
        return statistics.median(one / two for one, two in zip(self.alone, self.together, strict=True))


def measure(cases: tuple[Case, ...], repetitions: int) -> tuple[list[Measured], Link]:
    """Times of all cases on two new processes, and the connection between them."""
    with tempfile.TemporaryDirectory() as folder:
        multiprocessing.spawn(_process, (folder, cases, repetitions), nprocs=COUNT)  # type: ignore[attr-defined]
        content = read_json(Path(folder) / "result.json")
    measured = [_measured(case, each) for case, each in zip(cases, content["cases"], strict=True)]
    return measured, Link(**content["link"])


def _measured(case: Case, numbers: dict[str, Any]) -> Measured:
    outer, colours, (one, two) = numbers["outer"], numbers["colours"], numbers["working"]
    largest = largest_part if numbers["planes"] else largest_share
    work = Work(
        case.name,
        outer * colours,
        partial(largest, outer, colours),
        numbers["divided"],
        max(0.0, one / numbers["rounds"] - numbers["divided"]),
        numbers["size"],
        numbers["messages"],
        numbers["rounds"],
    )
    return Measured(work, numbers["alone"], numbers["together"], (one, two), numbers["error"])


def _process(rank: int, folder: str, cases: tuple[Case, ...], repetitions: int) -> None:
    torch.set_num_threads(1)
    # A file, since a port that was free when it was chosen may be taken when it is used.
    place = f"file://{folder}/meeting"
    torch.distributed.init_process_group("gloo", init_method=place, rank=rank, world_size=COUNT, timeout=_PATIENCE)
    results = [_case(case, repetitions) for case in cases]
    link = _link(repetitions)
    if rank == 0:
        write_json(Path(folder) / "result.json", {"cases": results, "link": link})
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()


def _case(case: Case, repetitions: int) -> dict[str, Any]:
    """Times of one case; both processes call this."""
    settings = load_config(case.config, [*case.changes, "device=cpu"])
    experiment = find_kind(settings.experiment).build(settings)
    tasks = {VolumeExperiment: _volume, PECExperiment: _pec, JointExperiment: _joint}
    task = tasks[type(experiment)](experiment, case.rounds)
    rank, (one, two) = process_count()[0], (task.run(shared) for shared in (False, True))  # warms up
    times: dict[str, list[float]] = {"divided": [], "alone": [], "together": []}
    working: tuple[list[float], list[float]] = [], []
    for _ in range(repetitions):
        torch.distributed.barrier()
        if rank == 0:  # the other process waits meanwhile
            times["divided"].append(_seconds(task.divided)[1])
            seconds, worked = _seconds(partial(task.run, False))
            times["alone"].append(seconds)
            working[0].append(worked)
        torch.distributed.barrier()
        seconds, worked = _seconds(partial(task.run, True))
        times["together"].append(seconds)
        busier = torch.tensor(worked, dtype=torch.float64)
        torch.distributed.all_reduce(busier, torch.distributed.ReduceOp.MAX)
        working[1].append(busier.item())
    if rank > 0:
        return {}
    return task.numbers | {
        "alone": times["alone"],
        "together": times["together"],
        "divided": statistics.median(times["divided"]),
        "working": [statistics.median(seconds) for seconds in working],
        "error": ((one - two).norm() / one.norm()).item(),
    }


@dataclass(frozen=True)
class _Task:
    """``run(shared)`` computes the task; ``divided`` that part of a round which processes can divide."""

    run: Callable[[bool], Tensor]
    divided: Callable[[], object]
    numbers: dict[str, Any]


def _volume(experiment: VolumeExperiment, rounds: int) -> _Task:
    (rank, count), planes, colours = process_count(), len(experiment.depths), len(experiment.settings.wavelengths)

    def run(shared: bool) -> Tensor:
        part = Part(rank, count, planes, colours) if shared else None
        fields = [experiment.hologram(seed, part=part)[0] for seed in range(rounds)]
        return torch.stack([added(field) if shared else field for field in fields])

    with torch.no_grad():
        layers = experiment.layers()
        rendered = [plane.clone() for plane in layers.amplitudes()]

    def divided() -> None:
        for colour, plan in enumerate(experiment.plans):
            total = plan.operator.accumulator(experiment.rays.shape, layers.phase)  # type: ignore[union-attr]
            for j, plane in enumerate(rendered):
                total.add(j, plane[colour])
            total.finish()

    size = run(False)[0].numel() * 8
    return _Task(
        run,
        divided,
        {"outer": planes, "colours": colours, "planes": True, "size": size, "messages": 1, "rounds": rounds},
    )


def _pec(experiment: PECExperiment, rounds: int) -> _Task:
    start = experiment.start_phase().to(experiment.dtype)

    def run(shared: bool) -> Tensor:
        return run_stages(experiment.stages(shared=shared), start).x

    evaluations = run_stages(experiment.stages(), start).evaluations
    fields = phasor(experiment.array.crosstalk(start))
    return _solver(run, experiment.propagator, fields, experiment.settings.frames, evaluations)


def _joint(experiment: JointExperiment, rounds: int) -> _Task:
    start = experiment.kinoform(experiment.random_fields(), experiment.crosstalk)
    solver, views = experiment.solver(experiment.crosstalk), experiment.trained

    def run(shared: bool) -> Tensor:
        return solver(experiment.problem(experiment.heat, views, experiment.settings.limit, shared=shared), start).x

    problem = experiment.problem(experiment.heat, views, experiment.settings.limit)
    evaluations = solver(problem, start).evaluations
    return _solver(run, views.operator, experiment.emitted(start), experiment.settings.frames, evaluations)


def _solver(
    run: Callable[[bool], Tensor], propagator: nn.Module, fields: Tensor, frames: int, evaluations: int
) -> _Task:
    def divided() -> None:
        field = fields.detach().requires_grad_()
        formed = intensity(propagator(field))
        torch.autograd.grad(formed, field, formed.detach())

    with torch.no_grad():
        size = 4 * propagator(fields).numel() + 8 * fields.numel()
    numbers = {"outer": frames, "colours": fields.shape[-3], "planes": False, "size": size, "messages": 3}
    return _Task(run, divided, numbers | {"rounds": evaluations})


def _link(repetitions: int) -> dict[str, float]:
    """Bandwidth and latency of sums over both processes, the best, which other programs disturb least."""
    large, small = torch.ones(_LARGE), torch.ones(_SMALL)
    times: dict[str, list[float]] = {"large": [], "small": []}
    for _ in range(4 * repetitions + 1):
        for name, values in (("large", large), ("small", small)):
            torch.distributed.barrier()
            times[name].append(_seconds(partial(added, values))[0])
    latency = min(times["small"][1:])
    return {"bandwidth": 4 * _LARGE / max(1e-9, min(times["large"][1:]) - latency), "latency": latency}


def _seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Seconds that a call took, and that the processor worked for this process meanwhile."""
    started, worked = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - started, time.process_time() - worked


def load() -> float:
    """Mean number of processes that ran or waited for a core in the last minute."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
