"""Design of an ``AxialHologram``, and the factors by which it multiplies spectra."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core.fourier import multiply_even
from holotorch.hologram.cone import taper
from holotorch.hologram.nodes import Nodes
from holotorch.hologram.padding import Axis, faded_out
from holotorch.hologram.raster import Raster
from holotorch.optics.free_space.kernels import turns_phasor


@dataclass(frozen=True)
class AxialDesign:
    """Nodes and transforms of an ``AxialHologram`` for layers of one shape."""

    axes: tuple[Axis, Axis]  # sources and pixels along (y, x)
    nodes: Nodes  # nodes along the optical axis
    raster: Raster  # padded array that holds the sources and the pixels
    predicted_error: float  # expected relative L2 error of the field of random sources
    adequate: bool  # whether ``predicted_error`` is within the tolerance

    @property
    def size(self) -> tuple[int, int]:
        """Size (N_y, N_x) of the spectra in samples."""
        return self.raster.size

    def step(self, nodes: int, like: Tensor) -> Tensor:
        """Factor exp(2 pi i (w - w0) z), [N_y, N_x], for a distance z of ``nodes`` times the spacing of the nodes.

        w is the axial frequency and w0 is ``nodes.centre``. dtype and device are those of ``like``.
        """
        _, offset = self._axial_frequency(like.device)
        whole = torch.ones(self.size, dtype=like.dtype, device=like.device)
        return multiply_even(whole, turns_phasor(offset * (self.nodes.spacing * nodes)).to(like.dtype))

    def last(self, node: int, like: Tensor) -> Tensor:
        """First quadrant of the factor by which the sum over all nodes is multiplied, to give the hologram's spectrum.

        The sum refers to the plane of ``node``. The factor is the spectrum of the spherical wave from it, times taper
        and attenuation, divided by the Fourier transform of the window. dtype and device are those of ``like``.
        """
        axial, offset = self._axial_frequency(like.device)
        strength = 1 / (axial * math.prod(self.raster.grid.pitch) * self.nodes.response(offset))
        strength = torch.where(axial > 0.07 / self.axes[0].wavelength, strength, 0)
        for axis, frequency, length in zip(self.axes, self.raster.frequencies(like.device), self.size, strict=True):
            if axis.cone == "taper":
                strength = strength * taper(2 * axis.pitch * frequency)
            strength = strength * faded_out(frequency / axial, *axis.fade(length))
        # The factor i of Weyl's expansion is a phase of a quarter cycle.
        wave = turns_phasor(offset * self.nodes.depth(node) + 0.25)
        return (wave * strength).to(like.dtype)

    def _axial_frequency(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Axial frequency w in cycles per metre, in the first quadrant, and w minus ``nodes.centre``."""
        fy, fx = self.raster.frequencies(device)
        wavelength = self.axes[0].wavelength
        square = wavelength**-2 - fy.square() - fx.square()
        axial = torch.sqrt(square.clamp(min=(0.05 / wavelength) ** 2))
        return axial, axial - self.nodes.centre
