"""Finding the heater phases whose image survives the proximity effect."""

from holotorch.correction.gerchberg_saxton import gerchberg_saxton
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
    "gerchberg_saxton",
    "nonnegative",
    "spread_preconditioner",
]
