"""What no configuration means is a mistake of its key, found in no time."""

import re
import time
from pathlib import Path

import pytest
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.config import load_study
from holotorch.experiments.registry import load_config

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
        (
            CORRECTION,
            "wavelengths=[]",
            "wavelengths: expected 1 (grey), 3 (red, green, blue) or another number up to 32, got 0",
        ),
        (
            CORRECTION,
            "wavelengths=1e99999999nm",
            "wavelengths: expected a length that a number can hold, such as 100 mm",
        ),
        (
            CORRECTION,
            "wavelengths=green",
            "wavelengths: expected a wavelength in nm (usual are 630 nm for red, 530 nm for green, 450 nm for blue), "
            "got 'green'",
        ),
        (CORRECTION, "wavelengths=[630 nm, Green]", "wavelengths.1: expected a wavelength in nm"),
        (CORRECTION, "propagator={kind: fresnel, distance: 1e99999999nm}", "expected a length that a number can hold"),
        (
            CORRECTION,
            "propagator={kind: fresnel, distance: 1e308}",
            "propagator.distance: expected a length within -10 m .. 10 m",
        ),
        (VOLUME, "hologram.depths=[]", "hologram.depths: expected a number of planes, or at least one distance"),
        (
            VOLUME,
            "hologram.distance=360",
            "expected a length within -10 m .. 10 m, got 360; 360 means metres: did you mean '360 mm'?",
        ),
        (EYE, "hologram.shape=64", "the scene has it; write 'scene.change=[\"hologram.KEY=VALUE\"]'"),
        (VOLUME, "view.width=1e-300", "view.width: expected a length within 1 nm .. 10 m"),
        (CORRECTION, "solver.max_steps=1000000000000", "solver.max_steps: expected less than or equal to 100000"),
        (VOLUME, "volume.dtype=cpu", "volume.dtype: expected a type of number, such as uint8, float32"),
        (VOLUME, "volume.dtype=O", "volume.dtype: expected a type of number"),
        (VOLUME, "volume.dtype='i4,i4'", "volume.dtype: expected a type of number"),
        (EYE, "eye.pupil_radius=100mm", "eye.pupil_radius: expected a length within 10 um .. 50 mm, got '100mm'"),
        (
            EYE,
            "eye.axial_length=24",
            "eye.axial_length: expected a length within 1 mm .. 200 mm, got 24; 24 means metres: did you mean '24 mm'?",
        ),
    ],
)
def test_values_beyond_all_use_are_mistakes_of_their_key(written, text, change, message):
    (found,) = mistakes(written(text), change)
    assert message in found and repr(change) in found


def test_a_length_that_fits_in_no_way_takes_no_time(written):
    began = time.perf_counter()
    (found,) = mistakes(written(CORRECTION.replace("9 um", "1" * 120_000 + "!")))
    assert "grid.pitch: expected a length such as 530 nm" in found and len(found) < 400
    assert time.perf_counter() - began < 3


LAUGHS = "a0: &a0 [1, 1]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 30))


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        (CORRECTION + LAUGHS, ":8:", "its aliases (*name) stand for more than 100000 values in all"),
        (CORRECTION + "x: &x {y: *x}\n", ": ", "nested without end"),
        (CORRECTION + f"# {'long ' * 60_000}\n", ": ", "more than 131072 bytes; expected settings such as"),
        (CORRECTION + f"x: {'1:' * 2000}1.5\n", ":8:1: ", "x: not a value: "),
        (CORRECTION + "x: !!int ''\n", ":8:1: ", "x: not a value: "),
        (CORRECTION + "x: !!timestamp soon\n", ":8:1: ", "x: not a value: "),
        (CORRECTION + "x: !!bool maybe\n", ":8:1: ", "x: not a value: "),
    ],
    ids=["aliases", "circle", "size", "sexagesimal", "int", "timestamp", "bool"],
)
def test_a_file_that_means_more_than_it_holds_is_refused_at_once(written, text, place, message):
    began = time.perf_counter()
    (found,) = mistakes(path := written(text))
    assert found.startswith(f"{path}{place}") and message in found
    assert time.perf_counter() - began < 10


def test_aliases_of_ordinary_use_stay(written):
    text = CORRECTION.replace("shape: [32, 48]", "shape: &sides [32, 48]").replace("coffee", "coffee, region: *sides")
    text = text.replace("target", "x: 0\ntarget", 1).replace("x: 0\n", "")
    lines = text.splitlines()
    assert load_config(written("\n".join([lines[0], lines[2], lines[1], *lines[3:]]))).target.region == (32, 48)


