"""A run of the volume experiment: realisation after realisation, in one process or several, restartable."""

import csv
import io
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs import pictures
from holotorch.experiments.runs.fingerprint import fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.processes import from_first, process_count
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.experiment import Part, VolumeExperiment
from holotorch.experiments.volume.judge import VolumeJudge
from holotorch.io.files import save_array, write_bytes, write_json, write_text
from holotorch.io.images import encode_png

_COLUMNS: tuple[str, ...] = (
    "realisation",
    "seconds",
    "rendering_seconds",
    "refocus_seconds",
    "ssim_in_focus",
    "speckle_contrast",
)


def run_volume(experiment: VolumeExperiment, opened: RunFolder) -> bool:
    """Compute the realisations, or this process's part of each, and fill the folder; whether the run is complete."""
    rank, count = process_count()
    if rank == 0:
        (opened.path / "arrays").mkdir(exist_ok=True)
    settings, planes, pressed = experiment.settings, len(experiment.depths), opened.pressed
    judge = VolumeJudge(experiment) if rank == 0 else None
    state = _State(opened.path, experiment, judge)
    start = from_first(torch.tensor(state.done)) if count > 1 else torch.tensor(state.done)
    part = Part(rank, count, planes) if count > 1 else None
    total = planes * settings.report.seeds
    bar = tqdm(
        total=total, initial=int(start) * planes, desc="rendering", unit="plane", disable=rank > 0, dynamic_ncols=True
    )
    with bar:
        try:
            for seed in range(int(start), settings.report.seeds):
                started = time.perf_counter()

                def seen() -> None:
                    if bar.n % 10 == 0:
                        bar.set_postfix(mem=f"{peak_memory() / 1e9:.2f}GB", refresh=False)
                    bar.update()

                hologram, rendering = experiment.hologram(seed, seen, part)
                if count > 1:
                    torch.distributed.all_reduce(hologram)  # of fields: each process has transformed its own sum
                seconds = time.perf_counter() - started
                if judge is not None:
                    with deferred(pressed):
                        state.take(hologram, seed, seconds, rendering)
                    if pressed:
                        break
        except KeyboardInterrupt:
            pass
        if rank > 0:
            return not pressed
        assert judge is not None
        if not judge.count:
            raise KeyboardInterrupt
        with deferred(pressed):
            return _write(opened, experiment, judge, state)


def described(experiment: VolumeExperiment) -> tuple[VolumeSettings, dict[str, tuple[Any, ...]], set[str]]:
    """What :func:`fingerprint` is made of: realisations may be added, on another device as well."""
    volume, file = experiment.volume, experiment.settings.transfer.file
    inputs: dict[str, tuple[Any, ...]] = {"volume": (volume.values, repr((volume.spacing, volume.unit)))}
    if file:
        inputs["transfer.file"] = (Path(file).read_bytes(),)
    return experiment.settings, inputs, {"device", "report.seeds"}


class _State:
    """What the realisations so far have given, on disk after each of them."""

    def __init__(self, out: Path, experiment: VolumeExperiment, judge: VolumeJudge | None):
        self.judge, self.out, self.rows = judge, out, []
        if judge is None:
            return
        self.checkpoint = Checkpoint(out / "checkpoint.pt", fingerprint(*described(experiment)))
        if content := self.checkpoint.load():
            try:
                judge.sums, judge.count, self.rows = content["sums"], content["count"], content["rows"]
            except KeyError as error:
                raise self.checkpoint.unreadable(error) from None
            if judge.count > (seeds := experiment.settings.report.seeds):
                cure = f"set it to that in {out / 'config.yaml'}, or run into a new folder"
                raise ConfigError([f"report.seeds: expected at least the {judge.count} done, got {seeds}; {cure}"])

    @property
    def done(self) -> int:
        """Complete realisations."""
        return 0 if self.judge is None else self.judge.count

    def take(self, hologram: Tensor, seed: int, seconds: float, rendering: float) -> None:
        """Judge a realisation and keep it."""
        assert self.judge is not None
        started = time.perf_counter()
        if seed == 0:
            save_array(self.out / "arrays" / "hologram.npy", hologram.cpu())
        self.judge.add(hologram)
        refocusing = time.perf_counter() - started
        numbers = self.judge.numbers()
        row = (seed, round(seconds, 4), round(rendering, 4), round(refocusing, 4))
        scores = (numbers.get("ssim_in_focus"), numbers["speckle_contrast"])
        self.rows.append(dict(zip(_COLUMNS, (*row, *scores), strict=True)))
        self.checkpoint.save({"sums": self.judge.sums, "count": self.judge.count, "rows": self.rows})


def _write(opened: RunFolder, experiment: VolumeExperiment, judge: VolumeJudge, state: _State) -> bool:
    out = opened.path
    files, done = Results(), state.done == experiment.settings.report.seeds
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(state.rows)
    files.write(write_text, out / "metrics.csv", text.getvalue())
    shown = judge.pictures
    for name, array in (("rendering", judge.rendering), ("refocused", shown), ("depth", judge.depth)):
        files.write(save_array, out / "arrays" / f"{name}.npy", array)
    layers = {"depths_m": list(experiment.depths), "rays": list(experiment.rays.shape), "stride": experiment.stride}
    files.write(write_json, out / "layers.json", layers | {"sign": "exp(+ikr) / r"})
    images = {"rendering": judge.rendering, "in_focus": judge.sharpest(shown)}
    images |= {f"focus_{f}": picture for f, picture in enumerate(shown)}
    for name, picture in images.items():
        files.write(write_bytes, out / "images" / f"{name}.png", encode_png(picture.clamp(0, 1)))
    captions = ["Direct volume rendering", "Hologram, every ray at its depth"]
    captions += [f"Hologram refocused at {depth * 1e3:.4g} mm" for depth in judge.depths]
    captions = [caption + (", synthetic" if experiment.synthetic else "") for caption in captions]
    files.write(write_bytes, out / "images" / "comparison.png", pictures.comparison([*images.values()], captions))
    depth = torch.where(judge.opacity > 0.05, judge.depth * 1e3, torch.nan)
    files.write(
        write_bytes,
        out / "images" / "depth.png",
        pictures.channel_maps(depth[None], ["what a ray sees"], "mean depth behind the hologram (mm)", "viridis"),
    )
    summary = {
        "experiment": "volume",
        "status": "",
        "synthetic": experiment.synthetic,
        "refocused_m": judge.depths,
        **judge.numbers(),
        "seconds": round(sum(row["seconds"] for row in state.rows), 3),
        "rendering_seconds": round(sum(row["rendering_seconds"] for row in state.rows), 3),
        "refocus_seconds": round(sum(row["refocus_seconds"] for row in state.rows), 3),
        "peak_memory_bytes": peak_memory(),
    }
    return conclude(opened, summary, files, done=done, checkpoint=state.checkpoint)
