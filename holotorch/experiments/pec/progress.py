"""Log of a running solver: progress bar, rows of metrics.csv, checkpoints."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tqdm import tqdm

from holotorch.correction import Solution
from holotorch.experiments.pec.evaluation import quality
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.saving import Checkpoint
from holotorch.experiments.runs.signals import deferred

CHECK_STEPS = 10  # solver steps between two scores of the hologram; scoring takes about as long as a step
_SAVE_EVERY = 30.0  # seconds between two checkpoints


class Log:
    """Callback of the solver that draws the progress bar and writes a checkpoint every 30 seconds.

    Attributes:
        last: The solution after the latest step, or None before the first.
        rows: Rows of metrics.csv.
        checked: (step, score) for each time the hologram was scored by :attr:`metric`.
        resume: State of the solver in the checkpoint, or None.
    """

    def __init__(self, experiment: PECExperiment, checkpoint: Checkpoint):
        self.experiment, self.checkpoint, self.last = experiment, checkpoint, None
        self.rows: list[list[str]] = []
        self.checked: list[tuple[int, float]] = []
        self.resume: dict[str, torch.Tensor] | None = None
        self._started = self._saved = time.perf_counter()
        if content := checkpoint.load():
            try:
                self.resume, self.rows = content["state"], content["rows"]
                self.checked = [tuple(pair) for pair in content["checked"]]
                self._started -= content["seconds"]
            except (KeyError, TypeError, ValueError) as error:
                raise checkpoint.unreadable(error) from None
        self._stages = len(experiment.stages())
        steps, done = experiment.settings.solver.max_steps, len(self.rows)
        self.bar = tqdm(total=steps, initial=done, desc="correcting", unit="step", dynamic_ncols=True)

    @property
    def metric(self) -> str:
        """Name of the metric by which the hologram is scored during the run."""
        return self.experiment.settings.report.metrics[0]

    @property
    def seconds(self) -> float:
        """Seconds spent in the solver, including those before an interruption, without those spent in this log."""
        return time.perf_counter() - self._started

    def __call__(self, solution: Solution) -> None:
        """Log one step."""
        entered, step, score = time.perf_counter(), len(solution.losses) - 1, ""
        elapsed = entered - self._started
        if step % CHECK_STEPS == 0:
            self.checked.append((step, quality(self.experiment, self.experiment.heater_phases(solution.x))))
            score = f"{self.checked[-1][1]:.6f}"
        losses = solution.losses[-1].reshape(-1, len(self.experiment.wavelengths)).mean(0).tolist()
        self.rows.append([str(step), str(solution.evaluations), f"{elapsed:.4f}", score, *map(repr, losses)])
        self.last = solution
        # Each stage has a loss of its own.
        first, stage = solution.state["inner_losses"][0], int(solution.state["stage"]) + 1
        relative = (solution.losses[-1] / first.clamp(min=1e-30)).mean().item()
        shown = {"stage": f"{stage}/{self._stages}"} if self._stages > 1 else {}
        if stage == 1:  # later stages begin near their end
            shown["loss/start"] = f"{relative:.2e}"
        shown["mem"] = f"{peak_memory() / 1e9:.2f}GB"
        if self.checked:
            shown[self.metric] = f"{self.checked[-1][1]:.4f}"
        self.bar.set_postfix(shown, refresh=False)
        self.bar.update()
        if entered - self._saved > _SAVE_EVERY:
            self.save()
        self._started += time.perf_counter() - entered

    def save(self) -> bool:
        """Write a checkpoint of :attr:`last`, if there is one. False if the file cannot be written."""
        if self.last is None:
            return True
        content: dict[str, Any] = {
            "state": self.last.state,
            "rows": self.rows[: len(self.last.losses) - 1],  # without the row of a step that a signal interrupted
            "checked": self.checked,
            "seconds": self.seconds,
        }
        self._saved = time.perf_counter()  # set even after a failure, so that the next attempt is 30 seconds later
        return self.checkpoint.save(content)

    @contextmanager
    def saved_on_failure(self, signals: list[int]) -> Iterator[None]:
        """Save the latest step if the block raises an exception, so that ``holotorch resume`` repeats no steps.

        A signal that follows the exception, as ``torchrun`` sends one when another process has ended, only goes into
        the list ``signals`` meanwhile.
        """
        try:
            yield
        except Exception:
            with deferred(signals):
                if not (self.checkpoint.path.parent / "summary.json").is_file():
                    self.save()
            raise

    def table(self) -> str:
        """The rows as CSV."""
        colours = [f"loss_{wavelength * 1e9:.0f}nm" for wavelength in self.experiment.wavelengths]
        header = ["step", "evaluations", "seconds", f"{self.metric}_mean", *colours]
        return "\n".join(",".join(row) for row in [header, *self.rows]) + "\n"
