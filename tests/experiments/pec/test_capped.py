"""A limit on the heat is kept by the phases that are saved, whatever else is asked for."""

import json
import re
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
from oracles import array
from paths import CONFIGS

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.pec import run as run_module
from holotorch.experiments.pec.experiment import build
from holotorch.experiments.pec.progress import Log
from holotorch.experiments.registry import load_config

pytestmark = pytest.mark.usefixtures("tiny")
CONFIG = CONFIGS / "pec" / "capped.yaml"
SMALL = ["grid.shape=[24,20]", "grid.pitch=15.625 um", "solver.max_steps=14", "frames=1", "report.baselines=[]"]
WAVES = np.array([630e-9, 530e-9, 445e-9])


def limited(folder: Path, *overrides: str, complete: bool = True):
    """A run's phases, their spread by the oracle, and the settings, numbers and number of taps that it saved."""
    settings = load_config(CONFIG, [*SMALL, *overrides])
    assert execute(settings, folder)[1] == complete
    phase = np.load(folder / "arrays" / "phase.npy").astype(np.float64)
    taps = json.loads((folder / "plan.json").read_text())["crosstalk"]["taps"]
    summary = json.loads((folder / ("summary.json" if complete else "interrupted.json")).read_text())
    spread = array.spread(phase, settings.modulator.sigma_px, taps)
    return phase, spread, summary["methods"]["corrected"]


def assert_kept(spread, numbers, limit: float) -> None:
    peak = spread.max((0, 2, 3))
    # One that is not reached tests nothing; four turns are more than frames that share an image need.
    assert peak.max() > 0.9 * limit or limit > 12
    assert peak.max() <= limit
    # Taps below 1e-12 of the centre are left out by the array; float64 sums round by less.
    assert numbers["peak_phase_rad"] == pytest.approx(peak.max(), rel=1e-9)
    assert numbers["peak_phase_rad"] <= limit
    kelvin = 175 / np.pi * WAVES / 630e-9
    assert numbers["peak_temperature_rise_K"] == pytest.approx(peak * kelvin, rel=1e-9)
    assert numbers["mean_temperature_rise_K"] == pytest.approx(spread.mean((0, 2, 3)) * kelvin, rel=1e-9)


NEAR = "propagator={kind: fresnel, distance: 20 mm}"


@pytest.mark.parametrize(
    ("sigma", "limit", "overrides"),
    [
        (0, 4.0, []),
        (0.3, 6.0, ["frames=2"]),
        (0.66, 6.0, []),
        (0.66, 12.566370614359172, ["frames=2"]),  # 4 pi
        (1.5, 9.0, []),
        (3, 20.0, ["frames=2"]),
        (0.66, 1.0, []),  # less than a turn
        (0.66, 3.0, [NEAR, "solver.start=hot"]),
        (1.5, 6.0, [NEAR, "frames=2", "solver.start=hot"]),
        (0.66, 6.0, [NEAR, "propagator.boundary=periodic"]),
        (1.5, 9.0, [NEAR, "propagator.boundary=periodic", "frames=2"]),
        (0.66, 6.0, ["frames=2", "multiplexing=independent"]),
        (0.66, 6.0, ["target.region=[12,12]"]),
        (0.66, 6.0, ["solver.start=quadratic", "modulator.bits=12"]),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, list) else str(value),
)
def test_the_hottest_pixel_never_passes_the_limit(tmp_path, sigma, limit, overrides):
    words = [f"modulator={{sigma_px: {sigma}, max_phase: {limit!r}}}", *overrides]
    phase, spread, numbers = limited(tmp_path / "a", *words)
    assert (phase >= 0).all()
    assert_kept(spread, numbers, limit)


@pytest.mark.parametrize("bits", [1, 2, 4, 6])
@pytest.mark.parametrize("frames", [1, 2])
def test_the_heaters_steps_keep_it_too(tmp_path, bits, frames):
    """Rounding to a step moves a phase up as often as down."""
    words = ["modulator.max_phase=6", f"modulator.bits={bits}", f"frames={frames}"]
    phase, spread, numbers = limited(tmp_path / "a", *words)
    assert_kept(spread, numbers, 6.0)
    assert all(len(np.unique(each)) <= 2**bits for each in phase.reshape(-1, 24, 20))


def test_what_an_interrupted_run_saves_keeps_it(tmp_path, monkeypatch):
    class Stopped(Log):
        def __call__(self, solution):
            super().__call__(solution)
            if len(solution.losses) == 7:  # in the first of the stages that only penalise what passes the limit
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(run_module, "Log", Stopped)
    _, spread, numbers = limited(tmp_path / "a", "modulator.max_phase=6", "frames=2", complete=False)
    assert_kept(spread, numbers, 6.0)


