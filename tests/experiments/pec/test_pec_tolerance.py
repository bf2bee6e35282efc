"""One tolerance of a run of kind pec: its shares, the settings that win over them, and the measured errors."""

import json

import numpy as np
import pytest
from paths import CONFIGS
from tiny_runs import command

from holotorch.cli import main
from holotorch.experiments.execute import check
from holotorch.experiments.pec.experiment import PECExperiment, build
from holotorch.experiments.pec.measured import pec_errors
from holotorch.experiments.pec.run import _fingerprint
from holotorch.experiments.planning.correction import NO_STEP
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs.fingerprint import differences

pytestmark = pytest.mark.usefixtures("tiny")
SMALL = ["device=cpu", "grid.shape=[32, 28]", "report.baselines=[]", "modulator={sigma_px: 1.0}"]


def settings(*words: str, file: str = "fourier"):
    return load_config(CONFIGS / "pec" / f"{file}.yaml", [*SMALL, *words])


def parts(values) -> dict[str, dict]:
    return {each["part"]: each for each in values["tolerances"]}


def test_without_a_tolerance_nothing_changes():
    for solver, stop in (("apg", 1e-3), ("adam", 1e-3), ("lbfgs", 1e-4)):
        plan = check(settings(f"solver={{kind: {solver}}}"))
        assert plan.values["stop_below"] == stop and plan.values["tolerance"] is None
        assert plan.values["crosstalk"]["taps"] == 7 and "complex64 in the solver" in plan.values["precision"]
        assert "Tolerance  " in plan.text and "by default" in plan.text


def test_a_tolerance_reaches_kernel_solver_and_precision():
    solver = "solver={kind: lbfgs, max_steps: 20}"
    loose, tight = (check(settings(f"tolerance={each}", solver)) for each in (0.05, 1e-4))
    assert loose.values["crosstalk"]["taps"] < tight.values["crosstalk"]["taps"] <= 7
    assert loose.values["stop_below"] > 1e3 * tight.values["stop_below"]
    assert "complex64 in the solver" in loose.text and "complex128 in the solver" in tight.text
    for plan, tolerance in ((loose, 0.05), (tight, 1e-4)):
        assert plan.values["predicted_error"] == pytest.approx(tolerance, rel=1e-3)
        assert f"Tolerance  {tolerance:.1e} = " in plan.text and "exceeds" not in plan.text


def test_settings_of_the_parts_win_and_count():
    own = ["modulator={sigma_px: 1.0, kernel_size: 3}", "solver={kind: apg, tolerance: 1e-2}"]
    plan = check(settings("tolerance=1e-3", *own))
    assert plan.values["crosstalk"]["taps"] == 3 and plan.values["stop_below"] == 1e-2
    assert parts(plan.values)["heat"]["from"] == "modulator.kernel_size"
    assert parts(plan.values)["stopping"]["from"] == "solver.tolerance"
    assert "exceeds it" in plan.text


def test_a_measured_kernel_is_taken_as_it_is(tmp_path):
    np.save(tmp_path / "kernel.npy", np.array([[0, 0.1, 0], [0.1, 1, 0.1], [0, 0.1, 0]]))
    chip = f"modulator={{kernel: {tmp_path / 'kernel.npy'}}}"
    assert list(parts(check(settings("tolerance=0.01", chip)).values)) == ["propagation", "stopping"]


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("fourier", []),
        ("fourier", ["frames=2", "multiplexing=independent"]),
        ("fresnel", ["propagator.distance=5 mm"]),
        ("capped", ["frames=2", "solver={kind: lbfgs, max_steps: 60}"]),
        ("depths", ["solver={kind: lbfgs, max_steps: 60}"]),
        ("fourier", ["target.region=[16, 14]", "solver={kind: lbfgs, max_steps: 60}"]),
    ],
)
@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_measured_errors_are_within_a_tolerance(file, words, tolerance):
    made = build(settings(f"tolerance={tolerance}", *words, file=file))
    assert isinstance(made, PECExperiment)
    for each in pec_errors(made, made.solve()):
        if each.note == NO_STEP:  # the solver stalled at its optimum
            assert each.part == "stopping" and each.measured is None
            continue
        stopped = "took all of its steps" not in each.note  # otherwise no rule bounds what is left
        assert each.measured is not None and each.measured <= (2 * each.predicted if stopped else 0.1), each


def test_a_reference_that_is_not_affordable_is_left_out():
    made = build(settings("solver.max_steps=2"))
    errors = pec_errors(made, made.solve(), limit=0.0)
    assert [each.measured for each in errors] == [None] * 3
    assert all(each.note.startswith("not measured: reference would take") for each in errors)


def test_a_solver_that_cannot_go_on_is_not_called_exact():
    made = build(settings("grid.shape=[16, 14]", "frames=4", "solver={kind: lbfgs, max_steps: 2000, tolerance: 1e-9}"))
    solution = made.solve()
    assert bool(solution.stalled.all())
    stopping = pec_errors(made, solution)[-1]
    assert stopping.measured is None and stopping.note == NO_STEP


def test_a_finished_run_has_measured_beside_predicted_errors(tmp_path):
    assert main(command("pec", tmp_path / "a", "tolerance=1e-4")) == 0
    summary = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert summary["measured_error"] is not None and summary["predicted_error"] > 0
    assert [each["part"] for each in summary["errors"]] == ["heat", "propagation", "stopping"]
    assert "Relative L2 error. heat" in (tmp_path / "a" / "report.html").read_text()
    assert np.load(tmp_path / "a" / "arrays" / "phase.npy").dtype == np.float32


def test_a_checkpoint_of_before_there_was_a_tolerance_is_taken_and_another_tolerance_is_not():
    before = _fingerprint(build(settings()))
    assert "tolerance" not in before
    assert differences(before, _fingerprint(build(settings("tolerance=0.1"))))
