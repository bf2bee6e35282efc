"""The table of quantities: ranges, messages, and what no range may refuse."""

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch

from holotorch.core import checks, quantities
from holotorch.core.grid import Grid
from holotorch.core.quantities import Quantity, shown
from holotorch.optics import propagate
from holotorch.optics.elements.converging import converging_fresnel
from holotorch.optics.free_space.kernels import carrier

TABLE = {name: value for name, value in vars(quantities).items() if isinstance(value, Quantity)}
NAN, INFINITE = math.nan, math.inf


@pytest.mark.parametrize("kind", TABLE.values(), ids=TABLE)
def test_ranges_hold_their_usual_values_and_end_where_they_say(kind):
    assert kind.low <= kind.usual[0] < kind.usual[1] <= kind.high
    for value in (*kind.usual, kind.high if kind.high < INFINITE else 1.0):
        assert checks.quantity(kind, value) == value
    if kind.low:
        assert checks.quantity(kind, kind.low) == kind.low
        with pytest.raises(ValueError, match=f"^{kind.name} must lie "):
            checks.quantity(kind, kind.low / 1.01)
    if kind.high < INFINITE:
        with pytest.raises(ValueError, match=f"^{kind.name} must lie "):
            checks.quantity(kind, kind.high * 1.01)
    for value, allowed in ((-kind.usual[0], kind.negative), (0.0, kind.zero), (INFINITE, kind.infinite), (NAN, False)):
        if allowed:
            assert checks.quantity(kind, value) == value
            continue
        with pytest.raises(ValueError, match=f"^{kind.name} must be .* in {kind.words}.*, got "):
            checks.quantity(kind, value)


@pytest.mark.parametrize(
    ("kind", "value", "cure"),
    [
        (quantities.WAVELENGTH, 450.0, "450 looks like nanometres: pass 450e-9"),
        (quantities.WAVELENGTH, 0.53, "0.53 looks like micrometres: pass 0.53e-6"),
        (quantities.WAVELENGTH, 5.3e-4, "0.00053 looks like millimetres: pass 5.3e-07"),
        (quantities.PITCH, 8.0, "8 looks like micrometres: pass 8e-6"),
        (quantities.PITCH, 8e-3, "0.008 looks like millimetres: pass 8e-06"),
        (quantities.PITCH, 3740.0, "3740 looks like nanometres: pass 3740e-9"),
        (quantities.PUPIL_RADIUS, 1.5, "1.5 looks like millimetres: pass 1.5e-3"),
        (quantities.EYE_LENGTH, 24.0, "24 looks like millimetres: pass 24e-3"),
        (quantities.EYE_LENGTH, 2.4, "2.4 looks like centimetres: pass 2.4e-2"),
        (quantities.TOOL_LENGTH, 350.0, "350 looks like millimetres: pass 350e-3"),
        (quantities.VOXEL, 0.5, "0.5 looks like millimetres: pass 0.5e-3"),
        (quantities.WAVELENGTH, 5e-13, "pass a number of metres, usually 200 nm to 20 um"),
        (quantities.SIGMA_PX, 1000.0, "pass a number of pixels, usually 0.1 pixels to 5 pixels"),
    ],
)
def test_the_message_says_what_to_pass(kind, value, cure):
    with pytest.raises(ValueError) as caught:
        checks.quantity(kind, value)
    assert str(caught.value).endswith(f"got {value:g} {kind.unit}; {cure}")
    if kind.unit == "m" and "pass a number" not in cure:
        assert checks.quantity(kind, float(cure.split()[-1])) > 0  # what it tells to pass is accepted


def test_values_are_shown_with_the_prefix_that_suits_them():
    for value, text in ((3.74e-6, "3.74 um"), (0.2, "200 mm"), (1.0, "1 m"), (1e-11, "10 pm"), (0.0, "0 m")):
        assert shown(value, "m") == text
    assert shown(0.66, "pixels") == "0.66 pixels"


def test_tensors_are_checked_element_by_element_with_their_gradients():
    waves = torch.tensor([[450e-9], [530e-9]], dtype=torch.float64, requires_grad=True)
    checks.quantities(quantities.WAVELENGTH, waves)
    checks.quantities(quantities.WAVELENGTH, waves[:0])
    with pytest.raises(ValueError, match="light must lie within 10 nm .. 300 um, got 530 m"):
        checks.quantities(quantities.WAVELENGTH, torch.tensor([450e-9, 530.0]), "light")
    with pytest.raises(TypeError, match="wavelength must be a number in metres, got str '450 nm'"):
        checks.quantity(quantities.WAVELENGTH, "450 nm")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="cannot carry a gradient"):
        checks.quantity(quantities.WAVELENGTH, waves[0, 0])  # type: ignore[arg-type]


