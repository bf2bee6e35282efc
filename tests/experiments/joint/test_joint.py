"""A volume on a hot array: scores against the baselines, borders of the model, and settings that cannot work."""

import csv
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from paths import CONFIGS
from tiny_runs import VOLUME, command

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.joint.charts import chart as joint_chart
from holotorch.experiments.joint.config import JointSettings
from holotorch.experiments.joint.evaluation import errors, evaluate
from holotorch.experiments.joint.experiment import build
from holotorch.experiments.joint.methods import Shown, baseline, show
from holotorch.experiments.joint.names import NAMES
from holotorch.experiments.joint.report import joint_outcome, joint_section
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs import figures
from holotorch.hologram import incoherent_views
from holotorch.optics import View, disc_source
from holotorch.scene import SourceLayers

SCENE = "volume={phantom: shells, samples: 24}"
DISPLAY = "display={shape: [48, 44], pitch: 9 um, distance: 6 mm, depth: 8 mm, planes: 4}"
PLAIN = "view={width: 0.3 mm}", "device=cpu", "report.baselines=[]"
TEAPOT = str(CONFIGS / "joint" / "teapot.yaml")


def experiment(*changes: str):
    settings = load_config(TEAPOT, [SCENE, VOLUME[1], *PLAIN, DISPLAY, *changes])
    assert isinstance(settings, JointSettings)
    return build(settings)


def scores(made, phase) -> dict[str, float]:
    return evaluate(made, show(made, phase))[0]


def test_the_joint_correction_is_ahead_of_every_baseline_also_where_it_was_not_trained():
    made = experiment("frames=6", "steps=40", "wavelengths=[520 nm]")
    joint = scores(made, made.solve().x)
    assert joint["peak_phase_pi"] <= 4
    for name in ("random", "afterwards", "light_field", "retrieved", "retrieved_pec", "slabs"):
        other = evaluate(made, baseline(made, name))[0]
        for views in ("stack", "held"):
            assert joint[f"{views}_psnr"] > other[f"{views}_psnr"] + 10
            assert joint[f"{views}_contrast"] < other[f"{views}_contrast"] / 3
    assert joint["stack_psnr"] > 40 and joint["held_psnr"] > 38


def test_a_gaussian_as_a_measured_kernel_gives_what_its_sigma_gives(tmp_path):
    """Also with heat that is left from earlier frames; up to what eight steps make of rounding errors."""
    words = "frames=3", "steps=8", "wavelengths=[520 nm]", "heat={frame_us: 20, time_constant_us: 15}"
    gaussian = experiment(*words, "display.sigma_px=0.8")
    np.save(tmp_path / "kernel.npy", 40 * gaussian.crosstalk.kernel.numpy())  # in any unit
    measured = experiment(*words, f"display.kernel={tmp_path / 'kernel.npy'}")  # sigma 0.66 px is not used
    drive = torch.rand(3, 1, 48, 44, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(measured.heat(drive), gaussian.heat(drive), rtol=0, atol=1e-12)
    one, other = (made.solve().x for made in (gaussian, measured))
    assert (one - other).abs().max() < 2e-2  # of 6 rad, after eight steps in float32
    assert scores(measured, other)["stack_psnr"] == pytest.approx(scores(gaussian, one)["stack_psnr"], abs=0.05)
    assert "heat" not in measured.budget.parts and "heat" in gaussian.budget.parts


def test_a_measured_kernel_need_not_be_symmetric_and_is_named_by_the_plan(tmp_path, capsys):
    kernel = np.array([[0.0, 0.1, 0.0], [0.3, 1.0, 0.05], [0.0, 0.2, 0.0]])
    np.savetxt(tmp_path / "kernel.csv", kernel, delimiter=",")
    made = experiment("frames=2", "steps=3", "wavelengths=[520 nm]", f"display.kernel={tmp_path / 'kernel.csv'}")
    drive = torch.zeros(2, 1, 48, 44)
    drive[:, :, 20, 30] = 1.0
    np.testing.assert_allclose(made.heat(drive)[0, 0, 19:22, 29:32], kernel, atol=1e-7)
    words = [SCENE, VOLUME[1], *PLAIN, DISPLAY, f"display.kernel={tmp_path / 'kernel.csv'}"]
    for tolerance in ([], ["tolerance=0.1"]):
        assert main(["check", TEAPOT, *words, *tolerance]) == 0
        assert f"heat spreads by the measured kernel {tmp_path / 'kernel.csv'}, 3 x 3 px" in capsys.readouterr().out


# Rows of a kernel that is wider than the array: 0.1 around a pixel of 1.
WIDE = "\n".join(",".join("1" if i == j == 25 else "0.1" for j in range(51)) for i in range(51))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("1,2\n3", "display.kernel: {path}: expected a table of temperature rises"),
        (WIDE, "display.kernel: 51 x 51 taps are more than the (48, 44) px of"),
    ],
)
def test_a_kernel_that_cannot_be_used_is_said(rows, message, tmp_path, capsys):
    path = tmp_path / "kernel.csv"
    path.write_text(rows)
    assert main(["check", TEAPOT, SCENE, VOLUME[1], *PLAIN, DISPLAY, f"display.kernel={path}"]) == 2
    assert message.format(path=path) in capsys.readouterr().err
    assert main(["check", TEAPOT, "modulator={kernel: a.csv}"]) == 2
    assert "display describes the chip, by sigma_px or kernel" in capsys.readouterr().err


