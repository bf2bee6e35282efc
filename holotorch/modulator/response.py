"""Response: the phase that the drive of a modulator causes, which differs from device to device."""

from collections.abc import Sequence

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.learning import PreciseModule, without_graph
from holotorch.core.precision import at_least_single


class Response(PreciseModule):
    """Phase as a piecewise-linear function of the drive, both in rad, so that an ideal device has the identity.

    Args:
        limit: Largest drive in rad; beyond it and below 0 the first and last segment are continued.
        phases: Phase at evenly spaced drives from 0 to ``limit``, rising, [K] with K >= 2; the drives themselves by
            default. An ``nn.Parameter`` is learned.
        knots: K, where ``phases`` is not given.
        learnable: Make the phases a Parameter. They are in ``state_dict`` in any case, as ``phases``.

    Raises:
        ValueError: A limit that is not above 0, fewer than 2 knots, phases that do not rise.
    """

    phases: Tensor

    def __init__(
        self,
        limit: float,
        phases: Tensor | Sequence[float] | None = None,
        *,
        knots: int = 9,
        learnable: bool = False,
    ):
        super().__init__()
        self.limit = checks.positive("limit", limit, "rad")
        without_graph("phases", phases)
        if phases is None:
            phases = torch.linspace(0, self.limit, checks.whole("knots", knots, 2), dtype=torch.float64)
        table = phases if isinstance(phases, Tensor) else torch.tensor(phases, dtype=torch.float64)
        if table.ndim != 1 or len(table) < 2 or not bool((table.detach().diff() > 0).all()):
            raise ValueError(f"phases must be at least 2 rising numbers in rad, got {table.detach().tolist()}")
        self.record("phases", table, learnable=learnable)

    def forward(self, drive: Tensor) -> Tensor:
        """Phase in rad for a drive in rad, real, of any shape."""
        checks.real("drive", drive)
        drive = at_least_single(drive)
        table = self.phases.to(drive.dtype)
        position = drive * ((len(table) - 1) / self.limit)
        segment = position.detach().clamp(0, len(table) - 2).to(torch.int64)
        return table[segment] + (position - segment) * table.diff()[segment]

    def drive(self, phase: Tensor) -> Tensor:
        """The inverse of the response: drive in rad for a phase in rad, real, of any shape."""
        checks.real("phase", phase)
        phase = at_least_single(phase)
        table = self.phases.to(phase.dtype)
        segment = (torch.bucketize(phase.detach(), table.detach()) - 1).clamp(0, len(table) - 2)
        return (segment + (phase - table[segment]) / table.diff()[segment]) * (self.limit / (len(table) - 1))
