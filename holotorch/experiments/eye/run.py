"""Run of kind ``eye``: pictures of every source and focus, their measurements, and the files of the run folder."""

import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.eye import focus as eye_focus
from holotorch.experiments.eye import geometry as eye_geometry
from holotorch.experiments.eye import speckle as eye_speckle
from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.eye.experiment import LIT, Observer
from holotorch.experiments.eye.measured import observer_errors
from holotorch.experiments.eye.report import by_wavelength
from holotorch.experiments.eye.tradeoff import WHITE, fitted_prefactor, in_words, tradeoff
from holotorch.experiments.planning.errors import measured_values
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs import figures
from holotorch.experiments.runs.fingerprint import Fingerprint, fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.page import plain
from holotorch.experiments.runs.pictures import save_picture
from holotorch.experiments.runs.processes import added, from_first, process_count
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.volume.config import VolumeSettings, contradictions
from holotorch.experiments.volume.experiment import Part
from holotorch.experiments.volume.run import fingerprint_inputs
from holotorch.io.bundled import find_config
from holotorch.io.colour_tables import picture_matrix
from holotorch.io.files import save_array, write_bytes
from holotorch.metrics import PerceptualSimilarity
from holotorch.optics.picture import equal_power, gamut_map, linear_srgb, tone_map

_SAVE_EVERY = 30.0  # seconds between two checkpoints
_REFERENCE_SEED = 100_000  # first seed of the realisations whose mean is the reference


def scene_settings(settings: ObserverSettings) -> VolumeSettings:
    """Configuration of the volume, with the changes in the settings. ConfigError for one of another kind."""
    path = find_config(settings.scene.config)
    assert path is not None  # validated with the settings
    scene = load_config(path, list(settings.scene.change))
    if not isinstance(scene, VolumeSettings):
        raise ConfigError([f"scene.config: {settings.scene.config} describes no volume but {scene.experiment!r}"])
    overrides = {
        name: value
        for name in ("volume", "transfer", "scale", "wavelengths")
        if (value := getattr(settings, name)) is not None
    }
    if (view := settings.view) is not None:
        overrides["view"] = scene.view.model_copy(update={name: getattr(view, name) for name in view.model_fields_set})
    scene = scene.model_copy(update=overrides)
    if problems := contradictions(scene):
        raise ConfigError([f"{'.'.join(map(str, key))}: {problem}" for key, problem in problems])
    return scene


def visible_surface(eye: Observer) -> eye_focus.Surface | None:
    """The surface that the focus is swept over, or None without a sweep. ConfigError for a scene without a surface."""
    try:
        return eye_focus.visible_surface(eye) if eye.settings.sweep else None
    except ValueError as error:
        raise ConfigError([f"sweep: {error}; leave it out"]) from None


def run_observer(eye: Observer, opened: RunFolder) -> bool:
    """Compute the observer's view, or this process's part of it, and fill the folder; True if the run is complete."""
    if process_count()[0] > 0:
        _Views(eye, None).compute(opened.signals)
        return True
    settings, folder, files = eye.settings, opened.path, Results()
    errors: dict[str, Any] | None = None
    values, surface = opened.plan.values, visible_surface(eye)
    (folder / "arrays").mkdir(exist_ok=True)
    files.write(write_bytes, folder / "images" / "geometry.png", eye_geometry.draw(eye))
    views = _Views(eye, Checkpoint(folder / "checkpoint.pt", _fingerprint(eye)))
    try:
        views.compute(opened.signals)
        if settings.sweep:
            sweep = eye_focus.focus_sweep(eye, settings.sweep, surface)
            files.write(write_table, folder / "focus.csv", [band.row for band in sweep.bands])
            drawn = eye_focus.draw(sweep, eye.scene.settings.wavelengths)
            files.write(write_bytes, folder / "images" / "focus.png", drawn)
            print("\n".join(eye_focus.in_words(sweep)))
        if settings.tradeoff:
            similarity = PerceptualSimilarity() if PerceptualSimilarity.is_there() else None
            if similarity is None:
                print("tradeoff.csv has no LPIPS, since its weights are not installed; see PerceptualSimilarity")
            cases = tradeoff(settings, eye.scene.settings, settings.tradeoff, similarity=similarity)
            files.write(write_table, folder / "tradeoff.csv", [case.row(fitted_prefactor(cases)) for case in cases])
            print("\n".join(in_words(cases)))
        errors = measured_values(lambda: observer_errors(eye))
    except KeyboardInterrupt:
        if not views.references:
            raise
    with deferred(opened.signals):
        summary = {"experiment": "eye", "status": "", "realisations": len(views.pictures)}
        if not views.pictures:
            opened.write_page = None  # there is nothing to show yet
            return conclude(opened, summary, files, done=False, checkpoint=views.checkpoint)
        summary |= _write(folder, eye, views, values, files)
        summary |= (errors or {}) | {"seconds": round(views.seconds, 2), "peak_memory_bytes": peak_memory()}
        return conclude(opened, summary, files, done=errors is not None, checkpoint=views.checkpoint)


