"""An own chip: a measured kernel, its limits in its own units, and files for its heaters."""

import csv
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from paths import CONFIGS
from tiny_runs import RUNS

from holotorch.cli import main
from holotorch.experiments.execute import execute
from holotorch.experiments.panel.heaters import export_heaters, heaters_text
from holotorch.experiments.registry import load_config
from holotorch.experiments.view.opening import open_viewer
from holotorch.io.panel_files import read_levels

SMALL = ["configs/pec/fourier.yaml", "grid.shape=[24,20]", "report.baselines=[]", "solver={kind: lbfgs, max_steps: 8}"]


def kernel(sigma: float = 0.66, size: int = 5, scale: float = 130.0) -> np.ndarray:
    y, x = np.mgrid[:size, :size] - size // 2
    return scale * np.exp(-(y**2 + x**2) / sigma**2)


@pytest.fixture(scope="module")
def known(tmp_path_factory, tiny) -> np.ndarray:
    """Phases of a run whose kernel is a Gaussian by its sigma."""
    folder = tmp_path_factory.mktemp("known") / "a"
    assert main(["run", *SMALL, "modulator={sigma_px: 0.66, kernel_size: 5}", "--out", str(folder)]) == 0
    return np.load(folder / "arrays" / "phase.npy")


@pytest.mark.parametrize("suffix", ["npy", "csv", "txt"])
def test_a_measured_gaussian_gives_what_its_sigma_gives(known, tmp_path, suffix, capsys):
    path = tmp_path / f"kernel.{suffix}"
    if suffix == "npy":
        np.save(path, kernel())
    else:
        np.savetxt(path, kernel(), delimiter="," if suffix == "csv" else " ", fmt="%.17g")
    assert main(["run", *SMALL, f"modulator={{kernel: {path}}}", "--out", str(tmp_path / "b")]) == 0
    other = np.load(tmp_path / "b" / "arrays" / "phase.npy")
    np.testing.assert_allclose(known, other, rtol=0, atol=2e-3)  # eight steps from phases of 6 rad, in float32
    plan = json.loads((tmp_path / "b" / "plan.json").read_text())["crosstalk"]
    assert plan["fitted_sigma_px"] == pytest.approx(0.66, abs=1e-3) and plan["fit_residual"] < 1e-3
    said = capsys.readouterr().out
    assert "has sigma 0.66 px" in said and "would not represent" not in said and "cut off" not in said


def test_a_kernel_that_is_no_gaussian_is_said(tmp_path, capsys):
    y, x = np.mgrid[-3:4, -3:4]
    np.savetxt(tmp_path / "kernel.csv", np.exp(-np.hypot(y, x) / 0.6), delimiter=",")
    assert main(["check", *SMALL, f"modulator={{kernel: {tmp_path / 'kernel.csv'}}}"]) == 0
    said = capsys.readouterr().out
    assert (
        "a sigma alone would not represent this kernel" in said and "cut off" not in said
    )  # exp(-5) at the nearest border


@pytest.mark.parametrize("noise", [0.0, 3e-3])
def test_noise_of_a_measured_kernel_is_estimated(tmp_path, capsys, noise):
    """32 taps are 16 pairs: the estimate has a deviation of 18 %."""
    y, x = np.mgrid[-4:5, -4:5]
    rise = 2.5 * (np.exp(-np.hypot(y, x) / 1.2) + noise * np.random.default_rng(1).normal(size=y.shape))
    np.savetxt(tmp_path / "kernel.csv", rise, delimiter=",")
    assert main(["check", *SMALL, f"modulator={{kernel: {tmp_path / 'kernel.csv'}}}"]) == 0
    said = re.search(r"report.kernel_noise=(\S+) tells", capsys.readouterr().out)
    assert (float(said[1]) if said else 0.0) == pytest.approx(noise, rel=0.5)


def test_a_kernel_that_is_cut_off_while_it_is_warm_is_noted(tmp_path, capsys):
    """exp(-d) on the rows 3 px from the centre, the warmer sides: a mean of 2.7 %."""
    y, x = np.mgrid[-3:4, -4:5]
    rise = np.exp(-np.hypot(y, x))
    np.savetxt(tmp_path / "kernel.csv", rise, delimiter=",")
    assert main(["check", *SMALL, f"modulator={{kernel: {tmp_path / 'kernel.csv'}}}"]) == 0
    assert f"cut off where the rise is still {rise[0].mean():.1%} of that of its centre" in capsys.readouterr().out


