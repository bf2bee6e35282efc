"""Finding the heater phases whose image survives the proximity effect."""

from holotorch.correction.deconvolution import deconvolve, deconvolve_admm, inverse
from holotorch.correction.gerchberg_saxton import gerchberg_saxton, iterative_pec
from holotorch.correction.lbfgs import LBFGS, spread_preconditioner
from holotorch.correction.problem import PECProblem
from holotorch.correction.run import Box, Solution, nonnegative
from holotorch.correction.solvers import APG, ProjectedAdam

__all__ = [
    "APG",
    "LBFGS",
    "Box",
    "PECProblem",
    "ProjectedAdam",
    "Solution",
    "deconvolve",
    "deconvolve_admm",
    "gerchberg_saxton",
    "inverse",
    "iterative_pec",
    "nonnegative",
    "spread_preconditioner",
]
