"""Speckle by itself: grains of known size, a scene that is divided out, and its spectrum."""

import pytest
import torch
from torch.fft import fft2, ifft2

from holotorch.experiments.eye.speckle import draw, grains, radial_spectrum, relative_speckle

SIZE = 128


def speckle(count: int, across: float, down: float, seed: int = 0) -> torch.Tensor:
    """Intensities of fields whose light fills a rectangle of ``across`` x ``down`` of the frequencies; mean 1."""
    generator = torch.Generator().manual_seed(seed)
    field = torch.randn(count, 1, SIZE, SIZE, dtype=torch.complex128, generator=generator)
    fy, fx = torch.fft.fftfreq(SIZE)[:, None].abs(), torch.fft.fftfreq(SIZE).abs()
    intensity = ifft2(fft2(field) * ((fx < across / 2) & (fy < down / 2))).abs().square()
    return intensity / intensity.mean((-2, -1), keepdim=True)


def test_grains_have_the_size_of_the_aperture_whatever_the_scene():
    """A square pupil that fills a share s of the band has grains of 0.8859 / s samples (Goodman, Sec. 4.4)."""
    scene = 1 + torch.linspace(0, 1, SIZE, dtype=torch.float64).expand(1, SIZE, SIZE)
    pictures = scene * speckle(8, 0.25, 0.125)
    found = grains(relative_speckle(pictures, scene, torch.zeros(())))
    assert found["grain_x"][0] == pytest.approx(0.8859 / 0.25, rel=0.1)
    assert found["grain_y"][0] == pytest.approx(0.8859 / 0.125, rel=0.1)
    assert found["anisotropy"][0] == pytest.approx(2, rel=0.15)


def test_dark_parts_of_the_scene_and_pictures_without_speckle_tell_nothing():
    scene = torch.ones(1, SIZE, SIZE, dtype=torch.float64)
    scene[..., : SIZE // 2] = 1e-6
    ratio = relative_speckle(scene * 3, scene, torch.tensor(0.05))
    assert bool((ratio[..., : SIZE // 2] == 1).all()) and ratio[0, 0, -1] == pytest.approx(3)
    assert grains(torch.ones(2, 1, 16, 16)) == {"grain_y": [None], "grain_x": [None], "anisotropy": [None]}


def test_the_spectrum_ends_where_the_light_does():
    """The spectrum of an intensity reaches twice as far as that of its field: here to a quarter of the samples."""
    frequency, power = radial_spectrum(speckle(8, 0.25, 0.25))
    beyond = frequency > 0.25 * 2**0.5 + 0.03
    assert power[beyond].max() < 1e-6 * power.max() and bool((power[frequency < 0.15] > 0.1 * power.max()).all())
    assert draw({"laser": speckle(1, 0.25, 0.25)}).startswith(b"\x89PNG")