def test_scarce_heat_is_where_the_model_of_it_pays():
    made = experiment("frames=6", "steps=40", "wavelengths=[520 nm]", "display.sigma_px=1.2")
    afterwards = evaluate(made, baseline(made, "unheated"))[0]
    assert scores(made, made.solve().x)["stack_psnr"] > afterwards["stack_psnr"] + 10


def test_parallax_is_bought_with_the_stack():
    options = "frames=6", "steps=40", "wavelengths=[520 nm]"
    plain, parallax = experiment(*options), experiment(*options, "eye.parallax=12")
    without, with_it = scores(plain, plain.solve().x), scores(parallax, parallax.solve().x)
    assert with_it["half_psnr"] > without["half_psnr"] + 1
    assert with_it["stack_psnr"] < without["stack_psnr"]


def test_each_pupil_sees_past_what_is_in_front_in_its_own_directions():
    """Images through half pupils are not those with the occlusion of the axis, and agree with light of their own."""
    options = "wavelengths=[520 nm]", "transfer={points: [[20, 1, 1, 1, 0], [60, 1, 1, 1, 1]], unit_distance: 0.02}"
    axial, own = experiment(*options), experiment(*options, "eye.occlusion=pupil")
    left, without = own.halves.images[0, 2], axial.halves.images[0, 2]
    assert (left - without).norm() > 0.02 * left.norm()
    view = own.halves.operator.views[2]
    points, weights = disc_source(view.radius, 2)
    kept = [(point, weight) for point, weight in zip(points, weights, strict=True) if point[1] * view.covered[1] <= 0]
    parts = torch.stack([weight * own.slabs.towards(point) for point, weight in kept])
    light = parts.sum(0) / sum(weight for _, weight in kept)
    layers = SourceLayers(own.grid, own.depths, 1, lambda: iter(light.sqrt()))
    # All foci at once, as the padding and with it the samples of the pupil's edge depend on them.
    image = incoherent_views(layers, own.settings.wavelengths, own.halves.operator.views[::2])[0, 1]
    torch.testing.assert_close(left / left.sum(), image / image.sum(), rtol=1e-4, atol=1e-9)
    # A pupil that is a point looks along the axis.
    torch.testing.assert_close(own._light_into(View(1e-3, 1e-9)), axial.light, rtol=0, atol=1e-5)


def test_heat_that_is_left_spoils_independent_frames_and_not_the_cycle():
    options = "frames=6", "steps=40", "wavelengths=[520 nm]"
    cold, warm = experiment(*options), experiment(*options, "heat={frame_us: 20, time_constant_us: 10}")
    phase = cold.solve().x
    alone, spoiled, cycle = scores(cold, phase), scores(warm, phase), scores(warm, warm.solve().x)
    assert spoiled["stack_psnr"] < alone["stack_psnr"] - 10
    assert cycle["stack_psnr"] > alone["stack_psnr"] - 3


def test_the_whole_chain_has_the_gradient_of_finite_differences():
    """From the images through pupils and heat that is left to the heaters."""
    made = experiment("frames=2", "display={shape: [11, 12], pitch: 9 um, distance: 2 mm, depth: 1 mm, planes: 2}",
                      "heat={frame_us: 2, time_constant_us: 1}", "wavelengths=[520 nm]")  # fmt: skip
    problem = made.problem(made.heat, made.stack, 4.0)
    phase = (3 + torch.rand(2, 1, 11, 12, dtype=torch.float64)).requires_grad_()
    # The scale that fits best is held constant in the gradient, which is exact at any phase.
    assert torch.autograd.gradcheck(problem, phase, eps=1e-6, atol=1e-5)


