"""The tolerance of a run of kind ``pec``, divided among heat kernel, propagation and stopping rule."""

import math

import torch

from holotorch.experiments.pec.config import PECSettings
from holotorch.experiments.planning import correction
from holotorch.experiments.planning.correction import HEAT, PROPAGATION, STOPPING, HeaterPhases
from holotorch.experiments.planning.tolerance import Budget, Part
from holotorch.modulator import ThermalCrosstalk
from holotorch.modulator.phased_array import REFERENCE_WAVELENGTH

_STOP = {"apg": 1e-3, "adam": 1e-3, "lbfgs": 1e-4}  # relative change of the loss at which runs without tolerance stop


def pec_budget(settings: PECSettings, start: str) -> Budget:
    """The shares of the parts with their predicted errors, for a kind of start phases."""
    solver, chip = settings.solver, settings.modulator
    parts = []
    if chip.sigma_px is not None:
        heaters, given = _heaters(settings, start), None
        if chip.kernel_size is not None:
            given = correction.cropping_error(chip.sigma_px, chip.kernel_size, heaters)
        complete = 2 * ThermalCrosstalk(chip.sigma_px).radius + 1
        every = correction.cropping_error(chip.sigma_px, complete, heaters)
        parts.append(Part(HEAT, every, "modulator.kernel_size", given))
    parts.append(Part(PROPAGATION, correction.rounding_error(torch.float32)))
    given = None if solver.tolerance is None else correction.stopping_error(solver.tolerance, solver.patience)
    default = correction.stopping_error(_STOP[solver.kind], solver.patience)
    budget = Budget(settings.tolerance, [*parts, Part(STOPPING, default, "solver.tolerance", given)])
    if chip.sigma_px is not None:
        taps = _taps(settings, start, budget)
        budget.predict(HEAT, correction.cropping_error(chip.sigma_px, taps, _heaters(settings, start)))
    budget.share(PROPAGATION)
    # The stopping rule decides on the precision, and is met more closely in double precision.
    budget.predict(PROPAGATION, correction.rounding_error(torch.float64))
    tolerance = stop(settings, budget)
    budget.predict(PROPAGATION, correction.rounding_error(correction.solver_precision(tolerance)))
    budget.predict(STOPPING, correction.stopping_error(tolerance, solver.patience))
    return budget


def taps(settings: PECSettings, start: str) -> int | None:
    """Taps of the heat kernel per axis; None for all that are needed, if the run has no tolerance."""
    if settings.modulator.kernel_size is not None or settings.tolerance is None:
        return settings.modulator.kernel_size
    if (sigma_px := settings.modulator.sigma_px) is None:
        return None
    return correction.needed_taps(sigma_px, _taps(settings, start, pec_budget(settings, start)))


def stop(settings: PECSettings, budget: Budget) -> float:
    """Relative change of the loss that counts as small."""
    solver = settings.solver
    if solver.tolerance is not None:
        return solver.tolerance
    if settings.tolerance is None:
        return _STOP[solver.kind]
    return correction.stopping_tolerance(budget.share(STOPPING), solver.patience)


def _taps(settings: PECSettings, start: str, budget: Budget) -> int:
    chip, share = settings.modulator, budget.share(HEAT)
    assert chip.sigma_px is not None
    if chip.kernel_size is not None:
        return chip.kernel_size
    if settings.tolerance is None:
        return 2 * ThermalCrosstalk(chip.sigma_px).radius + 1
    return correction.cropped_taps(chip.sigma_px, share, _heaters(settings, start))


def _heaters(settings: PECSettings, start: str) -> HeaterPhases:
    """Heater phases after the correction, which are about those of the start, below any limit."""
    chip, shape = settings.modulator, settings.grid.shape
    assert chip.sigma_px is not None
    total, limit = ThermalCrosstalk(chip.sigma_px).total, math.inf
    if chip.max_phase is not None:
        limit = chip.max_phase
    elif chip.max_temperature is not None:
        limit = chip.max_temperature * chip.reference_response * REFERENCE_WAVELENGTH / max(settings.wavelengths)
    # Corrected phases have means of 3.3 to 4.1 rad and deviations of 2.1 to 2.8 from a hot start, others less.
    mean, deviation = (4.0, 2.5) if start == "hot" else (1.0, 1.2)
    if start == "quadratic":
        mean = deviation = math.pi * sum(shape) / 12 / total  # mean of the lens's phase, which spreads
    return HeaterPhases(min(mean, limit / total), min(deviation, limit / total), shape)
