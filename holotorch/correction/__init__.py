"""Proximity effect correction: heater phases whose image is right although heat spreads between the pixels."""

import warnings
from typing import Any

from holotorch.correction.deconvolution import deconvolve, deconvolve_admm, inverse
from holotorch.correction.gerchberg_saxton import gerchberg_saxton, iterative_pec
from holotorch.correction.lbfgs import LBFGS, spread_preconditioner
from holotorch.correction.problem import PECProblem
from holotorch.correction.run import Box, Solution, nonnegative
from holotorch.correction.solvers import APG, ProjectedAdam
from holotorch.correction.stages import Stage, limit_peak_phase, penalty_schedule, proximal_pec, run_stages

__all__ = [
    "APG",
    "LBFGS",
    "Box",
    "PECProblem",
    "ProjectedAdam",
    "Solution",
    "Stage",
    "deconvolve",
    "deconvolve_admm",
    "gerchberg_saxton",
    "inverse",
    "iterative_pec",
    "limit_peak_phase",
    "nonnegative",
    "penalty_schedule",
    "proximal_pec",
    "run_stages",
    "spread_preconditioner",
]

_RENAMED = {"limited": penalty_schedule, "below": limit_peak_phase}


def __getattr__(name: str) -> Any:
    """The function that had this name in version 0.1, with a warning."""
    if name not in _RENAMED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    new = _RENAMED[name]
    warnings.warn(f"holotorch.correction.{name} is now {new.__name__}", DeprecationWarning, stacklevel=2)
    return new
