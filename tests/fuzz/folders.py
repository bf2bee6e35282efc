"""Targets: folders of runs, as ``report``, ``resume`` and ``export-slm`` read them."""

import io
import json
import signal
import tempfile
import zipfile
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from foreign import ATTACK, foreign
from fuzz.commands import command, files, without_figures
from fuzz.engine import Input, Refused, Target
from fuzz.mutate import mutated
from fuzz.mutate_headers import png_mutated
from fuzz.mutate_tree import json_mutated, table_mutated, yaml_mutated
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.pec.progress import Log

_PEC = [
    "pec/fourier.yaml",
    "grid={shape: [16, 16], pitch: 8 um}",
    "solver={kind: lbfgs, max_steps: 6}",
    "report.metrics=[psnr]",
]
_HOLOGRAM = "hologram={shape: [32, 32], pitch: 8 um, distance: 9 mm, depths: 4, rays: 16}"
_VOLUME = ["demo_volume.yaml", _HOLOGRAM, "volume={phantom: shells, samples: 8}", "report.seeds=2", "device=cpu"]
_CHANGES = {".json": json_mutated, ".yaml": yaml_mutated, ".csv": table_mutated, ".png": png_mutated}


@cache
def _run(config: str, *words: str) -> Input:
    """The files of a run, which two targets share: nobody changes them in place."""
    with without_figures(), tempfile.TemporaryDirectory() as folder:
        command("run", str(CONFIGS / config), *words, "--out", f"{folder}/run")
        return files(Path(folder))


def _reported(_: Path) -> list[Input]:
    made = [_run(*_PEC), _run(*_VOLUME)]
    return [{name: data for name, data in each.items() if not name.endswith((".npy", ".html"))} for each in made]


def _file_mutated(rng: Random, made: Input, other: Input, names: tuple[str, ...]) -> Input:
    """One or two files of a folder, sometimes left out; markup in place of some of their texts."""
    those = [name for name in made if name.endswith(names)]
    for name in rng.sample(those, rng.choice((1, 1, 2))):
        if rng.random() < 0.03:
            made = {each: data for each, data in made.items() if each != name}
            continue
        data = _CHANGES.get(Path(name).suffix, mutated)(rng, made[name], other.get(name, made[name]))
        if rng.random() < 0.3:
            data = _marked(rng, data)
        made = made | {name: data}
    return made


def _marked(rng: Random, data: bytes) -> bytes:
    """A word of a text as markup."""
    words = [word for word in set(data[:20_000].split(b'"')) if word.isalnum()]
    attack = json.dumps(ATTACK)[1:-1].encode()
    return data.replace(rng.choice(sorted(words)), attack, 1) if words else data + attack


def _report(folder: Path) -> None:
    command("report", str(folder / "run"))
    page = (folder / "run" / "report.html").read_text(encoding="utf-8")
    assert "<h1>" in page and not foreign(page)


def _interrupted(folder: Path) -> list[Input]:
    """A run that a signal has ended after four of its six steps."""
    original, calls = Log.__call__, []

    def noted(log: Log, solution: Any) -> None:
        calls.append(1)
        if len(calls) == 4:
            signal.raise_signal(signal.SIGTERM)
        original(log, solution)

    config, *words = _PEC
    with patch.object(Log, "__call__", noted), without_figures():
        assert main(["run", str(CONFIGS / config), *words, "--out", str(folder / "run")]) == 130
    return [{name: data for name, data in files(folder).items() if not name.endswith((".html", ".png"))}]


def _checkpoint_mutated(rng: Random, made: Input, other: Input) -> Input:
    name = "run/checkpoint.pt"
    if (kind := rng.random()) < 0.2:
        return _file_mutated(rng, made, other, (".json", ".yaml", ".npy"))
    if kind < 0.5:
        return made | {name: mutated(rng, made[name], other[name])}
    if kind < 0.6:
        return made | {name: _repacked(rng, made[name])}
    content = torch.load(io.BytesIO(made[name]), weights_only=True)
    holder = rng.choice([content, content["state"], content["state"]])
    for key in rng.sample(list(holder), rng.choice((1, 1, 2))):
        holder[key] = _tensor_mutated(rng, holder[key])
        if rng.random() < 0.1:
            del holder[key]
    stream = io.BytesIO()
    torch.save(content, stream)
    return made | {name: stream.getvalue()}


def _tensor_mutated(rng: Random, value: Any) -> Any:
    plain = (None, [], {}, "x", -1, 0, 10**12, float("nan"), [[1, 2, 3]], [["a"] * 7] * 3, torch.tensor(3))
    if not isinstance(value, torch.Tensor) or rng.random() < 0.2:
        return rng.choice(plain)
    match rng.randrange(8):
        case 0:
            return value[..., :1] if value.ndim else value[None]
        case 1:
            return value.to(rng.choice((torch.float16, torch.float64, torch.int32, torch.complex64, torch.bool)))
        case 2:
            return torch.full_like(value, 1) * rng.choice((-1, 0, 2**30, 10**12))
        case 3:
            return (value * torch.nan) if value.is_floating_point() else value.long() - 5
        case 4:
            return torch.zeros(1).expand(rng.choice(((10**12,), (10**5, 10**5), (3, 16, 16))))
        case 5:
            return torch.empty(0)
        case 6:
            return value[None].expand(rng.choice((2, 1000)), *value.shape)
        case _:
            return value.to_sparse() if value.ndim and value.is_floating_point() else value.long() + 1


def _repacked(rng: Random, data: bytes) -> bytes:
    """The archive with its parts compressed, one of them far larger than it was."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as before, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as after:
        grown = rng.choice([*before.namelist(), ""])
        for name in before.namelist():
            after.writestr(name, bytes(rng.choice((10**3, 3 * 10**8))) if name == grown else before.read(name))
    return stream.getvalue()


def _resumed(folder: Path) -> None:
    with without_figures():
        command("resume", str(folder / "run"))
    assert json.loads((folder / "run/summary.json").read_text())["status"] == "complete"
    assert np.isfinite(np.load(folder / "run/arrays/phase.npy")).all()


def _exported(_: Path) -> list[Input]:
    made = [_run(*_PEC), _run(*_VOLUME)]
    return [{name: data for name, data in each.items() if not name.endswith((".png", ".html"))} for each in made]


def _export(folder: Path) -> None:
    command("export-slm", str(folder / "run"), "--slm", str(CONFIGS / "slm/lcos_1080p.yaml"), "shape=[64,64]")


TARGETS = [
    Target("report", _reported, partial(_file_mutated, names=(".json", ".yaml", ".png")), _report, (Refused,)),
    Target("resume", _interrupted, _checkpoint_mutated, _resumed, (Refused,)),
    Target("export", _exported, partial(_file_mutated, names=(".json", ".yaml", ".npy")), _export, (Refused,)),
]
