"""Predicted errors of both methods to the retina against propagation in two dimensions of light of many kinds.

The displays, eyes and scenes took no part in the choice of the constants of ``line_errors``.
"""

import math
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from oracles import eye as oracle

from holotorch import Grid
from holotorch.core.complex import intensity
from holotorch.core.fourier import good_length
from holotorch.io.images import load_image
from holotorch.optics import Display, Eye, Retina, plan_retina, propagate, propagate_collapsed, propagate_elements
from holotorch.optics.viewing import line_errors as retina_lines
from holotorch.optics.viewing.elementwise import least_oversampling
from holotorch.optics.viewing.imaging import collapse_sampling, retinal_scale
from holotorch.optics.viewing.line_errors import field_lines, line_errors, noise_lines, scene_lines

GREEN, BLUE = 520e-9, 450e-9
VIEWS = {
    "planar": (Grid((28, 24), 20e-6), GREEN, Display.planar(0.03), Eye(1e-3, accommodation=0.05)),
    "magnified": (Grid((36, 40), 12e-6), GREEN, Display(12e-3, 20e-3, 30e-3), Eye(1.5e-3, accommodation=0.25)),
    "oblique paths": (Grid(64, 12e-6), BLUE, Display(18.9e-3, 20e-3, 15.4e-3), Eye(1.5e-3, accommodation=0.5)),
}
NARROW = Grid((32, 28), 16e-6), GREEN, Display(24e-3, 20e-3, 50e-3, lens_radius=0.5e-3), Eye(1e-3, accommodation=1.0)


def holograms(grid: Grid, wavelength: float, plane: float) -> dict[str, torch.Tensor]:
    """Fields [H, W] on the plane of the hologram, by name."""
    generator = torch.Generator().manual_seed(11)
    picture = load_image("page").double().mean(0)[None, None]
    amplitude = torch.nn.functional.interpolate(picture, size=grid.shape, mode="area")[0, 0].sqrt()
    turns = torch.rand(2, *grid.shape, generator=generator, dtype=torch.float64)
    phases = torch.polar(torch.ones_like(turns), 2 * math.pi * turns)
    points = torch.zeros(grid.shape, dtype=torch.complex128)
    points[[5, 11, 17, 22], [8, 21, 13, 4]] = torch.tensor([1, 2j, -1, 1.5], dtype=torch.complex128)
    y, x = grid.coordinates()
    width = 0.15 * grid.extent[0]
    return {
        "noise": torch.randn(grid.shape, dtype=torch.complex128, generator=generator),
        "random phases": phases[1],
        "photograph": amplitude.to(torch.complex128),
        "hologram of a photograph": propagate(amplitude * phases[0], grid, wavelength, -plane, tolerance=0.05),
        "hologram of points": propagate(points, grid, wavelength, -plane, tolerance=0.05),
        "beam": torch.exp(-((y + width).square() + x.square()) / (2 * width**2)).to(torch.complex128),
    }


def true_images(fields: torch.Tensor, grid: Grid, wavelength: float, display: Display, eye: Eye) -> torch.Tensor:
    """Intensities [S, H, W] by elements on 1.25 times the samples needed, in a window twice as wide."""
    least = least_oversampling(grid, [wavelength], display, eye)
    finer = replace(
        least,
        oversampling=tuple(1.25 * m for m in least.oversampling),
        padded=tuple(good_length(2 * n) for n in least.padded),
        fine=tuple(good_length(math.ceil(2.5 * n)) for n in least.fine),
    )
    images = propagate_elements(fields[:, None].to(torch.complex64), grid, wavelength, display, eye, sampling=finer)
    return intensity(images)[:, 0].double()


@lru_cache
def scenes(view: str) -> tuple[list[str], torch.Tensor, torch.Tensor]:
    """Names of scenes, their fields [S, H, W] and true intensities; every second scene for the largest grid."""
    grid, wavelength, display, eye = VIEWS[view]
    fields = holograms(grid, wavelength, float(display.focus_plane(eye.accommodation)))
    names = list(fields)[:: 2 if view == "oblique paths" else 1]
    stack = torch.stack([fields[name] for name in names])
    return names, stack, true_images(stack, grid, wavelength, display, eye)


def differences(images: torch.Tensor, wanted: torch.Tensor) -> list[float]:
    """Relative L2 error of each image [S, H, W]."""
    return ((images - wanted).flatten(1).norm(dim=1) / wanted.flatten(1).norm(dim=1)).tolist()


