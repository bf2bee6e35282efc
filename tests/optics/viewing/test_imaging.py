"""Two ways to the retina against the thesis's simulation on one axis, oversampled, in plain numpy."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import eye as oracle
from torch import nn

from holotorch import Grid
from holotorch.core.checks import CostWarning, SamplingWarning
from holotorch.core.complex import intensity
from holotorch.optics import Display, Eye, Retina, plan_retina, propagate_collapsed, propagate_elements, retinal_image
from holotorch.optics.viewing.display import number
from holotorch.optics.viewing.elementwise import ElementSampling, least_oversampling
from holotorch.optics.viewing.imaging import CollapseSampling, collapse_sampling, retinal_scale
from holotorch.optics.viewing.retina import collapse_error

RED, PITCH, SIZE, FAR = 636e-9, 3.74e-6, 2048, 30e-3
GRID = Grid((1, SIZE), PITCH)
DISPLAY, EYE = Display(FAR + 140e-3 / 9, 20e-3, 50e-3), Eye(1.5e-3, 24e-3, 120e-3)
SMALL = Grid((48, 40), (8e-6, 9e-6))  # planar display for small two-dimensional checks
NEAR = Display.planar(20e-3)
NARROW = Eye(0.5e-3, 24e-3, 25e-3, softness=20e-6)


def relative(got, wanted) -> float:
    return float(np.linalg.norm(got - wanted) / np.linalg.norm(wanted))


def reference(height: float, oversampling: int, paraxial: bool, **options) -> tuple[torch.Tensor, np.ndarray]:
    """Hologram of a point, and the retina's intensity at the scaled points of the hologram's grid."""
    hologram = oracle.point_hologram(SIZE, PITCH, RED, FAR, height, paraxial)
    x = (np.arange(SIZE) - SIZE // 2) * PITCH
    near = np.abs(x - height) < 0.4e-3  # holds all of the light but 1e-3 of its intensity's norm
    scale = retinal_scale(DISPLAY, EYE)
    display, eye = (DISPLAY.lens_distance, 20e-3, 50e-3), (EYE.focal_length, 1.5e-3, 24e-3)
    light = np.zeros(SIZE)
    points = x[near] * scale
    field = oracle.retina(hologram, PITCH, RED, display, eye, points, oversampling, paraxial, **options)
    light[near] = np.abs(field) ** 2 * abs(scale)
    return torch.from_numpy(hologram)[None, None], light


@pytest.mark.parametrize("height", [0, 1e-3, 2e-3])
def test_collapse_equals_the_oversampled_elements(height):
    hologram, light = reference(height, 8, paraxial=True)
    got = propagate_collapsed(hologram, GRID, RED, DISPLAY, EYE, paraxial=True)[0, 0].abs().square().numpy()
    # Pupil edges fall between samples of 2.2 um here and 1.4 um there, 1e-3 of its width; the issue asks for 2 %.
    assert relative(got * (light > 0), light) < 4e-3
    long = propagate_elements(hologram, GRID, RED, DISPLAY, EYE, paraxial=True)[0, 0].abs().square().numpy()
    assert relative(long * (light > 0), light) < 1e-3


def test_collapse_on_the_axis_equals_exact_legs():
    # The issue asks for 3 %. Without the spherical aberration of the legs behind the plane: 3.3 %.
    hologram, light = reference(0.0, 8, paraxial=False)
    got = propagate_collapsed(hologram, GRID, RED, DISPLAY, EYE)[0, 0].abs().square().numpy()
    assert relative(got * (light > 0), light) < 5e-3


@pytest.mark.parametrize("height", [0, 0.3e-3, 0.6e-3])
def test_a_pupil_that_takes_more_than_the_pitch_carries(height):
    """Close up, an eye sees the edge of a scene by light that comes in beyond the hologram's band around the axis."""
    size, near, away = 512, 4e-3, 10e-3
    grid, display, eye = Grid((1, size), PITCH), Display.planar(near + away), Eye(1.5e-3, 24e-3, away)
    assert eye.pupil_radius / away > 1.7 * RED / (2 * PITCH)
    hologram = oracle.point_hologram(size, PITCH, RED, near, height)
    x = (np.arange(size) - size // 2) * PITCH
    scale = retinal_scale(display, eye)
    points, focal = x * scale, eye.focal_length
    field = oracle.retina(hologram, PITCH, RED, (near, np.inf, away), (focal, 1.5e-3, 24e-3), points, 8, windows=5)
    light = np.abs(field) ** 2 * abs(scale)
    got = propagate_collapsed(torch.from_numpy(hologram)[None, None], grid, RED, display, eye, paraxial=True)
    # Light that leaves the window before the plane is left out: the tails of the spot, of 1e-2 of its norm.
    assert relative(got[0, 0].abs().square().numpy(), light) < 2e-2


def test_work_is_a_tenth():
    full = Grid(2048, PITCH)
    short = collapse_sampling(full, (RED,), DISPLAY, EYE, FAR)
    long = least_oversampling(full, (RED,), DISPLAY, EYE)
    eight = ElementSampling((8, 8), long.padded, (8 * 3 * 2048, 8 * 3 * 2048))
    assert short.flops < long.flops / 30
    assert short.flops < eight.flops / 100


def test_vignetting():
    # Rays give 1 / 0.756 / 0.256 / 0 (test_viewing.py); diffraction smooths the edge.
    powers = []
    for height in (0, 1e-3, 2e-3, 2.6e-3):
        hologram = torch.from_numpy(oracle.point_hologram(SIZE, PITCH, RED, FAR, height))[None, None]
        powers.append(propagate_collapsed(hologram, GRID, RED, DISPLAY, EYE).abs().square().sum().item())
    assert np.array(powers) / powers[0] == pytest.approx([1, 0.75, 0.25, 0.005], abs=5e-3)


def test_the_hologram_s_own_sampling_aliases():
    """The pitch of the hologram everywhere, as Algorithm 6 has it: fine on the axis, wrong where the lens is steep."""
    padded, window = [], []
    for height in (0, 1e-3, 2e-3):
        _, light = reference(height, 8, paraxial=True)
        padded.append(relative(reference(height, 1, paraxial=True)[1], light))
        window.append(relative(reference(height, 1, paraxial=True, windows=1)[1], light))
    # Near the axis the light that aliases at the eyepiece misses the pupil; on the hologram's own window more comes
    # back.
    assert padded == pytest.approx([0.002, 0.001, 0.590], abs=3e-3)
    assert window[0] < 0.01 < window[1] < 0.1 < 0.5 < window[2]
    hologram = reference(0.0, 1, paraxial=False)[0]
    with pytest.warns(SamplingWarning, match=r"alias in a lens; 4\.76 times would do"):
        propagate_elements(hologram, GRID, RED, DISPLAY, EYE, sampling=ElementSampling((1, 1), (1, 4608), (1, 6144)))
    with pytest.warns(SamplingWarning, match=r"aliases into the pupil; 2\.1\d times would do"):
        propagate_collapsed(
            hologram, GRID, RED, DISPLAY, EYE, sampling=CollapseSampling((1, 1), (1, 4096), (1, 2048), (1, 2048))
        )


def test_plan_takes_the_cheaper_way_that_is_good_enough():
    on_axis = plan_retina(GRID, RED, DISPLAY, EYE, tolerance=0.02, reach=0.02e-3)
    assert (on_axis.method, on_axis.adequate) == ("collapse", True)
    whole = plan_retina(GRID, RED, DISPLAY, EYE, tolerance=0.02, reach=1e-3)
    assert (whole.method, whole.adequate) == ("elements", True)
    assert "collapse: error" in whole.runner_up
    assert plan_retina(GRID, RED, DISPLAY, EYE, tolerance=0.02, paraxial=True).method == "collapse"
    least = plan_retina(GRID, RED, DISPLAY, EYE, tolerance=1e-5, reach=1e-3)
    assert (least.method, least.adequate) == ("elements", False)
    with pytest.raises(ValueError, match="no method fits into"):
        plan_retina(GRID, RED, DISPLAY, EYE, memory_limit=1000)
    rim = Display(DISPLAY.lens_distance, 20e-3, 50e-3, lens_radius=0.5e-3)
    assert plan_retina(GRID, RED, rim, EYE, tolerance=0.02, paraxial=True).method == "elements"


def test_a_retina_is_affordable_by_default_and_says_what_a_better_one_costs():
    """Beside the axis most of the collapse's error is a shift; element by element costs hundreds of times as much."""
    scene = Grid(256, 8e-6), 640e-9, Display(50e-3, 50e-3, 50e-3), Eye(accommodation=1.0)
    with pytest.warns(SamplingWarning, match=r"0\.1 is not met: collapse at .*; tolerance=0\.1 takes .*: elements"):
        default = Retina(*scene)
    assert default.plan.method == "collapse" and not default.plan.adequate
    with pytest.warns(CostWarning, match=r"elements at .* times those of the other method: collapse: error"):
        better = Retina(*scene, tolerance=0.05)
    assert better.plan.method == "elements" and better.plan.cost_ratio > 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Retina(*scene, reach=0.2e-3)


def test_a_fixed_retina_keeps_its_factors_and_a_learned_one_does_not():
    fixed = Retina(SMALL, RED, NEAR, NARROW, tolerance=0.5)
    field = random_field(SMALL)
    first = fixed(field)
    (kept,) = fixed._factors.values()
    assert torch.equal(fixed(field), first) and next(iter(fixed._factors.values())) is kept
    torch.testing.assert_close(first, intensity(propagate_collapsed(field, SMALL, RED, NEAR, NARROW)), rtol=0, atol=0)
    single = fixed(field.to(torch.complex64))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), first, rtol=0, atol=1e-5 * first.max().item())
    accommodation = nn.Parameter(torch.tensor(float(number(NARROW.accommodation)), dtype=torch.float64))
    learned = Retina(SMALL, RED, NEAR, replace(NARROW, accommodation=accommodation), tolerance=0.5)
    torch.testing.assert_close(learned(field).detach(), first, rtol=1e-9, atol=1e-12 * first.max().item())
    assert not learned._factors and list(learned.parameters())[0] is accommodation


