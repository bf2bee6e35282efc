"""A run of the volume experiment: it can be resumed after each realisation, and several processes can share it."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.planning.errors import measured_values
from holotorch.experiments.runs import figures
from holotorch.experiments.runs.fingerprint import fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.pictures import in_colour, save_picture
from holotorch.experiments.runs.processes import added, from_first, process_count
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import Signals, deferred
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.evaluation import VolumeEvaluation
from holotorch.experiments.volume.experiment import Part, VolumeExperiment
from holotorch.experiments.volume.measured import hologram_error, refocusing_error
from holotorch.io.files import save_array, write_bytes, write_json


def run_volume(experiment: VolumeExperiment, opened: RunFolder) -> bool:
    """Compute the realisations, or this process's part of each, and fill the folder; True if the run is complete."""
    rank, count = process_count()
    planes, seeds, signals = len(experiment.depths), experiment.settings.report.seeds, opened.signals
    state = _State(opened.path, experiment) if rank == 0 else None  # only the first process has results
    (start,) = from_first([state.evaluation.count if state else 0])
    part = Part(rank, count, planes, len(experiment.settings.wavelengths)) if count > 1 else None
    total, done = planes * seeds, planes * start
    with tqdm(total=total, initial=done, desc="rendering", unit="plane", disable=not state, dynamic_ncols=True) as bar:

        def advance() -> None:
            if bar.n % 10 == 0:
                bar.set_postfix(mem=f"{peak_memory() / 1e9:.2f}GB", refresh=False)
            bar.update()

        try:
            for seed in range(start, seeds):
                started = time.perf_counter()
                hologram, rendering = experiment.hologram(seed, advance, part)
                hologram = added(hologram)
                seconds = time.perf_counter() - started
                if state:
                    with deferred(signals):
                        state.add(hologram, seed, seconds, rendering)
                    if signals:
                        break
        except KeyboardInterrupt:
            pass
        if not state:
            return not signals
        if not state.evaluation.count:
            raise KeyboardInterrupt
        errors = _errors(experiment, state, signals)
        with deferred(signals):
            return _write(opened, experiment, state, errors)


_HANDEDNESS = "as scanned"  # runs of before showed the mirror image, and must not be completed by this


def fingerprint_inputs(experiment: VolumeExperiment) -> tuple[VolumeSettings, dict[str, tuple[Any, ...]], set[str]]:
    """Settings, inputs and free keys for :func:`fingerprint`; a resumed run may change seeds and device."""
    volume, file = experiment.volume, experiment.settings.transfer.file
    inputs: dict[str, tuple[Any, ...]] = {
        "volume": (volume.values.cpu(), repr((volume.spacing, volume.unit, _HANDEDNESS)))
    }
    if file:
        inputs["transfer.file"] = (Path(file).read_bytes(),)
    if experiment.samples > 1:  # checkpoints of before had one
        inputs["samples"] = (repr(experiment.samples),)
    return experiment.settings, inputs, {"device", "report.seeds", "view.samples"}


class _State:
    """Results of the realisations so far, saved to disk after each realisation."""

    def __init__(self, out: Path, experiment: VolumeExperiment):
        (out / "arrays").mkdir(exist_ok=True)
        self.evaluation, self.out, self.rows = VolumeEvaluation(experiment), out, []
        self.checkpoint = Checkpoint(out / "checkpoint.pt", fingerprint(*fingerprint_inputs(experiment)))
        if content := self.checkpoint.load():
            try:
                sums, count, self.rows = content["sums"], content["count"], content["rows"]
            except KeyError as error:
                raise self.checkpoint.unreadable(error) from None
            if count > (seeds := experiment.settings.report.seeds):
                hint = f"set it to that in {out / 'config.yaml'}, or run into a new folder"
                raise ConfigError([f"report.seeds: expected at least the {count} done, got {seeds}; {hint}"])
            self.evaluation.sums, self.evaluation.count = sums, count

    def add(self, hologram: Tensor, seed: int, seconds: float, rendering: float) -> None:
        """Evaluate a realisation and save its results."""
        started = time.perf_counter()
        if seed == 0:
            save_array(self.out / "arrays" / "hologram.npy", hologram.to(torch.complex64).cpu())
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


def _errors(experiment: VolumeExperiment, state: _State, signals: Signals) -> dict[str, Any] | None:
    """Predicted and measured errors of all realisations, for the summary; None after an interruption."""
    if signals or state.evaluation.count < experiment.settings.report.seeds:
        return None
    hologram = torch.from_numpy(np.load(state.out / "arrays" / "hologram.npy")).to(experiment.device)
    depths = state.evaluation.depths
    return measured_values(
        lambda: [hologram_error(experiment), refocusing_error(experiment, hologram, depths[len(depths) // 2])]
    )


def _write(opened: RunFolder, experiment: VolumeExperiment, state: _State, errors: dict[str, Any] | None) -> bool:
    """Fill the folder; without ``errors`` the run is not complete, and resuming it measures them."""
    out, files, evaluation = opened.path, Results(), state.evaluation
    files.write(write_table, out / "metrics.csv", state.rows)
    pictures = evaluation.pictures
    for name, array in (("rendering", evaluation.rendering), ("refocused", pictures), ("depth", evaluation.depth)):
        files.write(save_array, out / "arrays" / f"{name}.npy", array)
    layers = {"depths_m": list(experiment.depths), "rays": list(experiment.rays.shape), "stride": experiment.stride}
    files.write(write_json, out / "layers.json", layers | {"sign": "exp(+ikr) / r"})
    images = {"rendering": evaluation.rendering, "in_focus": evaluation.sharpest(pictures)}
    images |= {f"focus_{f}": picture for f, picture in enumerate(pictures)}
    images = {name: in_colour(picture, experiment.settings.wavelengths) for name, picture in images.items()}
    for name, picture in images.items():
        files.write(save_picture, out / "images" / name, picture)
    captions = ["Direct volume rendering", "Hologram, nearest focus per ray"]
    captions += [f"Hologram refocused at {depth * 1e3:.4g} mm" for depth in evaluation.depths]
    captions = [caption + (", synthetic" if experiment.synthetic else "") for caption in captions]
    files.write(write_bytes, out / "images" / "comparison.png", figures.comparison([*images.values()], captions))
    depth_mm = torch.where(evaluation.visible, evaluation.depth * 1e3, torch.nan)[None]
    label = "mean distance from the hologram (mm)"
    depth_map = figures.channel_maps(depth_mm, ["depth of each ray"], label, "viridis")
    files.write(write_bytes, out / "images" / "depth.png", depth_map)
    seconds = ("seconds", "rendering_seconds", "refocus_seconds")
    summary = {
        "experiment": "volume",
        "status": "",
        "synthetic": experiment.synthetic,
        "refocused_m": evaluation.depths,
        **evaluation.numbers(),
        **(errors or {}),
        **{name: round(sum(row[name] for row in state.rows), 3) for name in seconds},
        "peak_memory_bytes": peak_memory(),
    }
    return conclude(opened, summary, files, done=errors is not None, checkpoint=state.checkpoint)