def ratios(fields, wanted, grid, wavelength, display, eye, *, paraxial=False) -> tuple[list[float], list[float]]:
    """Predicted error divided by the measured one of every field [S, H, W], for the collapse and for elements."""
    setup, plane = (grid, [wavelength], display, eye), float(display.focus_plane(eye.accommodation))
    samplings = [collapse_sampling(*setup, plane), least_oversampling(*setup)]
    predicted = [line_errors([field_lines(f)], *setup, plane, samplings, paraxial=paraxial) for f in fields]
    both = []
    for method, errors in zip((propagate_collapsed, propagate_elements), zip(*predicted, strict=True), strict=True):
        measured = differences(intensity(method(fields[:, None], *setup, paraxial=paraxial))[:, 0], wanted)
        both.append([p / m for p, m in zip(errors, measured, strict=True)])
    return both[0], both[1]


@pytest.mark.parametrize("view", ["planar", "magnified"])
def test_without_an_example_errors_are_those_of_speckle(view):
    grid, wavelength, display, eye = VIEWS[view]
    setup, plane = (grid, [wavelength], display, eye), float(display.focus_plane(eye.accommodation))
    names, fields, wanted = scenes(view)
    [predicted] = line_errors([noise_lines(grid)], *setup, plane, [collapse_sampling(*setup, plane)])
    measured = differences(intensity(propagate_collapsed(fields[:, None], *setup))[:, 0], wanted)
    ratio = {name: predicted / each for name, each in zip(names, measured, strict=True)}
    assert all(1 / 3 < ratio[name] < 3 for name in ("noise", "random phases", "hologram of a photograph"))
    assert ratio["photograph"] > 3 and ratio["hologram of points"] > 1 and ratio["beam"] > 100


@pytest.mark.parametrize("view", VIEWS)
def test_errors_of_a_field_are_predicted_within_a_factor_of_three(view):
    _, fields, wanted = scenes(view)
    for method in ratios(fields, wanted, *VIEWS[view]):
        assert all(1 / 3 < each < 3 for each in method), method


@pytest.mark.parametrize(("focal_length", "radius", "focus"), [(20e-3, 1e-3, 0.3), (30e-3, 1.5e-3, math.inf)])
def test_errors_against_quadrature_over_the_pupil(focal_length, radius, focus):
    """With the lens at the hologram, each sample lights the pupil by a plane wave, and the integral converges."""
    grid, display, eye = Grid((40, 36), 12e-6), Display.spherical(focal_length), Eye(radius, accommodation=focus)
    fields = torch.stack([*holograms(grid, GREEN, float(display.focus_plane(focus))).values()])
    scale, lens = float(retinal_scale(display, eye)), (1 / focus, radius, float(eye.axial_length))
    pitch = grid.pitch[0]
    coarse, fine = (
        oracle.retina_by_quadrature(fields.numpy(), pitch, GREEN, focal_length, lens, scale * pitch, nodes)
        for nodes in (120, 160)
    )
    coarse, fine = torch.from_numpy(coarse), torch.from_numpy(fine)
    wanted = intensity(fine) * scale**2
    assert max(differences(intensity(coarse) * scale**2, wanted)) < 1e-6
    for method in ratios(fields, wanted, grid, GREEN, display, eye, paraxial=True):
        assert all(1 / 3 < each < 3 for each in method), method


def test_an_eyepiece_that_cuts_light_is_predicted_for_light_everywhere():
    """A line through the side of a round eyepiece is shorter than its diameter, which lines do not know."""
    fields = holograms(NARROW[0], GREEN, float(NARROW[2].focus_plane(1.0)))
    everywhere = torch.stack([fields[name] for name in ("noise", "random phases", "photograph")])
    for method in ratios(everywhere, true_images(everywhere, *NARROW), *NARROW):
        assert all(1 / 3 < each < 3 for each in method), method


def test_plans_are_for_noise_or_for_an_example():
    grid, wavelength, display, eye = VIEWS["magnified"]
    plane = float(display.focus_plane(eye.accommodation))
    fields = holograms(grid, wavelength, plane)
    wanted = true_images(fields["noise"][None], *VIEWS["magnified"])
    retina = Retina(*VIEWS["magnified"])
    measured = differences(retina(fields["noise"][None])[None, 0], wanted)[0]
    assert retina.plan.method == "collapse" and 1 / 3 < retina.plan.predicted_error / measured < 3
    setup = grid, [wavelength], display, eye
    smooth = plan_retina(*setup, example=fields["beam"][None], dtype=torch.complex128)
    [expected] = line_errors([field_lines(fields["beam"])], *setup, plane, [smooth.sampling])
    assert smooth.predicted_error == pytest.approx(expected)
    # The accuracy that noise does not reach is enough for the beam: the cheaper method is adequate.
    assert plan_retina(*setup, example=fields["beam"][None], tolerance=1e-3).adequate
    assert not plan_retina(*setup, tolerance=1e-3).adequate
    with pytest.raises(ValueError, match=r"example must end in \(C, H, W\) = \(1, 36, 40\)"):
        plan_retina(*setup, example=fields["beam"])


