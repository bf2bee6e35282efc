"""A simulated chip in front of a camera, and the model that is fitted to it."""

import math

import torch
from torch import Tensor, nn

from holotorch.core.complex import intensity, phasor
from holotorch.core.grid import Grid
from holotorch.correction import LBFGS, Box, PECProblem
from holotorch.metrics import ssim
from holotorch.modulator import Response, ThermalCrosstalk
from holotorch.optics import CroppedKernel

LIMIT = 4 * math.pi  # largest drive of a heater in rad
TAPS = 7  # of the heat kernel, as in the dissertation


class Chip(nn.Module):
    """Intensity at a distance, real [..., C, H, W], for drives in rad: response, spreading of heat, propagation.

    Args:
        grid: Pixels of the chip.
        wavelength: In metres.
        response: From drive to heat.
        sigma_px: Of the heat kernel.
        distance: To the camera in metres.
        residual: Module from field to field for effects that the other parts do not model; None for nothing.
        learnable: Whether response, sigma and distance are Parameters.
    """

    def __init__(
        self,
        grid: Grid,
        wavelength: float,
        response: Response,
        sigma_px: float,
        distance: float,
        *,
        residual: nn.Module | None = None,
        learnable: bool = False,
    ):
        super().__init__()
        self.response, self.residual = response, residual
        self.crosstalk = ThermalCrosstalk(sigma_px, TAPS, learnable=learnable)
        self.propagator = CroppedKernel(grid, wavelength, distance, learnable=learnable)

    def forward(self, drive: Tensor) -> Tensor:
        """Intensity for drives in rad, real [..., C, H, W]."""
        return intensity(self.propagated(phasor(self.crosstalk(self.response(drive)))))

    def propagated(self, field: Tensor) -> Tensor:
        """Field at the camera for the field on the chip."""
        return self.propagator(field if self.residual is None else self.residual(field))

    def corrected(
        self, target: Tensor, *, frames: int, generator: torch.Generator, steps: tuple[int, int] = (100, 300)
    ) -> Tensor:
        """Drives [F, C, H, W] whose mean intensity, by this model, is ``target`` [C, H, W] but for a gain.

        ``steps``: of L-BFGS, on the amplitudes and then on the intensities.
        """
        setup = self._spread, self.propagated, target
        # From a nearly plain drive, and with the amplitudes first, little light leaves the window as speckle.
        drive = 3 + 0.3 * torch.rand(frames, *target.shape, generator=generator, dtype=target.dtype)
        for amplitude, most in zip((True, False), steps, strict=True):
            problem = PECProblem(*setup, scale_free=True, amplitude=amplitude, frames=True)
            drive = LBFGS(max_steps=most)(problem, drive, Box(0.0, LIMIT)).x
        return drive

    def _spread(self, drive: Tensor) -> Tensor:
        return self.crosstalk(self.response(drive))


class FieldResidual(nn.Module):
    """A small network that multiplies a field by 1 plus a complex correction, which is 0 at first.

    Its inputs are real and imaginary part of the field and the position on the grid, so that it can learn effects
    that depend on the position, such as uneven illumination or a warped chip.
    """

    def __init__(self, grid: Grid, channels: int = 16):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(5, channels, 1), nn.SiLU(), nn.Conv2d(channels, channels, 1), nn.SiLU(), nn.Conv2d(channels, 2, 1)
        )
        nn.init.zeros_(self.layers[-1].weight)  # type: ignore[arg-type]
        nn.init.zeros_(self.layers[-1].bias)  # type: ignore[arg-type]
        y, x = (torch.linspace(-1, 1, n)[:, None] if axis == 0 else torch.linspace(-1, 1, n)[None]
                for axis, n in enumerate(grid.shape))  # fmt: skip
        self.register_buffer(
            "place", torch.stack([y.expand(grid.shape), x.expand(grid.shape), y.square() + x.square()])
        )

    def forward(self, field: Tensor) -> Tensor:
        """Corrected field, complex [..., H, W]."""
        weight = next(self.parameters())
        flat = torch.view_as_real(field.resolve_conj()).movedim(-1, -3).flatten(0, -4).to(weight.dtype)
        place = self.place.to(weight).expand(len(flat), -1, -1, -1)  # type: ignore[union-attr, operator]
        real, imaginary = self.layers(torch.cat([flat, place], 1)).unflatten(0, field.shape[:-2]).unbind(-3)
        return field * (1 + torch.complex(real, imaginary).to(field.dtype))


def quality(chip: Chip, drive: Tensor, target: Tensor) -> float:
    """SSIM of the mean of the frames that ``chip`` shows, at the gain that fits the target [C, H, W] best."""
    with torch.no_grad():
        shown = chip(drive).mean(-4)
        gain = (shown * target).sum() / shown.square().sum()
        top = target.max().item()
        return ssim((gain * shown).clamp(0, top), target, data_range=top).mean().item()
