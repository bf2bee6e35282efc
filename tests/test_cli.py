"""The command as a user meets it: exit statuses, messages without tracebacks, nothing imported needlessly."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from apart import start_apart
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.registry import find_kind, load_config

CONFIG = str(CONFIGS / "pec" / "fourier.yaml")
TINY = ["grid.shape=[16,16]", "solver.max_steps=2"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_run_prints_the_plan_and_ends_with_the_report(capsys):
    assert main(["run", CONFIG, *TINY]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Picture    astronaut") and lines[-1] == "runs/fourier-001/report.html"
    assert Path(lines[-1]).is_file()


def test_check_computes_and_writes_nothing(capsys, tmp_path):
    words = [CONFIG, "propagator={kind: fresnel, distance: 100 mm}"]
    assert main(["check", *words]) == 0
    out = capsys.readouterr().out
    kind = find_kind("pec")
    single = kind.plan(kind.build(load_config(words[0], words[1:]))).values["single_propagation"]
    assert "cropped kernel on 256 x 256 samples is the cheapest" in single["reason"]
    assert "paraxial kernel on twice the window" in out and "field of view" in out and "GB of memory" in out
    assert not list(tmp_path.iterdir())


HEAT = "Heat       "
NO_LIMIT = HEAT + "no limit, as in the thesis: the hottest pixel is reported"
SHARED = "700 / 589 / 494 degC above ambient of the colours, which share this limit"
FOUR_PI = f"{HEAT}the phase after spreading stays below 12.57 rad, {SHARED}"
RESPONSE = "; modulator.rad_per_K=0.01795 at 630 nm, that of the thesis's chip: give yours"
FRAMES = "Frames     4, shown in turn and solved for {}; the eye sees their mean"


@pytest.mark.parametrize("path", sorted(Path(CONFIG).parent.glob("*.yaml")), ids=lambda path: path.stem)
def test_check_says_how_hot_and_how_many_frames(path, capsys):
    assert main(["check", str(path)]) == 0
    out = capsys.readouterr().out.splitlines()
    capped = path.stem == "capped"
    assert [line for line in out if line.startswith(HEAT)] == [(FOUR_PI if capped else NO_LIMIT) + RESPONSE]
    assert [line for line in out if line.startswith("Frames")] == ([FRAMES.format("together")] if capped else [])
    assert main(["check", str(path), "frames=4", "multiplexing=independent", "modulator.bits=6"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert (FOUR_PI if capped else NO_LIMIT) + "; heaters with 64 steps" + RESPONSE in out
    assert FRAMES.format("one by one") in out
    (crosstalk,) = (line for line in out if line.startswith("Crosstalk"))
    assert (
        "warms one d px away by exp(-d^2/sigma^2) of its own rise; sigma is the usual Gaussian sigma times" in crosstalk
    )
    assert any("random heater phases" in line for line in out if line.startswith("Solver"))  # what a start is


def test_report_of_several_runs(capsys):
    for name in ("a", "b"):
        main(["run", CONFIG, *TINY, "--out", name])
    assert main(["report", "a"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "a/report.html"
    assert main(["report", "a", "b"]) == 0
    assert Path("report.html").is_file()


def test_demo_runs_on_bundled_data(capsys):
    assert main(["demo", "--out", "here"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "here/report.html"
    page = Path("here/report.html").read_text()
    assert "Corrected" in page and "Direct volume rendering" in page and "Synthetic volume" in page
    parts = {"correction", "volume", "tracking", "layout"}
    assert {path.name for path in Path("here").iterdir()} == {*parts, "report.html"}
    for part in ("tracking", "layout"):
        assert f'href="{part}/report.html"' in Path("here/report.html").read_text()
        assert Path(f"here/{part}/report.html").is_file()
    assert json.loads(Path("here/tracking/summary.json").read_text())["statuses"] == {"OK": 10}


def test_doctor(capsys):
    assert main(["doctor"]) == 0


def black(path):
    cv2.imwrite(path, np.zeros((20, 20), dtype=np.uint8))


def tiny(path):
    cv2.imwrite(path, np.full((8, 8), 200, dtype=np.uint8))


def not_a_number(path):
    cv2.imwrite(path, np.full((20, 20), np.nan, dtype=np.float32))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["modulator.sigma=1"], "modulator.sigma: unknown setting; did you mean 'sigma_px'?"),
        (["modulator.sigma_px=wide"], "modulator.sigma_px: expected a number, got 'wide'"),
        (["target.image=missing.png"], "no such picture: 'missing.png'"),
        (["grid.pitch=-9 um"], "grid.pitch: expected a length within 1 nm .. 2 mm"),
        (["wavelengths=[630 nm, 0, 445 nm]"], "wavelengths.1: expected a length within 10 nm .. 300 um, got 0"),
        (["grid.shape=[16,16]", "modulator.kernel_size=17"], "expected at most 16, the smaller side of the grid"),
        (["grid.shape=[8,8]"], "expected at least 11 x 11 px for ssim, got (8, 8); use a larger grid"),
        (["target.image=black.png"], "is black throughout; use another picture"),
        (
            ["target.image=tiny.png"],
            "is 8 x 8 px, less than the 11 x 11 px window of the image metric SSIM; use a larger one",
        ),
        (["target.image=nan.tiff"], "is nan (400 in all); repair the picture"),
        (["--out", "file/inside"], "cannot write to file/inside: Not a directory; choose another place with --out"),
        (["a=1", "b=2", "grid=3", "seed=x", "solver.kind=y"], "solver.kind: expected one of apg, adam, lbfgs, got 'y'"),
    ],
)
@pytest.mark.parametrize("command", ["run", "check"])
def test_bad_input_exits_2_and_says_what_to_change(command, words, message, capsys):
    if command == "check" and "--out" in words:
        pytest.skip("check writes nothing, so it takes no --out")
    for make, path in ((black, "black.png"), (tiny, "tiny.png"), (not_a_number, "nan.tiff")):
        make(path)
    Path("file").write_text("")
    assert main([command, CONFIG, *words]) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    if words[0] == "a=1":
        assert len(error.splitlines()) == 5
    assert not Path("runs").exists()


def test_a_missing_configuration(capsys):
    assert main(["run", "none.yaml"]) == 2
    assert "none.yaml: cannot read the configuration: No such file or directory" in capsys.readouterr().err


def test_unknown_commands_exit_2(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["rum", CONFIG])
    assert caught.value.code == 2


def test_a_full_disk_is_a_failure_without_a_traceback(monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device", "runs/a/arrays/phase.npy")

    monkeypatch.setattr("holotorch.experiments.pec.run.save_array", full)
    assert main(["run", CONFIG, *TINY]) == 1
    assert "runs/a/arrays/phase.npy: No space left on device" in capsys.readouterr().err
    (folder,) = Path("runs").iterdir()  # with all that could be written
    assert (folder / "checkpoint.pt").is_file() and (folder / "interrupted.json").is_file()


def test_a_reader_that_leaves_early_is_no_error():
    done = subprocess.run(
        f"{sys.executable} -m holotorch keys pec | head -1", shell=True, capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("experiment") and done.stderr == ""


def test_out_of_memory_is_a_failure_without_a_traceback(monkeypatch, capsys):
    def greedy(*_):
        import torch

        return torch.empty(2**60, dtype=torch.float32)

    monkeypatch.setattr("holotorch.experiments.pec.experiment.PECExperiment.solve", greedy)
    assert main(["run", CONFIG, *TINY]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "out of memory; use a smaller grid"


def test_check_says_when_a_run_will_not_fit(capsys):
    assert main(["check", CONFIG, "grid.shape=16384"]) == 2
    captured = capsys.readouterr()
    assert "GB of memory at the peak" in captured.out and "the run needs about" in captured.err


def end_with(words: list[str]) -> None:
    sys.exit(main(words))


def test_ctrl_c_exits_130_and_saves(tmp_path):
    """The real signal, sent to a real process in the middle of its work."""
    words = ["run", CONFIG, "grid.shape=[16,16]", "solver.max_steps=100000", "solver.tolerance=0", "--out", "cut"]
    said = tmp_path / "said"
    process, deadline = start_apart(end_with, words, said=said), time.monotonic() + 120
    while not (said.exists() and b"ssim=" in said.read_bytes()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert process.pid
    os.kill(process.pid, signal.SIGINT)
    process.join(120)
    assert process.exitcode == 130, said.read_text()[-2000:]
    assert (tmp_path / "cut" / "interrupted.json").is_file() and not (tmp_path / "cut" / "summary.json").exists()
    phase = np.load(tmp_path / "cut" / "arrays" / "phase.npy")
    assert np.isfinite(phase).all() and phase.max() > 0


def imported(code: str) -> set[str]:
    words = f"import sys; {code}; print('\\n'.join(sys.modules))"
    return set(subprocess.run([sys.executable, "-c", words], check=True, capture_output=True, text=True).stdout.split())


def test_import_and_help_load_nothing_heavy():
    heavy = {"torch", "numpy", "cv2", "colour", "kornia", "matplotlib", "pydantic", "yaml", "tqdm"}
    assert not heavy & imported("import holotorch")
    help_page = "from holotorch.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass"
    assert not heavy & imported(f"exec({help_page!r})")


def test_importing_the_library_opens_no_file_and_sets_no_global(tmp_path):
    code = """
import sys, warnings
import torch
def state():
    return torch.get_default_dtype(), torch.get_num_threads(), list(warnings.filters), torch.get_rng_state().sum()
before = state()
opened = []
def watch(event, arguments):
    if event == "open" and arguments[1] is not None and not str(arguments[0]).endswith((".py", ".pyc")):
        opened.append(arguments[0])
sys.addaudithook(watch)
import holotorch, holotorch.optics, holotorch.modulator, holotorch.correction, holotorch.metrics
holotorch.Grid
assert before == state()
assert not opened, opened
assert not {"cv2", "colour", "kornia", "matplotlib", "pydantic", "jinja2"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert not list(tmp_path.iterdir())
