"""What an observer sees: sources, focus, and the page of a run."""

import csv
import json
import signal
import sys
from functools import cache

import numpy as np
import pytest
import torch
from apart import start_apart
from paths import CONFIGS
from tiny_runs import EYE

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.eye import experiment as eye_module
from holotorch.experiments.eye import plan as eye_plan
from holotorch.experiments.eye import run as eye_run
from holotorch.experiments.eye.experiment import observer
from holotorch.experiments.eye.plan import plan_text, plan_values
from holotorch.experiments.eye.run import scene_settings
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs import figures
from holotorch.optics.light import spectral

CONFIG = CONFIGS / "eye" / "teapot.yaml"
SCENE = (
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 32}', "
    "'hologram={shape: [128, 128], pitch: 3.74 um, distance: 12 mm, depths: 12, rays: 64}']}"
)
# 128 px see so little of the pupil that the collapse is off by more than the default allows, by a rule of thumb.
SMALL = [SCENE, "seeds=1", "light={sources: [laser, led]}", "focus=[12 mm]", "eye.tolerance=0.1"]
# A display so small that both ways are quick: the collapse is predicted to be off by 4 %, the elements by 3 %. The
# pupil takes no more than the pitch carries, a sine of 0.05 where that is 0.057 at the blue end.
TINY = [
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 16}', "
    "'hologram={shape: [64, 64], pitch: 3.74 um, distance: 2 mm, depths: 4, rays: 32}']}",
    *("display={kind: planar, distance: 4 mm}", "eye={pupil_radius: 0.1 mm, axial_length: 2 mm}"),
    *("seeds=1", "light={sources: [laser]}", "focus=[2 mm]"),
]


def settings(*overrides: str):
    return load_config(CONFIG, [*SMALL, *overrides])


def test_a_run_shows_less_speckle_under_wider_sources(tmp_path, monkeypatch):
    captions = []
    monkeypatch.setattr(figures, "comparison", lambda images, words: captions.extend(words) or b"")
    folder, complete = execute(settings(), tmp_path / "a", "a")
    names = {path.name for path in folder.iterdir()}
    assert complete and names == {
        *("arrays", "config.yaml", "env.json", "images", "plan.json", "report.html", "summary.json", "table.csv")
    }
    assert np.load(folder / "arrays" / "retina.npy").shape == (2, 1, 3, 64, 64)
    rows = json.loads((folder / "summary.json").read_text())["rows"]
    laser, led = (next(row for row in rows if row["source"] == source) for source in ("laser", "led"))
    for colour in range(3):
        assert led["contrast"][colour] < laser["contrast"][colour]
        assert led["sharpness"][colour] < laser["sharpness"][colour] + 0.05
        assert led["contrast_predicted"][colour] < laser["contrast_predicted"][colour] <= 1
        assert led["wavelengths"][colour] >= laser["wavelengths"][colour]
    with open(folder / "table.csv", newline="") as stream:
        table = list(csv.DictReader(stream))
    each = ("wavelengths", "followed", "contrast", "contrast_predicted", "ssim", "sharpness", "grain_y", "grain_x",
            "anisotropy", "best_fwhm_nm_by_formula")  # fmt: skip
    assert all(0.5 < laser[f"grain_{axis}"][colour] < 20 for axis in "yx" for colour in range(3))
    assert all(1 <= value < 3 for value in laser["anisotropy"]) and (folder / "images" / "speckle.png").is_file()
    assert len(table) == 2 and list(table[0]) == [
        *("source", "focus_mm"),
        *(f"{name}_{wave}nm" for name in each for wave in (636, 520, 455)),
    ]
    assert [float(table[0][f"contrast_{wave}nm"]) for wave in (636, 520, 455)] == pytest.approx(
        laser["contrast"], rel=1e-4
    )
    page = (folder / "report.html").read_text()
    for words in (
        "they are those at 636 / 520 / 455 nm",
        "predicted contrast",
        "evenly filled round pupil and fully developed speckle",
        "and measures lower",
    ):
        assert words in page
    assert "Synthetic volume" in page and "focus 12 mm, synthetic volume</figcaption>" in page
    assert captions == [
        "reference, focus 12 mm, synthetic",
        "laser, focus 12 mm, synthetic",
        "led, focus 12 mm, synthetic",
    ]


