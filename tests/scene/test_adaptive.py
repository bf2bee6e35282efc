"""Fewer rays: what is followed is right, what is filled in is linear, and the report says what it costs."""

import pytest
import torch

from holotorch import Grid
from holotorch.scene.adaptive import adaptive_report, render_adaptively, sample_adaptively
from holotorch.scene.phases import point_phases, random_phase
from holotorch.scene.sampler import DVRSampler
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Volume

DEPTHS = [0.02 + 1e-3 * ((k + 0.5) / 6 - 0.5) for k in range(6)]


def sampler(shape=(61, 50)) -> DVRSampler:
    parts = [[0.0, 0.3, 1.0], [[0.1, 0.2, 0.9], [0.5, 0.9, 0.1], [1.0, 0.3, 0.2]], [0.0, 0.0, 0.5]]
    table = TransferFunction(*(torch.tensor(part).double() for part in parts), unit_distance=0.05)
    return DVRSampler(table, Grid(shape, 2e-5), DEPTHS, width=1e-3)


def ball() -> Volume:
    axis = torch.linspace(-1, 1, 32, dtype=torch.float64)
    radius = (axis[:, None, None].square() + axis[:, None].square() + axis.square()).sqrt()
    return Volume(torch.sigmoid((0.6 - radius) * 30), (1.0, 1.0, 1.0), "relative")


@pytest.mark.parametrize("step", [1, 3, 4, 7])
def test_followed_rays_are_right_and_the_rest_lies_between_them(step):
    made = sampler()
    whole, opacity = made.render(ball())
    found = render_adaptively(made, ball(), step=step, contrast=0.02)
    torch.testing.assert_close(found.image[:, found.traced], whole[:, found.traced], rtol=0, atol=0)
    torch.testing.assert_close(found.opacity[found.traced], opacity[found.traced], rtol=0, atol=0)
    assert found.traced[::step, ::step].all() and found.traced[-1, -1]
    if step == 1:
        assert found.traced.all()
        return
    filled = ~found.traced
    assert filled.float().mean() > 0.15
    # Neighbouring corners differ by up to the contrast, so does what is between them.
    assert (found.image - whole)[:, filled].abs().max() < 0.02
    torch.testing.assert_close(made.render(ball(), found.traced)[1], opacity * found.traced, rtol=0, atol=0)


def test_linear_pictures_are_filled_in_exactly():
    """One plane through a ramp of faint opacity, of which 1 - (1 - a)^(1 / 20) is linear to a^2 / 2."""
    ramp = torch.linspace(0, 1, 201, dtype=torch.float64)
    volume = Volume((ramp[:, None] + ramp)[None] / 2, (201.0, 1.0, 1.0), "relative")
    table = TransferFunction(
        *(torch.tensor(part).double() for part in ([0.0, 1.0], [[0.5, 0.7, 0.9]] * 2, [0.0, 1e-6])), unit_distance=20.0
    )
    made = DVRSampler(table, Grid((31, 30), 2e-5), [0.02], width=1e-3, early=0.0)
    whole, _ = made.render(volume)
    found = render_adaptively(made, volume, step=4, contrast=1.0)
    assert found.share < 0.1
    torch.testing.assert_close(found.image, whole, rtol=1e-6, atol=0)


def test_report_trades_rays_for_error():
    reports = [adaptive_report(sampler(), ball(), step=4, contrast=c) for c in (0.0, 0.05, 0.5, 2.0)]
    assert all(a.share >= b.share and a.error <= b.error for a, b in zip(reports, reports[1:], strict=False))
    assert reports[0].error < 1e-12 and reports[-1].share < 0.09
    whole = sampler().render(ball())[0]
    coarse = render_adaptively(sampler(), ball(), step=4, contrast=2.0).image
    assert reports[-1].error == pytest.approx(((coarse - whole).square().sum() / whole.square().sum()).sqrt().item())
    assert reports[-1].largest == pytest.approx((coarse - whole).abs().max().item())


def test_gradients_and_special_grids():
    values = ball().values.requires_grad_()
    picture = render_adaptively(sampler(), Volume(values, (1.0, 1.0, 1.0), "relative"))
    (gradient,) = torch.autograd.grad(picture.image.sum(), values)
    assert torch.isfinite(gradient).all() and gradient.abs().max() > 0
    for shape in ((1, 1), (1, 9), (9, 1), (2, 3), (4, 5)):
        found = render_adaptively(sampler(shape), ball(), contrast=0.0)
        torch.testing.assert_close(found.image, sampler(shape).render(ball())[0], rtol=0, atol=1e-12)
    empty = Volume(torch.zeros(3, 3, 3, dtype=torch.float64), (1.0, 1.0, 1.0), "relative")
    report = adaptive_report(sampler(), empty)
    assert (report.error, report.largest) == (0, 0) and report.share < 0.1


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="step must be at least 1"):
        render_adaptively(sampler(), ball(), step=0)
    with pytest.raises(ValueError, match="contrast must be at least zero"):
        render_adaptively(sampler(), ball(), contrast=-1.0)


def test_sources_between_the_rays_have_the_light_of_the_adaptive_picture():
    made = sampler()
    layers, followed = sample_adaptively(made, ball(), contrast=0.4)
    found = render_adaptively(made, ball(), contrast=0.4)
    assert torch.equal(followed, found.traced) and 0.06 < followed.double().mean() < 0.6
    light = torch.stack(list(layers.amplitudes())).square()
    torch.testing.assert_close(light.sum(0), found.image, rtol=1e-10, atol=1e-12)
    exact = torch.stack(list(made(ball()).amplitudes())).square()
    torch.testing.assert_close(light[..., followed], exact[..., followed], rtol=1e-12, atol=1e-15)
    assert 0.001 < (light - exact).norm() / exact.norm() < 0.2


@pytest.mark.parametrize("phase", [random_phase, point_phases])
def test_adaptive_sources_have_the_phases_of_the_sampler(phase):
    parts = [[0.0, 0.3, 1.0], [[0.1, 0.2, 0.9], [0.5, 0.9, 0.1], [1.0, 0.3, 0.2]], [0.0, 0.0, 0.5]]
    table = TransferFunction(*(torch.tensor(part).double() for part in parts), unit_distance=0.05)
    made = DVRSampler(
        table,
        Grid((20, 21), 5e-5),
        DEPTHS,
        width=1e-3,
        phase=lambda grid: phase(grid, generator=torch.Generator().manual_seed(3)),
    )
    whole, adaptive = made(ball()).stack(), sample_adaptively(made, ball(), contrast=0.02)[0].stack()
    both = (whole.abs() > 1e-6) & (adaptive.abs() > 1e-6)
    torch.testing.assert_close(adaptive[both].angle(), whole[both].angle(), rtol=0, atol=1e-6)


def test_rays_that_are_left_out_have_no_sources_and_an_eye_is_refused():
    made, rays = sampler((20, 21)), torch.zeros(20, 21, dtype=torch.bool)
    rays[8:13] = True
    light = made(ball(), rays).stack()
    assert float(light[:, :, ~rays].abs().max()) == 0 < float(light.abs().max())
    made.eye = 0.001
    with pytest.raises(ValueError, match="eye=None"):
        sample_adaptively(made, ball())