@pytest.mark.parametrize(
    "changes",
    [
        ["frames=1"],
        ["display.planes=1", "display.depth=null"],
        ["display.max_phase=2.5"],  # below pi: hardly any light, but right
        ["transfer={points: [[0, 1, 1, 1, 0], [255, 1, 1, 1, 0.001]], unit_distance: 0.05}"],  # nearly empty
        ["eye.pupil=1"],
    ],
)
def test_borders_give_finite_scores_within_the_limit(changes):
    made = experiment("frames=2", "steps=8", "wavelengths=[520 nm]", *changes)
    numbers = scores(made, made.solve().x)
    assert all(math.isfinite(value) for value in numbers.values())
    assert numbers["peak_phase_pi"] * math.pi <= made.settings.display.max_phase
    assert 0 < numbers["light_in_pupil"] <= 1


def test_a_focus_at_the_array_is_taken_and_a_plane_behind_it_is_not():
    near = experiment("display={shape: [48, 44], pitch: 9 um, distance: 0.21 mm, depth: 0.4 mm, planes: 2}", "frames=2")
    assert min(near.foci) == pytest.approx(0.11e-3)
    assert near.stack.images.isfinite().all()


def test_the_default_comparison_with_slabs_is_left_out_where_frames_are_too_few(capsys):
    words = ["check", TEAPOT, SCENE, "view={width: 0.3 mm}", DISPLAY]
    assert main([*words, "frames=4"]) == main([*words, "frames=2"]) == 0
    enough, few = (line for line in capsys.readouterr().out.splitlines() if line.startswith("Solver"))
    assert enough.endswith("compared with random, afterwards, slabs")
    assert few.endswith("compared with random, afterwards (slabs, one plane a frame, needs as many frames)")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["display.depth=13 mm"], "less than twice the distance, 0.012 m"),
        (["frames=2", "report.baselines=[slabs]"], "report.baselines: the comparison 'slabs' shows one plane a frame"),
        (["wavelengths=[]"], "expected 1 (grey), 3 (red, green, blue) or another number, got 0"),
        (["display.pitch=0.4 um"], "at least 0.9 of the longest wavelength"),
        (["display.distance=0.1 mm", "display.depth=null"], "display.distance: expected the whole volume in front"),
        (["display.shape=[8, 8]"], "at least 11 x 11 px"),
        (["eye.pupil=1.1"], "eye.pupil"),
        (["eye={parallax: 2, per_step: 3}"], "expected at most the 2 parts of eye.parallax, got 3"),
        (["eye={parallax: 2, per_step: 1}", "tolerance=0.1"], "leave eye.per_step or it out"),
        (["display.sigma=1"], "display.sigma"),
        (["volume.path=/nowhere.nrrd"], "expected a file or folder that exists"),
    ],
)
def test_settings_that_cannot_work_are_refused(words, message, capsys):
    assert main(["check", TEAPOT, SCENE, "view={width: 0.3 mm}", DISPLAY, *words]) == 2
    assert message in capsys.readouterr().err


def test_a_colour_without_light_is_refused():
    red = "transfer={points: [[20, 1, 0, 0, 0], [255, 1, 0, 0, 0.9]], unit_distance: 0.05}"
    with pytest.raises(ConfigError, match="no light at 520 nm, 455 nm"):
        _ = experiment(red).stack


