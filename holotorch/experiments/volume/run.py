"""A run of the volume experiment: one realisation after another, in one process or several, and resumable."""

import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs import figures
from holotorch.experiments.runs.fingerprint import fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.pictures import save_picture
from holotorch.experiments.runs.processes import from_first, process_count
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.evaluation import VolumeEvaluation
from holotorch.experiments.volume.experiment import Part, VolumeExperiment
from holotorch.io.files import save_array, write_bytes, write_json


def run_volume(experiment: VolumeExperiment, opened: RunFolder) -> bool:
    """Compute the realisations, or this process's part of each, and fill the folder; True if the run is complete."""
    rank, count = process_count()
    if rank == 0:
        (opened.path / "arrays").mkdir(exist_ok=True)
    settings, planes, pressed = experiment.settings, len(experiment.depths), opened.pressed
    evaluation = VolumeEvaluation(experiment) if rank == 0 else None
    state = _State(opened.path, experiment, evaluation)
    start = from_first(torch.tensor(state.done)) if count > 1 else torch.tensor(state.done)
    part = Part(rank, count, planes) if count > 1 else None
    total = planes * settings.report.seeds
    done = int(start) * planes
    with tqdm(total=total, initial=done, desc="rendering", unit="plane", disable=rank > 0, dynamic_ncols=True) as bar:
        try:
            for seed in range(int(start), settings.report.seeds):
                started = time.perf_counter()

                def advance() -> None:
                    if bar.n % 10 == 0:
                        bar.set_postfix(mem=f"{peak_memory() / 1e9:.2f}GB", refresh=False)
                    bar.update()

                hologram, rendering = experiment.hologram(seed, advance, part)
                if count > 1:
                    torch.distributed.all_reduce(hologram)  # the sum of the fields of all processes
                seconds = time.perf_counter() - started
                if evaluation is not None:
                    with deferred(pressed):
                        state.take(hologram, seed, seconds, rendering)
                    if pressed:
                        break
        except KeyboardInterrupt:
            pass
        if rank > 0:
            return not pressed
        assert evaluation is not None
        if not evaluation.count:
            raise KeyboardInterrupt
        with deferred(pressed):
            return _write(opened, experiment, evaluation, state)


def fingerprint_inputs(experiment: VolumeExperiment) -> tuple[VolumeSettings, dict[str, tuple[Any, ...]], set[str]]:
    """Arguments for :func:`fingerprint`; the number of realisations and the device may change in a resumed run."""
    volume, file = experiment.volume, experiment.settings.transfer.file
    inputs: dict[str, tuple[Any, ...]] = {"volume": (volume.values, repr((volume.spacing, volume.unit)))}
    if file:
        inputs["transfer.file"] = (Path(file).read_bytes(),)
    return experiment.settings, inputs, {"device", "report.seeds"}


class _State:
    """Results of the realisations so far, saved to disk after each of them."""

    def __init__(self, out: Path, experiment: VolumeExperiment, evaluation: VolumeEvaluation | None):
        self.evaluation, self.out, self.rows = evaluation, out, []
        if evaluation is None:
            return
        self.checkpoint = Checkpoint(out / "checkpoint.pt", fingerprint(*fingerprint_inputs(experiment)))
        if content := self.checkpoint.load():
            try:
                evaluation.sums, evaluation.count, self.rows = content["sums"], content["count"], content["rows"]
            except KeyError as error:
                raise self.checkpoint.unreadable(error) from None
            if evaluation.count > (seeds := experiment.settings.report.seeds):
                hint = f"set it to that in {out / 'config.yaml'}, or run into a new folder"
                raise ConfigError([f"report.seeds: expected at least the {evaluation.count} done, got {seeds}; {hint}"])

    @property
    def done(self) -> int:
        """Number of complete realisations."""
        return 0 if self.evaluation is None else self.evaluation.count

    def take(self, hologram: Tensor, seed: int, seconds: float, rendering: float) -> None:
        """Evaluate a realisation and save its results."""
        assert self.evaluation is not None
        started = time.perf_counter()
        if seed == 0:
            save_array(self.out / "arrays" / "hologram.npy", hologram.cpu())
        self.evaluation.add(hologram)
        refocusing = time.perf_counter() - started
        numbers = self.evaluation.numbers()
        self.rows.append(
            {
                "realisation": seed,
                "seconds": round(seconds, 4),
                "rendering_seconds": round(rendering, 4),
                "refocus_seconds": round(refocusing, 4),
                "ssim_in_focus": numbers.get("ssim_in_focus"),
                "speckle_contrast": numbers["speckle_contrast"],
            }
        )
        self.checkpoint.save({"sums": self.evaluation.sums, "count": self.evaluation.count, "rows": self.rows})


def _write(opened: RunFolder, experiment: VolumeExperiment, evaluation: VolumeEvaluation, state: _State) -> bool:
    out = opened.path
    files, done = Results(), state.done == experiment.settings.report.seeds
    files.write(write_table, out / "metrics.csv", state.rows)
    shown = evaluation.pictures
    for name, array in (("rendering", evaluation.rendering), ("refocused", shown), ("depth", evaluation.depth)):
        files.write(save_array, out / "arrays" / f"{name}.npy", array)
    layers = {"depths_m": list(experiment.depths), "rays": list(experiment.rays.shape), "stride": experiment.stride}
    files.write(write_json, out / "layers.json", layers | {"sign": "exp(+ikr) / r"})
    images = {"rendering": evaluation.rendering, "in_focus": evaluation.sharpest(shown)}
    images |= {f"focus_{f}": picture for f, picture in enumerate(shown)}
    for name, picture in images.items():
        files.write(save_picture, out / "images" / name, picture)
    captions = ["Direct volume rendering", "Hologram, every ray at its depth"]
    captions += [f"Hologram refocused at {depth * 1e3:.4g} mm" for depth in evaluation.depths]
    captions = [caption + (", synthetic" if experiment.synthetic else "") for caption in captions]
    files.write(write_bytes, out / "images" / "comparison.png", figures.comparison([*images.values()], captions))
    depth = torch.where(evaluation.visible, evaluation.depth * 1e3, torch.nan)
    files.write(
        write_bytes,
        out / "images" / "depth.png",
        figures.channel_maps(depth[None], ["depth of each ray"], "mean depth behind the hologram (mm)", "viridis"),
    )
    seconds = ("seconds", "rendering_seconds", "refocus_seconds")
    summary = {
        "experiment": "volume",
        "status": "",
        "synthetic": experiment.synthetic,
        "refocused_m": evaluation.depths,
        **evaluation.numbers(),
        **{name: round(sum(row[name] for row in state.rows), 3) for name in seconds},
        "peak_memory_bytes": peak_memory(),
    }
    return conclude(opened, summary, files, done=done, checkpoint=state.checkpoint)