def test_a_kernel_beside_a_sigma_is_told_how_to_take_its_place(tmp_path, capsys):
    path = tmp_path / "kernel.npy"
    np.save(path, kernel())
    assert main(["check", *SMALL, f"modulator.kernel={path}"]) == 2
    assert f"got both; to use the file give 'modulator={{kernel: {path}}}'\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("kernel.csv", "1,2\n3", "expected a table of temperature rises, a line for each row of pixels"),
        ("kernel.csv", "0,1,0\n1,2,9\n0,1,0", "kernel.csv must hold rises >= 0 with the heated centre the warmest"),
        ("kernel.csv", "0,1\n1,2", "two odd sizes"),
        (
            "kernel.csv",
            "0,0,0,0\n0,1,0,0\n1,9,2,0\n0,1,0,0",
            "; the warmest pixel is in row 3, column 2 of the file: keep rows 2 to 4 and columns 1 to 3",
        ),
        ("kernel.csv", "0,1\n1,2", "; 2 x 2: add or drop a row and a column so that the heated pixel is in the middle"),
        ("kernel.csv", "1,2,1\n0,1,0", "; 2 x 3: add or drop a row so that the heated pixel is in the middle"),
        ("kernel.csv", "9,1,0\n1,2,1\n0,1,0", "in row 1, column 1 of the file: it needs neighbours on all sides"),
        ("kernel.csv", "-1,-0.5,-1\n-0.5,-0.2,3\n-1,-0.5,-1", "rises are negative (-1 ... -0.2): subtract the ambient"),
        ("kernel.csv", "0,1,0\n1,9,1\n0,1,-0.1", "rises are negative (-0.1 ... -0.1), as noise is: average more"),
        ("kernel.csv", "1,0,0\n0,1,0\n0,0,1", "in rows 1, 3 of the file, 2 pixels are as warm as the heated pixel in"),
        (
            "kernel.csv",
            "0,0,0\n1,1,0\n0,0,0",
            "pixels of row 2 are as warm as the heated pixel in the middle (1.0): is",
        ),
        ("kernel.png", "no numbers", "levels of a picture are no temperatures, write the rises as numbers"),
        ("kernel.csv", "0,1,0\n1,nan,1\n0,1,0", "kernel.csv must be finite, but element (1, 1) is nan"),
        ("kernel.npy", "no array", "expected a table"),
        ("kernel.mat", "0", "expected a heat kernel as .npy, .csv or .txt"),
    ],
)
def test_what_is_no_kernel_is_said(tmp_path, name, text, message, capsys):
    (tmp_path / name).write_text(text)
    assert main(["check", *SMALL, f"modulator={{kernel: {tmp_path / name}}}"]) == 2
    error = capsys.readouterr().err
    assert message.lower() in error.lower() and "modulator.kernel" in error


