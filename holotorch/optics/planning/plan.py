"""Which propagator, with how much padding: the cheapest whose predicted error is within the tolerance."""

from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.grid import Grid
from holotorch.core.plan import Plan
from holotorch.core.quantities import DISTANCE
from holotorch.optics.free_space.plane_pair import PlanePair, plane_pair
from holotorch.optics.planning.candidates import Candidate, candidates
from holotorch.optics.planning.content import described, measured


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
    """Choose how to propagate a field over ``distance``.

    Args:
        grid: Sampling of the field.
        wavelength: In metres; of several, the plan serves all.
        distance: In metres, of either sign; likewise.
        tolerance: Largest relative L2 error of the result that is wanted.
        band: Highest frequencies (y, x) of the content in cycles per metre; up to the grid's own by default. The
            prediction is the expectation for noise that fills this band and the window; smoother content does better.
        spread: The same said as how far (y, x) in metres the content travels sideways over the distance.
        margin: Widths (y, x) in metres over which the content fades smoothly to nothing at both ends of each axis. By
            default it is cut hard by the window, and the edges diffract.
        field: An example of the content, complex [..., H, W], to measure instead of a description.
        out_grid: Sampling of the result; that of the field by default.
        offset: Where (y, x) in metres the axis of the result lies beside that of the field.
        tilt: Sines (y, x) of the direction of a carrier that is taken out of the field and of the result.
        dtype: complex64 or complex128, of the field.
        memory_limit: Refuse a plan that needs more bytes than this per channel.

    Raises:
        ValueError: Impossible numbers, or more memory than ``memory_limit``; the message says how to tile.
    """
    waves = checks.wavelengths(wavelength)
    planes = plane_pair(grid, out_grid, offset, tilt, waves)
    found = find(
        planes,
        waves,
        [checks.quantity(DISTANCE, z) for z in _listed(distance)],
        band=band,
        spread=spread,
        margin=margin,
        field=field,
        dtype=dtype,
    )
    return plan_from(found, planes, tolerance, memory_limit, dtype)


def find(
    planes: PlanePair,
    waves: Sequence[float],
    distances: Sequence[float],
    *,
    band: tuple[float, float] | None = None,
    spread: tuple[float, float] | None = None,
    margin: tuple[float, float] = (0.0, 0.0),
    field: Tensor | None = None,
    dtype: torch.dtype = torch.complex64,
) -> list[Candidate]:
    """Every way for the described or measured content; arguments as of :func:`plan_propagation`."""
    content = described(planes.grid, max(waves), max(map(abs, distances)), band=band, spread=spread, margin=margin)
    if field is not None:
        checks.field("field", field, planes.grid.shape)
        content = measured(field, planes.grid)
    return candidates(planes, waves, distances, content, dtype)


def plan_from(
    found: list[Candidate],
    planes: PlanePair,
    tolerance: float,
    memory_limit: int | None = None,
    dtype: torch.dtype = torch.complex64,
) -> Plan:
    """The plan for the best of ``found``."""
    best, second = choose(found, checks.positive("tolerance", tolerance))
    adequate = best.error <= tolerance
    size = f"{best.padded[0]} x {best.padded[1]} samples"
    if memory_limit is not None and best.memory > memory_limit:
        raise ValueError(
            f"{best.method} on {size} needs {best.memory / 1e9:.3g} GB per channel, more than the "
            f"{memory_limit / 1e9:.3g} GB allowed; propagate tiles of the source, each padded to the whole window, and "
            "add their results, or use a coarser grid"
        )
    verdict = "the cheapest adequate" if adequate else "the most accurate, though not adequate,"
    reason = (
        f"{best.method} on {size} is {verdict} of {len(found)} ways: predicted error {best.error:.1e} for a tolerance "
        f"of {tolerance:.1e}"
    )
    pad = best.padded[0] / planes.grid.shape[0], best.padded[1] / planes.grid.shape[1]
    precision, window = str(dtype).removeprefix("torch."), (planes.out.shape, planes.out.pitch, planes.offset)
    return Plan(
        best.method,
        pad,
        best.padded,
        precision,
        window,
        best.error,
        best.memory,
        best.flops,
        reason,
        _lost(best, second),
        adequate,
    )


def choose(found: list[Candidate], tolerance: float) -> tuple[Candidate, Candidate | None]:
    """The cheapest adequate candidate, or the most accurate if none is, and the one that came next.

    Cheap ones are asked for their error first, and none after the first that is adequate.
    """
    ranked = sorted(found, key=lambda way: (way.cost, not way.paraxial))
    for i, way in enumerate(ranked):
        if way.error <= tolerance:
            rival = ranked[i - 1] if i else ranked[1] if len(ranked) > 1 else None
            return way, rival
    ranked.sort(key=lambda way: way.error)
    return ranked[0], ranked[1] if len(ranked) > 1 else None


def _listed(values: float | Sequence[float]) -> list[float]:
    return list(values) if isinstance(values, Sequence) else [values]


def _lost(best: Candidate, second: Candidate | None) -> str:
    if second is None:
        return "no other way was considered"
    name = f"{second.method} on {second.padded[0]} x {second.padded[1]} samples"
    if second.cost > best.cost:
        return f"{name} lost by its cost, {second.cost / max(best.cost, 1):.2f} times as much arithmetic"
    return f"{name} lost by its predicted error of {second.error:.1e}"