def test_few_wavelengths_are_as_good_as_many():
    """Against one every nanometre, as the thesis takes them: within the tolerance of a picture's rms brightness."""
    found = observer(settings(), scene_settings(settings()))
    hologram, _ = found.scene.hologram(0)
    depth = found.focus[0]
    few = found.image(hologram, "led", depth)

    class Dense(eye_module.Observer):
        def samples(self, source, wavelength, depth):
            wavelengths, weights = eye_module.PRESETS[source](wavelength).every(1e-9)
            return wavelengths, weights, len(wavelengths)

    many = Dense(found.settings, found.scene, found.focus, found.budget).image(hologram, "led", depth)
    error = (few - many).square().mean().sqrt() / many.square().mean().sqrt()
    # 1 % expected for the integral; the sum over whole nanometres is itself that far from it.
    assert error < 0.03
    assert all(found.samples("led", wave, depth)[2] <= 15 for wave in found.scene.settings.wavelengths)


def test_the_eye_sees_sharply_where_it_is_focused():
    """A point at each of two depths: the picture of each is brightest when the eye accommodates to it."""
    found = observer(settings("focus=[10 mm, 14 mm]"), scene_settings(settings()))
    grid, waves = found.scene.grid, found.scene.settings.wavelengths
    from holotorch.hologram import ConvolutionHologram

    layers = torch.zeros(2, 64, 64, dtype=torch.complex64)
    layers[0, 32, 20] = layers[1, 32, 44] = 1.0
    fields = [ConvolutionHologram(grid, wave, (10e-3, 14e-3), cone="taper", stride=2)(layers) for wave in waves]
    near, far = (found.image(torch.stack(fields), None, depth)[1] for depth in found.focus)
    assert near[32, 20] > 1.5 * far[32, 20] and far[32, 44] > 1.5 * near[32, 44]
    assert found.accommodation(14e-3) < found.accommodation(10e-3)  # nearer to the eyepiece: the image is nearer


def test_the_plan_says_how_the_scene_is_seen():
    found = observer(settings(), scene_settings(settings()))
    values = plan_values(found)
    text = plan_text(found, values)
    assert "synthetic: a phantom was asked for" in text
    assert "wavelengths simulated; the others are derived from them" in text and "s start-up and figures" in text
    assert values["accommodation_mm"][0] == pytest.approx(120, rel=1e-6)  # the middle, where the display puts it
    assert main(["check", str(CONFIG), *SMALL]) == 0


def test_what_spoils_the_pictures_is_said_before_they_are_computed():
    def warnings(*changes: str) -> list[str]:
        eye = observer(wanted := settings(*changes), scene_settings(wanted))
        values = plan_values(eye)
        assert all(f"WARNING    {words}" in plan_text(eye, values) for words in values["warnings"])
        return [words.partition(":")[0] for words in values["warnings"]]

    near = SCENE.replace("distance: 12 mm", "distance: 3 mm"), "focus=[3 mm]"
    assert warnings(*near) == []
    (flat,) = warnings()
    assert flat.startswith("the scene is ") and "this eye's depth of focus" in flat
    (dark,) = warnings(*near, "transfer={points: [[220, 1, 1, 1, 0], [255, 1, 1, 1, 1]]}")
    assert dark.endswith("% of the picture is black")


def check_without_template_engine(words: list[str]) -> None:
    assert "jinja2" not in sys.modules  # or the rest would show nothing
    assert not main(words) and "jinja2" not in sys.modules


def test_a_check_does_not_load_the_template_engine(tmp_path):
    words = ["check", str(CONFIG), *SMALL]
    process = start_apart(check_without_template_engine, words, said=tmp_path / "said")
    process.join(120)
    assert process.exitcode == 0, (tmp_path / "said").read_text()


def test_the_plan_names_what_it_does_not_count(capsys):
    words = [*TINY, "eye.tolerance=0.1", "tradeoff=[2 mm, 3 mm]", "sweep={steps: 5, realisations: 2}"]
    assert main(["check", str(CONFIG), *words]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(("Sweep", "Trade-off"))]
    assert lines[0].startswith("Sweep      in addition, 5 depths of focus, 2 realisation(s) each")
    assert lines[1] == "Trade-off  in addition, at 2, 3 mm, by the method collapse; the cost above excludes it"


