"""One tolerance of a joint run: its shares, the number of planes that follows, and the measured errors."""

import json
import re

import numpy as np
import pytest
import torch
from paths import CONFIGS
from tiny_runs import VOLUME, command

from holotorch.cli import main
from holotorch.correction.problem import best_scale
from holotorch.experiments.execute import check
from holotorch.experiments.joint.config import MOST_PLANES
from holotorch.experiments.joint.evaluation import errors, evaluate
from holotorch.experiments.joint.experiment import JointExperiment, build
from holotorch.experiments.joint.measured import joint_errors
from holotorch.experiments.joint.methods import show
from holotorch.experiments.joint.report import joint_outcome
from holotorch.experiments.registry import load_config

pytestmark = pytest.mark.usefixtures("tiny")
WORDS = [
    *("volume={phantom: shells, samples: 24}", VOLUME[1], "view={width: 0.3 mm}", "device=cpu", "report.baselines=[]"),
    *("display={shape: [32, 28], pitch: 9 um, distance: 6 mm, depth: 5 mm}", "wavelengths=[520 nm]", "frames=4"),
]


def settings(*words: str):
    return load_config(CONFIGS / "joint" / "teapot.yaml", [*WORDS, *words])


def parts(values) -> dict[str, dict]:
    return {each["part"]: each for each in values["tolerances"]}


def test_without_a_tolerance_nothing_changes():
    plan = check(settings())
    assert len(plan.values["planes_mm"]) == 5 and plan.values["stop_below"] == 0 and "L-BFGS, 60 steps" in plan.text
    assert plan.values["taps"] == 5 and plan.values["precision"] == "complex64"
    assert list(parts(plan.values)) == ["heat", "planes", "propagation"] and "by default" in plan.text
    assert parts(plan.values)["planes"]["predicted_error"] < 0.05 and "off this volume" not in plan.text


@pytest.mark.parametrize(("planes", "shown"), [(5, "thin parts of it broken"), (2, "slices of it")])
def test_too_few_samples_of_a_volume_are_noted(planes, shown):
    """With one for each plane, 5 planes are 37 % off, and 2 more than 50 %."""
    plan = check(settings(f"display.planes={planes}", "view.samples=1"))
    error = parts(plan.values)["planes"]["predicted_error"]
    (note,) = [line for line in plan.text.splitlines() if "off this volume" in line]
    assert f"{error:.0%} off" in note and shown in note and "without view.samples" in note
    sampled = check(settings(f"display.planes={planes}"))
    assert parts(sampled.values)["planes"]["predicted_error"] < 0.05 and "off this volume" not in sampled.text


def test_opaque_surfaces_without_shading_are_noted():
    noted = [
        "opaque surfaces" in check(settings("transfer=skin", *light)).text for light in ([], ["view.lighting=true"])
    ]
    assert noted == [True, False]


def test_planes_far_apart_are_noted_with_a_number_that_is_not():
    """520 nm, sine 0.0202: a depth of focus of 1.27 mm; planes 2.5 mm apart."""
    (note,) = [
        line for line in check(settings("display.planes=2", "eye.pupil=0.7")).text.splitlines() if " apart" in line
    ]
    number = re.search(r"; display.planes=(\d+) puts it where it belongs", note)
    assert number and "planes are" not in check(settings(f"display.planes={number[1]}", "eye.pupil=0.7")).text
    with_slabs = check(settings("display.planes=2", "eye.pupil=0.7", "frames=2", "report.baselines=[slabs]"))
    assert re.search(r"; display.planes=(\d+) frames=\1 puts", with_slabs.text)


@pytest.mark.parametrize(("planes", "foci"), [(4, 4), (8, 8), (9, 8), (40, 9), (200, 9)])
def test_planes_within_a_depth_of_focus_share_foci(planes, foci):
    """520 nm, sine 0.0202: a depth of focus of 1.27 mm; 40 planes span 4.875 mm, and 200 of them 4.975 mm."""
    plan = check(settings(f"display.planes={planes}", "eye.pupil=0.7")).values
    span = plan["planes_mm"][0], plan["planes_mm"][-1]
    apart = plan["depth_of_focus_mm"] / 2
    assert len(plan["planes_mm"]) == planes and len(plan["foci_mm"]) == plan["views"] == foci
    assert (plan["foci_mm"][0], plan["foci_mm"][-1]) == pytest.approx(span)
    assert np.diff(plan["foci_mm"]) == pytest.approx((span[1] - span[0]) / (foci - 1))
    assert foci == planes or (span[1] - span[0]) / (foci - 1) <= apart < (span[1] - span[0]) / max(foci - 2, 1e-9)