def test_impossible_ways():
    with pytest.raises(ValueError, match="the pupil is an image of this object plane"):
        propagate_collapsed(random_field(SMALL), SMALL, RED, NEAR, NARROW, plane=20e-3)
    with pytest.warns(SamplingWarning, match="an error of 1e-06 is not met: elements at"):
        Retina(SMALL, RED, NEAR, NARROW, tolerance=1e-6)
    with pytest.raises(ValueError, match=r"field must end in \(C, H, W\) = \(1, 48, 40\)"):
        propagate_collapsed(random_field(SMALL)[0], SMALL, RED, NEAR, NARROW)
    with pytest.raises(TypeError, match="field must be complex"):
        propagate_elements(random_field(SMALL).real, SMALL, RED, NEAR, NARROW)


@pytest.mark.parametrize(("height", "error"), [(1e-3, 0.117), (1.5e-3, 0.058), (2e-3, 0.142)])
def test_predicted_error_beside_the_axis_is_the_measured_one(height, error):
    hologram, light = reference(height, 8, paraxial=False)
    got = propagate_collapsed(hologram, GRID, RED, DISPLAY, EYE)[0, 0].abs().square().numpy()
    measured = relative(got * (light > 0), light)
    assert measured == pytest.approx(error, abs=5e-3)
    # First order in the phase left out, of up to a radian, and rays that end sharply at the edge of the light.
    assert collapse_error(GRID, RED, DISPLAY, EYE, FAR, [height]) == pytest.approx(measured, rel=0.15)


