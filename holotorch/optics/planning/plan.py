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
    """Choose how to propagate a field over ``distance``.

    Args:
        grid: Sampling of the field.
        wavelength: In metres. A plan for several wavelengths serves all of them.
        distance: In metres, of either sign. A plan for several distances serves all of them.
        tolerance: Largest accepted relative L2 error of the result.
        band: Highest frequencies (y, x) of the content in cycles per metre; up to the grid's highest frequency by
            default. The prediction is the expectation for noise that fills this band and the window; smoother content
            has a smaller error.
        spread: Alternative to ``band``: distance (y, x) in metres that the content travels sideways on its path.
        margin: Widths (y, x) in metres over which the content fades smoothly to zero at both ends of each axis. By
            default the window cuts the content off, and the edges diffract.
        field: An example of the content, complex [..., H, W], which is measured and replaces the description.
        out_grid: Sampling of the result; that of the field by default.
        offset: Position (y, x) in metres of the axis of the result relative to the axis of the field.
        tilt: Sines (y, x) of the direction of a carrier wave by which the field and the result are divided.
        dtype: complex64 or complex128, of the field.
        memory_limit: Refuse a plan that needs more bytes than this per channel.

    Raises:
        ValueError: An argument outside its range, or a plan that needs more than ``memory_limit``; the message says
            how to propagate in tiles.
    """
    wavelengths = checks.wavelengths(wavelength)
    planes = plane_pair(grid, out_grid, offset, tilt, wavelengths)
    distances = list(distance) if isinstance(distance, Sequence) else [distance]
    distances = [checks.quantity(DISTANCE, each) for each in distances]
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
        f"{best.method} on {size} is {verdict} of {len(options)} ways: predicted error {best.error:.1e} for a "
        f"tolerance of {tolerance:.1e}"
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
        _rejection(best, second),
        adequate,
    )


def choose(options: list[Candidate], tolerance: float) -> tuple[Candidate, Candidate | None]:
    """The cheapest adequate candidate, or else the most accurate one, and the runner-up.

    Errors are computed in the order of cost, and only up to the first adequate candidate.
    """
    ranked = sorted(options, key=lambda candidate: (candidate.cost, not candidate.paraxial))
    for i, candidate in enumerate(ranked):
        if candidate.error <= tolerance:
            return candidate, ranked[i - 1] if i else ranked[1] if len(ranked) > 1 else None
    ranked.sort(key=lambda candidate: candidate.error)
    return ranked[0], ranked[1] if len(ranked) > 1 else None


def _rejection(best: Candidate, second: Candidate | None) -> str:
    """One sentence on why the runner-up was not chosen."""
    if second is None:
        return "no other way was considered"
    name = f"{second.method} on {second.padded[0]} x {second.padded[1]} samples"
    if second.cost > best.cost:
        return f"{name} lost by its cost, {second.cost / max(best.cost, 1):.2f} times as much arithmetic"
    return f"{name} lost by its predicted error of {second.error:.1e}"
