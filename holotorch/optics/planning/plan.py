"""plan_propagation: choose the cheapest method and padding whose predicted error is within the tolerance."""

from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.plan import Plan
from holotorch.core.quantities import DISTANCE
from holotorch.optics.free_space.plane_pair import PlanePair, plane_pair
from holotorch.optics.planning.candidates import Candidate, candidates
from holotorch.optics.planning.content import field_content


def plan_propagation(
    grid: Grid,
    wavelength: float | Sequence[float],
    distance: float | Sequence[float],
    *,
    tolerance: float = 1e-3,
    band: tuple[float, float] | None = None,
    spread: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
    field: Tensor | None = None,
    out_grid: Grid | None = None,
    offset: tuple[float, float] = (0.0, 0.0),
    tilt: tuple[float, float] = (0.0, 0.0),
    dtype: torch.dtype = torch.complex64,
    memory_limit: int | None = None,
) -> Plan:
    """Choose how to propagate a field over ``distance``, without propagating it.

    Arguments that are not described here are those of ``propagate``. A plan for several wavelengths or distances is
    for all of them together. ``field`` is an example of the content, complex [..., H, W], which is measured and
    replaces the description by ``band``, ``spread`` and ``margin``. ``dtype`` is the type of the fields to propagate,
    complex64 or complex128. A plan that needs more than ``memory_limit`` bytes per channel is refused.

    Raises:
        ValueError: An argument outside its range, or a plan that needs more than ``memory_limit``; the message says
            how to propagate in tiles.
    """
    wavelengths = checks.wavelengths(wavelength)
    planes = plane_pair(grid, out_grid, offset, tilt, wavelengths)
    distances = list(distance) if isinstance(distance, Sequence) else [distance]
    distances = [checks.quantity(DISTANCE, distance) for distance in distances]
    content = field_content(grid, wavelengths, distances, band=band, spread=spread, margin=margin, field=field)
    return plan_from(candidates(planes, wavelengths, distances, content, dtype), planes, tolerance, memory_limit, dtype)


def plan_from(
    options: list[Candidate],
    planes: PlanePair,
    tolerance: float,
    memory_limit: int | None = None,
    dtype: torch.dtype = torch.complex64,
) -> Plan:
    """The plan for the best of the candidates ``options``."""
    best, second = choose(options, checks.positive("tolerance", tolerance))
    if memory_limit is not None and best.memory > memory_limit:
        raise ValueError(
            f"{best.label} needs {best.memory / 1e9:.3g} GB per channel, more than the {memory_limit / 1e9:.3g} GB "
            "allowed; propagate tiles of the source, each padded to the whole window, and add their results, or use a "
            "coarser grid"
        )
    if second is None:
        runner_up = "no other method was considered"
    elif second.cost > best.cost:
        ratio = second.cost / max(best.cost, 1)
        runner_up = f"{second.label} lost by its cost, {ratio:.2f} times as much arithmetic"
    else:
        runner_up = f"{second.label} lost by its predicted error of {second.error:.1e}"
    adequate = best.error <= tolerance
    verdict = "the cheapest adequate" if adequate else "the most accurate, though not adequate,"
    reason = (
        f"{best.label} is {verdict} of {len(options)} candidates: predicted error {best.error:.1e} for a tolerance of "
        f"{tolerance:.1e}"
    )
    pad = best.padded[0] / planes.grid.shape[0], best.padded[1] / planes.grid.shape[1]
    precision, window = str(dtype).removeprefix("torch."), (planes.out.shape, planes.out.pitch, planes.offset)
    costs = best.error, best.memory, best.flops
    return Plan(
        best.method,
        pad,
        best.padded,
        precision,
        window,
        *costs,
        reason,
        runner_up,
        adequate,
        best.sampled,
        best.paraxial,
    )


def choose(options: list[Candidate], tolerance: float) -> tuple[Candidate, Candidate | None]:
    """The cheapest candidate within the tolerance, or else the most accurate one, and the runner-up.

    Errors are computed in the order of cost, and only up to the first candidate within the tolerance.
    """
    ranked = sorted(options, key=lambda candidate: (candidate.cost, not candidate.paraxial))
    index = next((i for i, candidate in enumerate(ranked) if candidate.error <= tolerance), None)
    if index is None:
        index = 0
        ranked.sort(key=lambda candidate: candidate.error)
    best = ranked.pop(index)
    return best, ranked[max(index - 1, 0)] if ranked else None