def test_shift_is_most_of_the_error_beside_the_axis():
    hologram, light = reference(1e-3, 8, paraxial=False)
    spectrum = np.fft.fft(propagate_collapsed(hologram, GRID, RED, DISPLAY, EYE)[0, 0].numpy())
    moved = np.exp(2j * np.pi * np.fft.fftfreq(SIZE, PITCH) * -0.425e-6)  # a ninth of a sample
    measured = relative(np.abs(np.fft.ifft(spectrum * moved)) ** 2 * (light > 0), light)
    assert measured == pytest.approx(0.035, abs=3e-3)
    # The least-squares ramp of the phase is not quite the best shift of the intensity.
    predicted = collapse_error(GRID, RED, DISPLAY, EYE, FAR, [1e-3], registered=True)
    assert 0.5 * measured < predicted < measured
    plan = plan_retina(GRID, RED, DISPLAY, EYE, tolerance=0.05, registered=True)
    assert plan.method == "collapse"


def random_field(grid: Grid) -> torch.Tensor:
    parts = torch.randn(2, 1, *grid.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return torch.complex(parts[0], parts[1])


def test_both_ways_agree_in_two_dimensions():
    field = random_field(SMALL)
    short = Retina(SMALL, RED, NEAR, NARROW, paraxial=True, tolerance=0.1)
    assert short.plan.method == "collapse"
    long = propagate_elements(field, SMALL, RED, NEAR, NARROW, paraxial=True).abs().square()
    # The collapse loses what leaves the window of 0.38 mm before the plane, 5 mm behind; both see the same middle.
    middle = (..., slice(12, 36), slice(10, 30))
    assert relative(short(field)[middle].numpy(), long[middle].numpy()) < 0.05
    torch.testing.assert_close(
        retinal_image(field, SMALL, RED, NEAR, NARROW, paraxial=True, tolerance=0.1), short(field)
    )
    assert short.scale == pytest.approx(-24 / 25)


def test_defocus_and_the_focus_plane_agree():
    """Seen through the hologram's own plane, a defocused pupil must show what the plane in focus shows."""
    eye = Eye(0.5e-3, 24e-3, 22e-3, softness=20e-6)
    y, x = SMALL.coordinates()
    field = torch.exp(-(y.square() + x.square()) / (2 * 40e-6**2)).to(torch.complex128)[None]
    at = propagate_collapsed(field, SMALL, RED, NEAR, eye, paraxial=True).abs().square()
    through = propagate_collapsed(field, SMALL, RED, NEAR, eye, plane=0.0, paraxial=True).abs().square()
    # The same retina in other units: 22 mm against 20 mm of object plane per retina.
    scale = retinal_scale(NEAR, eye, 0.0) / retinal_scale(NEAR, eye)
    second = [(light * (x.square() + 0 * y)).sum() / light.sum() for light in (at, through)]
    assert math.sqrt(second[1] / second[0]) == pytest.approx(1 / scale, rel=2e-3)
    assert through.sum().item() == pytest.approx(at.sum().item(), rel=2e-3)


@pytest.mark.parametrize("way", [propagate_collapsed, propagate_elements])
def test_gradients(way):
    field, weight = random_field(SMALL), torch.rand(SMALL.shape, dtype=torch.float64)
    values = [20e-3, 50e-3, 10e-3, 0.5e-3, 30e-3, 24e-3]

    # Sizes fixed: they step with the lengths, by amounts that only matter to finite differences.
    wide = Eye(0.7e-3, 24e-3, 30e-3, softness=20e-6)
    if way is propagate_collapsed:
        sizes = collapse_sampling(SMALL, (RED,), Display(*values[:3]), wide, 5e-3)
    else:
        sizes = least_oversampling(SMALL, (RED,), Display(*values[:3]), wide, plane=5e-3)

    def loss(*lengths):
        d_el, f_el, d_eye, radius, focus, depth = lengths
        display, eye = Display(d_el, f_el, d_eye), Eye(radius, depth, focus, softness=20e-6)
        return (way(field, SMALL, RED, display, eye, plane=5e-3, sampling=sizes).abs().square() * weight).sum()

    given = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in values]
    found = torch.autograd.grad(loss(*given), given)
    for i, (value, gradient) in enumerate(zip(values, found, strict=True)):
        step = 1e-4 * value
        ends = [loss(*(v + sign * step * (j == i) for j, v in enumerate(values))).item() for sign in (1, -1)]
        wanted = (ends[0] - ends[1]) / (2 * step)
        # Central differences: the third derivative, over phases of tens of radians, leaves about (1e-4 * 30)^2.
        assert gradient.item() == pytest.approx(wanted, rel=1e-3, abs=1e-5 * loss(*values).item() / value)


