"""Finding the heater phases whose image survives the proximity effect."""

from holotorch.correction.gerchberg_saxton import gerchberg_saxton
from holotorch.correction.problem import PECProblem
from holotorch.correction.solvers import APG, ProjectedAdam, Solution, nonnegative

__all__ = ["APG", "PECProblem", "ProjectedAdam", "Solution", "gerchberg_saxton", "nonnegative"]
