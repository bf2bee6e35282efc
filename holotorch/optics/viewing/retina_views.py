"""RetinaViews: images of a display on several retinas, such as one eye at several foci, for a correction problem."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class RetinaViews(nn.Module):
    """Intensities on V retinas, real [..., C, V, H, W], of one field [..., C, H, W].

    Unlike the fields of :class:`PupilViews`, they come from the whole chain of display, eyepiece and eye. A
    ``PECProblem`` takes them as they are.

    Args:
        retinas: A ``Retina`` or ``SpectralRetina`` for each focus or position of the eye, with the same grid and
            wavelengths.

    Raises ValueError for no retinas, or retinas that differ in grid or wavelengths.
    """

    image_axes = 3  # of a result: (V, H, W)

    def __init__(self, retinas: Sequence[nn.Module]):
        super().__init__()
        if len({(retina.grid, retina.wavelengths) for retina in retinas}) != 1:
            raise ValueError("RetinaViews needs at least one retina, and all with the same grid and wavelengths")
        self.retinas = nn.ModuleList(retinas)

    def forward(self, field: Tensor) -> Tensor:
        """Intensities on all retinas."""
        return torch.stack([retina(field) for retina in self.retinas], -3)
