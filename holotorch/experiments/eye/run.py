"""A run of the observer: holograms once, then every source and focus, pictures, a table and a page."""

import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.eye import focus as eye_focus
from holotorch.experiments.eye import geometry as eye_geometry
from holotorch.experiments.eye.config import ObserverSettings
from holotorch.experiments.eye.experiment import Observer, observer, realisations
from holotorch.experiments.eye.report import by_wavelength
from holotorch.experiments.eye.tradeoff import fitted_prefactor, in_words, tradeoff
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs import pictures
from holotorch.experiments.runs.fingerprint import Fingerprint, fingerprint
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.markup import plain
from holotorch.experiments.runs.memory import peak_memory
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import deferred
from holotorch.experiments.runs.tables import write_table
from holotorch.experiments.volume.config import VolumeSettings
from holotorch.experiments.volume.run import described
from holotorch.io.bundled import find_config
from holotorch.io.colour_tables import srgb_matrix, white_balance
from holotorch.io.files import save_array, write_bytes
from holotorch.io.images import encode_png
from holotorch.optics.picture import equal_power, gamut_map, linear_srgb, tone_map

_SAVE_EVERY = 30.0  # seconds between two checkpoints
_BRIGHT = 0.995  # of the reference's pixels are at most as bright as what is shown white


def scene_settings(settings: ObserverSettings) -> VolumeSettings:
    """The volume's configuration with its changes. ConfigError for one of another kind."""
    path = find_config(settings.scene.config)
    assert path is not None  # as its settings have checked
    found = load_config(path, list(settings.scene.change))
    if not isinstance(found, VolumeSettings):
        raise ConfigError([f"scene.config: {settings.scene.config} describes no volume but {found.experiment!r}"])
    return found


def build_observer(settings: ObserverSettings) -> Observer:
    """The observer of the scene that the settings name."""
    return observer(settings, scene_settings(settings))


def visible_surface(eye: Observer) -> eye_focus.Surface | None:
    """What a sweep of the focus looks for, if there is one. ConfigError for a scene in which it is not to be found."""
    try:
        return eye_focus.visible_surface(eye) if eye.settings.sweep else None
    except ValueError as error:  # said before hours of work, not after it
        raise ConfigError([f"sweep: {error}; leave it out"]) from None


def run_observer(eye: Observer, opened: RunFolder) -> bool:
    """Look at the scene as planned and fill the folder; whether the run is complete."""
    settings, folder, files, done = eye.settings, opened.path, Results(), False
    values, surface = opened.plan.values, visible_surface(eye)
    (folder / "arrays").mkdir(exist_ok=True)
    files.write(write_bytes, folder / "images" / "geometry.png", eye_geometry.draw(eye))
    looked = _Looked(eye, Checkpoint(folder / "checkpoint.pt", _fingerprint(eye)))
    try:
        looked.look(opened.pressed)
        if settings.sweep:
            sweep = eye_focus.focus_sweep(eye, settings.sweep, surface)
            files.write(write_table, folder / "focus.csv", [band.row for band in sweep.bands])
            files.write(write_bytes, folder / "images" / "focus.png", eye_focus.draw(sweep))
            print("\n".join(eye_focus.in_words(sweep)))
        if settings.tradeoff:
            cases = tradeoff(settings, eye.scene.settings, settings.tradeoff)
            files.write(write_table, folder / "tradeoff.csv", [case.row(fitted_prefactor(cases)) for case in cases])
            print("\n".join(in_words(cases)))
        done = True
    except KeyboardInterrupt:
        if not looked.references:
            raise
    with deferred(opened.pressed):
        summary = {"experiment": "eye", "status": "", "realisations": len(looked.seen)}
        if not looked.seen:
            opened.write_page = None  # of pictures that are not there yet
            return conclude(opened, summary, files, done=False, checkpoint=looked.checkpoint)
        summary |= _write(folder, eye, looked, values, files)
        summary |= {"seconds": round(looked.seconds, 2), "peak_memory_bytes": peak_memory()}
        return conclude(opened, summary, files, done=done, checkpoint=looked.checkpoint)


def _fingerprint(eye: Observer) -> Fingerprint:
    """Realisations may be added, and what is done after all pictures may change."""
    settings, inputs, free = described(eye.scene)
    scene = fingerprint(settings, inputs, {*free, "report"})
    own = fingerprint(eye.settings, {}, {"seeds", "sweep", "tradeoff", "scene"})
    return own | {f"scene.{key}": value for key, value in scene.items()}