def test_a_dark_colour_stays_cold(tmp_path):
    pixels = np.random.default_rng(0).integers(20, 255, (24, 20, 3), dtype=np.uint8)
    pixels[..., 1] = 0
    cv2.imwrite(str(tmp_path / "no_green.png"), pixels)
    words = [f"target.image={tmp_path / 'no_green.png'}", "modulator.max_phase=6", "frames=2"]
    phase, spread, numbers = limited(tmp_path / "a", *words)
    assert phase.shape == (2, 3, 24, 20) and phase[:, 1].max() == 0
    assert_kept(spread, numbers, 6.0)


@pytest.mark.parametrize("solver", ["{kind: apg}", "{kind: adam}"])
def test_solvers_that_keep_no_limit_are_refused(solver):
    with pytest.raises(ConfigError) as caught:
        load_config(CONFIG, [f"solver={solver}"])
    assert len(caught.value.mistakes) == 1
    assert caught.value.mistakes[0].startswith(f"{CONFIG}:")
    assert caught.value.mistakes[0].endswith(
        "modulator.max_phase: only the solver lbfgs keeps a limit; use solver=lbfgs, or leave it out"
    )


@pytest.mark.parametrize("limit", ["0", "-1", "0.05", "1001", ".inf", ".nan", "hot"])
def test_impossible_limits_are_refused(limit):
    with pytest.raises(ConfigError, match="modulator.max_phase: expected"):
        load_config(CONFIG, [f"modulator.max_phase={limit}"])


def test_four_frames_within_four_pi_form_a_photograph(tmp_path):
    words = ["grid.shape=48", "frames=4", "solver.max_steps=300", "target.image=coffee"]
    _, spread, numbers = limited(tmp_path / "a", *words)
    assert_kept(spread, numbers, 4 * np.pi)
    target = np.load(tmp_path / "a" / "arrays" / "target.npy")
    formed = (np.abs(array.far(np.exp(1j * spread))) ** 2).mean(0)
    scores = [array.ssim(formed[c] * target[c].mean(), target[c]) for c in range(3)]
    assert numbers["ssim"] == pytest.approx(scores, abs=1e-9)
    assert min(scores) >= 0.99


def test_a_weight_on_the_heating_power_lowers_it(tmp_path):
    powers = []
    for weight in (0.0, 1.0):
        execute(load_config(CONFIG, [*SMALL, f"modulator.power_weight={weight}"]), tmp_path / str(weight))
        numbers = json.loads((tmp_path / str(weight) / "summary.json").read_text())["methods"]["corrected"]
        powers.append(sum(numbers["heating_power_K_per_pixel"]))
    assert powers[1] < 0.9 * powers[0]


def test_a_report_says_which_methods_show_fewer_frames(tmp_path):
    execute(load_config(CONFIG, [*SMALL, "frames=2", "report.baselines=[none]"]), tmp_path / "two")
    page = (tmp_path / "two" / "report.html").read_text()
    assert "<th>frames</th>" in page and "compared with show a single frame" in page
    for caption in (
        "Heater phases, before the heat spreads",
        "Temperature of the chip above ambient, after the heat has",
    ):
        assert re.search(f"{caption}[^<]*; frame 1 of 2, arrays/phase.npy holds all", page)
    assert "SSIM half a sample off" in page and "midway between four samples" in page
    execute(load_config(CONFIG, [*SMALL, "report.baselines=[none]"]), tmp_path / "one")
    page = (tmp_path / "one" / "report.html").read_text()
    assert "single frame" not in page and "frame 1" not in page


@pytest.mark.parametrize("frames", [1, 3])
def test_maps_name_the_frame_that_they_show(tmp_path, monkeypatch, frames):
    titles = []
    monkeypatch.setattr(run_module.figures, "channel_maps", lambda values, names, *_: titles.append(names) or b"")
    execute(load_config(CONFIG, [*SMALL, f"frames={frames}"]), tmp_path / "a")
    wavelengths = ["630 nm", "530 nm", "445 nm"]
    assert titles == 2 * [wavelengths if frames == 1 else [f"{each}, frame 1 of 3" for each in wavelengths]]


def test_a_checkpoint_with_other_axes_is_refused(tmp_path):
    """Joint frames were [C, F, H, W] in checkpoints of version 0.1.0, and with F = C only the fingerprint tells."""
    joint, alone = (build(load_config(CONFIG, [*SMALL, f"frames={frames}"])) for frames in (3, 1))
    assert run_module._fingerprint(joint)["axes of joint frames"] == "F, C, H, W"
    assert "axes of joint frames" not in run_module._fingerprint(alone)
