"""The tolerance of a joint run, divided among heat kernel, planes, propagation and stopping rule."""

import math
from collections.abc import Callable

import torch

from holotorch.core.grid import Grid
from holotorch.experiments.joint.config import PLANES, JointSettings
from holotorch.experiments.planning import correction
from holotorch.experiments.planning.correction import HEAT, PROPAGATION, STOPPING, HeaterPhases
from holotorch.experiments.planning.tolerance import Budget, Part
from holotorch.modulator import ThermalCrosstalk

# Error of representing a volume by planes above which thin parts break, and above which only slices are left.
FEW_PLANES, COARSE_PLANES = 0.15, 0.5
SLABS = "planes"  # part with the error of representing slabs of the volume by planes
PATIENCE = 10  # small changes of the loss in a row after which the solver stops, with a tolerance
_COUNTS = (5, 8, 12, 16, 24, 32, 48, 64)  # numbers of planes to choose from
_DEVIATION = 2.5  # rad, of the heater phases: phases within one cycle, deconvolved
_EDGE = 0.6  # error of an image / number of samples in the radius of its pupil; 0.2 to 0.6 with 48 to 128 px
PADDINGS = 1, 2, 4  # factors on the longest distance for which the padding of a view suffices


def joint_budget(settings: JointSettings, error_of_planes: float, padded: Callable[[int], Grid]) -> Budget:
    """The shares of the parts with their predicted errors.

    Args:
        settings: The configuration.
        error_of_planes: Relative L2 error of the rendering by planes.
        padded: Padded grid of a view for a factor of ``PADDINGS``.
    """
    errors = {factor: edge_error(settings, padded(factor)) for factor in PADDINGS}
    budget = _begun(settings, error_of_planes, errors[PADDINGS[0]])
    budget.share(SLABS)
    budget.predict(SLABS, error_of_planes)
    share = budget.share(PROPAGATION)
    error = errors[padding(settings, share, errors)]
    budget.predict(PROPAGATION, error)
    if settings.tolerance is not None:
        single = correction.rounding_error(solver_dtype(settings, budget))
        budget.predict(PROPAGATION, math.hypot(error, single))
        budget.predict(STOPPING, correction.stopping_error(stop(settings, budget), PATIENCE))
    return budget


def choose_planes(settings: JointSettings, slab_error: Callable[[int], float]) -> int:
    """Number of planes: the given one, 5 without a tolerance, otherwise the fewest whose error is within the share.

    ``slab_error`` gives the error of a number of planes with one sample of the volume for each.
    """
    given = settings.display.planes
    if given is not None or settings.tolerance is None:
        return PLANES if given is None else given
    most = min(settings.frames, _COUNTS[-1]) if "slabs" in settings.comparisons else _COUNTS[-1]
    counts, share = [count for count in _COUNTS if count < most] + [most], _begun(settings, 0.0, 0.0).share(SLABS)
    return next((count for count in counts if slab_error(count) <= share), most)


def taps(settings: JointSettings) -> int | None:
    """Taps of a Gaussian heat kernel per axis; None for all that are needed, if the run has no tolerance."""
    if settings.tolerance is None or settings.display.kernel is not None:
        return None
    share = Budget(settings.tolerance, _parts(settings, 0.0, 0.0)).share(HEAT)
    chosen = correction.cropped_taps(settings.display.sigma_px, share, _heaters(settings))
    return correction.needed_taps(settings.display.sigma_px, chosen)


def padding(settings: JointSettings, share: float, errors: dict[int, float]) -> int:
    """Factor of ``PADDINGS``: the smallest whose predicted error is within the share, 1 without a tolerance."""
    if settings.tolerance is None:
        return PADDINGS[0]
    return next((factor for factor in PADDINGS if errors[factor] <= share), PADDINGS[-1])


def edge_error(settings: JointSettings, padded: Grid) -> float:
    """Error of an image whose pupil has a hard edge between the samples of the padded grid's frequencies."""
    side = min(n * step for n, step in zip(padded.shape, padded.pitch, strict=True))
    # The radius of the pupil in cycles per metre is its share of half the sampling rate of the pixels.
    return _EDGE / (settings.eye.pupil / (2 * max(padded.pitch)) * side)


def stop(settings: JointSettings, budget: Budget) -> float:
    """Relative change of the loss that counts as small; 0 without a tolerance, so that all steps are taken."""
    return 0.0 if settings.tolerance is None else correction.stopping_tolerance(budget.share(STOPPING), PATIENCE)


def solver_dtype(settings: JointSettings, budget: Budget) -> torch.dtype:
    """Precision of the phases in the solver."""
    return correction.solver_precision(stop(settings, budget))


def _begun(settings: JointSettings, error_of_planes: float, error_of_edges: float) -> Budget:
    """The budget after the taps of the heat kernel are chosen."""
    budget = Budget(settings.tolerance, _parts(settings, error_of_planes, error_of_edges))
    if settings.display.kernel is not None:
        return budget
    sigma_px, chosen = settings.display.sigma_px, taps(settings)
    chosen = 2 * ThermalCrosstalk(sigma_px).radius + 1 if chosen is None else chosen
    budget.share(HEAT)
    budget.predict(HEAT, correction.cropping_error(sigma_px, chosen, _heaters(settings)))
    return budget


def _parts(settings: JointSettings, error_of_planes: float, error_of_edges: float) -> list[Part]:
    """The parts in the order in which they are planned, with their errors in a run without tolerance.

    Such a run takes all steps, whatever error remains. The number of taps of a measured heat kernel is given.
    """
    given = error_of_planes if settings.display.planes is not None else None
    heat = correction.cropping_error(
        settings.display.sigma_px, 2 * ThermalCrosstalk(settings.display.sigma_px).radius + 1, _heaters(settings)
    )
    parts = [
        *([Part(HEAT, heat)] if settings.display.kernel is None else []),
        Part(SLABS, error_of_planes, "display.planes", given),
        Part(PROPAGATION, error_of_edges),
    ]
    return parts if settings.tolerance is None else [*parts, Part(STOPPING, settings.tolerance)]


def _heaters(settings: JointSettings) -> HeaterPhases:
    display = settings.display
    total = ThermalCrosstalk(display.sigma_px).total
    limit = settings.limit / total
    return HeaterPhases(min(2 * math.pi / total, limit), min(_DEVIATION, limit), display.shape)
