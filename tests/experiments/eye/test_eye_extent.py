"""Sources of some extent: less speckle and less detail than a point, of the same power."""

import pytest
import torch
from paths import CONFIGS

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.eye.experiment import observer
from holotorch.experiments.eye.plan import plan_text, plan_values
from holotorch.experiments.eye.run import scene_settings
from holotorch.experiments.registry import load_config
from holotorch.metrics import sharpness, speckle_contrast

CONFIG = CONFIGS / "eye" / "teapot.yaml"
SCENE = (
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 32}', "
    "'hologram={shape: [128, 128], pitch: 3.74 um, distance: 12 mm, depths: 12, rays: 64}']}"
)


def looking(extent: float):
    light = f"light={{sources: [laser], extent: {extent}}}"
    settings = load_config(CONFIG, [SCENE, "seeds=1", "focus=[12 mm]", "eye.tolerance=0.1", light])
    return observer(settings, scene_settings(settings))


def test_an_extended_laser_has_less_speckle_and_less_detail():
    """2 mrad at 12 mm move the picture by 24 um to every side, two spots of 13 um: of order four cells that add up."""
    small, large = looking(0.0), looking(2e-3)
    hologram, _ = small.scene.hologram(1)
    reference = torch.stack([small.image(small.scene.hologram(k)[0], None, 12e-3) for k in range(10, 18)]).mean(0)
    mask = reference > 0.05 * reference.amax((-2, -1), keepdim=True)
    point, disc = (eye.image(hologram, "laser", 12e-3) for eye in (small, large))
    seen = [speckle_contrast(each, reference=reference, mask=mask) for each in (point, disc)]
    assert (seen[1] < 0.75 * seen[0]).all()
    assert (sharpness(disc, reference) < sharpness(point, reference)).all()
    power = (disc.sum((1, 2)) / point.sum((1, 2))).tolist()
    # At most 24 of the 479 um of the window move out of it, to either side: 5 %.
    assert power == pytest.approx([1, 1, 1], abs=0.05)


def test_directions_are_half_a_spot_apart():
    eye, wave = looking(2e-3), 520e-9
    tilts, shares = eye.points(wave, 12e-3)
    rings = round((len(tilts) / 4) ** 0.5)
    assert sum(shares) == pytest.approx(1, rel=1e-12) and max(y * y + x * x for y, x in tilts) < 2e-3**2
    assert 12e-3 * 2e-3 / rings <= wave / (2 * eye.aperture(12e-3)) < 12e-3 * 2e-3 / (rings - 1)
    assert looking(0.0).points(wave, 12e-3) == ([(0.0, 0.0)], [1.0])
    values = plan_values(eye)
    assert values["directions"] == [len(eye.points(each, 12e-3)[0]) for each in eye.scene.settings.wavelengths]
    assert "directions" in plan_text(eye, values)
    assert values["images"] > 4 * plan_values(looking(0.0))["images"] / 3


def test_an_extent_of_too_many_directions_is_refused():
    with pytest.raises(ConfigError, match=r"light\.extent: 0\.05 needs \d+ directions; at most"):
        looking(0.05).points(520e-9, 12e-3)
    with pytest.raises(ConfigError, match=r"light\.extent"):
        load_config(CONFIG, [SCENE, "light={extent: -1}"])
