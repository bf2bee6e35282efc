"""Transfer factors of an axial hologram: propagation from node to node, and the spectrum of the spherical wave."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core.fourier import multiply_even
from holotorch.core.grid import Grid
from holotorch.hologram.cone import taper
from holotorch.hologram.nodes import Nodes
from holotorch.hologram.padding import Axis, faded_out
from holotorch.hologram.raster import Raster
from holotorch.optics.free_space.kernels import turns_phasor


@dataclass(frozen=True)
class AxialDesign:
    """Choices of an :class:`AxialHologram` for layers of one shape.

    Attributes:
        nodes: Nodes along the axis.
        size: Size (y, x) of the transforms in samples.
        predicted_error: Expected relative L2 error for random sources, against the wave that ``cone`` defines.
        adequate: Whether ``predicted_error`` is within the tolerance.
    """

    nodes: Nodes
    size: tuple[int, int]
    predicted_error: float
    adequate: bool


class TransferFactors:
    """Factors of the spectra in frequency, for layers of one shape.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        design: Nodes and transform size.
        axes: Sources and pixels along (y, x).
        raster: Positions of both on the padded array.
        dtype: Complex dtype of the factors.
        device: Device of the factors.
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
        """Factor [N_y, N_x] from one node to the node that is ``nodes`` deeper."""
        cycles = self._axial_offset() * (self.design.nodes.spacing * nodes)
        whole = torch.ones(self.design.size, dtype=self.dtype, device=cycles.device)
        return multiply_even(whole, turns_phasor(cycles).to(self.dtype))

    def last(self, node: int) -> Tensor:
        """Quadrant of the factor for the sum at ``node``.

        It is the spectrum of the spherical wave times cone and attenuation, divided by the spectrum of the window.
        """
        nodes, axial, offset = self.design.nodes, self._axial(), self._axial_offset()
        strength = 1 / (axial * math.prod(self.grid.pitch) * nodes.response(offset))
        strength = torch.where(axial > 0.07 / self.wavelength, strength, 0)
        for axis, frequency, length in zip(self.axes, (self.fy, self.fx), self.design.size, strict=True):
            if axis.cone == "taper":
                strength = strength * taper(2 * axis.pitch * frequency)
            strength = strength * faded_out(frequency / axial, *axis.fade(length))
        wave = turns_phasor(offset * nodes.depth(node) + 0.25)  # a quarter cycle is the factor i of Weyl's expansion
        return (wave * strength).to(self.dtype)

    def _axial(self) -> Tensor:
        square = self.wavelength**-2 - self.fy.square() - self.fx.square()
        return torch.sqrt(square.clamp(min=(0.05 / self.wavelength) ** 2))

    def _axial_offset(self) -> Tensor:
        return self._axial() - self.design.nodes.centre
