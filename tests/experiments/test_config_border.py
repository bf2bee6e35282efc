"""What no configuration means is a mistake of its key, found in no time."""

import time
from pathlib import Path

import pytest

from holotorch.experiments.config import load_config
from holotorch.experiments.errors import ConfigError

CORRECTION = """\
experiment: pec
target: {image: coffee}
grid: {shape: [32, 48], pitch: 9 um}
wavelengths: [630 nm, 530 nm, 445 nm]
modulator: {sigma_px: 0.66}
propagator: {kind: fraunhofer}
solver: {kind: apg}
"""
VOLUME = """\
experiment: volume
volume: {phantom: gaussian_ball, samples: 16}
transfer: {preset: bone, low: 40, high: 200}
hologram: {shape: [64, 64], pitch: 3.74 um, distance: 10 mm, depths: 8}
wavelengths: [630 nm, 530 nm, 445 nm]
"""
EYE = """\
experiment: eye
scene: {config: configs/demo_volume.yaml}
display: {kind: planar}
"""


@pytest.fixture
def written(tmp_path):
    def write(text: str) -> Path:
        path = tmp_path / "a.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def mistakes(path: Path, *overrides: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load_config(path, list(overrides))
    return caught.value.mistakes


@pytest.mark.parametrize(
    ("text", "change", "message"),
    [
        (CORRECTION, "wavelengths=[]", "wavelengths: expected 1 (grey) or 3 (red, green, blue), got 0"),
        (
            CORRECTION,
            "wavelengths=1e99999999nm",
            "wavelengths: expected a length that a number can hold, such as 100 mm",
        ),
        (CORRECTION, "propagator={kind: fresnel, distance: 1e99999999nm}", "expected a length that a number can hold"),
        (
            CORRECTION,
            "propagator={kind: fresnel, distance: 1e308}",
            "expected a distance of at most 10 m; 360 mm is 0.36",
        ),
        (VOLUME, "hologram.depths=[]", "hologram.depths: expected a number of planes, or one distance at least"),
        (VOLUME, "hologram.distance=360", "hologram.distance: expected a distance of at most 10 m; 360 mm is 0.36"),
        (VOLUME, "volume.dtype=cpu", "volume.dtype: expected a type of number, such as uint8, float32"),
        (VOLUME, "volume.dtype=O", "volume.dtype: expected a type of number"),
        (VOLUME, "volume.dtype='i4,i4'", "volume.dtype: expected a type of number"),
        (EYE, "eye.pupil_radius=100mm", "eye.pupil_radius: expected the radius of a pupil, 10 um to 20 mm"),
        (EYE, "eye.axial_length=24", "eye.axial_length: expected the length of an eye, 1 mm to 0.2 m"),
    ],
)
def test_values_beyond_all_use_are_mistakes_of_their_key(written, text, change, message):
    (found,) = mistakes(written(text), change)
    assert message in found and repr(change) in found


def test_a_length_that_fits_in_no_way_takes_no_time(written):
    began = time.perf_counter()
    (found,) = mistakes(written(CORRECTION.replace("9 um", "1" * 200_000 + "!")))
    assert "grid.pitch: expected a length such as 530 nm" in found and len(found) < 400
    assert time.perf_counter() - began < 3