def _fingerprint(eye: Observer) -> Fingerprint:
    """Settings and inputs that must not change before a run is resumed."""
    settings, inputs, free = fingerprint_inputs(eye.scene)
    scene = fingerprint(settings, inputs, {*free, "report"})
    observer = fingerprint(eye.settings, {}, {"seeds", "sweep", "tradeoff", "scene", "view", "scale"})
    return observer | {f"scene.{key}": value for key, value in scene.items()}


class _Views:
    """The pictures computed so far, saved to disk every 30 seconds.

    Attributes:
        total: Sum of the pictures of the reference for each focus, [F, C, h, w].
        references: Number of realisations in ``total``.
        pictures: For each realisation, the pictures of all sources and foci, [sources, F, C, h, w].
        checkpoint: The file that stores these pictures; None in all processes but the first.
    """

    def __init__(self, eye: Observer, checkpoint: Checkpoint | None):
        self.eye, self.checkpoint = eye, checkpoint
        self.total, self.references = torch.zeros(()), 0
        self.pictures: list[Tensor] = []
        self._started = self._saved = time.perf_counter()
        if checkpoint is None:
            return
        if content := checkpoint.load():
            try:
                self.total, self.references = content["total"], content["references"]
                self.pictures, self._started = content["seen"], self._started - content["seconds"]
            except KeyError as error:
                raise checkpoint.unreadable(error) from None
        if (done := len(self.pictures)) > (seeds := eye.settings.seeds):
            hint = f"set it to that in {checkpoint.path.parent / 'config.yaml'}, or run into a new folder"
            raise ConfigError([f"seeds: expected at least the {done} done, got {seeds}; {hint}"])

    @property
    def seconds(self) -> float:
        """Seconds spent so far, including those before an interruption."""
        return time.perf_counter() - self._started

    @property
    def reference(self) -> Tensor:
        """Mean picture of the reference for each focus, [F, C, h, w]."""
        return self.total / self.references

    def compute(self, signals: list[int]) -> None:
        """Compute the remaining pictures. A signal saves the complete realisations and raises KeyboardInterrupt."""
        sources, seeds = self.eye.settings.light.sources, self.eye.settings.seeds
        # A realisation has one step of the progress bar for the hologram, and one for each picture.
        reference, measured = 1 + len(self.eye.focus), 1 + len(self.eye.focus) * len(sources)
        references, pictures = from_first([self.references, len(self.pictures)])
        done, total = references * reference + pictures * measured, seeds * (8 * reference + measured)
        quiet = self.checkpoint is None
        with tqdm(total=total, initial=done, desc="imaging", unit="picture", disable=quiet, dynamic_ncols=True) as bar:
            try:
                for seed in range(_REFERENCE_SEED + references, _REFERENCE_SEED + 8 * seeds):
                    picture = self._pictures(seed, (None,), bar)[0]
                    with deferred(signals):
                        self.total, self.references = self.total + picture, self.references + 1
                    self._save_if_due(signals)
                for seed in range(pictures, seeds):
                    self.pictures.append(self._pictures(seed, sources, bar))
                    self._save_if_due(signals)
            finally:
                with deferred(signals):
                    self._save()
            if signals:
                raise KeyboardInterrupt

    def _pictures(self, seed: int, sources: Sequence[str | None], bar: tqdm) -> Tensor:
        """Pictures of a realisation, [sources, F, C, h, w]; several processes share planes and colours."""
        (rank, count), scene = process_count(), self.eye.scene
        part = Part(rank, count, len(scene.depths), len(scene.settings.wavelengths)) if count > 1 else None
        hologram = added(scene.hologram(self.eye.settings.seed + seed, part=part)[0])
        bar.set_postfix(mem=f"{peak_memory() / 1e9:.2f}GB", refresh=False)
        bar.update()
        pictures = []
        for k, (source, depth) in enumerate(itertools.product(sources, self.eye.focus)):
            colours = [c for c in range(len(hologram)) if (k * len(hologram) + c) % count == rank]
            pictures.append(self.eye.image(hologram, source, depth, colours))
            bar.update()
        return added(torch.stack(pictures)).unflatten(0, (len(sources), -1))

    def _save_if_due(self, signals: list[int]) -> None:
        if signals:  # one arrived while they were deferred
            raise KeyboardInterrupt
        if time.perf_counter() - self._saved > _SAVE_EVERY:
            self._save()

    def _save(self) -> None:
        content = {"total": self.total, "references": self.references, "seen": self.pictures, "seconds": self.seconds}
        if self.references and self.checkpoint:
            self.checkpoint.save(content)
        self._saved = time.perf_counter()


