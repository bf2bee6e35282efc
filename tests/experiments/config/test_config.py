import sys
from pathlib import Path

import pytest
import yaml
from paths import CONFIGS
from pydantic import BaseModel

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.registry import load_config
from holotorch.experiments.volume.config import VolumeSettings

KINDS = "pec, pec_study, volume, eye, joint, track, measure, perception_layout, perception_analysis"
GOOD = """\
experiment: pec
target: {image: coffee}
grid: {shape: [32, 48], pitch: 9 um}
wavelengths: [630 nm, 530 nm, 445 nm]
modulator: {sigma_px: 0.66}
propagator: {kind: fraunhofer}
solver: {kind: apg}
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
    return [line.replace(f"{path}:", "") for line in caught.value.mistakes]


def kind(path: Path) -> str:
    return path.relative_to(CONFIGS).parts[0]


# Panels, cameras and studies in the browser are no runs, and have readers of their own.
RUNS = sorted(path for path in CONFIGS.rglob("*.yaml") if "\nexperiment: " in "\n" + path.read_text())


@pytest.mark.parametrize("path", RUNS, ids=lambda path: f"{kind(path)}-{path.stem}")
def test_every_config_of_the_project_loads(path):
    assert isinstance(load_config(path), {"volume": VolumeSettings, "eye": ObserverSettings}.get(kind(path), BaseModel))


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("530 nm", 530e-9),
        ("530nm", 530e-9),
        ("0.53 um", 530e-9),
        ("0.53 µm", 530e-9),
        ("5.3e-7", 530e-9),
        ("5.3e-4 mm", 530e-9),
        ("5.3e-5 cm", 530e-9),
        ("5.3e-7 m", 530e-9),
        ("0.00000053", 530e-9),
    ],
)
def test_lengths_take_units(written, text, metres):
    assert load_config(written(GOOD), [f"wavelengths={text}"]).wavelengths == pytest.approx((metres,), rel=1e-15)


def test_one_pitch_means_both_axes_and_conversion_rounds_once(written):
    settings = load_config(written(GOOD))
    assert settings.grid.pitch == (9e-6, 9e-6)
    assert settings.wavelengths == (630e-9, 530e-9, 445e-9)


def test_overrides_reach_any_depth_and_make_missing_sections(written):
    path = written(GOOD)
    settings = load_config(path, ["modulator.sigma_px=1.5", "report.metrics=[psnr]", "target.image=page", "seed=3"])
    assert (settings.modulator.sigma_px, settings.report.metrics, settings.seed) == (1.5, ("psnr",), 3)
    assert settings.target.image == "page"


def test_the_resolved_settings_load_to_the_same(written):
    settings = load_config(CONFIGS / "pec" / "fresnel.yaml")
    again = load_config(written(yaml.safe_dump(settings.model_dump(mode="json"))))
    assert again == settings


def test_a_misspelt_key_names_its_place_and_the_nearest(written):
    assert mistakes(written(GOOD.replace("sigma_px", "sgima_px"))) == [
        "5:13: modulator.sgima_px: unknown setting; did you mean 'sigma_px'?",
    ]


def test_five_mistakes_at_once_each_with_its_place(written):
    text = """\
