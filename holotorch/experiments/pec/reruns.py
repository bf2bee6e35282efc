"""Another start for a hologram with speckle noise (thesis Sec. 4.4.5.2)."""

from collections.abc import Sequence
from dataclasses import replace

from holotorch.correction import Solution
from holotorch.experiments.pec.evaluation import speckle_spots
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.timing import timed


def rerun(experiment: PECExperiment, first: Solution, seconds: float) -> tuple[Solution, float, Sequence[int]]:
    """Solve again from other random phases while the best solution has dark spots, ``solver.reruns`` times at most.

    Returns the solution with the fewest dark spots, the seconds of all, and the dark spots of each attempt.
    """
    best, spots = first, [_total(experiment, first)]
    for attempt in range(1, experiment.settings.solver.reruns + 1):
        if min(spots) == 0:
            break
        settings = experiment.settings.model_copy(update={"seed": experiment.settings.seed + attempt})
        other, took = timed(replace(experiment, settings=settings).solve)
        seconds += took
        spots.append(_total(experiment, other))
        if spots[-1] < min(spots[:-1]):
            best = other
    return best, seconds, spots


def _total(experiment: PECExperiment, solution: Solution) -> int:
    return int(speckle_spots(experiment, experiment.heater_phases(solution.x)).sum())
