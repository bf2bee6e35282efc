"""PhasedArray: heater phases to the field that a nanophotonic phased array emits."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.modulator.crosstalk import ThermalCrosstalk

# The thesis's phase shifter turns red light of 630 nm by pi when it is 175 K above ambient.
REFERENCE_WAVELENGTH = 630e-9
REFERENCE_RESPONSE = math.pi / 175


class PhasedArray(nn.Module):
    """Thermally driven phased array with uniform amplitude: one heater and one antenna per pixel and colour.

    Args:
        wavelengths: In metres, one per channel.
        crosstalk: Spreads heater phases [..., C, H, W].

    A phase is a temperature rise above ambient times ``response`` (rad/K), which falls with the wavelength:
    (pi/175 rad/K)(630 nm / wavelength). The thesis's text says "proportional" under Eq. 4.1; its three printed values
    are inversely proportional.
    """

    crosstalk: ThermalCrosstalk

    def __init__(self, wavelengths: float | Sequence[float], crosstalk: ThermalCrosstalk):
        super().__init__()
        self.wavelengths, self.crosstalk = checks.wavelengths(wavelengths), crosstalk

    @property
    def response(self) -> tuple[float, ...]:
        """Phase per temperature rise in rad/K, one value per channel."""
        return tuple(REFERENCE_RESPONSE * REFERENCE_WAVELENGTH / wavelength for wavelength in self.wavelengths)

    def forward(self, phase: Tensor) -> Tensor:
        """Emitted field, complex [..., C, H, W], for heater phases in rad, real [..., C, H, W].

        Frames are [F, C, H, W]: phases [C, F, H, W] are refused, but where F = C no shape tells them apart.
        """
        self._check(phase)
        return phasor(self.crosstalk(phase))

    def temperature(self, phase: Tensor) -> Tensor:
        """Temperature rise in kelvin that gives ``phase`` [..., C, H, W]; of the chip for a phase after spreading."""
        return phase / self._response_like(phase)

    def phase(self, temperature: Tensor) -> Tensor:
        """Phase in rad that a temperature rise in kelvin, [..., C, H, W], gives; inverse of :meth:`temperature`."""
        return temperature * self._response_like(temperature)

    def _check(self, value: Tensor) -> None:
        checks.real("phase or temperature", value)
        if value.ndim < 3 or value.shape[-3] != len(self.wavelengths):
            raise ValueError(
                f"phase or temperature must end in (C, H, W) with C = {len(self.wavelengths)}, one per wavelength, got "
                f"{tuple(value.shape)}; frames go in front, [F, C, H, W]"
            )

    def _response_like(self, value: Tensor) -> Tensor:
        self._check(value)
        return torch.tensor(self.response, dtype=value.dtype, device=value.device)[:, None, None]