def test_fewer_foci_correct_all_planes_as_well():
    """The pictures at each of 24 planes, by a focus on each and by those half a depth of focus apart."""
    words = "display.planes=24", "steps=30", "frames=3"
    few = build(settings(*words))
    every = build(settings(*words))
    every.__dict__["foci"] = sorted(every.depths)
    scores = []
    for experiment in (few, every):
        shown = show(experiment, experiment.solve().x)
        with torch.no_grad():
            images = shown.images(every.stack.operator)
        images = images * best_scale(images, every.stack.images, -3)[:, None, None, None]
        scores.append(float((images - every.stack.images).square().mean().sqrt()))
    assert len(few.foci) < 10 < len(every.foci)
    assert scores[0] < 1.1 * scores[1]


def test_no_note_proposes_more_planes_than_a_run_takes():
    """Of a volume that is stretched to 1.9 m, the planes are never close enough."""
    words = "display.distance=1 m", "display.depth=1.9 m"
    for planes in (5, MOST_PLANES):
        text = check(settings(f"display.planes={planes}", *words)).text
        proposed = [int(each) for each in re.findall(r"display\.planes=(\d+)", text)]
        assert proposed == [MOST_PLANES] * (planes < MOST_PLANES) and "a smaller pupil" in text


@pytest.mark.parametrize("rows", range(52, 64, 3))
def test_a_volume_wider_than_the_array_is_noted_with_the_width_that_fits(rows):
    """The width that fits is stated in two digits, for arrays in which the nearest ones are above and below it."""
    array = f"display.shape=[{rows}, 64]"
    wide = check(settings("view.width=4 mm", array))
    (note,) = [line for line in wide.text.splitlines() if "is cut off" in line]
    assert "beside the array" in note and "4 mm wide" in wide.text
    fits = re.search(r"view\.width=([\d.]+ mm)", note)
    assert fits and "is cut off" not in check(settings(f"view.width={fits[1]}", array)).text
    _, height, width = build(settings(array)).scene.volume.extent  # its rows are horizontal
    longest = max(height, width) * min(rows / height, 64 / width) * 9e-6  # of a volume that fits exactly
    assert 0.9 * longest < 1e-3 * float(fits[1].split()[0]) <= longest * (1 + 1e-9)


def test_a_tolerance_reaches_kernel_planes_padding_and_stopping_rule():
    loose, tight = (check(settings(f"tolerance={each}")) for each in (0.5, 0.05))
    assert len(loose.values["planes_mm"]) < len(tight.values["planes_mm"]) <= 64
    assert loose.values["samples"] < tight.values["samples"]
    assert loose.values["stop_below"] > tight.values["stop_below"] > 0
    assert loose.values["taps"] <= tight.values["taps"] <= 5
    assert "Tolerance  5.0e-02 = " in tight.text and "in a row change the loss by less than" in tight.text
    assert loose.values["predicted_seconds"] < tight.values["predicted_seconds"]


def test_a_number_of_planes_wins_and_slabs_take_no_more_than_there_are_frames():
    given = check(settings("tolerance=0.05", "display.planes=3", "view.samples=1"))
    assert len(given.values["planes_mm"]) == 3 and parts(given.values)["planes"]["from"] == "display.planes"
    assert "exceeds it" in given.text
    assert len(check(settings("tolerance=0.05", "report.baselines=[slabs]")).values["planes_mm"]) == 4


@pytest.mark.parametrize("noisy", [0.0, 0.03])
def test_a_psnr_is_stated_beside_that_of_an_exact_calculation(noisy):
    """Pictures that a calculation shows wrong by 3 % on its own are further from those wanted by as much."""
    made = build(settings("steps=60"))
    assert isinstance(made, JointExperiment)
    numbers, images = evaluate(made, show(made, made.solve().x))
    wanted = made.stack.images.cpu()
    noise = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(0))
    exact = images["stack"].cpu() + noisy * noise * wanted.square().mean().sqrt()
    summary = {
        "methods": {"joint": numbers},
        "errors": [
            {"part": "heat", "predicted": 1.0, "measured": None},  # would have taken too long
            {"part": "planes", "predicted": 1.0, "measured": 1.0},  # of what is wanted, not of what is shown
            {"part": "propagation", "predicted": 1.0, "measured": noisy},
        ],
    }
    stated = re.search(r"PSNR ([\d.]+) dB by exact heat and light \(", joint_outcome(summary)[0])
    assert bool(stated) == bool(noisy)
    if stated:
        assert float(stated[1]) == pytest.approx(errors(exact, wanted)["psnr"], abs=0.3)
        assert float(stated[1]) < numbers["stack_psnr"] - 1