@pytest.mark.parametrize(("tolerance", "method"), [(0.05, "collapse"), (0.03, "elements")])
def test_the_run_goes_the_way_that_its_plan_says(tolerance, method, tmp_path, monkeypatch):
    called = []
    collapse = spectral.propagate_collapsed
    for name, way in (("collapse", "propagate_collapsed"), ("elements", "propagate_elements")):
        # Elements in fact are tried below; here it counts which way is called.
        monkeypatch.setattr(
            spectral, way, lambda *words, name=name, **more: called.append(name) or collapse(*words, **more)
        )
    monkeypatch.setattr(eye_run, "observer_errors", lambda _: [])  # which propagates wavelengths of its own
    given = load_config(CONFIG, [*TINY, f"eye.tolerance={tolerance}"])
    folder, _ = execute(given, tmp_path / "a", "a")
    planned = json.loads((folder / "plan.json").read_text())
    assert [way["method"] for way in planned["retina"]] == [method]
    assert planned["tolerances"][2]["tolerance"] == tolerance
    assert set(called) == {method} and len(called) == planned["images"]
    assert f"Retina     {method} at" in (folder / "report.html").read_text()


def test_what_observers_see_is_put_on_one_page(tmp_path, tiny):
    names = ("one", "two")
    for name, source in zip(names, ("laser", "led"), strict=True):
        words = [*TINY, f"light={{sources: [{source}]}}", "eye.tolerance=0.1"]
        execute(load_config(CONFIG, words), tmp_path / name, name)
    assert main(["report", *(str(tmp_path / name) for name in names), "--out", str(tmp_path / "both.html")]) == 0
    page = (tmp_path / "both.html").read_text()
    for words in (
        "<h1>one</h1>",
        "<h1>two</h1>",
        "<td>laser</td>",
        "<td>led</td>",
        "contrast",
        "sharpness",
        "Retina  ",
    ):
        assert words in page
    assert page.count("data:image/png;base64,") == 6 and page.count("How to repeat") == 2


def test_both_ways_show_the_same_and_the_plan_tells_their_costs():
    given = [load_config(CONFIG, [*TINY, f"eye.tolerance={tolerance}"]) for tolerance in (0.05, 0.03)]
    short, long = (observer(each, scene_settings(each)) for each in given)
    hologram, _ = short.scene.hologram(0)
    seen = [found.image(hologram, None, 2e-3) for found in (short, long)]
    error = (seen[0] - seen[1]).norm() / seen[1].norm()
    ways = [found.retina(2e-3) for found in (short, long)]
    assert [way.method for way in ways] == ["collapse", "elements"]
    assert error < sum(way.predicted_error for way in ways)
    predicted = [plan_values(found)["seconds_of"]["pictures"] for found in (short, long)]
    assert predicted[1] > 2 * predicted[0]


@pytest.mark.parametrize(("tolerance", "hinted"), [(0.02, True), (0.01, False), (0.04, False)])
def test_a_cheaper_method_that_nearly_meets_the_tolerance_is_pointed_out(tolerance, hinted):
    words = [*EYE, "seeds=1", "light={sources: [laser]}", "focus=[2 mm]"]

    def plan(*more: str) -> tuple[dict, str]:
        settings = load_config(CONFIGS / "eye" / "teapot.yaml", [*words, *more])
        eye = observer(settings, scene_settings(settings))
        values = plan_values(eye)
        return values["retina"][0], plan_text(eye, values)

    chosen, text = plan(f"eye.tolerance={tolerance}")
    [*hints] = [line.split() for line in text.splitlines() if line.startswith("Hint")]
    assert len(hints) == hinted
    if hinted:
        cheaper, _ = plan(hints[0][1])
        assert chosen["method"] == "elements" and cheaper["method"] == "collapse"
        assert cheaper["predicted_error"] == chosen["cheapest_error"] < 2 * tolerance


def test_a_way_that_does_not_fit_is_refused_before_it_starts(capsys, monkeypatch):
    assert main(["check", str(CONFIG), *TINY, "eye.tolerance=0.05"]) == 0
    monkeypatch.setattr(eye_plan, "_BASE_BYTES", 1e18)
    assert main(["check", str(CONFIG), *TINY, "eye.tolerance=0.05"]) == 2
    assert "GB are free; use a smaller grid" in capsys.readouterr().err
    assert main(["check", str(CONFIG), *TINY]) == 2
    assert "use a smaller grid, or a larger tolerance" in capsys.readouterr().err


def test_the_teapot_of_the_thesis_is_collapsed():
    """Its configuration, its pixels; only the voxels are fewer."""
    change = "'volume={phantom: c60, samples: 16}', 'hologram={shape: [512, 512], pitch: 3.74 um, distance: 30 mm}'"
    given = load_config(CONFIG, [f"scene={{config: configs/volume/teapot.yaml, change: [{change}]}}"])
    found = observer(given, scene_settings(given))
    assert given.eye.tolerance is None and found.budget.share("retina") == 0.03
    ways = [found.retina(depth) for depth in found.focus]
    assert {way.method for way in ways} == {"collapse"} and all(way.predicted_error < 0.03 for way in ways)