@pytest.mark.usefixtures("tiny")
def test_a_run_has_its_tables_and_pictures_and_can_be_exported(tmp_path, capsys):
    folder = tmp_path / "a"
    assert main(command("joint", folder)) == 0
    with open(folder / "methods.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["method"] for row in rows] == ["joint", "afterwards", "slabs"]
    with open(folder / "views.csv", newline="") as stream:
        views = list(csv.DictReader(stream))
    trained = len({row["view"] for row in views if row["use"] == "trained"})
    assert trained >= 2 and len(views) == 3 * (trained + 1 + 4 + 4)  # for each colour
    arrays = [np.load(folder / "arrays" / f"{name}.npy") for name in ("target", "shown")]
    assert (
        arrays[0].shape
        == arrays[1].shape
        == (trained + 1 + 4 + 4, 3, *np.load(folder / "arrays" / "phase.npy").shape[-2:])
    )
    from PIL import Image

    with Image.open(folder / "images" / "sweep.png") as sweep:
        assert getattr(sweep, "n_frames", 1) > 10
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["synthetic"] and summary["status"] == "complete"
    page = (folder / "report.html").read_text()
    assert "one plane a frame" in page and "Synthetic volume" in page
    panel = ["--slm", str(CONFIGS / "slm" / "lcos_2048.yaml"), "shape=[24, 20]", "pitch=9 um"]
    panel.append("calibration=[{wavelength: 636 nm}, {wavelength: 520 nm}, {wavelength: 455 nm}]")
    assert main(["export-slm", str(folder), *panel, "--out", str(tmp_path / "slm")]) == 0
    assert "9 png for" in capsys.readouterr().out  # three frames of three colours


def test_pictures_of_many_foci_are_a_few(tmp_path, monkeypatch):
    drawn: dict[str, tuple[int, list[str]]] = {}

    def table(rows, titles):
        drawn[str(len(drawn))] = rows["wanted"].shape[1], titles
        return b"png"

    monkeypatch.setattr(figures, "picture_table", table)
    words = [*("display.planes=15", "frames=1", "steps=1", "wavelengths=[520 nm]"), SCENE, VOLUME[1], *PLAIN, DISPLAY]
    words = [*words[4:], *words[:4], "eye.pupil=0.9"]  # as wide, each plane needs a focus
    assert execute(load_config(TEAPOT, words), tmp_path / "a", "a")[1]
    assert drawn["0"] == (8, [f"{each:.4g} mm" for each in (2.267, 3.333, 4.4, 5.467, 6.533, 7.6, 8.667, 9.733)])


def test_anybody_can_compute_the_pictures_of_a_run_from_its_files(tmp_path):
    """With NumPy alone: heat, light through a pupil at the focus of each view, and the mean over the frames."""
    words = [*("frames=2", "steps=5", "wavelengths=[520 nm]", "eye.parallax=3"), SCENE, VOLUME[1], *PLAIN, DISPLAY]
    folder, complete = execute(load_config(TEAPOT, words), tmp_path / "a", "a")
    assert complete
    phase = np.load(folder / "arrays" / "phase.npy")[:, 0].astype(float)
    target, shown = (np.load(folder / "arrays" / f"{name}.npy")[:, 0] for name in ("target", "shown"))
    with open(folder / "views.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(target) == len(shown)
    # Heat: exp(-r^2 / sigma^2) with sigma 0.66 px, 1 in the middle, by loops.
    r = np.arange(-2, 3)
    taps = np.exp(-(r[:, None] ** 2 + r**2) / 0.66**2)
    height, width = phase.shape[-2:]
    padded = np.pad(phase, ((0, 0), (2, 2), (2, 2)))
    spread = sum(taps[i, j] * padded[:, i : i + height, j : j + width] for i in range(5) for j in range(5))
    scales = []
    for row in rows:
        number = {name: float(value) for name, value in row.items() if name != "use"}
        size = 512
        fy, fx = np.fft.fftfreq(size, number["pitch_y_m"])[:, None], np.fft.fftfreq(size, number["pitch_x_m"])
        y, x = fy - number["pupil_y_per_m"], fx - number["pupil_x_per_m"]
        pupil = (y**2 + x**2 <= number["pupil_radius_per_m"] ** 2) & (
            number["covered_y"] * y + number["covered_x"] * x <= 0
        )
        axial = np.sqrt(number["wavelength_m"] ** -2 - fy**2 - fx**2)
        spectrum = np.fft.fft2(np.exp(1j * spread), (size, size))
        fields = np.fft.ifft2(spectrum * pupil * np.exp(-2j * np.pi * axial * number["focus_m"]))
        seen, given = (np.abs(fields[:, :height, :width]) ** 2).mean(0), shown[int(number["view"])]
        scales.append((seen * given).sum() / (seen * seen).sum())
        error = np.linalg.norm(scales[-1] * seen - given) / np.linalg.norm(given)
        assert error < 0.1, row  # the edge of the pupil is sampled more finely here
    assert np.std(scales) < 0.05 * np.mean(scales)  # one scale for all views
    assert sum(row["use"] == "trained" for row in rows) == 4 + 3


def test_laser_powers_weight_the_frames():
    made = experiment("frames=2", "wavelengths=[520 nm]")
    fields = made.random_fields()
    powers = torch.tensor([[2.0], [0.0]])
    first = Shown(fields[:1]).images(made.stack.operator)
    torch.testing.assert_close(Shown(fields, laser=powers).images(made.stack.operator), first)


def test_equal_images_have_no_error_and_flat_ones_no_contrast():
    images = torch.rand(1, 2, 16, 16) + 0.1
    numbers = errors(images * 1.1, images)
    assert numbers["contrast"] < 1e-5 and numbers["psnr"] < 30


def test_a_small_chart_is_complete(tmp_path, monkeypatch, capsys):
    amount = {"cases": ("8 frames", "parallax"), "size": 24, "steps": 3, "budgets": (2, 3), "light": (0.0,)}
    monkeypatch.setattr(joint_chart, "FULL", replace(joint_chart.QUICK, **amount))
    made = joint_chart._experiment
    monkeypatch.setattr(
        joint_chart, "_experiment", lambda scene, seed, words, of: made(scene, seed, [SCENE, *words], of)
    )
    monkeypatch.setattr(joint_chart, "CASES", {"8 frames": ([], ("random",)), "parallax": (["eye.parallax=2"], ())})
    monkeypatch.delenv(joint_chart.VOLUMES, raising=False)
    assert main(["chart", "joint", "--out", str(tmp_path / "c")]) == 0
    names = {"chart.csv", "chart.png", "memory.csv", "speed.csv", "device.csv", "light.csv", "verdict.txt"}
    assert {path.name for path in (tmp_path / "c").iterdir()} == names
    assert "Synthetic volumes" in capsys.readouterr().out


def test_light_in_the_pupil_is_bought_with_accuracy():
    options = "frames=4", "steps=30", "wavelengths=[520 nm]"
    plain, bright = experiment(*options), experiment(*options, "light_weight=0.1")
    without, with_it = scores(plain, plain.solve().x), scores(bright, bright.solve().x)
    assert with_it["light_in_pupil"] > 1.5 * without["light_in_pupil"]
    assert with_it["stack_psnr"] < without["stack_psnr"]


@pytest.mark.parametrize(("light", "said"), [(0.049, True), (0.051, False)])
def test_a_report_says_that_there_is_little_light_where_that_begins_and_what_to_change(light, said):
    methods = {"joint": {"light_in_pupil": light, "seconds": 1.0}}
    record = SimpleNamespace(
        title="a",
        summary={"status": "complete", "synthetic": "", "methods": methods},
        plan={},
        picture=lambda name: "",
        rows=lambda name: [],
    )
    page = " ".join(joint_section(record))  # type: ignore[arg-type]
    assert ("only 4.9% of the light reaches the pupil and the window (said below 5%)" in page) == said
    assert ("light_weight asks the solver for more" in page) == said


def test_a_result_names_planes_limit_and_ideal_fields_that_qualify_its_score():
    methods = {"joint": {"stack_psnr": 20.0, "at_limit": True}, "random": {"stack_psnr": 25.0}}
    text = "\n".join(joint_outcome({"methods": methods, "measured_error": 0.4}))
    assert "20.0 dB" in text and "of pictures that are 40% off the volume" in text and "at their limit" in text
    assert "(no chip shows such fields): 25.0 dB" in text
    methods = {"joint": {"stack_psnr": 50.0, "at_limit": True}, "afterwards": {"stack_psnr": 25.0}}
    text = "\n".join(joint_outcome({"methods": methods, "measured_error": 0.05}))
    assert "off the volume" not in text and "limit" not in text and "no chip" not in text


def test_a_result_names_the_views_in_which_another_method_is_ahead():
    methods = {
        "joint": {"stack_psnr": 43.0, "half_psnr": 30.3, "part_psnr": 26.6},
        "random": {"stack_psnr": 27.7, "half_psnr": 28.2, "part_psnr": 28.2},
        "slabs": {"stack_psnr": 23.3, "half_psnr": 31.0, "part_psnr": 21.1},
    }
    text = "\n".join(joint_outcome({"methods": methods}))
    assert f"through half pupils, 30.3 dB against 31.0 of: {NAMES['slabs']}" in text
    assert f"through circles, 26.6 dB against 28.2 of: {NAMES['random']}" in text
    assert "against" not in "\n".join(joint_outcome({"methods": {"joint": methods["joint"]}}))
