"""What an axial hologram multiplies spectra with: the step between nodes, and the wave itself."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core.fourier import multiply_even
from holotorch.core.grid import Grid
from holotorch.hologram.cone import taper
from holotorch.hologram.guard import Axis, faded_out
from holotorch.hologram.nodes import Nodes
from holotorch.hologram.raster import Raster
from holotorch.optics.free_space.kernels import turns_phasor


@dataclass(frozen=True)
class AxialDesign:
    """What an :class:`AxialHologram` does for layers of one shape.

    Attributes:
        nodes: Along the axis.
        size: Samples of the transforms, (y, x).
        predicted_error: Expected relative L2 error for sources like noise, against the cone's own definition.
        adequate: Whether that is within the tolerance.
    """

    nodes: Nodes
    size: tuple[int, int]
    predicted_error: float
    adequate: bool


class Waves:
    """Factors in frequency for layers of one shape.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        design: Nodes and lengths.
        axes: Of sources and pixels, (y, x).
        raster: Where both lie.
        dtype: Of the factors, complex.
        device: Where they are.
    """

    def __init__(
        self,
        grid: Grid,
        wavelength: float,
        design: AxialDesign,
        axes: tuple[Axis, Axis],
        raster: Raster,
        dtype: torch.dtype,
        device: torch.device,
    ):
        self.grid, self.wavelength, self.design, self.axes, self.raster = grid, wavelength, design, axes, raster
        self.dtype = dtype
        height, width = design.size
        self.fy = torch.arange(height // 2 + 1, dtype=torch.float64, device=device)[:, None] / (height * grid.pitch[0])
        self.fx = torch.arange(width // 2 + 1, dtype=torch.float64, device=device)[None, :] / (width * grid.pitch[1])

    def step(self, nodes: int) -> Tensor:
        """The factor from one node to another, so many deeper, [N_y, N_x]."""
        turns = self._beside() * (self.design.nodes.spacing * nodes)
        whole = torch.ones(self.design.size, dtype=self.dtype, device=turns.device)
        return multiply_even(whole, turns_phasor(turns).to(self.dtype))

    def last(self, node: int) -> Tensor:
        """What the sum at ``node`` is multiplied with in the end, a quadrant: phase, wave, cone, window."""
        nodes, axial, beside = self.design.nodes, self._axial(), self._beside()
        strength = 1 / (axial * math.prod(self.grid.pitch) * nodes.response(beside))
        strength = torch.where(axial > 0.07 / self.wavelength, strength, 0)
        for axis, frequency, length in zip(self.axes, (self.fy, self.fx), self.design.size, strict=True):
            if axis.cone == "taper":
                strength = strength * taper(2 * axis.pitch * frequency)
            strength = strength * faded_out(frequency / axial, *axis.fade(length))
        wave = turns_phasor(beside * nodes.depth(node) + 0.25)  # the quarter turn is Weyl's i
        return (wave * strength).to(self.dtype)

    def _axial(self) -> Tensor:
        square = self.wavelength**-2 - self.fy.square() - self.fx.square()
        return torch.sqrt(square.clamp(min=(0.05 / self.wavelength) ** 2))

    def _beside(self) -> Tensor:
        return self._axial() - self.design.nodes.centre
