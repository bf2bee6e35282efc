"""Regions, depths, frames, coarse heaters and baselines: the folders' numbers follow from the saved phases alone."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import paths
import pytest
import torch
from oracles import array
from scipy.ndimage import convolve

from holotorch.experiments.execute import execute
from holotorch.experiments.pec import baselines as module
from holotorch.experiments.pec.baselines import baseline
from holotorch.experiments.pec.experiment import build
from holotorch.experiments.pec.report import METHOD_NAMES
from holotorch.experiments.registry import load_config

pytestmark = pytest.mark.usefixtures("tiny")
CONFIGS = paths.CONFIGS / "pec"
SHAPE, PITCH, WAVES = (24, 27), (15.625e-6, 15.625e-6), (630e-9, 530e-9, 445e-9)
SMALL = ["grid.shape=[24,27]", "grid.pitch=15.625 um", "target.image=coffee", "report.baselines=[]"]
# The error of stopping is measured by as many further steps as the patience.
LBFGS = "solver={kind: lbfgs, max_steps: 14, patience: 3}"


def settings(*overrides: str):
    return load_config(CONFIGS / "fourier.yaml", [*SMALL, LBFGS, *overrides])


def solved(folder: Path, *overrides: str):
    """What a run saved: fields [F, C, H, W] of its phases by the oracle, target, picture, and numbers."""
    assert execute(settings(*overrides), folder)[1]
    phase, target, picture = (np.load(folder / "arrays" / f"{name}.npy") for name in ("phase", "target", "intensity"))
    assert phase.dtype == np.float32 and (phase >= 0).all()
    numbers = json.loads((folder / "summary.json").read_text())["methods"]["corrected"]
    return np.exp(1j * array.spread(phase.astype(np.float64), 0.66, 7)), target, picture, numbers


def seen(propagated) -> np.ndarray:
    """Mean intensity of frames [F, ...]."""
    return (np.abs(propagated) ** 2).mean(0)


def assert_scores(picture, target, saved, numbers, c: int) -> None:
    assert saved[c] == pytest.approx(picture, rel=1e-7, abs=1e-9)
    assert numbers["ssim"][c] == pytest.approx(array.ssim(picture, target[c]), abs=1e-7)
    assert numbers["psnr"][c] == pytest.approx(array.psnr(picture, target[c]), rel=1e-7)


def middle(size, shape=SHAPE):
    """Samples of a picture whose centre size // 2 lies on the axis n // 2."""
    return np.ix_(*(np.arange(part) - part // 2 + whole // 2 for part, whole in zip(size, shape, strict=True)))


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("size", [(12, 16), (13, 11), (24, 27)])
def test_a_region_holds_the_picture_and_its_share_of_the_light(tmp_path, size, frames):
    field, target, saved, numbers = solved(tmp_path / "a", f"target.region={list(size)}", f"frames={frames}")
    assert field.shape == (frames, 3, *SHAPE) and target.shape == saved.shape == (3, *size)
    formed = seen(array.far(field))
    for c in range(3):
        inside = formed[c][middle(size)]
        assert_scores(array.at_best_scale(inside, target[c]), target, saved, numbers, c)
        assert numbers["efficiency"][c] == pytest.approx(inside.sum() / formed[c].sum(), rel=1e-9)
    assert numbers["ssim_mean"] > 0.9  # the rest of the image is free
    if size != SHAPE:
        assert max(numbers["efficiency"]) < 1


def test_a_region_of_a_chip_that_stands_alone(tmp_path):
    words = ["propagator={kind: fresnel, distance: 20 mm}", "target.region=[12,14]", "frames=2", "wavelengths=530 nm"]
    field, target, saved, numbers = solved(tmp_path / "a", *words)
    formed = seen(array.alone(field[:, 0], PITCH, 530e-9, 0.02))
    inside = formed[middle((12, 14))]
    # The array is 24 x 27 pixels of unit light, some of which passes the window.
    assert numbers["efficiency"][0] == pytest.approx(inside.sum() / (24 * 27), rel=1e-7)
    assert_scores(array.at_best_scale(inside, target[0]), target, saved, numbers, 0)
    exact = seen(array.alone(field[:, 0], PITCH, 530e-9, 0.02, paraxial=False))[middle((12, 14))]
    # The exact kernel moves light by z (tan - sin) of at most lambda / 2 pitch: 50 nm of 16 um, 3e-3 of a sample.
    assert numbers["isolated"]["efficiency"][0] == pytest.approx(exact.sum() / (24 * 27), rel=1e-3)


DEPTHS = (0.02, 0.03, -0.01)
LIGHT = "propagator={kind: fresnel, distance: [20 mm, 30 mm, -10 mm], boundary: %s}"


def in_focus(formed, kind: str):
    """One picture of intensities [D, H, W]: band d of D of the columns from depth d, or the mean of all."""
    if kind == "full":
        return formed.mean(0)
    picture, width = np.zeros(formed.shape[1:]), formed.shape[2]
    for d in range(len(formed)):
        band = slice(d * width // len(formed), (d + 1) * width // len(formed))
        picture[:, band] = formed[d][:, band]
    return picture


@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("kind", ["bands", "full"])
def test_depths_are_scored_where_they_are_in_focus(tmp_path, kind, frames):
    words = [LIGHT % "periodic", f"target.depths={kind}", f"frames={frames}"]
    field, target, saved, numbers = solved(tmp_path / "a", *words)
    assert field.shape == (frames, 3, *SHAPE) and saved.shape == target.shape == (3, *SHAPE)
    for c, wave in enumerate(WAVES):
        formed = [seen(array.periodic(field[:, c], PITCH, wave, distance)) for distance in DEPTHS]
        picture = in_focus(np.array(formed), kind)
        assert_scores(picture * target[c].mean(), target, saved, numbers, c)
        assert numbers["efficiency"][c] == pytest.approx(picture.mean(), rel=1e-9)


@pytest.mark.parametrize("kind", ["bands", "full"])
def test_depths_of_a_chip_that_stands_alone(tmp_path, kind):
    words = [LIGHT % "isolated", f"target.depths={kind}", "frames=2", "wavelengths=530 nm"]
    field, target, saved, numbers = solved(tmp_path / "a", *words)
    formed = [seen(array.alone(field[:, 0], PITCH, 530e-9, distance)) for distance in DEPTHS]
    picture = in_focus(np.array(formed), kind)
    assert_scores(array.at_best_scale(picture, target[0]), target, saved, numbers, 0)
    assert numbers["efficiency"][0] == pytest.approx(picture.mean(), rel=1e-7)
    assert numbers["isolated"]["ssim_mean"] == pytest.approx(numbers["ssim_mean"], abs=1e-3)


def test_frames_that_are_solved_for_together_form_a_better_mean(tmp_path):
    psnr = {}
    for how in ("joint", "independent"):
        field, target, saved, numbers = solved(tmp_path / how, "frames=3", f"multiplexing={how}")
        assert field.shape == (3, 3, *SHAPE) and numbers["frames"] == 3
        formed = seen(array.far(field))
        for c in range(3):
            assert_scores(formed[c] * target[c].mean(), target, saved, numbers, c)
        assert len({frame.tobytes() for frame in field}) == 3
        psnr[how] = numbers["psnr_mean"]
    assert psnr["joint"] > psnr["independent"] + 3  # dB; three independent speckles average to 4.8 dB less at best


@pytest.mark.parametrize("bits", [1, 3, 8, 16])
@pytest.mark.parametrize("words", [[], ["frames=2"], ["frames=2", "multiplexing=independent"]], ids=" ".join)
def test_coarse_heaters_have_their_steps(tmp_path, bits, words):
    field, target, saved, numbers = solved(tmp_path / "a", f"modulator.bits={bits}", *words)
    phase = np.load(tmp_path / "a" / "arrays" / "phase.npy")
    for hologram in phase.reshape(-1, *SHAPE):
        assert len(np.unique(hologram)) <= 2**bits
        steps = hologram.astype(np.float64) / hologram.max() * (2**bits - 1)
        assert np.abs(steps - steps.round()).max() <= 1e-6 * 2**bits  # rounding of float32, in steps
    formed = seen(array.far(field))
    for c in range(3):
        assert_scores(formed[c] * target[c].mean(), target, saved, numbers, c)


BASELINES = ("none", "chopping", "shifting", "nonnegative", "basic_ipec", "ipec")


@pytest.mark.parametrize(
    "words",
    [[], ["target.region=[12,12]"], ["propagator={kind: fresnel, distance: 20 mm}"], ["frames=2"]],
    ids=lambda words: " ".join(words) or "fourier",
)
def test_every_baseline_runs_and_is_reported(tmp_path, words, capsys, monkeypatch):
    monkeypatch.setattr(module, "PASSES", 20)
    listed = f"report.baselines=[{','.join(BASELINES)}]"
    assert execute(settings("solver={kind: lbfgs, max_steps: 60}", *words, listed), tmp_path / "a")[1]
    methods = json.loads((tmp_path / "a" / "summary.json").read_text())["methods"]
    assert list(methods) == ["corrected", *BASELINES]
    page = (tmp_path / "a" / "report.html").read_text()
    assert "Basic iterative correction (basic IPEC: no deconvolution)" in page
    assert "Iterative proximity effect correction (IPEC)" in page  # abbreviations are written out
    for name in BASELINES:
        caption = METHOD_NAMES[name]
        numbers = methods[name]
        assert np.isfinite([numbers["ssim_mean"], numbers["psnr_mean"], *numbers["peak_temperature_rise_K"]]).all()
        assert numbers["frames"] == 1 and 0 < min(numbers["efficiency"]) <= max(numbers["efficiency"]) <= 1 + 1e-9
        assert (tmp_path / "a" / "images" / f"{name}.png").is_file() and f"{caption}: SSIM" in page
        assert methods["corrected"]["psnr_mean"] > numbers["psnr_mean"]
    assert "left out" not in capsys.readouterr().err


def test_baselines_deconvolve_the_phases_of_no_correction():
    experiment = build(settings())
    phase = {name: baseline(experiment, name).x.double().cpu().numpy() for name in BASELINES[:4]}
    columns, rows = (array.spread(np.eye(n)[:, :, None], 0.66, 7)[..., 0] for n in SHAPE)
    exact = np.linalg.solve(columns, phase["none"]) @ np.linalg.inv(rows).T
    assert phase["none"].min() >= 0 and phase["none"].max() < 2 * np.pi and exact.min() < 0
    # Solved in float64 and rounded to float32, which is 1e-6 at 10 rad.
    assert phase["chopping"] == pytest.approx(exact.clip(0), abs=3e-6)
    assert phase["shifting"] == pytest.approx(exact - exact.min((1, 2), keepdims=True), abs=3e-6)
    left = {name: np.linalg.norm(array.spread(phase[name], 0.66, 7) - phase["none"]) for name in phase}
    assert phase["nonnegative"].min() == 0 and left["nonnegative"] < min(left["chopping"], left["none"])


def test_a_baseline_without_an_inverse_is_left_out_and_said(tmp_path, capsys):
    # Three taps t, 1, t on n = 23 pixels have the eigenvalues 1 + 2 t cos(k pi / 24): one is 0 at t = 1 / sqrt 2, where
    # exp(-1 / sigma^2) = 2^(-1/2).
    words = ["grid.shape=[23,23]", f"modulator={{sigma_px: {(2 / math.log(2)) ** 0.5!r}, kernel_size: 3}}"]
    baselines = "report.baselines=[none, chopping, shifting, nonnegative]"
    assert execute(settings(*words, baselines), tmp_path / "a")[1]
    lines = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert len(lines) == 2
    for name, line in zip(("chopping", "shifting"), lines, strict=True):
        assert f"{name} is left out: " in line and "has no inverse on (23, 23) px" in line
    methods = json.loads((tmp_path / "a" / "summary.json").read_text())["methods"]
    assert list(methods) == ["corrected", "none", "nonnegative"]


@pytest.mark.parametrize("frames", [1, 2])
def test_starts_are_what_their_names_say(frames):
    starts = {}
    for kind in ("hot", "cool", "flat", "quadratic"):
        experiment = build(settings(f"solver.start={kind}", f"frames={frames}"))
        start = experiment.start_phase()
        assert start.dtype == torch.float32 and start.min() >= 0
        starts[kind] = experiment.heater_phases(start).double().cpu().numpy()
        assert starts[kind].shape == (frames, 3, *SHAPE)
    spread = {kind: array.spread(phase, 0.66, 7) for kind, phase in starts.items()}
    assert 0.95 * 2 * np.pi < starts["hot"].max() < 2 * np.pi
    assert 0.7 * 2 * np.pi < spread["cool"].max() < 2 * np.pi
    assert 0.95 < starts["flat"].max() < 1
    y, x = np.arange(24)[:, None] - 12, np.arange(27)[None] - 13
    lens = np.pi * (y**2 / 24 + x**2 / 27)  # by pi per pixel at the edge
    # Three pixels from the edge all the heat arrives; spreading adds the lens's curvature times the kernel's width to a
    # parabola, pi (1/24 + 1/27) sigma^2 / 2 = 0.05 rad, and the noise 0.01 rad a pixel.
    inner = (..., slice(3, -3), slice(3, -3))
    assert np.abs(spread["quadratic"][inner] - lens[3:-3, 3:-3]).max() < 0.08


@pytest.mark.parametrize("kind", ["hot", "cool", "flat", "quadratic"])
def test_every_start_leads_to_a_picture(tmp_path, kind):
    _, _, _, numbers = solved(tmp_path / "a", "solver={kind: lbfgs, max_steps: 60}", f"solver.start={kind}")
    assert numbers["ssim_mean"] > 0.9


DARK = [
    ["target.region=[12,12]"],
    ["target.region=[12,12]", "propagator={kind: fresnel, distance: 20 mm}"],
    [LIGHT % "periodic"],
    [LIGHT % "isolated", "target.depths=full"],
    [LIGHT % "periodic", "multiplexing=independent"],
    ["modulator.max_phase=6", "modulator.bits=6", "target.region=[12,12]"],
    ["report.baselines=[none, chopping, shifting, nonnegative, basic_ipec, ipec]", "multiplexing=independent"],
]


@pytest.mark.parametrize("words", DARK, ids=" ".join)
def test_a_black_colour_stays_dark_in_every_scene(tmp_path, words, monkeypatch):
    monkeypatch.setattr(module, "PASSES", 20)
    pixels = np.random.default_rng(0).integers(20, 255, (24, 27, 3), dtype=np.uint8)
    pixels[..., 2] = 0  # red, as OpenCV orders
    cv2.imwrite(str(tmp_path / "cyan.png"), pixels)
    picture = f"target.image={tmp_path / 'cyan.png'}"
    field, target, saved, numbers = solved(tmp_path / "a", picture, "frames=2", *words)
    assert field.shape == (2, 3, *SHAPE) and np.array_equal(field[:, 0], np.ones((2, *SHAPE)))
    assert target[0].max() == saved[0].max() == 0 and saved[1:].max((1, 2)).min() > 0
    assert numbers["ssim"][0] == 1 and numbers["psnr"][0] is None
    for name in ("efficiency", "peak_temperature_rise_K", "heating_power_K_per_pixel"):
        assert numbers[name][0] == 0 < min(numbers[name][1:])
    assert numbers["ssim_mean"] == pytest.approx(np.mean(numbers["ssim"][1:]))
    with open(tmp_path / "a" / "metrics.csv") as stream:
        assert stream.readline().strip().endswith("ssim_mean,loss_530nm,loss_445nm")


def test_noise_in_a_measured_kernel_is_tried_on_four_chips(tmp_path):
    kernel = array.spread(np.pad([[1.0]], 2), 0.66, 5)
    np.save(tmp_path / "kernel.npy", kernel)
    scores = {}
    for noise in (1e-9, 0.01, 0.03):
        words = [f"modulator={{kernel: {tmp_path / 'kernel.npy'}}}", f"report.kernel_noise={noise}", "frames=2"]
        assert execute(settings(*words, "seed=5"), tmp_path / str(noise))[1]
        numbers = json.loads((tmp_path / str(noise) / "summary.json").read_text())["methods"]["corrected"]
        assert numbers["kernel_noise"].pop("noise") == noise
        scores[noise] = numbers["kernel_noise"]
        assert f"noise of {100 * noise:g} % of the centre" in (tmp_path / str(noise) / "report.html").read_text()
    assert scores[1e-9]["ssim_mean"] == pytest.approx([numbers["ssim_mean"]] * 4, abs=1e-5)
    assert (np.array(scores[0.01]["psnr_mean"]) > scores[0.03]["psnr_mean"]).all()  # three times the same noise
    phase, target = (np.load(tmp_path / "0.03" / "arrays" / f"{name}.npy") for name in ("phase", "target"))
    generator = torch.Generator().manual_seed(5)
    for psnr, ssim in zip(scores[0.03]["psnr_mean"], scores[0.03]["ssim_mean"], strict=True):
        other = kernel + 0.03 * torch.randn(5, 5, generator=generator, dtype=torch.float64).numpy()
        other[2, 2] = 1
        heat = [[convolve(one, other.clip(0, 1), mode="constant") for one in frame] for frame in phase.astype(float)]
        formed = seen(array.far(np.exp(1j * np.array(heat)))) * target.mean((1, 2), keepdims=True)
        assert psnr == pytest.approx(np.mean([array.psnr(formed[c], target[c]) for c in range(3)]), rel=1e-6)
        assert ssim == pytest.approx(np.mean([array.ssim(formed[c], target[c]) for c in range(3)]), abs=1e-6)


def test_heat_beyond_the_table_of_a_measured_kernel_is_tried(tmp_path):
    y, x = np.mgrid[-2:3, -2:3]
    np.save(tmp_path / "kernel.npy", np.exp(-np.hypot(y, x)))
    words = [f"modulator={{kernel: {tmp_path / 'kernel.npy'}}}", "frames=2"]
    assert execute(settings(*words), tmp_path / "run")[1]
    corrected = json.loads((tmp_path / "run" / "summary.json").read_text())["methods"]["corrected"]
    numbers = corrected["kernel_continued"]
    assert numbers["taps"] == [15, 15]  # exp(-7) is the last above a thousandth
    phase, target = (np.load(tmp_path / "run" / "arrays" / f"{name}.npy") for name in ("phase", "target"))
    y, x = np.mgrid[-7:8, -7:8]
    whole = np.exp(-np.hypot(y, x))
    heat = [[convolve(one, whole, mode="constant") for one in frame] for frame in phase.astype(float)]
    formed = seen(array.far(np.exp(1j * np.array(heat)))) * target.mean((1, 2), keepdims=True)
    assert numbers["ssim_mean"] == pytest.approx(
        np.mean([array.ssim(formed[c], target[c]) for c in range(3)]), abs=1e-6
    )
    assert numbers["ssim_mean"] < corrected["ssim_mean"]
    assert "if the rise falls on beyond it" in (tmp_path / "run" / "report.html").read_text()


def test_a_table_whose_opposite_taps_differ_is_tried_with_their_means(tmp_path):
    kernel = array.spread(np.pad([[1.0]], 2), 0.66, 5)
    kernel += 0.05 * kernel * (1 - kernel) * np.random.default_rng(2).normal(size=kernel.shape)
    np.save(tmp_path / "kernel.npy", kernel)
    assert execute(settings(f"modulator={{kernel: {tmp_path / 'kernel.npy'}}}", "frames=2"), tmp_path / "run")[1]
    corrected = json.loads((tmp_path / "run" / "summary.json").read_text())["methods"]["corrected"]
    numbers = corrected["kernel_even"]
    assert numbers["noise"] == pytest.approx(np.sqrt(((kernel - kernel[::-1, ::-1]) ** 2).mean() / 2), rel=1e-5)
    phase, target = (np.load(tmp_path / "run" / "arrays" / f"{name}.npy") for name in ("phase", "target"))
    means = (kernel + kernel[::-1, ::-1]) / 2
    heat = [[convolve(one, means, mode="constant") for one in frame] for frame in phase.astype(float)]
    formed = seen(array.far(np.exp(1j * np.array(heat)))) * target.mean((1, 2), keepdims=True)
    wanted = np.mean([array.psnr(formed[c], target[c]) for c in range(3)])
    assert numbers["psnr_mean"] == pytest.approx(wanted, rel=1e-5) and wanted < corrected["psnr_mean"]
    assert "if heat spreads as their means" in (tmp_path / "run" / "report.html").read_text()


def test_a_table_that_holds_the_heat_is_not_continued(tmp_path):
    np.save(tmp_path / "kernel.npy", array.spread(np.pad([[1.0]], 3), 0.66, 7))
    assert execute(settings(f"modulator={{kernel: {tmp_path / 'kernel.npy'}}}"), tmp_path / "run")[1]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert not {"kernel_continued", "kernel_even"} & set(summary["methods"]["corrected"])


def test_pictures_of_fewer_frames_or_too_much_heat_say_so(tmp_path, monkeypatch):
    captions = []
    monkeypatch.setattr(
        "holotorch.experiments.pec.run.figures.comparison", lambda pictures, names: captions.extend(names) or b""
    )
    words = ["modulator={sigma_px: 0.66, max_temperature: 200 degC}", "frames=2", "report.baselines=[none]"]
    assert execute(settings(*words), tmp_path / "run")[1]
    assert [name.split(", ", 2)[-1] for name in captions[1:2]] == ["1 frame, above the limit"]
    assert "frame" not in captions[2] and "limit" not in captions[2]