experiment: pec
sede: 7
target: {image: cofee}
grid: {shape: [32, 48.5], pitch: -9 um}
wavelengths: [630 nm, 0, 445 parsec]
modulator: {sigma_px: wide, kernel_size: yes}
propagator: {kind: fresnl, distance: 100 mm}
solver: {kind: apg, tolerance: .nan, start: warm}
"""
    assert mistakes(written(text)) == [
        "2:1: sede: unknown setting; did you mean 'seed'?",
        "3:10: target.image: no such picture: 'cofee'; did you mean 'coffee'? give a path, or one of "
        "astronaut, brick, camera, chelsea, coffee, coins, grass, moon, page, text",
        "4:20: grid.shape.1: expected a whole number, got 48.5",
        "4:27: grid.pitch: expected a length within 1 nm .. 2 mm, got '-9 um'",
        "5:23: wavelengths.1: expected a length within 10 nm .. 300 um, got 0",
        "5:26: wavelengths.2: expected a length such as 530 nm, 3.74 um, 100 mm or a number of metres, "
        "got '445 parsec'",
        "6:13: modulator.sigma_px: expected a number, got 'wide'",
        "6:29: modulator.kernel_size: expected a number, got True",
        "7:14: propagator.kind: expected one of fraunhofer, fresnel, angular_spectrum, got 'fresnl'; "
        "did you mean 'fresnel'?",
        "8:21: solver.tolerance: expected a finite number, got NaN",
        "8:38: solver.start: expected 'hot', 'cool', 'flat', 'quadratic' or 'retrieved', got 'warm'",
    ]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("wavelengths=0 nm", "wavelengths: expected a length within 10 nm .. 300 um, got '0 nm'"),
        ("wavelengths=530", "wavelengths: expected a length within 10 nm .. 300 um, got 530"),
        ("grid.pitch=9", "grid.pitch: expected a length within 1 nm .. 2 mm, got 9"),
        ("propagator={kind: fresnel, distance: 0}", "propagator.distance: expected a distance of 1 um or more"),
        ("solver.learning_rate=1", "a setting of kind adam, not of apg; to change the kind give the whole section"),
        (f"seed=0x{4000 * '9'}", "seed: not a value: Exceeds the limit (4300 digits)"),
        ("seed=2001-99-99", "seed: not a value: month must be in 1..12"),
        ("grid.pitch=-1um", "grid.pitch: expected a length within 1 nm .. 2 mm, got '-1um'"),
        ("modulator.sgima_px=1", "modulator.sgima_px: unknown setting; did you mean 'sigma_px'?"),
        ("modulator.kernel_size=33", "expected at most 32, the smaller side of the grid, got 33"),
        ("modulator.kernel_size=8", "expected an odd number of taps, got 8; use 9"),
        ("grid.shape=[8,8]", "expected at least 11 x 11 px for ssim, got (8, 8); use a larger grid"),
        (
            f"wavelengths=[{', '.join(['530 nm'] * 33)}]",
            "expected 1 (grey), 3 (red, green, blue) or another number up to",
        ),
        ("target.image=missing.png", "no such picture: 'missing.png'"),
        ("propagator.distance=1 mm", "propagator.distance: a setting of kind fresnel and angular_spectrum, not of"),
        ("solver={}", "solver.kind: expected one of apg, adam, lbfgs, got 'none'"),
        ("solver=3", "solver: expected settings, as in {key: value}, got 3; known: solver.kind, solver.max_steps, "),
        ("target=photo.png", "expected settings, as in {key: value}, got 'photo.png'; did you mean target.image?"),
        ("seed=-1", "seed: expected greater than or equal to 0, got -1"),
        ("grid.shape=", "grid.shape: expected a whole number, got nothing"),
        (
            "grid.shape=100x200",
            "grid.shape: expected [rows, columns] in brackets, such as [100,200], got '100x200'",
        ),
        ("grid.pitch=9um x 8um", "expected [rows, columns] in brackets, such as [9um,8um], got '9um x 8um'"),
        ("sigma_px=0.9", "sigma_px: unknown setting; did you mean modulator.sigma_px?"),
        ("learning_rate=0.9", "learning_rate: unknown setting; did you mean solver.learning_rate?"),
        ("target.region=[33,48]", "target.region: expected at most the grid, (32, 48), got (33, 48)"),
        ("target.region=[32,49]", "target.region: expected at most the grid, (32, 48), got (32, 49)"),
        ("target.region=10", "target.region: expected at least 11 x 11 px for ssim, got (10, 10)"),
        ("target.region=[12,0]", "target.region.1: expected greater than or equal to 1, got 0"),
        ("target.regoin=12", "target.regoin: unknown setting; did you mean 'region'?"),
        ("target.depths=band", "target.depths: expected 'bands' or 'full', got 'band'; did you mean 'bands'?"),
        ("target.depths=FULL", "target.depths: expected 'bands' or 'full', got 'FULL'; did you mean 'full'?"),
        ("propagator={kind: fresnel, distance: [8 mm, 0]}", "distance.1: expected a distance of 1 um or more"),
        ("propagator={kind: fresnel, distance: []}", "propagator.distance: expected"),
        ("modulator.bits=0", "modulator.bits: expected greater than or equal to 1, got 0"),
        ("modulator.bits=17", "modulator.bits: expected less than or equal to 16, got 17"),
        ("modulator.bits=2.5", "modulator.bits: expected a whole number, got 2.5"),
        (
            "modulator.max_phase=9",
            "modulator.max_phase: only the solver lbfgs keeps a limit; use solver=lbfgs",
        ),
        ("frames=0", "frames: expected greater than or equal to 1, got 0"),
        ("frames=65", "frames: expected less than or equal to 64, got 65"),
        ("frame=2", "frame: unknown setting; did you mean 'frames'?"),
        ("multiplexing=jont", "expected 'joint' or 'independent', got 'jont'; did you mean 'joint'?"),
        ("report.baselines=[ipecs]", "report.baselines.0: expected 'none', 'basic_ipec', 'ipec', 'chopping', "),
        ("solver={kind: lbfgs, memory: 0}", "solver.memory: expected greater than or equal to 1, got 0"),
        ("seed", "expected key=value or key.sub=value"),
        ("seed.value=3", "'seed' is a single value and has no settings inside"),
        ("seed=[", "not valid YAML"),
    ],
)
def test_overrides_get_the_same_messages(written, override, message):
    lines = mistakes(written(GOOD + "seed: 1\n"), override)
    assert any(message in line for line in lines), lines
    assert any(line.startswith(f"argument '{override}'") for line in lines), lines


def test_a_kind_given_alone_is_named_by_the_cure(written):
    path = written(GOOD.replace("kind: apg", "kind: apg, step: 2.0"))
    words = "a setting of kind apg, not of adam; to change the kind give the whole section, as in 'solver={kind: adam}'"
    assert mistakes(path, "solver.kind=adam") == [f"7:21: solver.step: {words}"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "1:1: the file is empty; expected settings such as 'experiment: pec'"),
        ("[1, 2]", "1:1: expected settings such as 'experiment: pec', got [1, 2]"),
        ("seed: 1\n", f"1:1: experiment: expected one of {KINDS}, it is missing"),
        (
            "experiment: pek\n",
            f"1:1: experiment: expected one of {KINDS}, got 'pek'; did you mean 'pec'?",
        ),
        (GOOD + "seed: 1\nseed: 2\n", "9:1: seed: written twice; keep one"),
        (GOOD + "seed: {\n", "9:1: not valid YAML: "),
        (GOOD.replace("kind: apg", "kind: [1]"), "solver.kind: expected one of apg, adam"),
        (GOOD + "a: \0\n", "not valid YAML: unacceptable character"),
        (GOOD + "a: &a [*a]\n", "nested without end"),
        (GOOD + "a: " + "[" * 3000 + "\n", "nested without end"),
        (GOOD + "[1, 2]: 3\n", "?: unknown setting"),
    ],
)
def test_files_that_are_no_configuration(written, text, message):
    assert any(message in line for line in mistakes(written(text)))


@pytest.mark.parametrize("name", ["config/pec/fourier.yaml", "fourier"])
def test_a_bundled_configuration_is_suggested_from_any_folder(name):
    with pytest.raises(ConfigError, match="did you mean configs/pec/fourier.yaml"):
        load_config(name)


def test_a_file_with_nearly_this_name_is_suggested(tmp_path):
    (tmp_path / "kernel.csv").write_text("1")
    with pytest.raises(ConfigError, match=f"exists, got '{tmp_path}/kernl.csv'; did you mean {tmp_path}/kernel.csv"):
        load_config(CONFIGS / "pec" / "fresnel.yaml", [f"modulator={{kernel: {tmp_path / 'kernl.csv'}}}"])


def test_a_near_image_needs_a_pitch_of_about_a_wavelength(written):
    near = GOOD.replace("fraunhofer", "fresnel, distance: 1 mm")
    assert mistakes(written(near), "grid.pitch=0.5 um") == [
        "argument 'grid.pitch=0.5 um': grid.pitch: expected at least 0.9 of the longest wavelength, 5.67e-07 m, for an "
        "image at a distance, got 5e-07 m"
    ]
    assert load_config(written(near), ["grid.pitch=0.57 um"]).grid.pitch == (0.57e-6, 0.57e-6)


def test_a_region_goes_with_one_distance_and_may_be_small_without_ssim(written):
    words = ["target.region=[12,12]", "propagator={kind: fresnel, distance: [8 mm, 9 mm]}"]
    assert mistakes(written(GOOD), *words) == [
        "argument 'target.region=[12,12]': target.region: expected one distance beside a region"
    ]
    assert load_config(written(GOOD), [words[0], "propagator={kind: fresnel, distance: [8 mm]}"])
    assert load_config(written(GOOD), ["target.region=[5,4]", "report.metrics=psnr"]).target.region == (5, 4)
    assert load_config(written(GOOD), ["target.region=12"]).target.region == (12, 12)


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        (
            "items=[{icon: dog, azimuth_deg: 10}]",
            ["items.0.icon: expected 'wheel', 'coaster', 'castle', 'boat', 'tent', "],
        ),
        (
            "items=[{icon: dog, azimuth_deg: 10}, {icon: boat, azimuth_deg: 200}]",
            ["items.0.icon: expected", "items.1.azimuth_deg: expected less than or equal to 180, got 200"],
        ),
        ("items=[]", ["items: expected at least 1 entry, got 0"]),
        (
            "targets=[" + ", ".join(7 * ["{size_deg: 5, eccentricity_deg: 10}"]) + "]",
            ["targets: expected at most 6 entries, got 7"],
        ),
    ],
)
def test_a_list_is_too_short_or_too_long_in_plain_words_and_only_where_it_is(override, wanted):
    found = mistakes(CONFIGS / "perception" / "layout.yaml", override)
    assert len(found) == len(wanted)
    assert all(words in line for words, line in zip(wanted, found, strict=True))


def test_single_values_stand_for_lists(written):
    settings = load_config(written(GOOD), ["grid.shape=24", "report.metrics=psnr", "report.baselines=none"])
    assert settings.grid.shape == (24, 24)
    assert (settings.report.metrics, settings.report.baselines) == (("psnr",), ("none",))


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the configuration: No such file or directory$"):
        load_config(tmp_path / "missing.yaml")
    (tmp_path / "otherend.yaml").write_text(GOOD)  # similar to the next name by its suffix alone
    with pytest.raises(ConfigError, match="No such file or directory$"):
        load_config(tmp_path / "head.yaml")
    # A bundled configuration is named as it was asked for, wherever its file lies.
    with pytest.raises(ConfigError, match=r"directory; did you mean configs/pec/fourier\.yaml\?$"):
        load_config("configs/pec/fourrier.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a UTF-8 text file"):
        load_config(tmp_path / "binary.yaml")


def test_settings_are_frozen(written):
    with pytest.raises(ValueError, match="frozen"):
        load_config(written(GOOD)).seed = 3  # type: ignore[misc]


def test_a_picture_may_be_a_path(written, tmp_path):
    import cv2
    import numpy as np

    cv2.imwrite(str(tmp_path / "mine.png"), np.full((20, 20), 9, dtype=np.uint8))
    assert load_config(written(GOOD), [f"target.image={tmp_path / 'mine.png'}"]).target.image.endswith("mine.png")


def test_validation_needs_no_torch(tmp_path):
    import subprocess

    code = (
        "import sys; from holotorch.experiments.registry import load_config; load_config(sys.argv[1]);"
        "assert not {'torch', 'cv2', 'kornia', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(CONFIGS / "demo.yaml")], check=True, cwd=tmp_path)
