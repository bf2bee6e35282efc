"""Times of trackers on the same synthetic frames, measured alternately in one process, and of their stages."""

import statistics
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.timing import interleaved, timed
from holotorch.experiments.tracking_benchmark.bench import Row, count_statuses
from holotorch.experiments.tracking_benchmark.methods import BASE, COLD, PRIOR, Method, as_camera, before, methods
from holotorch.experiments.tracking_benchmark.thesis_opencv import ThesisOpenCV
from holotorch.tracking.detection.channels import ChannelOrder
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation.trials import conditions, negatives, occlusions
from holotorch.tracking.simulation.world import Case, World
from holotorch.tracking.thesis.tracker import ThesisTracker

KORNIA = "thesis, kornia"
# Names of the conditions whose frames are timed, by kind of frame.
_FRAMES = {"plain desk": ("plain",), "clutter": ("heavy clutter",), "drape": ("cloth as band 3",)}
_PHOTOGRAPH = ("photograph 0", "texture")  # the texture is used if the world has no photographs


def timing(world: World, rounds: int, stream: int) -> list[Row]:
    """Milliseconds per frame of each method and kind of frame, medians over rounds, and ratios to the baseline.

    In each round, each method processes ``stream`` different frames one after another, as from a camera. Six frames of
    6 MB do not fit into the caches of the processor together, while the data of the method itself may stay there.
    """
    kornia = ThesisTracker(world.camera, world.catheter)
    trackers: dict[str, Method] = methods(world) | {KORNIA: lambda frame, _: kornia(frame[None])[0]}
    worlds = [replace(world, seed=world.seed + i) for i in range(stream)]
    scenes = [{case.name: case for case in conditions(one)} for one in worlds]
    rows = []
    for kind, names in tqdm((_FRAMES | {"photograph": _PHOTOGRAPH}).items(), desc="times", unit="frame"):
        name = next(name for name in names if name in scenes[0])
        frames = [(as_camera(cases[name].frame()), cases[name]) for cases in scenes]
        poses: dict[str, list[Pose]] = {}
        calls = {method: partial(_all, track, frames, poses, method) for method, track in trackers.items()}
        seconds = interleaved(calls, rounds)
        for method, value in seconds.items():
            status = count_statuses(Status(pose.status) for pose in poses[method])
            row: Row = {"frame": kind, "method": method, "milliseconds": round(1e3 * value / stream, 2)}
            rows.append(row | {"ratio": round(value / seconds[BASE], 3), "status": status})
    return rows


def _all(track: Method, frames: list[tuple[Tensor, Case]], poses: dict[str, list[Pose]], method: str) -> None:
    """Track all frames, and keep the poses of the method."""
    poses[method] = [track(frame, case) for frame, case in frames]


def stages(world: World, rounds: int) -> list[Row]:
    """Mean time of each stage and its share of the total, as in Table 3.1, for a catheter on a plain desk."""
    case = next(case for case in conditions(world) if case.name == "plain")
    frames = as_camera(case.frame())[None]
    expected = [before(case)]
    ours = CatheterTracker(world.camera, world.catheter, channels=ChannelOrder.RGB)
    thesis, kornia = ThesisOpenCV(world.camera, world.catheter), ThesisTracker(world.camera, world.catheter)
    calls: dict[str, tuple[ThesisOpenCV | ThesisTracker | CatheterTracker, Callable[[], list[Pose]]]] = {
        BASE: (thesis, lambda: thesis(frames)),
        KORNIA: (kornia, lambda: kornia(frames)),
        COLD: (ours, lambda: ours(frames)),
        PRIOR: (ours, lambda: ours(frames, expected)),
    }
    rows = []
    for name, (tracker, call) in calls.items():
        call()
        spent: dict[str, float] = {}
        for _ in range(rounds):
            _, total = timed(call)
            own = dict(tracker.times)
            own["Other"] = own.get("Other", 0.0) + total - sum(own.values())
            spent = {stage: spent.get(stage, 0.0) + value for stage, value in own.items()}
        spent["Total"] = total = sum(spent.values())
        for stage, value in spent.items():
            row: Row = {"method": name, "stage": stage, "milliseconds": round(1e3 * value / rounds, 3)}
            rows.append(row | {"percent": round(100 * value / total, 2)})
    return rows


def spread(world: World, seeds: int, share: float, repeats: int) -> list[Row]:
    """Time of the slowest frame relative to the median frame, for each method.

    The frames are all conditions and occlusions, and one negative of each kind, from ``seeds`` seeds with two
    photographs of the world each. The time of a frame is a median over ``repeats`` calls, which single stalls of the
    machine do not affect, each divided by the time of a plain frame directly before it, which removes most of the
    influence of other load.
    """
    cases, plain = [], next(case for case in conditions(world) if case.name == "plain")
    plain_frame = as_camera(plain.frame())
    for i in range(seeds):
        seeded = replace(world, photographs=world.photographs[2 * i : 2 * i + 2], seed=world.seed + i)
        some = [*conditions(seeded), *occlusions(seeded), *negatives(seeded, 10)][:: max(1, round(1 / share))]
        cases += [replace(case, name=f"{case.name}, seed {seeded.seed}") for case in some]
    trackers = methods(world, (BASE, COLD, PRIOR))
    ratios: dict[str, list[tuple[float, str]]] = {name: [] for name in trackers}
    plain_seconds: dict[str, list[float]] = {name: [] for name in trackers}
    for case in tqdm(cases, desc="slowest frames", unit="frame", dynamic_ncols=True):
        frame = as_camera(case.frame())
        for name, track in trackers.items():
            if name == PRIOR and case.tip is None:
                continue  # a frame without a catheter has no previous pose
            track(frame, case)
            calls = partial(track, plain_frame, plain), partial(track, frame, case)
            pairs = [[timed(call)[1] for call in calls] for _ in range(repeats)]
            ratios[name].append((statistics.median(own / before for before, own in pairs), case.name))
            plain_seconds[name] += [before for before, _ in pairs]
    rows = []
    for name, values in ratios.items():
        if values:
            middle, (slowest, case_name) = statistics.median(ratio for ratio, _ in values), max(values)
            unit = 1e3 * statistics.median(plain_seconds[name])
            row: Row = {"method": name, "frames": len(values), "median_ms": round(unit * middle, 2)}
            row |= {"slowest_ms": round(unit * slowest, 2), "ratio": round(slowest / middle, 2)}
            rows.append(row | {"slowest": case_name})
    return rows
