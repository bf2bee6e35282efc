"""A run of the observer: holograms once, then every source and focus, pictures, a table and a page."""

import time
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments import eye_focus, eye_geometry, pictures
from holotorch.experiments.chart import write_table
from holotorch.experiments.config import load_config
from holotorch.experiments.config_eye import ObserverSettings
from holotorch.experiments.config_volume import VolumeSettings
from holotorch.experiments.environment import environment
from holotorch.experiments.errors import ConfigError
from holotorch.experiments.eye import Observer, observer, realisations
from holotorch.experiments.eye_plan import plan, plan_text, too_large
from holotorch.experiments.eye_report import by_wavelength
from holotorch.experiments.eye_tradeoff import fitted_prefactor, in_words, tradeoff
from holotorch.experiments.markup import plain
from holotorch.experiments.memory import peak_memory
from holotorch.experiments.report import write_report
from holotorch.experiments.run_folder import claim
from holotorch.experiments.signals import deferred, interruptible
from holotorch.io.bundled import find_config
from holotorch.io.colour_tables import srgb_matrix, white_balance
from holotorch.io.files import save_array, write_bytes, write_json, write_text
from holotorch.io.images import encode_png
from holotorch.optics.colour import desaturated, linear_srgb
from holotorch.optics.exposure import equal_power, exposed

_BRIGHT = 0.995  # of the reference's pixels are at most as bright as what is shown white


def scene_settings(settings: ObserverSettings) -> VolumeSettings:
    """The volume's configuration with its changes. ConfigError for one of another kind."""
    path = find_config(settings.scene.config)
    assert path is not None  # as its settings have checked
    found = load_config(path, list(settings.scene.change))
    if not isinstance(found, VolumeSettings):
        raise ConfigError([f"scene.config: {settings.scene.config} describes no volume but {found.experiment!r}"])
    return found


def run_observer(settings: ObserverSettings, out: Path | None, name: str) -> tuple[Path, bool]:
    """Carry a run out and fill a folder; returns and raises as :func:`holotorch.experiments.run.run`."""
    eye = observer(settings, scene_settings(settings))
    values = plan(eye)
    values["text"] = plan_text(eye, values)
    print(values["text"], flush=True)
    if text := too_large(values):
        raise ConfigError([text])
    folder = claim(out, name)
    for part in ("arrays", "images"):
        (folder / part).mkdir(exist_ok=True)
    write_text(folder / "config.yaml", yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
    write_json(folder / "plan.json", values)
    write_bytes(folder / "images" / "geometry.png", eye_geometry.draw(eye))
    write_json(folder / "env.json", environment(settings.seed, eye.scene.device))
    started = time.perf_counter()
    references, own = realisations(8 * settings.seeds, reference=True), realisations(settings.seeds, reference=False)
    sources, focus = settings.light.sources, eye.focus
    reference, seen = torch.zeros(()), []
    total = len(references) * (1 + len(focus)) + len(own) * (1 + len(focus) * len(sources))
    with interruptible() as pressed, tqdm(total=total, desc="looking", unit="picture", dynamic_ncols=True) as bar:
        try:
            for seed in references:
                hologram = _hologram(eye, seed, bar)
                reference = reference + torch.stack([_seen(eye, hologram, None, depth, bar) for depth in focus])
            reference = reference / len(references)
            for seed in own:
                hologram = _hologram(eye, seed, bar)
                rows = [torch.stack([_seen(eye, hologram, source, at, bar) for at in focus]) for source in sources]
                seen.append(torch.stack(rows))
        except KeyboardInterrupt:
            if not seen:
                raise
        with deferred(pressed):
            _write(folder, eye, reference, torch.stack(seen), values, time.perf_counter() - started, not pressed)
    if settings.sweep and not pressed:
        sweep = eye_focus.focus_sweep(eye, settings.sweep)
        write_table(folder / "focus.csv", [band.row for band in sweep.bands])
        write_bytes(folder / "images" / "focus.png", eye_focus.draw(sweep))
        print("\n".join(eye_focus.in_words(sweep)))
        write_report([folder], folder / "report.html")
    if settings.tradeoff and not pressed:
        cases = tradeoff(settings, scene_settings(settings), settings.tradeoff)
        write_table(folder / "tradeoff.csv", [case.row(fitted_prefactor(cases)) for case in cases])
        print("\n".join(in_words(cases)))
    return folder, not pressed


def _hologram(eye: Observer, seed: int, bar: tqdm) -> Tensor:
    hologram, _ = eye.scene.hologram(eye.settings.seed + seed)
    bar.set_postfix(mem=f"{peak_memory() / 1e9:.2f}GB", refresh=False)
    bar.update()
    return hologram


def _seen(eye: Observer, hologram: Tensor, source: str | None, depth: float, bar: tqdm) -> Tensor:
    picture = eye.seen(hologram, source, depth)
    bar.update()
    return picture


def _write(
    out: Path, eye: Observer, reference: Tensor, seen: Tensor, values: dict[str, Any], seconds: float, complete: bool
) -> None:
    """``reference`` [F, 3, h, w], ``seen`` [S, sources, F, 3, h, w]."""
    sources, focus = eye.settings.light.sources, eye.focus
    save_array(out / "arrays" / "retina.npy", seen[0])
    save_array(out / "arrays" / "reference.npy", reference)
    # Sources are set so that equal values are neutral grey, and each colour's light is that of the rendering.
    waves = eye.scene.settings.wavelengths
    matrix = srgb_matrix(waves, white_balance(waves)).float()
    with torch.no_grad():
        rendering = eye.scene.sampler().render(eye.scene.volume)[0].cpu()
    reference = equal_power(reference, rendering.expand_as(reference))
    shown, captions = [], []
    for f, depth in enumerate(focus):
        peak = desaturated(linear_srgb(reference[f], matrix)).flatten().quantile(_BRIGHT)
        for s, source in enumerate(("reference", *sources)):
            light = reference[f] if s == 0 else equal_power(seen[0, s - 1, f], reference[f])
            picture = exposed(desaturated(linear_srgb(light, matrix)), peak=peak)
            write_bytes(out / "images" / f"{source}_{f}.png", encode_png(picture))
            shown.append(picture)
            kind = ", synthetic" if values["synthetic"] else ""
            captions.append(f"{source.replace('_', ' ')}, focus {depth * 1e3:.4g} mm{kind}")
    columns = len(sources) + 1
    rows = [
        pictures.comparison(shown[k : k + columns], captions[k : k + columns]) for k in range(0, len(shown), columns)
    ]
    for f, data in enumerate(rows):
        write_bytes(out / "images" / f"comparison_{f}.png", data)
    found = [
        eye.row(source, depth, seen[:, s, f], reference[f])
        for s, source in enumerate(sources)
        for f, depth in enumerate(focus)
    ]
    lengths = [wave * 1e9 for wave in waves]
    flat = [by_wavelength(row, lengths) for row in found]
    write_table(out / "table.csv", [{key: plain(value) for key, value in row.items()} for row in flat])
    summary = {
        "experiment": "eye",
        "status": "complete" if complete else "interrupted",
        "synthetic": values["synthetic"],
        "wavelengths_nm": lengths,
        "realisations": len(seen),
        "rows": found,
        "seconds": round(seconds, 2),
        "peak_memory_bytes": peak_memory(),
    }
    write_json(out / ("summary.json" if complete else "interrupted.json"), summary)
    write_report([out], out / "report.html")
