"""Proximity effect correction: heater phases that form the target image although heat spreads between pixels."""

from holotorch.core.deprecation import renamed
from holotorch.correction.calibration import Calibration, calibrate, scan
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
    "Calibration",
    "PECProblem",
    "ProjectedAdam",
    "Solution",
    "Stage",
    "calibrate",
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
    "scan",
    "spread_preconditioner",
]

__getattr__ = renamed(__name__, {"limited": "penalty_schedule", "below": "limit_peak_phase"})
