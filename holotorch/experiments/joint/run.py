"""A run of kind ``joint``: the solver, the methods it is compared with, and the files of the run folder."""

import signal
import sys
import time
from typing import Any

from tqdm import tqdm

from holotorch.correction import Solution
from holotorch.correction.run import State
from holotorch.experiments.joint import pictures
from holotorch.experiments.joint.evaluation import evaluate, per_view
from holotorch.experiments.joint.experiment import JointExperiment
from holotorch.experiments.joint.measured import joint_errors
from holotorch.experiments.joint.methods import SHARED, Shown, baseline, show
from holotorch.experiments.planning.errors import measured_values
from holotorch.experiments.runs.fingerprint import Fingerprint, fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.processes import from_first, process_count
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.timing import timed
from holotorch.experiments.volume.run import fingerprint_inputs
from holotorch.io.files import save_array

_SAVE_EVERY = 30.0  # seconds between two checkpoints


def run_joint(experiment: JointExperiment, opened: RunFolder) -> bool:
    """Solve for the phases, evaluate them and the other methods, and fill the folder; True if the run is complete.

    Several processes share the solvers; only the first one evaluates and fills the folder.
    """
    if process_count()[0] > 0:
        experiment.solve(resume=from_first(None))
        for name in experiment.settings.comparisons:
            if name in SHARED:
                baseline(experiment, name)
        return True
    out, pressed, files = opened.path, opened.signals, Results()
    (out / "arrays").mkdir(exist_ok=True)
    log = Log(experiment, Checkpoint(out / "checkpoint.pt", _fingerprint(experiment)))
    try:
        solution = experiment.solve(log, from_first(log.resume))
    except KeyboardInterrupt:
        solution = log.last
    finally:
        with deferred(pressed):  # torchrun sends a signal when another process has ended
            log.bar.close()
            log.save()
    if solution is None:
        raise KeyboardInterrupt
    with deferred(pressed):  # from here on Ctrl-C takes effect only after the results are saved
        shown = {"joint": show(experiment, solution.x.float())}
        files.write(save_array, out / "arrays" / "phase.npy", shown["joint"].phase)
    seconds = {"joint": log.seconds}
    for name in experiment.settings.comparisons:
        try:
            if not pressed:
                shown[name], seconds[name] = timed(lambda name=name: baseline(experiment, name))
        except KeyboardInterrupt:
            pressed.append(signal.SIGINT)
    compared = None if pressed else measured_values(lambda: joint_errors(experiment, solution))
    if pressed:  # of many planes this takes a minute or more
        print("interrupted; what there is of the run is evaluated and saved before it ends", file=sys.stderr)
    with deferred(pressed):
        summary = _write(opened, experiment, shown, seconds, solution, files) | (compared or {})
        return conclude(opened, summary, files, done=compared is not None and not pressed, checkpoint=log.checkpoint)


def _fingerprint(experiment: JointExperiment) -> Fingerprint:
    """Settings and inputs that must not change before a run is resumed."""
    _, inputs, _ = fingerprint_inputs(experiment.scene)
    settings = experiment.settings
    free = {"device", "steps", "view.samples"}  # the number of samples is among the inputs
    if settings.eye.per_step is None:
        free.add("eye.per_step")  # checkpoints of before there was one do not have it
    else:
        free.remove("steps")  # the learning rate falls over the steps
    if len(experiment.foci) < len(experiment.depths):  # checkpoints of before corrected every plane
        inputs["display.foci"] = (repr(experiment.foci),)
    if settings.eye.parallax:
        inputs["eye.parallax"] = (repr(experiment.trained.operator.views),)
    if settings.display.rad_per_K_at == type(settings.display).model_fields["rad_per_K_at"].default:
        free.add("display.rad_per_K_at")  # checkpoints of before there was one do not have it
    if settings.display.kernel is None:
        free.add("display.kernel")  # checkpoints of before there was one do not have it
    else:
        inputs["display.kernel"] = (experiment.crosstalk.kernel,)
    if settings.tolerance is None:
        free.add("tolerance")  # checkpoints of before there was one do not have it
    if settings.tolerance is None or settings.display.planes is not None:
        free.add("report")  # otherwise the number of planes depends on the methods of comparison, see budget.py
    # Checkpoints of before, of volumes whose hidden end was nearest to the eye, lack this entry.
    return fingerprint(settings, inputs, free) | {"view": "the end that faces the observer is nearest to the array"}


class Log:
    """Callback of the solver that draws the progress bar and writes a checkpoint every 30 seconds.

    Attributes:
        last: The solution after the latest step, or None before the first.
        resume: State of the solver in the checkpoint, or None.
    """

    def __init__(self, experiment: JointExperiment, checkpoint: Checkpoint):
        self.checkpoint, self.last = checkpoint, None
        self.resume: State | None = None
        self._started = self._saved = time.perf_counter()
        done = 0
        if content := checkpoint.load():
            try:
                self.resume, done = content["state"], int(content["state"]["counts"][0])
                self._started -= content["seconds"]
            except (KeyError, TypeError, ValueError) as error:
                raise checkpoint.unreadable(error) from None
        steps = experiment.settings.steps
        self.bar = tqdm(total=steps, initial=done, desc="correcting", unit="step", dynamic_ncols=True)

    @property
    def seconds(self) -> float:
        """Seconds spent so far, including those before an interruption."""
        return time.perf_counter() - self._started

    def __call__(self, solution: Solution) -> None:
        """Log one step."""
        self.last = solution
        relative = (solution.losses[-1] / solution.losses[0].clamp(min=1e-30)).mean().item()
        self.bar.set_postfix(loss=f"{relative:.2e}", mem=f"{peak_memory() / 1e9:.2f}GB", refresh=False)
        self.bar.update()
        if time.perf_counter() - self._saved > _SAVE_EVERY:
            self.save()

    def save(self) -> None:
        """Write a checkpoint of :attr:`last`, if there is one."""
        self._saved = time.perf_counter()  # set even after a failure, so that the next attempt is 30 seconds later
        if self.last is not None:
            self.checkpoint.save({"state": self.last.state, "seconds": self.seconds})


def _write(
    opened: RunFolder,
    experiment: JointExperiment,
    shown: dict[str, Shown],
    seconds: dict[str, float],
    solution: Solution,
    files: Results,
) -> dict[str, Any]:
    """Write arrays, tables and pictures. Returns the summary."""
    out = opened.path
    evaluated = {name: evaluate(experiment, each) for name, each in shown.items()}
    methods = {name: numbers | {"seconds": round(seconds[name], 3)} for name, (numbers, _) in evaluated.items()}
    files.write(write_table, out / "methods.csv", [{"method": name, **row} for name, row in methods.items()])
    target, images, views = per_view(experiment, shown["joint"])
    files.write(write_table, out / "views.csv", views)
    losses = [{"step": step, "loss": loss} for step, loss in enumerate(solution.losses.mean(-1).tolist())]
    files.write(write_table, out / "metrics.csv", losses)
    files.write(save_array, out / "arrays" / "target.npy", target)
    files.write(save_array, out / "arrays" / "shown.npy", images)
    pictures.write(out / "images", experiment, shown, {name: each[1] for name, each in evaluated.items()}, files)
    return {
        "experiment": "joint",
        "status": "",
        "synthetic": experiment.scene.synthetic,
        "foci_m": experiment.foci,
        "methods": methods,
        "steps": len(losses) - 1,
        "peak_memory_bytes": peak_memory(),
    }
