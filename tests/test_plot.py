import math

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.plot import show


def panels(figure) -> list[np.ndarray]:
    return [np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images and axes.get_title()]


def test_a_field_shows_amplitude_and_phase():
    field = torch.polar(torch.rand(2, 5, 7), 6 * torch.rand(2, 5, 7) - 3)
    shown = panels(show(field, Grid((5, 7), 1e-3), names=["a", "b"]))
    assert len(shown) == 4
    np.testing.assert_allclose(shown[0], field[0].abs(), rtol=1e-6)
    np.testing.assert_allclose(shown[2], field[0].angle(), rtol=1e-5)
    np.testing.assert_allclose(shown[3], field[1].angle(), rtol=1e-5)


def test_phases_without_light_are_blank():
    field = torch.tensor([[1.0, 1.01e-5j], [0.99e-5j, 0.0]], dtype=torch.complex128)
    lit, dark = (np.ma.filled(each, np.nan) for each in panels(show(torch.stack([field, 0 * field]), what="phase")))
    np.testing.assert_allclose(lit, [[0, math.pi / 2], [np.nan, np.nan]], rtol=1e-6)
    assert np.isnan(dark).all()


def test_axes_count_millimetres_from_the_optical_axis():
    figure = show(torch.rand(4, 5), Grid((4, 5), (1e-3, 2e-3)), what="intensity")
    left, right, bottom, top = figure.axes[0].images[0].get_extent()
    assert (left, right) == (-5.0, 5.0) and (top, bottom) == (-2.5, 1.5)  # sample n // 2 is at 0
    assert figure.axes[0].get_xlabel() == "x (mm)"


def test_colour_takes_three_channels_and_is_brightest_at_the_peak():
    picture = torch.rand(3, 4, 5)
    (shown,) = panels(show(picture, what="colour"))
    assert shown.shape == (4, 5, 3) and shown.max() == pytest.approx(1)
    assert shown.reshape(-1)[int(picture.movedim(0, -1).reshape(-1).argmax())] == pytest.approx(1)


def test_intensity_of_a_field_with_a_gradient():
    field = torch.randn(4, 4, dtype=torch.complex128, requires_grad=True)
    (shown,) = panels(show(field, what="intensity"))
    np.testing.assert_allclose(shown, field.detach().abs().square(), rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "what", "message"),
    [
        (torch.rand(4), None, r"values must end in \(H, W\)"),
        (torch.rand(4, 4), "phase", "phase needs a complex field, got torch.float32"),
        (torch.rand(4, 4), "power", "what must be among amplitude, phase, intensity, colour, got 'power'"),
        (torch.rand(2, 4, 4), "colour", "colour needs three channels"),
        (torch.rand(99, 4, 4), None, "values make 99 panels, more than 24"),
    ],
)
def test_refusals(values, what, message):
    with pytest.raises(ValueError, match=message):
        show(values, what=what)
    assert math.isfinite(values.sum())


def test_arrays_and_names_without_an_item_are_refused():
    with pytest.raises(TypeError, match=r"values must be a torch.Tensor, got ndarray; use torch.from_numpy"):
        show(np.zeros((4, 4)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"expected 2 names, one for each panel, got 3: \['a', 'b', 'c'\]"):
        show(torch.rand(2, 4, 4), names=["a", "b", "c"])
    with pytest.raises(ValueError, match=r"expected 6 names, one for each panel, got 2: .*; what='colour' shows"):
        show(torch.rand(2, 3, 4, 4), what="intensity", names=["a", "b"])