def test_errors_of_colours_and_axes_add_up():
    """The error of all channels is that of their light together; an axis of one sample has none."""
    grid, _, display, eye = VIEWS["magnified"]
    plane, colours = float(display.focus_plane(eye.accommodation)), [GREEN, BLUE]
    samplings = [collapse_sampling(grid, colours, display, eye, plane)]
    noise = y, x = noise_lines(grid)
    assert y is not None and x is not None
    dark = 0 * y, 0 * x
    setup = grid, colours, display, eye, plane, samplings
    [both] = line_errors([noise, noise], *setup)
    [green], [blue] = line_errors([noise, dark], *setup), line_errors([dark, noise], *setup)
    assert min(green, blue) < both < max(green, blue)
    assert line_errors([dark, dark], *setup) == [0.0]
    [rows], [columns] = line_errors([(None, x)] * 2, *setup), line_errors([(y, None)] * 2, *setup)
    assert both == pytest.approx(math.hypot(rows, columns), rel=0.1)  # the colours weigh a little differently


@pytest.mark.parametrize("view", VIEWS)
def test_fewer_lines_predict_the_errors_of_all(view, monkeypatch):
    """An eye two metres away took four seconds for each focus (a find of fuzzing)."""
    grid, wavelength, display, eye = VIEWS[view]
    setup, plane = (grid, [wavelength], display, eye), float(display.focus_plane(eye.accommodation))
    samplings = [collapse_sampling(*setup, plane), least_oversampling(*setup)]
    rows, propagated = [], retina_lines.propagate_elements

    def counted(field, *arguments, **options):
        rows.append(len(field))
        return propagated(field, *arguments, **options)

    monkeypatch.setattr(retina_lines, "propagate_elements", counted)
    errors = []
    for most, lines in ((2**20, 16), (1, 1)):
        monkeypatch.setattr(retina_lines, "_SAMPLES", most)
        rows.clear()
        errors.append(line_errors([noise_lines(grid)], *setup, plane, samplings))
        assert max(rows) == lines
    for every, few in zip(*errors, strict=True):
        assert 1 / 2 < few / every < 2  # one line is a sample of 24 to 64 of noise instead of 384 to 1024


@pytest.mark.parametrize("reach", [None, 1e-4])
def test_light_that_spreads_over_too_many_samples_is_refused(reach):
    """Ten metres away, pixels of 1 um light a strip 5 m wide."""
    grid, eye = Grid(64, 1e-6), Eye(2e-3, accommodation=9.9)
    with pytest.raises(ValueError, match=r"spreads over .* samples, expected 4.2e\+06 at most; bring eyepiece and eye"):
        plan_retina(grid, GREEN, Display.planar(10.0), eye, reach=reach)
    coarse = Grid(64, 4e-6)
    assert plan_retina(coarse, GREEN, Display.planar(10.0), eye, reach=reach).method == "collapse"


def test_lines_of_a_scene_come_together_in_its_plane():
    grid, plane, reach = Grid((48, 1), 8e-6), 5e-3, 40e-6
    column, row = scene_lines(grid, GREEN, plane, reach)
    assert row is None and column is not None
    there = propagate(column[..., None], grid, GREEN, plane, tolerance=0.01)
    y, _ = grid.coordinates()
    inside = (there.abs().square() * (y.abs() <= reach + grid.pitch[0])).sum() / there.abs().square().sum()
    assert inside > 0.95


def test_lines_of_a_field_are_those_that_hold_its_light():
    field = torch.zeros(2, 9, 7, dtype=torch.complex64)
    field[0, 3, 5], field[1, 6, 2] = torch.tensor(2j), torch.tensor(1.0)
    columns, rows = field_lines(field)
    assert rows is not None and columns is not None
    assert rows.shape == (16, 7) and columns.shape == (16, 9)
    # 4 / 5 of the light lies in one row and one column, 1 / 5 in others.
    assert (rows[:, 5] == 2j).sum() == 13 and (columns[:, 6] == 1).sum() == 3
