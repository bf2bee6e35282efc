"""Geometry of the thesis's display as its plan says it, and the drawing of it."""

import io
import json
import math

import numpy as np
import pytest
from paths import CONFIGS
from PIL import Image

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.eye.experiment import observer
from holotorch.experiments.eye.geometry import draw, geometry, in_words
from holotorch.experiments.eye.run import scene_settings
from holotorch.experiments.registry import load_config

CONFIG = CONFIGS / "eye" / "tooth.yaml"
SCENE = (
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 32}', "
    "'hologram={shape: [%d, %d], pitch: 3.74 um, distance: %s, depths: 12, rays: 128}']}"
)


def looking(*overrides: str, size: int = 2048, distance: str = "30 mm"):
    settings = load_config(CONFIG, [SCENE % (size, size, distance), f"focus=[{distance}]", *overrides])
    return observer(settings, scene_settings(settings))


def test_the_thesis_display_has_the_thesis_numbers():
    """Sec. 5.4 to 5.6: 9.755 deg for 636 nm under a plane wave, 2 atan(w / 2f) through the eyepiece."""
    values = geometry(looking())
    assert values["planar_fov_deg"][0] == pytest.approx(9.755, abs=5e-4)
    assert values["magnified_fov_deg"] == pytest.approx(math.degrees(2 * math.atan(2048 * 3.74e-6 / 40e-3)), rel=1e-12)
    # A scene that fills the field: tan(fov / 2) times the distance that it seems to be at, over its magnification.
    assert values["filling_scene_mm"] == pytest.approx(2 * math.tan(math.radians(21.681) / 2) * 26.667, rel=1e-4)
    assert values["region_of_centre"] == [1, 1, 1] and values["region_of_edge"] == [2, 2, 2]
    # Region I: the whole cone is used, so the spot is one pixel's, whatever the distance and the wavelength.
    assert np.allclose(values["smallest_spot_um"][0], 3.74, rtol=0.01)
    assert values["eye_box_mm"] == [0, 0, 0] and values["light_of_edge"] == [0, 0, 0]
    near, far = values["accommodation_mm"]
    assert near == pytest.approx(71.24, abs=0.05) and far is None  # nearer to the hologram than the focal length allows
    assert json.loads(json.dumps(values)) == values
    words = " ".join(in_words(values))
    assert "9.76 deg" in words and "beyond infinity" in words and "centre I, edge II" in words
    assert "WARNING    the edge of the scene is invisible to this eye; enlarge eye.pupil_radius" in words
    assert "WARNING    the scene appears 71.2 mm from the eye (14 dioptres), nearer than eyes focus" in words
    assert "0 % of the light of the edge enters the pupil, and below 0.5 % it counts as invisible" in words


def test_a_small_scene_far_away_is_in_region_three_and_seen_whole():
    values = geometry(looking("display={kind: planar, distance: 250 mm}", size=512))
    assert "magnified_fov_deg" not in values and values["light_of_edge"] == [1, 1, 1]
    assert min(values["eye_box_mm"]) > 3 and values["region_of_centre"] == [3, 3, 3]
    assert values["placement_mm"] > 30 and 2 in values["region_of_edge"]
    near, far = values["accommodation_mm"]
    assert near < 220 < far
    words = " ".join(in_words(values))
    assert "100 % of the light from the scene's edge enters the pupil" in words and "WARNING" not in words


def test_a_lens_at_the_hologram_shows_the_scene_under_the_angle_of_its_focal_length():
    eye = looking("display={kind: spherical, focal_length: 150 mm}", size=512)
    values = geometry(eye)
    assert values["magnified_fov_deg"] == pytest.approx(math.degrees(2 * math.atan(512 * 3.74e-6 / 0.3)), rel=1e-12)
    assert values["scene_fov_deg"] == pytest.approx(
        values["magnified_fov_deg"] * eye.scene.width / (512 * 3.74e-6), rel=1e-4
    )
    for depth in (0.0295, 0.0305):  # the plane that the eye sees sharply is the one it looks at
        assert eye.display.focus_plane(eye.accommodation(depth)) == pytest.approx(depth, rel=1e-9)
    assert values["accommodation_mm"][0] == pytest.approx(150**2 / (150 + 30), rel=0.02)


@pytest.mark.parametrize("display", ["magnifying", "planar", "spherical"])
def test_the_drawing_shows_all_three_parts(display):
    given = {
        "magnifying": [],
        "planar": ["display={kind: planar, distance: 250 mm}"],
        "spherical": ["display={kind: spherical}"],
    }[display]
    picture = np.asarray(Image.open(io.BytesIO(draw(looking(*given, size=512)))).convert("RGB")).astype(int)
    assert picture.shape[1] > 1500
    for left, right in ((0, 0.41), (0.41, 0.71), (0.71, 1)):
        part = picture[:, int(left * picture.shape[1]) : int(right * picture.shape[1])]
        assert ((part.max(-1) - part.min(-1)) > 100).sum() > 500  # coloured lines or areas


def test_an_eye_that_no_light_reaches_is_said():
    eye = looking(size=128, distance="5 m")
    with pytest.raises(ConfigError, match="display: no light of 636 nm of the scene reaches the pupil when the eye"):
        eye.samples("narrow_sled", 636e-9, 5.0)