def test_interrupted_runs_keep_what_was_seen(tmp_path, monkeypatch):
    original = eye_module.Observer.image
    seen = []

    def pressed(self, hologram, source, *words):
        seen.append(source)
        if seen.count("led") == 2:
            signal.raise_signal(signal.SIGINT)
        return original(self, hologram, source, *words)

    monkeypatch.setattr(eye_module.Observer, "image", pressed)
    folder, complete = execute(settings("seeds=2"), tmp_path / "a", "a")
    saved = json.loads((folder / "interrupted.json").read_text())
    assert not complete and saved["realisations"] == 1 and not (folder / "summary.json").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("eye={pupil_radius: 0}", "eye.pupil_radius: expected a length within 10 um .. 50 mm"),
        ("display={kind: magnifying, focal_length: -1 mm}", "display.*focal_length: expected a length above zero"),
        ("light={sources: [lamp]}", "light.sources"),
        ("light={sources: [lazer]}", "did you mean 'laser'"),
        ("scene={config: no.yaml}", "scene.config: expected a configuration file of a volume that exists"),
        ("seeds=0", "seeds"),
    ],
)
def test_bad_settings_are_named(override, message):
    with pytest.raises(ConfigError, match=message):
        settings(override)


def test_a_scene_that_the_display_cannot_show_is_refused():
    wrong = settings("focus=[40 mm]")  # beyond the eyepiece
    with pytest.raises(ConfigError, match=r"display: .*; the eye cannot focus at a depth of 40 mm"):
        observer(wrong, scene_settings(wrong))
    finer = scene_settings(settings())
    finer = finer.model_copy(update={"hologram": finer.hologram.model_copy(update={"pitch": (3e-7, 3e-7)})})
    with pytest.raises(ConfigError, match=r"hologram.pitch: expected more than .* half the longest wavelength"):
        observer(settings(), finer)
    other = settings("scene={config: configs/demo.yaml}")
    with pytest.raises(ConfigError, match="describes no volume but 'pec'"):
        scene_settings(other)


@cache
def _picture(source: str, *changes: str) -> torch.Tensor:
    given = load_config(CONFIG, [*TINY, "eye.tolerance=0.1", *changes])
    eye = observer(given, scene_settings(given))
    return eye.image(eye.scene.hologram()[0], source, 2e-3)


def test_every_wavelength_on_its_own_gives_the_same_picture():
    """With a position so small that it is rounded to none."""
    together, apart = _picture("led"), _picture("led", "eye.position=[1 nm, 0 m]")
    assert (together - apart).norm() < 0.02 * together.norm()


def test_an_eye_beside_the_axis_sees_the_same_plane_in_another_perspective():
    axis, side = _picture("laser"), _picture("laser", "eye.position=[0 m, 60 um]")
    assert side.isfinite().all() and 0.3 < side.sum() / axis.sum() < 3
    assert (axis - side).norm() > 0.05 * axis.norm()
    given = load_config(CONFIG, [*TINY, "eye.tolerance=0.1", "eye.position=[0 m, 1 mm]"])
    with pytest.raises(ConfigError, match="eye.position: position of the eye must be within"):
        observer(given, scene_settings(given))  # before anything is computed


def test_dispersion_matters_for_wide_sources_only():
    change = [
        ((one - other).norm() / one.norm()).item()
        for one, other in (
            (_picture(source), _picture(source, f"light={{sources: [laser], dispersion: {value}}}"))
            for source, value in (("laser", "true"), ("led", "true"))
        )
    ]
    assert 0 < 2 * change[0] < change[1] < 0.1, change


def test_a_lens_at_the_hologram_is_a_display_that_runs():
    picture = _picture("laser", "display={kind: spherical, focal_length: 10 mm}")
    assert picture.isfinite().all() and picture.max() > 5 * picture.mean()


def test_a_plan_says_that_an_eye_is_beside_the_axis():
    given = load_config(CONFIG, [*TINY, "eye.tolerance=0.1", "eye.position=[0 m, 60 um]"])
    eye = observer(given, scene_settings(given))
    text = plan_text(eye, plan_values(eye))
    assert "beside the axis, at y 0 mm, x 0.06 mm" in text and "derived" not in text