def test_a_thousand_mistakes_are_counted_not_listed(written):
    with pytest.raises(ConfigError) as refused:
        load_config(written(CORRECTION + "".join(f"k{i}: 1\n" for i in range(1000))))
    lines = str(refused.value).splitlines()
    assert len(lines) == 51 and lines[-1] == "and 950 more mistakes"


def test_keys_written_twice_a_thousand_times_are_listed_up_to_fifty(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("experiment: pec\n" + "seed: 1\n" * 1001)
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    lines = str(refused.value).splitlines()
    assert len(lines) == 51 and lines[-1] == "and 950 more mistakes"


@pytest.mark.parametrize(
    ("word", "advice"),
    [
        ("grid.pitch=8mm", "got '8mm'; did you mean '8 um'?"),
        ("grid.pitch=10mm", "got '10mm'; did you mean '10 um'?"),
        ("grid={shape:32, pitch: 8 um}", "unknown setting; YAML wants a space after the colon, 'shape: 32'"),
    ],
)
def test_advice_on_units_and_colons(written, word, advice):
    assert any(advice in mistake for mistake in mistakes(written(CORRECTION), word))


def test_a_long_name_of_a_kind_is_cut_off(written):
    (mistake,) = mistakes(written(f"experiment: [{'pec' * 10_000}]\n"))
    assert "experiment: expected one of pec, " in mistake and len(mistake) < 1000


def test_a_number_that_no_float_can_be_is_a_mistake(written):
    (found,) = mistakes(written(CORRECTION), f"solver.patience=1{'0' * 400}")
    assert "solver.patience: expected a number of at most 300 digits, got 1000" in found and "(401 characters)" in found


def test_planes_at_one_distance_are_a_mistake_of_their_key():
    with pytest.raises(ConfigError, match=r"hologram.depths: expected distances that all differ, got 0.004 m twice"):
        load_config(Path("configs/volume/c60.yaml"), ["hologram.depths=[4 mm, 5 mm, 4 mm]"])


@pytest.mark.parametrize(
    ("words", "got"),
    [
        (["hologram.depths=[4 mm, 5 mm]", "hologram.distance=1e-300"], "got 1e-300 m"),
        (["hologram.depths=[4 mm, 2 nm]", "scale=4"], "got 2e-09 m divided by the scale 4"),
    ],
)
def test_planes_at_the_hologram_are_a_mistake(words, got):
    with pytest.raises(ConfigError, match=f"hologram.distance: expected distances of at least 1e-09 m, {got}"):
        load_config(Path("configs/volume/c60.yaml"), words)


STUDY = "experiment: pec_study\nstudy: lowpass\nimages: [camera]\nsweep: [0.1]\n"
ANALYSIS = "experiment: perception_analysis\ntargets: [{seconds: 0.45}]\n"


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (CORRECTION, "target.image"),
        (STUDY, "images"),
        (VOLUME, "volume.path"),
        (VOLUME, "transfer.file"),
        (EYE, "scene.config"),
        (ANALYSIS, "logs"),
    ],
)
def test_a_name_too_long_for_a_file_is_a_mistake_of_its_key(written, text, key):
    (found,) = mistakes(written(text), f"{key}={'a' * 20_000}")
    place, _, message = found[found.index("': ") :].partition(f"{key}: ")
    assert place == "': " and re.search(r"no such picture|that exists", message) and "File name too long" in message
    assert len(message) < 500


def test_a_folder_that_may_not_be_looked_into_is_a_mistake_of_its_key(written, tmp_path, monkeypatch):
    def closed(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "exists", closed)
    (found,) = mistakes(written(VOLUME), "volume.path=secret/a.nrrd")
    assert "volume.path: expected a file or folder that exists, got 'secret/a.nrrd' (Permission denied)" in found


def test_the_command_line_takes_a_name_too_long_for_a_file_as_bad_input(written, capsys):
    assert main(["run", str(written(CORRECTION)), "--out", "b" * 20_000]) == 2
    assert "File name too long" in capsys.readouterr().err


def test_a_study_of_more_trials_than_anyone_sits_through_is_refused_at_once(tmp_path):
    text = (CONFIGS / "perception/study.yaml").read_text()
    (tmp_path / "study.yaml").write_text(text)
    wide = [1 + i / 1000 for i in range(5000)]  # 25 million pairs
    for change in ("repeats.target=5000000000000", f"patterns=[{{eccentricities_deg: {wide}, sizes_deg: {wide}}}]"):
        with pytest.raises(ConfigError, match="repeats: expected at most 10000 trials for a participant, got"):
            load_study(tmp_path / "study.yaml", [change])
