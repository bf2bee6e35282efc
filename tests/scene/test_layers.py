"""SourceLayers: amplitude times phase, plane by plane; and the phases there are."""

import math

import numpy as np
import pytest
import torch

from holotorch import Grid
from holotorch.scene.layers import SourceLayers
from holotorch.scene.phases import point_phases, random_phase, smooth_phase

GRID = Grid((5, 8), 1e-6)


def layers(planes, **options) -> SourceLayers:
    depths = options.pop("depths", tuple(0.01 + 1e-3 * k for k in range(len(planes))))
    return SourceLayers(options.pop("grid", GRID), depths, 3, lambda: iter(planes), options.pop("phase", None))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_planes_are_amplitudes_turned_by_the_common_phase(dtype):
    planes, phase = list(torch.rand(4, 3, 5, 8, dtype=dtype)), torch.rand(5, 8, dtype=dtype) * 7
    found = layers(planes, phase=phase).stack()
    wanted = torch.stack(planes).numpy() * np.exp(1j * phase.numpy())
    np.testing.assert_allclose(found, wanted, rtol=4 * torch.finfo(dtype).eps)
    assert found.dtype == (torch.complex64 if dtype == torch.float32 else torch.complex128)


def test_no_phase_and_phases_of_their_own():
    planes = [torch.rand(3, 5, 8), torch.rand(3, 5, 8, dtype=torch.complex64)]
    first, second = layers(planes).planes()
    assert torch.equal(first.real, planes[0]) and first.imag.eq(0).all()
    assert torch.equal(second, planes[1])


def test_only_one_plane_is_asked_for_at_a_time():
    asked = []

    def amplitudes():
        for k in range(3):
            asked.append(k)
            yield torch.ones(3, 5, 8)

    planes = SourceLayers(GRID, (0.01, 0.02, 0.03), 3, amplitudes).planes()
    assert asked == []
    next(planes)
    assert asked == [0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: layers([], depths=()), "at least one distance"),
        (lambda: layers([], depths=(0.1, -0.1)), "depth of a layer must be above zero"),
        (lambda: layers([], depths=(math.inf,)), "must be finite"),
        (lambda: SourceLayers(GRID, (0.1,), 0, lambda: iter([])), "channels must be at least 1"),
        (lambda: layers([], depths=(0.1,), phase=torch.ones(8, 5)), r"must end in \(H, W\) = \(5, 8\)"),
        (lambda: layers([], depths=(0.1,), phase=torch.ones(3, 5, 8)), "must be one map"),
        (lambda: layers([torch.ones(1, 5, 8)]).stack(), r"plane 1 of the layers must be \(C, h, w\) = \(3, 5, 8\)"),
        (lambda: layers([torch.ones(3, 5, 8)], depths=(0.1, 0.2)).stack(), "each of 2 depths, got 1"),
        (lambda: layers([torch.ones(3, 5, 8)] * 2, depths=(0.1,)).stack(), "each of 1 depths, got more"),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
    with pytest.raises(TypeError, match="pass lambda: iter"):
        SourceLayers(GRID, (0.1,), 3, [torch.ones(3, 5, 8)])  # type: ignore[arg-type]


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(5)


def test_random_phases_are_uniform_and_repeatable():
    grid = Grid((200, 250), 1e-6)
    phase = random_phase(grid, generator=generator())
    assert torch.equal(phase, random_phase(grid, generator=generator()))
    assert phase.min() >= 0 and phase.max() < 2 * math.pi
    # Counts of 50000 in 10 bins spread by 67; five times that.
    assert (torch.histc(phase, 10, 0, 2 * math.pi) - 5000).abs().max() < 335


def test_point_phases_differ_between_planes_but_not_between_visits():
    phases = point_phases(GRID, generator=generator())
    assert torch.equal(phases(3), phases(3)) and not torch.equal(phases(3), phases(4))
    assert torch.equal(phases(2), point_phases(GRID, generator=generator())(2))
    turns = torch.stack([torch.polar(torch.ones(5, 8), phases(plane)) for plane in range(300)]).flatten(1)
    alike = (turns @ turns.mH / 40).abs()
    alike.fill_diagonal_(0)
    # Means of 40 random directions are 0.16 long; the longest of 45000 about 3.3 times that.
    assert alike.max() < 0.7 and alike.mean().item() == pytest.approx(0.14, abs=0.02)


def test_smooth_phase_is_as_wide_and_as_smooth_as_asked():
    grid, length = Grid((256, 300), (1e-6, 1.2e-6)), 6e-6
    phase = smooth_phase(grid, length, spread=2.0, generator=generator()).double()
    # About 256 x 300 x 1.2 / (4 pi 36) = 200 independent patches: the variance is right to sqrt(2 / 200).
    assert phase.square().mean().sqrt().item() == pytest.approx(2.0, rel=0.15)
    for axis, pitch in ((0, 1e-6), (1, 1.2e-6)):
        for shift in (3, 6, 9):
            correlation = (phase * phase.roll(shift, axis)).mean() / phase.square().mean()
            wanted = math.exp(-((shift * pitch) ** 2) / (2 * length**2))
            assert correlation.item() == pytest.approx(wanted, abs=0.15)