@pytest.mark.parametrize(
    "words",
    [[], ["heat={frame_us: 20, time_constant_us: 10}"], ["eye.parallax=2"], ["display.planes=2"], ["display.planes=1"]],
)
@pytest.mark.parametrize("samples", ["1", "null"])
def test_measured_errors_are_about_those_predicted(words, samples):
    words = [*words, f"view.samples={samples}"]
    made = build(settings("tolerance=0.3", "steps=20", *words))
    assert isinstance(made, JointExperiment)
    measured = {each.part: each for each in joint_errors(made, made.solve())}
    assert list(measured) == ["heat", "planes", "propagation", "stopping"]
    for each in measured.values():
        assert each.measured is not None and each.measured <= 2 * each.predicted, each
    if samples == "1":  # errors of few per thousand, of many samples, are not asymptotic in a phantom of 24 voxels
        assert measured["planes"].measured == pytest.approx(measured["planes"].predicted, rel=0.5)


def test_a_tight_tolerance_is_solved_in_double_precision():
    made = build(settings("tolerance=0.5", "steps=3"))
    tight = build(settings("tolerance=1e-5", "steps=3", "display.planes=1"))
    assert str(made.solve().x.dtype) == "torch.float32" and str(tight.solve().x.dtype) in ("torch.float64")


def test_a_reference_that_is_not_affordable_is_left_out():
    made = build(settings("tolerance=0.5", "steps=2"))
    assert [each.measured for each in joint_errors(made, made.solve(), limit=0.0)] == [None] * 4


def test_a_finished_run_has_measured_beside_predicted_errors(tmp_path):
    assert main(command("joint", tmp_path / "a", "tolerance=0.3")) == 0
    summary = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert summary["measured_error"] is not None and summary["predicted_error"] > 0
    assert [each["part"] for each in summary["errors"]] == ["heat", "planes", "propagation", "stopping"]
    assert "Relative L2 error. heat" in (tmp_path / "a" / "report.html").read_text()


def test_the_phase_per_kelvin_of_a_joint_run_may_be_given_at_any_wavelength():
    texts = [
        check(settings("display.max_temperature=300 degC", f"display.rad_per_K={value}", *at)).values
        for value, at in ((0.02, ()), (0.02 * 630 / 525, ("display.rad_per_K_at=525 nm",)))
    ]
    limits = [
        settings("display.max_temperature=300 degC", *words).limit
        for words in (
            ("display.rad_per_K=0.02",),
            (f"display.rad_per_K={0.02 * 630 / 525}", "display.rad_per_K_at=525 nm"),
        )
    ]
    assert limits[0] == pytest.approx(limits[1]) and texts[0]["stop_below"] == texts[1]["stop_below"]


def test_a_measured_kernel_of_a_joint_run_states_noise_and_missing_heat(tmp_path):
    y, x = np.mgrid[-3:4, -3:4]
    rise = np.exp(-np.hypot(y, x)) + 0.004 * np.random.default_rng(1).normal(size=y.shape)
    np.savetxt(tmp_path / "kernel.csv", rise.clip(0) / rise.max(), delimiter=",")
    text = check(settings(f"display.kernel={tmp_path / 'kernel.csv'}")).text
    assert "differ as by noise of 0.00" in text and "the measured kernel is cut off" in text


@pytest.mark.parametrize("front", ["far", "near"])
def test_what_the_observer_sees_first_is_nearest_to_the_array(front):
    """An opaque ball, whose visible half lies before its middle, 6 mm behind the array."""
    opaque = "transfer={points: [[0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [255, 1, 1, 1, 1]]}"
    experiment = build(settings(f"view.front={front}", opaque, "display.planes=12"))
    depths, light = torch.tensor(experiment.depths), experiment.light.sum((1, 2, 3))
    assert list(experiment.depths) == sorted(experiment.depths)
    assert float((depths * light).sum() / light.sum()) < 6e-3 - 0.5e-3