def _write(out: Path, eye: Observer, views: _Views, values: dict[str, Any], files: Results) -> dict[str, Any]:
    """Write arrays, pictures and the table. Returns entries of the summary."""
    reference, images = views.reference, torch.stack(views.pictures)  # [F, C, h, w], [S, sources, F, C, h, w]
    sources, focus = eye.settings.light.sources, eye.focus
    files.write(save_array, out / "arrays" / "retina.npy", images[0])
    files.write(save_array, out / "arrays" / "reference.npy", reference)
    # Each colour is scaled to the power of the rendering; equal values of all colours give neutral grey.
    wavelengths = eye.scene.settings.wavelengths
    matrix, rendering = picture_matrix(wavelengths).float(), eye.scene.rendering()[0]
    reference = equal_power(reference, rendering.expand_as(reference))
    for f, depth in enumerate(focus):
        shown, captions = [], []
        peak = gamut_map(linear_srgb(reference[f], matrix)).flatten().quantile(WHITE)
        for s, source in enumerate(("reference", *sources)):
            light = reference[f] if s == 0 else equal_power(images[0, s - 1, f], reference[f])
            picture = tone_map(gamut_map(linear_srgb(light, matrix)), peak=peak)
            files.write(save_picture, out / "images" / f"{source}_{f}", picture)
            shown.append(picture)
            kind = ", synthetic" if values["synthetic"] else ""
            captions.append(f"{source.replace('_', ' ')}, focus {depth * 1e3:.4g} mm{kind}")
        files.write(write_bytes, out / "images" / f"comparison_{f}.png", figures.comparison(shown, captions))
    measured = [
        eye.row(source, depth, images[:, s, f], reference[f])
        for s, source in enumerate(sources)
        for f, depth in enumerate(focus)
    ]
    peak = reference[0].amax((-2, -1), keepdim=True)
    speckle = {
        source: eye_speckle.relative_speckle(
            equal_power(images[:, s, 0], reference[0].expand_as(images[:, s, 0])), reference[0], LIT * peak
        )
        for s, source in enumerate(sources)
    }
    files.write(write_bytes, out / "images" / "speckle.png", eye_speckle.draw(speckle))
    lengths = [wavelength * 1e9 for wavelength in wavelengths]
    flat = [by_wavelength(row, lengths) for row in measured]
    files.write(write_table, out / "table.csv", [{key: plain(value) for key, value in row.items()} for row in flat])
    return {"synthetic": values["synthetic"], "wavelengths_nm": lengths, "rows": measured}
