"""Random arguments of ``propagate`` against the oracle: nothing is wrong by ten tolerances without a word."""

import warnings

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.diffraction import band_limited_sum

from holotorch import Grid
from holotorch.optics import propagate

MICRONS = st.floats(0.3, 30).map(lambda value: value * 1e-6)
UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}


@st.composite
def sampling(draw, largest=20):
    """Shape and pitch in metres of a grid, square or not."""
    shape = draw(st.integers(1, largest)), draw(st.integers(1, largest))
    y = draw(MICRONS)
    return shape, (y, draw(st.sampled_from([y, 0.7 * y, 1.6 * y])))


@st.composite
def cases(draw):
    """Arguments of a propagation of noise; distances up to 12 times the cross-over distance of the window."""
    shape, pitch = draw(sampling())
    wavelength = draw(st.floats(400e-9, 700e-9))
    crossover = 2 * max(shape) * max(pitch) ** 2 / wavelength
    distance = draw(st.sampled_from([-1.0, 1.0])) * crossover * 10 ** draw(st.floats(-3, 1.1))
    same = draw(st.booleans())
    out_shape, out_pitch = (shape, pitch) if same else draw(sampling())
    around, share = draw(st.floats(0, 2 * np.pi)), draw(st.sampled_from([0.0, 0.0, 0.1, 0.5]))
    steep = share * max(0.0, 0.97 - np.hypot(*(wavelength / 2 / p for p in pitch)))
    tilt = float(steep * np.sin(around)), float(steep * np.cos(around))
    arrived = [distance * sine / np.sqrt(1 - steep**2) for sine in tilt]
    aside = draw(st.sampled_from([(0.0, 0.0), (0.3, -0.4), (1.5, 0.0)]))
    offset = tuple(float(a + s * n * p) for a, s, n, p in zip(arrived, aside, shape, pitch, strict=True))
    dtype = draw(st.sampled_from([torch.complex64, torch.complex128]))
    return shape, pitch, wavelength, distance, out_shape, out_pitch, offset, tilt, dtype


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(cases(), st.sampled_from([1e-1, 1e-2, 1e-3, 1e-5]), st.integers(0, 3))
def test_no_random_propagation_is_silently_wrong(case, tolerance, seed):
    shape, pitch, wavelength, distance, out_shape, out_pitch, offset, tilt, dtype = case
    noise = np.random.default_rng(seed).normal(size=(2, *shape))
    field = torch.from_numpy(noise[0] + 1j * noise[1]).to(dtype)
    window = {"out_grid": Grid(out_shape, out_pitch), "offset": offset, "tilt": tilt}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            got = propagate(field, Grid(shape, pitch), wavelength, distance, tolerance=tolerance, **window)
        except ValueError as refused:
            assert len(str(refused)) > 30  # advice, not an exception from the depths
            return
    assert got.dtype == dtype and got.shape == out_shape and torch.view_as_real(got).isfinite().all()
    if not caught:
        exact = field.numpy().astype(complex), pitch, wavelength, distance, out_shape, out_pitch, offset, tilt
        wanted = band_limited_sum(*exact)
        assert np.linalg.norm(got.numpy() - wanted) <= 10 * tolerance * np.linalg.norm(wanted)


@settings(max_examples=15, deadline=None, derandomize=True, database=None)
@given(st.floats(0.1, 900), st.sampled_from(list(UNITS)), st.floats(0.1, 900), st.sampled_from(list(UNITS)))
def test_lengths_in_any_unit_are_propagated_or_refused_by_name(wavelength, first, pitch, second):
    """A length in the wrong unit is implausible; what is plausible is finite."""
    field = torch.ones(6, 5, dtype=torch.complex128)
    with warnings.catch_warnings(action="ignore"):
        try:
            got = propagate(field, Grid((6, 5), pitch * UNITS[second]), wavelength * UNITS[first], 1e-3)
        except ValueError as refused:
            assert any(word in str(refused) for word in ("pitch", "wavelength", "tolerance"))
        else:
            assert torch.view_as_real(got).isfinite().all()