@pytest.mark.parametrize(
    ("modulator", "message"),
    [
        ("{}", "expected sigma_px, or kernel with a file in its place, got neither"),
        ("{sigma_px: 0.66, max_phase: 4pi, max_temperature: 500 degC}", "expected one limit"),
        ("{sigma_px: 0.66, max_phase: 500 degC}", "expected a phase such as 4pi"),
        ("{sigma_px: 0.66, max_temperature: 4pi}", "expected a temperature above ambient such as 500 degC"),
    ],
)
def test_settings_of_a_chip_that_contradict_each_other(modulator, message, capsys):
    assert main(["check", *SMALL, f"modulator={modulator}"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("text", "pis"), [("4pi", 4), ("2.5 pi", 2.5), ("pi", 1), ("6.283185307179586", 2)])
def test_phases_in_units_of_pi(text, pis):
    settings = load_config(SMALL[0], ["solver={kind: lbfgs}", f"modulator={{sigma_px: 0.66, max_phase: {text}}}"])
    assert settings.modulator.max_phase == pytest.approx(pis * math.pi, rel=1e-15)


def test_heater_files_say_what_they_are_and_agree(tmp_path, capsys):
    chip = "{sigma_px: 0.66, kernel_size: 5, max_temperature: 300 degC, rad_per_K: 0.03}"
    run, out = tmp_path / "run", tmp_path / "run" / "heaters"
    assert main(["run", *SMALL, f"modulator={chip}", "frames=2", "--out", str(run)]) == 0
    rises = json.loads((run / "summary.json").read_text())["methods"]["corrected"]["peak_temperature_rise_K"]
    assert main(["export-heaters", str(run), "--bits", "8"]) == 0
    assert "before the heat spreads" in capsys.readouterr().out
    report, phase = json.loads((out / "export.json").read_text()), np.load(run / "arrays" / "phase.npy")
    assert len(report["files"]) == 4 * 2 * 3 and report["frames"] == 2
    assert report["peak_temperature_K"] == pytest.approx(max(rises), rel=1e-5)
    assert report["peak_temperature_K"] <= 300 * (1 + 1e-6)
    taps = torch.from_numpy(kernel(scale=1.0))[None, None]
    response = [0.03 * 630e-9 / wavelength for wavelength in report["wavelengths_m"]]
    for entry in report["files"]:
        frame, colour = entry["frame"], report["wavelengths_m"].index(entry["wavelength_m"])
        heater = torch.from_numpy(phase[frame, colour]).double()
        optical = torch.nn.functional.conv2d(heater[None, None], taps, padding=2)[0, 0]
        wanted = {"heater": heater, "rise": heater / response[colour], "optical": optical}
        wanted = (wanted | {"temperature": optical / response[colour]})[entry["quantity"]]
        array = np.load(out / entry["files"][0])
        np.testing.assert_allclose(array, wanted, rtol=1e-5, atol=1e-5)
        with open(out / entry["files"][1], newline="") as stream:
            table = [[float(value) for value in row] for row in csv.reader(stream)]
        np.testing.assert_allclose(table, array, rtol=1e-5, atol=1e-5)
        levels, about = read_levels(out / entry["files"][2])
        np.testing.assert_allclose(levels.numpy() * about["step"], array, atol=0.51 * about["step"] + 1e-5)
        assert (about["unit"], about["quantity"]) == (entry["unit"], entry["quantity"])
        if entry["quantity"] == "heater":
            integers = np.loadtxt(out / entry["files"][3], delimiter=",", dtype=int)
            assert levels.int().max() <= 255 and np.array_equal(integers, levels.int().numpy())
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    for number in ("002", "003"):  # as folders of runs number themselves
        assert main(["export-heaters", str(run), "--bits", "8"]) == 0
        assert capsys.readouterr().out.splitlines()[-1] == f"{out}-{number}"
        assert {path.name: path.read_bytes() for path in Path(f"{out}-{number}").iterdir()} == before
    assert main(["export-heaters", str(run), "--out", str(out)]) == 2
    assert "holds files already" in capsys.readouterr().err
    assert main(["export-heaters", str(tmp_path)]) == 2 and "holds no run" in capsys.readouterr().err


def test_heat_that_is_left_from_earlier_frames_is_in_the_files(tiny, tmp_path):
    config, *words = RUNS["joint"]
    words += ["report.baselines=[]", "heat={frame_us: 20, time_constant_us: 10}", "display.sigma_px=0.66"]
    run = tmp_path / "run"
    assert execute(load_config(CONFIGS / config, words), run)[1]
    _, report = export_heaters(run)
    phase = np.load(run / "arrays" / "phase.npy").astype(float)
    rows, columns = (np.exp(-(np.subtract.outer(range(n), range(n)) ** 2) / 0.66**2) for n in phase.shape[-2:])
    warm, wanted = np.zeros(phase.shape[1:]), np.zeros_like(phase)
    for _ in range(20):  # cycles from a cold chip; exp(-2) of the heat is left after each frame
        for frame, steady in enumerate(rows @ phase @ columns):
            warm = steady + (warm - steady) * math.exp(-2)
            wanted[frame] = warm
    # The heat that is left is far above the tolerance: the test can fail.
    assert np.abs(wanted - rows @ phase @ columns).max() > 0.1
    for entry in report["files"]:
        if entry["quantity"] == "optical":
            array = np.load(run / "heaters" / entry["files"][0])
            np.testing.assert_allclose(array, wanted[entry["frame"], entry["colour"]], rtol=1e-5, atol=1e-4)
    response = [math.pi / 175 * 630e-9 / wavelength for wavelength in report["wavelengths_m"]]
    hottest = (wanted / np.array(response)[:, None, None]).max()
    assert report["peak_temperature_K"] == pytest.approx(hottest, rel=1e-4)


def test_a_volume_keeps_a_limit_in_degrees_of_an_own_chip(tiny, tmp_path):
    config, *words = RUNS["joint"]
    words += ["report.baselines=[]", "display.max_temperature=150 degC", "display.rad_per_K=0.03", "steps=20"]
    run = tmp_path / "run"
    assert execute(load_config(CONFIGS / config, words), run)[1]
    _, report = export_heaters(run)
    wavelengths = report["wavelengths_m"]
    assert report["rad_per_K"] == pytest.approx([0.03 * 630e-9 / wavelength for wavelength in wavelengths])
    assert report["limit_rad"] == pytest.approx(150 * 0.03 * 630e-9 / max(wavelengths))
    assert 100 < report["peak_temperature_K"] <= 150 * (1 + 1e-6)


def test_coarse_levels_above_the_limit_are_warned_of_and_files_of_near_colours_stay_apart(tmp_path, capsys):
    chip = "{sigma_px: 0.66, kernel_size: 5, max_temperature: 300 degC, rad_per_K: 0.03}"
    run = tmp_path / "run"
    words = [*SMALL, f"modulator={chip}", "wavelengths=[532.4 nm, 531.9 nm, 445 nm]", "--out", str(run)]
    assert main(["run", *words]) == 0
    capsys.readouterr()
    assert main(["export-heaters", str(run)]) == 0 and "WARNING" not in capsys.readouterr().out
    report = json.loads((run / "heaters" / "export.json").read_text())
    names = [name for entry in report["files"] for name in entry["files"]]
    assert len(names) == len(set(names)) == 3 * (4 * 3 + 1) and all(
        (run / "heaters" / name).is_file() for name in names
    )
    coarse = tmp_path / "coarse"
    assert main(["export-heaters", str(run), "--bits", "1", "--out", str(coarse)]) == 0
    assert "WARNING: rounded to 1 bits" in capsys.readouterr().out
    report = json.loads((coarse / "export.json").read_text())
    taps, peaks = torch.from_numpy(kernel(scale=1.0))[None, None], []
    for entry in report["files"]:
        if entry["quantity"] == "heater":
            levels, about = read_levels(coarse / entry["files"][2])
            driven = levels.double()[None, None] * about["step"]
            peaks.append(torch.nn.functional.conv2d(driven, taps, padding=2).max().item())
    assert report["peak_phase_of_levels_rad"] == pytest.approx(max(peaks), rel=1e-9)
    assert max(peaks) > report["limit_rad"] == pytest.approx(300 * 0.03 * 630 / 532.4)


def test_levels_above_the_limit_by_a_hair_are_warned_of_and_16_bits_are_not(tmp_path):
    chip = "{sigma_px: 0.66, kernel_size: 5, max_phase: 6.3}"
    run = tmp_path / "run"
    assert main(["run", *SMALL, f"modulator={chip}", "--out", str(run)]) == 0
    phase = torch.from_numpy(np.load(run / "arrays" / "phase.npy")).double()
    taps = torch.from_numpy(kernel(scale=1.0)).expand(phase.shape[1], 1, 5, 5)
    phase *= 6.3 / torch.nn.functional.conv2d(phase, taps, padding=2, groups=phase.shape[1]).max()  # at the limit
    np.save(run / "arrays" / "phase.npy", phase.float().numpy())
    excess = {}
    for bits in range(6, 17):
        _, report = export_heaters(run, bits=bits)
        excess[bits] = report["peak_phase_of_levels_rad"] / report["limit_rad"] - 1
        assert ("WARNING" in heaters_text(report)) == (excess[bits] > 5e-5)
    assert excess[16] < 5e-5 and any(5e-5 < each < 1e-3 for each in excess.values())


def test_an_export_that_fails_leaves_no_files(tmp_path, capsys, monkeypatch):
    run, out = tmp_path / "run", tmp_path / "out"
    assert main(["run", *SMALL, "modulator={sigma_px: 0.66}", "--out", str(run)]) == 0
    with monkeypatch.context() as patch:

        def full(*_):
            raise OSError(28, "No space left on device", "a.png")

        patch.setattr("holotorch.experiments.panel.heaters.write_levels", full)
        assert main(["export-heaters", str(run), "--out", str(out)]) != 0
    assert not out.exists()
    np.save(run / "arrays" / "phase.npy", np.load(run / "arrays" / "phase.npy")[..., 1:])
    capsys.readouterr()
    assert main(["export-heaters", str(run), "--out", str(out)]) == 2
    assert "phase.npy must have the shape (F, C, H, W)" in capsys.readouterr().err and not out.exists()


def test_the_view_of_an_own_chip_tells_its_temperature(tmp_path):
    run = tmp_path / "run"
    assert main(["run", *SMALL, "modulator={sigma_px: 0.66, rad_per_K: 0.03}", "--out", str(run)]) == 0
    rises = json.loads((run / "summary.json").read_text())["methods"]["corrected"]["peak_temperature_rise_K"]
    viewer = open_viewer(run)
    with torch.no_grad():
        seen = viewer.show({control.name: control.value for control in viewer.controls}, False, lambda: None)
    assert seen.numbers["hottest pixel"] == f"{max(rises):.0f} degC above ambient"