class _Looked:
    """What was seen so far, on disk now and then: sums of references, and pictures of each realisation.

    Attributes:
        total: Sum of the references [F, 3, h, w].
        references: How many are in it.
        seen: [sources, F, 3, h, w] of each realisation.
        checkpoint: Where they are kept.
    """

    def __init__(self, eye: Observer, checkpoint: Checkpoint):
        self.eye, self.checkpoint = eye, checkpoint
        self.total, self.references = torch.zeros(()), 0
        self.seen: list[Tensor] = []
        self._before, self._started = 0.0, time.perf_counter()
        self._saved = self._started
        if content := checkpoint.load():
            try:
                self.total, self.references = content["total"], content["references"]
                self.seen, self._before = content["seen"], content["seconds"]
            except KeyError as error:
                raise checkpoint.unreadable(error) from None
        if len(self.seen) > (seeds := eye.settings.seeds):
            config = checkpoint.path.parent / "config.yaml"
            cure = f"set it to that in {config}, or run into a new folder"
            raise ConfigError([f"seeds: expected at least the {len(self.seen)} done, got {seeds}; {cure}"])

    @property
    def seconds(self) -> float:
        """Spent so far, also before an interruption."""
        return self._before + time.perf_counter() - self._started

    @property
    def reference(self) -> Tensor:
        """Mean of the references."""
        return self.total / self.references

    def look(self, pressed: list[int]) -> None:
        """See what is still to be seen. KeyboardInterrupt, with all whole realisations saved, where a signal comes."""
        eye, sources, focus = self.eye, self.eye.settings.light.sources, self.eye.focus
        seeds = eye.settings.seeds
        references, own = realisations(8 * seeds, reference=True), realisations(seeds, reference=False)
        each = [1 + len(focus), 1 + len(focus) * len(sources)]
        before = self.references * each[0] + len(self.seen) * each[1]
        total = len(references) * each[0] + len(own) * each[1]
        with tqdm(total=total, initial=before, desc="looking", unit="picture", dynamic_ncols=True) as bar:
            try:
                for seed in references[self.references :]:
                    hologram = _hologram(eye, seed, bar)
                    pictures = torch.stack([_seen(eye, hologram, None, depth, bar) for depth in focus])
                    with deferred(pressed):
                        self.total, self.references = self.total + pictures, self.references + 1
                    self._keep(pressed)
                for seed in own[len(self.seen) :]:
                    hologram = _hologram(eye, seed, bar)
                    rows = [torch.stack([_seen(eye, hologram, source, at, bar) for at in focus]) for source in sources]
                    self.seen.append(torch.stack(rows))
                    self._keep(pressed)
            except Exception:
                self._save()
                raise
            except KeyboardInterrupt:
                with deferred(pressed):
                    self._save()
                raise
            with deferred(pressed):
                self._save()
            if pressed:
                raise KeyboardInterrupt

    def _keep(self, pressed: list[int]) -> None:
        if pressed:  # it came while it was held back
            raise KeyboardInterrupt
        if time.perf_counter() - self._saved > _SAVE_EVERY:
            self._save()

    def _save(self) -> None:
        content = {"total": self.total, "references": self.references, "seen": self.seen, "seconds": self.seconds}
        if self.references:
            self.checkpoint.save(content)
        self._saved = time.perf_counter()


def _hologram(eye: Observer, seed: int, bar: tqdm) -> Tensor:
    hologram, _ = eye.scene.hologram(eye.settings.seed + seed)
    bar.set_postfix(mem=f"{peak_memory() / 1e9:.2f}GB", refresh=False)
    bar.update()
    return hologram


def _seen(eye: Observer, hologram: Tensor, source: str | None, depth: float, bar: tqdm) -> Tensor:
    picture = eye.seen(hologram, source, depth)
    bar.update()
    return picture


def _write(out: Path, eye: Observer, looked: _Looked, values: dict[str, Any], files: Results) -> dict[str, Any]:
    """Arrays, pictures and the table of what was seen; returns its numbers."""
    reference, seen = looked.reference, torch.stack(looked.seen)  # [F, 3, h, w], [S, sources, F, 3, h, w]
    sources, focus = eye.settings.light.sources, eye.focus
    files.write(save_array, out / "arrays" / "retina.npy", seen[0])
    files.write(save_array, out / "arrays" / "reference.npy", reference)
    # Sources are set so that equal values are neutral grey, and each colour's light is that of the rendering.
    waves = eye.scene.settings.wavelengths
    matrix = srgb_matrix(waves, white_balance(waves)).float()
    with torch.no_grad():
        rendering = eye.scene.sampler().render(eye.scene.volume)[0].cpu()
    reference = equal_power(reference, rendering.expand_as(reference))
    shown, captions = [], []
    for f, depth in enumerate(focus):
        peak = gamut_map(linear_srgb(reference[f], matrix)).flatten().quantile(_BRIGHT)
        for s, source in enumerate(("reference", *sources)):
            light = reference[f] if s == 0 else equal_power(seen[0, s - 1, f], reference[f])
            picture = tone_map(gamut_map(linear_srgb(light, matrix)), peak=peak)
            files.write(write_bytes, out / "images" / f"{source}_{f}.png", encode_png(picture))
            shown.append(picture)
            kind = ", synthetic" if values["synthetic"] else ""
            captions.append(f"{source.replace('_', ' ')}, focus {depth * 1e3:.4g} mm{kind}")
    columns = len(sources) + 1
    rows = [
        pictures.comparison(shown[k : k + columns], captions[k : k + columns]) for k in range(0, len(shown), columns)
    ]
    for f, data in enumerate(rows):
        files.write(write_bytes, out / "images" / f"comparison_{f}.png", data)
    found = [
        eye.row(source, depth, seen[:, s, f], reference[f])
        for s, source in enumerate(sources)
        for f, depth in enumerate(focus)
    ]
    lengths = [wave * 1e9 for wave in waves]
    flat = [by_wavelength(row, lengths) for row in found]
    files.write(write_table, out / "table.csv", [{key: plain(value) for key, value in row.items()} for row in flat])
    return {"synthetic": values["synthetic"], "wavelengths_nm": lengths, "rows": found}
