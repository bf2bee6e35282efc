import math

import numpy as np
import pytest
import torch

from holotorch.modulator import PhasedArray, ThermalCrosstalk

WAVES = (630e-9, 530e-9, 445e-9)


def test_response_has_the_three_printed_values():
    wanted = [math.pi / 175, math.pi / 147, math.pi / 124]
    assert PhasedArray(WAVES, ThermalCrosstalk(0)).response == pytest.approx(wanted, rel=5e-3)


def test_field_has_unit_amplitude_and_the_spread_phase():
    crosstalk = ThermalCrosstalk(0.66)
    phase = torch.rand(2, 3, 8, 9, dtype=torch.float64)
    field = PhasedArray(WAVES, crosstalk)(phase)
    torch.testing.assert_close(field, torch.exp(1j * crosstalk(phase)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_temperature_and_phase_undo_each_other(dtype):
    array = PhasedArray(WAVES, ThermalCrosstalk(0))
    phase = torch.rand(2, 3, 4, 5, dtype=dtype)
    temperature = array.temperature(phase)
    assert temperature.dtype == dtype
    torch.testing.assert_close(array.phase(temperature), phase)
    assert array.temperature(torch.full((3, 1, 1), math.pi, dtype=dtype)).ravel().tolist() == pytest.approx(
        [175, 175 * 530 / 630, 175 * 445 / 630]
    )


def test_refuses_other_channel_counts():
    array = PhasedArray(WAVES, ThermalCrosstalk(0))
    for call in (array, array.temperature, array.phase):
        for shape in ((2, 4, 5), (3, 2, 4, 5), (4, 5)):  # (3, 2, 4, 5): colours before frames
            with pytest.raises(ValueError, match=r"\(C, H, W\) with C = 3, one per wavelength, got .* \[F, C, H, W\]"):
                call(torch.rand(shape))


def test_an_array_of_numpy_is_told_to_become_a_tensor():
    array = PhasedArray(WAVES, ThermalCrosstalk(0))
    for call in (array, array.temperature, array.phase):
        with pytest.raises(TypeError, match=r"phase or temperature must be .* got ndarray; use torch.from_numpy"):
            call(np.zeros((3, 4, 5)))  # type: ignore[arg-type]