@pytest.mark.parametrize("paraxial", [True, False])
def test_light_to_all_sides_does_not_wrap_into_the_window(paraxial):
    """A hologram of random phase fills its band: most of its light passes beside the window, 2 mm at 30 mm."""
    size, generator = 128, torch.Generator().manual_seed(0)
    grid, eye = Grid(size, PITCH), Eye(1.5e-3, 24e-3, 120e-3, softness=50e-6)
    turns = torch.rand(1, size, size, generator=generator, dtype=torch.float64)
    field = torch.polar(torch.ones_like(turns), 2 * math.pi * turns)
    least = collapse_sampling(grid, [RED], DISPLAY, eye, FAR)
    assert least.padded[0] < 600 and FAR * RED / (2 * PITCH**2) > 680  # samples: what moves farther would wrap
    whole = CollapseSampling(least.oversampling, (1800, 1800), least.window, least.fine)
    got, wanted = (
        propagate_collapsed(field, grid, RED, DISPLAY, eye, plane=FAR, sampling=sampling, paraxial=paraxial)
        .abs()
        .square()
        .numpy()
        for sampling in (least, whole)
    )
    # The band's edge lights up to 2.5 mm; its diffraction a distance d inside has sqrt(RED FAR) / (2 pi d) of the
    # amplitude, 1 % here on either axis, which the taper takes away. Wrapped light made it 11 %, paraxial 240 %.
    assert relative(got, wanted) < 2e-2