def test_what_is_no_tensor_is_told_how_to_become_one():
    for check in (checks.real, lambda name, value: checks.field(name, value, (2, 2))):
        with pytest.raises(TypeError, match=r"light must be a.* got ndarray; use torch.from_numpy\(\.\.\.\)$"):
            check("light", np.zeros((2, 2)))  # type: ignore[arg-type]
        with pytest.raises(TypeError, match=r"light must be a.* got list; use torch.tensor\(\.\.\.\)$"):
            check("light", [[0.0, 0.0], [0.0, 0.0]])  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="light must be a.* got NoneType$"):
            check("light", None)  # type: ignore[arg-type]


def test_a_real_field_is_told_how_to_become_complex():
    with pytest.raises(TypeError) as caught:
        checks.field("light", torch.ones(2, 2), (2, 2))
    cure = "of a real field give field + 0j, of amplitude and phase torch.polar(amplitude, phase)"
    assert str(caught.value) == f"light must be complex (complex64 or complex128), got torch.float32; {cure}"
    checks.field("light", torch.ones(2, 2) + 0j, (2, 2))
    checks.field("light", torch.polar(torch.ones(2, 2), torch.zeros(2, 2)), (2, 2))


def test_grids_refuse_a_pitch_in_other_units():
    for pitch in (8.0, (8e-6, 8.0), 8e-3, 3740):
        with pytest.raises(
            ValueError, match="grid pitch must lie within 1 nm .. 2 mm, got .* m; .* looks like .*metres"
        ):
            Grid(8, pitch)
    assert dataclasses.asdict(Grid(8, 3.74e-6))["pitch"] == (3.74e-6, 3.74e-6)


def test_tensors_that_hold_no_values_yet_are_taken_as_they_are():
    """Mapped over or compiled: whether they can be meant is asked where they hold values."""
    waves = torch.tensor([450e-9, 530.0], dtype=torch.float64)
    mapped = torch.vmap(lambda wave: carrier(wave, 1e-3))(waves)
    assert mapped.shape == (2,)
    with pytest.raises(ValueError, match="wavelength must lie within"):
        carrier(waves, 1e-3)
    checks.plausible(quantities.WAVELENGTH, torch.empty(3, device="meta"))


@pytest.mark.parametrize("shape", [(), (2,)])
def test_a_phase_that_float32_turns_is_warned_of(shape):
    """0.1 m / 530 nm is 1.9e5 cycles, of which float32 rounds away up to 6e-8: 0.07 rad."""
    field, grid = torch.ones(2, 8, 8, dtype=torch.complex128), Grid(8, 8e-6)
    distance = torch.full(shape, 0.1)
    calls = {
        "carrier": lambda far: carrier(530e-9, far),
        "propagate": lambda far: propagate(field, grid, 530e-9, far, tolerance=0.09),
        "converging_fresnel": lambda far: converging_fresnel(field, grid, 530e-9, far, 0.2, grid),
    }
    for call in calls.values():
        with pytest.warns(
            checks.PrecisionWarning, match="distance is float32, .* by up to 0.071 rad here; pass float64"
        ):
            coarse = call(distance)
        with warnings.catch_warnings():
            warnings.simplefilter("error", checks.PrecisionWarning)
            exact = call(distance.double().fill_(0.1))  # and with as many digits as there are
            call(distance / 1e3)  # too short for it to show
        turned = (coarse.flatten()[0] * exact.flatten()[0].conj()).angle().abs().item()
        assert 0.005 < turned < 0.071  # it is there, and within what the warning says
    with pytest.warns(checks.PrecisionWarning, match="wavelength is float32, .* by up to 0.071 rad"):
        carrier(torch.full(shape, 530e-9), 0.1)


def test_a_whole_number_beyond_all_floats_is_not_finite():
    for value in (10**400, -(10**400)):
        with pytest.raises(ValueError, match="x must be finite"):
            checks.finite("x", value)
        with pytest.raises(ValueError, match="x must be"):
            checks.positive("x", value)
