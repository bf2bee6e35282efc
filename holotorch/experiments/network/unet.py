"""PhaseUNet: heater phases from a picture, by one pass of a small U-Net."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from holotorch.core.operator import LinearOperator


class PhaseUNet(nn.Module):
    """Heater phases [B, C, H, W] in rad, 0 to ``limit``, for target intensities [B, C, H, W].

    The input of the network is the target amplitude, propagated back to the modulator with a flat phase: real and
    imaginary part for each colour. Diffraction is thus accounted for already, and the network, whose
    convolutions are local, corrects phase, amplitude and heat. H and W are multiples of 4.

    Args:
        propagator: From modulator to image, with ``adjoint``.
        channels: Colours C.
        limit: Largest phase in rad.
        width: Feature maps of the first level; 2 and 4 times as many on the next two.
    """

    def __init__(self, propagator: LinearOperator, *, channels: int = 1, limit: float = 4 * math.pi, width: int = 24):
        super().__init__()
        self.propagator, self.limit = propagator, limit
        self.first = _block(2 * channels, width)
        self.second = _block(width, 2 * width)
        self.third = _block(2 * width, 4 * width)
        self.up_second = _block(6 * width, 2 * width)
        self.up_first = _block(3 * width, width)
        self.last = nn.Conv2d(width, channels, 3, padding=1)

    def forward(self, target: Tensor) -> Tensor:
        """Phases for ``target``, the target intensity with a mean of 1."""
        if target.ndim != 4 or target.shape[-1] % 4 or target.shape[-2] % 4:
            raise ValueError(
                f"target must be (B, C, H, W) with H and W multiples of 4, got {tuple(target.shape)}; crop or pad it"
            )
        amplitude = target.clamp(min=0).sqrt()
        back = self.propagator.adjoint(torch.complex(amplitude, torch.zeros_like(amplitude)))
        first = self.first(torch.cat([back.real, back.imag], 1))
        second = self.second(functional.avg_pool2d(first, 2))
        third = self.third(functional.avg_pool2d(second, 2))
        second = self.up_second(torch.cat([functional.interpolate(third, scale_factor=2.0), second], 1))
        first = self.up_first(torch.cat([functional.interpolate(second, scale_factor=2.0), first], 1))
        return self.limit * torch.sigmoid(self.last(first).float())


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1), nn.SiLU(), nn.Conv2d(outputs, outputs, 3, padding=1), nn.SiLU()
    )
