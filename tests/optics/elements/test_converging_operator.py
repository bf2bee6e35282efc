"""ConvergingFresnel: the phase beyond Fresnel that its warning estimates, and refused arguments."""

import math
import warnings

import pytest
import torch
from oracles import converging as oracle

from holotorch import Grid
from holotorch.optics import RayleighSommerfeld
from holotorch.optics.elements.converging import ConvergingFresnel, converging_fresnel

WAVE, GRID = 530e-9, Grid((20, 24), (6e-6, 5e-6))
FINE = Grid(129, 1.2e-6)  # carries rays of up to wavelength / (2 pitch) = 0.22


def bump(place: float, slope: float) -> torch.Tensor:
    """A beam of 12 um radius at (place, place) that leaves with this slope on both axes."""
    y, x = GRID.coordinates()
    tone = torch.exp(2j * torch.pi * slope / WAVE * (y + x))
    return torch.exp(-((y - place).square() + (x - place).square()) / 12e-6**2) * tone


@pytest.mark.parametrize("focus", [0.5e-3, 1e-3, 4e-3])
@pytest.mark.parametrize("content", ["a steep beam", "the whole window"])
def test_what_lies_beyond_fresnel_against_the_full_integral(focus, content):
    if content == "a steep beam":
        place, slope = 25e-6, -0.02
        field, out_grid = bump(place, slope), Grid(17, 3e-6)
        offset = (place + focus * (slope - place / focus),) * 2
    else:
        y, x = (torch.hann_window(n + 1, periodic=False, dtype=torch.float64)[:-1] ** 0.5 for n in GRID.shape)
        field, out_grid, offset = (y[:, None] * x).to(torch.complex128), Grid(12, 3e-6), (0.0, 0.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        operator = ConvergingFresnel(GRID, WAVE, focus, focus, out_grid=out_grid, offset=offset)
    estimate = operator.beyond_fresnel
    assert len(caught) == (estimate > 0.1)
    if caught:
        assert f"{estimate:.2g} rad" in str(caught[0].message)
    assert estimate > 0.1 if focus < 1.5e-3 else estimate < 0.1
    y, x = FINE.coordinates()
    source = oracle.interpolated(field.numpy(), GRID.pitch, (y.numpy().ravel(), x.numpy().ravel()))
    lens = torch.exp(-1j * torch.pi / (WAVE * focus) * (y.square() + x.square()))
    wanted = RayleighSommerfeld(FINE, WAVE, focus, out_grid=out_grid, offset=offset)(
        (torch.from_numpy(source) * lens)[None]
    )
    error = ((operator(field[None]) - wanted).norm() / wanted.norm()).item()
    # A maximum over all rays: content that is less steep, or of one phase all over, is off by less.
    assert estimate / 100 <= error <= estimate


def test_no_ray_arrives_no_phase_is_left_out():
    operator = ConvergingFresnel(GRID, WAVE, 5e-3, 5e-3, out_grid=Grid(8, 1e-6), offset=(0.0, 1e-3))
    assert operator.beyond_fresnel == 0


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="distance must not be 0"):
        ConvergingFresnel(GRID, WAVE, 0.0, 1e-2)
    with pytest.raises(ValueError, match="focus must be other than zero"):
        ConvergingFresnel(GRID, WAVE, 1e-2, 0.0)
    with pytest.raises(ValueError, match="focus must be finite in metres, or infinite, got nan"):
        ConvergingFresnel(GRID, WAVE, 1e-2, math.nan)
    with pytest.raises(
        ValueError, match=r"so near to the focus, 0\.01 m.*pass out_grid, for instance Grid\(\(20, 24\), \("
    ):
        ConvergingFresnel(GRID, WAVE, 1e-2, 1e-2)
    with pytest.raises(ValueError, match="offset must be finite"):
        ConvergingFresnel(GRID, WAVE, 1e-2, 2e-2, offset=(0.0, math.inf))
    operator = ConvergingFresnel(GRID, WAVE, 1e-2, 3e-2, out_grid=Grid((9, 14), 3e-6))
    field = torch.ones(1, *GRID.shape, dtype=torch.complex128)
    with pytest.raises(ValueError, match=r"field must end in \(C, H, W\) = \(1, 20, 24\)"):
        operator(field.transpose(-1, -2))
    with pytest.raises(ValueError, match=r"field must end in \(C, H, W\) = \(1, 9, 14\)"):
        operator.adjoint(field)
    assert "magnification=0.666667" in repr(operator)
    for lengths, message in (
        ((0.0, 1e-2, 1e-2), "wavelength must be above zero"),
        ((WAVE, 0.0, 1e-2), "distance must be other than zero"),
        ((WAVE, 1e-2, 0.0), "focus must be other than zero"),
        ((WAVE, math.nan, 1e-2), "distance must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            converging_fresnel(field, GRID, *lengths, GRID)
