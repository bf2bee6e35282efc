"""The incoherent images in closed form against a direct sum over points, and against random-phase holograms."""

import math

import numpy as np
import pytest
import torch
from oracles import dense

from holotorch import Grid
from holotorch.core.complex import intensity, phasor
from holotorch.hologram import incoherent_views
from holotorch.optics import PupilViews, View, propagate
from holotorch.optics.viewing.pupil_views import view_padding
from holotorch.scene.layers import SourceLayers

GRID, WAVELENGTHS = Grid((14, 17), (5e-6, 4e-6)), (630e-9, 530e-9)
DEPTHS = (0.30e-3, 0.36e-3, 0.45e-3)
VIEWS = [View(0.3e-3, 0.03), View(0.4e-3, 0.02, (0.01, -0.012)), View(0.36e-3, 0.03, covered=(0.0, 1.0))]


def layers(grid: Grid = GRID, channels: int = 2, depths=DEPTHS) -> SourceLayers:
    light = torch.rand(len(depths), channels, *grid.shape, dtype=torch.float64)
    light[:, :, :3] = 0
    return SourceLayers(grid, depths, channels, lambda: iter(light.sqrt()))


def test_equals_the_sum_over_all_points():
    scene = layers()
    images = incoherent_views(scene, WAVELENGTHS, VIEWS)
    longest = max(abs(view.focus - depth) for view in VIEWS for depth in DEPTHS)
    padded = view_padding(GRID, WAVELENGTHS, VIEWS, longest).shape
    for c, wavelength in enumerate(WAVELENGTHS):
        for v, view in enumerate(VIEWS):
            wanted = np.zeros(GRID.shape)
            for depth, plane in zip(DEPTHS, scene.planes(), strict=True):
                transfer = dense.angular_spectrum_transfer(padded, GRID.pitch, wavelength, depth - view.focus, False)
                pupil = dense.pupil(padded, GRID.pitch, wavelength, view.radius, view.centre, view.covered)
                matrix = np.abs(dense.spectral_filter(GRID.shape, transfer * pupil)) ** 2
                wanted += (matrix @ intensity(plane[c]).numpy().reshape(-1)).reshape(GRID.shape)
            np.testing.assert_allclose(images[c, v].numpy(), wanted, rtol=0, atol=1e-12 * wanted.max())


def test_holograms_of_random_phases_approach_it_as_one_over_the_root_of_their_number():
    grid, wavelength, depths = Grid(48, 9e-6), 520e-9, (4e-3, 6e-3)
    window = torch.zeros(48, 48, dtype=torch.float64)
    window[12:36, 12:36] = torch.rand(24, 24, dtype=torch.float64)
    light = [window, window.flip(0)]
    scene = SourceLayers(grid, depths, 1, lambda: iter([each.sqrt()[None] for each in light]))
    views = [View(4e-3, 0.25 * wavelength / 9e-6), View(5e-3, 0.25 * wavelength / 9e-6)]
    wanted, operator = incoherent_views(scene, wavelength, views), PupilViews(grid, wavelength, views)
    total, errors = torch.zeros_like(wanted), {}
    inside = (slice(None), slice(None), slice(14, 34), slice(14, 34))  # the window of the hologram cuts off the rest
    for n in range(1, 257):
        field = torch.zeros(1, 48, 48, dtype=torch.complex128)
        for depth, each in zip(depths, light, strict=True):
            source = each.sqrt() * phasor(2 * math.pi * torch.rand(1, 48, 48, dtype=torch.float64))
            field += propagate(source, grid, wavelength, depth)
        total += intensity(operator(field))
        if n in (16, 256):
            shown = total[inside] / n
            shown = shown * (shown * wanted[inside]).sum() / shown.square().sum()
            errors[n] = (shown - wanted[inside]).norm() / wanted[inside].norm()
    assert errors[256] < 0.1
    assert 2.5 < errors[16] / errors[256] < 6  # 4, but for the edges of the window


def test_a_smaller_pupil_is_darker_in_proportion_to_its_area():
    light = torch.zeros(1, 64, 64, dtype=torch.float64)
    light[0, 20:44, 20:44] = 1
    scene = SourceLayers(Grid(64, 9e-6), (5e-3,), 1, lambda: iter([light]))
    large, small = incoherent_views(scene, 520e-9, [View(5e-3, 0.0144), View(5e-3, 0.0072)]).sum((-2, -1))[0]
    assert small / large == pytest.approx(0.25, rel=0.1)


def test_arguments_are_checked():
    with pytest.raises(ValueError, match="one per channel of the layers, 2"):
        incoherent_views(layers(), 530e-9, VIEWS)
    with pytest.raises(ValueError, match="at least one view"):
        incoherent_views(layers(), WAVELENGTHS, [])


def test_dark_planes_and_one_plane_are_right():
    dark = SourceLayers(GRID, DEPTHS, 1, lambda: iter([torch.zeros(1, 14, 17)] * 3))
    assert not incoherent_views(dark, 530e-9, VIEWS).any()
    assert incoherent_views(layers(depths=DEPTHS[:1]), WAVELENGTHS, VIEWS).amax() > 0
