"""PhasedArray: the field that a nanophotonic phased array emits for given heater phases."""

import math
from collections.abc import Sequence

from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.precision import double
from holotorch.modulator.crosstalk import ThermalCrosstalk

# The thesis's phase shifter shifts light of 630 nm by pi at 175 K above ambient.
REFERENCE_WAVELENGTH, REFERENCE_RESPONSE = 630e-9, math.pi / 175  # metres; rad/K at this wavelength


class PhasedArray(nn.Module):
    """Thermally driven phased array with uniform amplitude: one heater and one antenna per pixel and colour.

    A phase is the product of a temperature rise above ambient and :attr:`response`. Departure from the thesis: its text
    under Eq. 4.1 calls the response proportional to the wavelength, but its three printed values are inversely
    proportional, as here.

    Args:
        wavelengths: In metres, one per channel.
        crosstalk: Spreading of the heat, an operator on heater phases [..., C, H, W].
        reference_response: Phase per temperature rise at 630 nm, in rad/K; that of the thesis's chip by default.
    """

    crosstalk: ThermalCrosstalk

    def __init__(
        self,
        wavelengths: float | Sequence[float],
        crosstalk: ThermalCrosstalk,
        *,
        reference_response: float = REFERENCE_RESPONSE,
    ):
        super().__init__()
        self.reference_response = checks.positive("reference_response", reference_response, "rad/K")
        self.wavelengths, self.crosstalk = checks.wavelengths(wavelengths), crosstalk

    @property
    def response(self) -> tuple[float, ...]:
        """Phase per temperature rise in rad/K, one value per channel, inversely proportional to the wavelength."""
        return tuple(self.reference_response * REFERENCE_WAVELENGTH / wavelength for wavelength in self.wavelengths)

    def forward(self, phase: Tensor) -> Tensor:
        """Emitted field, complex [..., C, H, W], for heater phases in rad, real [..., C, H, W]."""
        self._check(phase)
        return phasor(self.crosstalk(phase))

    def temperature(self, phase: Tensor) -> Tensor:
        """Temperature rise in kelvin for ``phase`` [..., C, H, W] in rad, which includes crosstalk or does not."""
        return phase / self._response_like(phase)

    def phase(self, temperature: Tensor) -> Tensor:
        """Phase in rad for a temperature rise in kelvin, [..., C, H, W]; inverse of :meth:`temperature`."""
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
        return double(self.response, value.device).to(value.dtype)[:, None, None]
