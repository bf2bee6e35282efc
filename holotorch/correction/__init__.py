"""Finding the heater phases whose image survives the proximity effect."""

from holotorch.correction.deconvolution import deconvolve, deconvolve_admm, inverse
from holotorch.correction.gerchberg_saxton import gerchberg_saxton, iterative_pec
from holotorch.correction.lbfgs import LBFGS, spread_preconditioner
from holotorch.correction.problem import PECProblem
from holotorch.correction.run import Box, Solution, nonnegative
from holotorch.correction.solvers import APG, ProjectedAdam
from holotorch.correction.stages import Stage, below, limited, proximal_pec, run_stages

__all__ = [
    "APG",
    "LBFGS",
    "Box",
    "PECProblem",
    "ProjectedAdam",
    "Solution",
    "Stage",
    "below",
    "deconvolve",
    "deconvolve_admm",
    "gerchberg_saxton",
    "inverse",
    "iterative_pec",
    "limited",
    "nonnegative",
    "proximal_pec",
    "run_stages",
    "spread_preconditioner",
]
