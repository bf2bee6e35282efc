"""Targets: YAML files of every kind of experiment, through ``check``, and of panels, cameras, catheters and studies."""

import json
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import torch
import yaml
from fuzz.commands import command
from fuzz.engine import Input, Refused, Target
from fuzz.mutate import NUMBERS, mutated
from fuzz.mutate_tree import LENGTHS, table_mutated, yaml_mutated
from paths import CONFIGS

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.panel.config import build_panel, load_panel
from holotorch.experiments.perception.study.config import load_study
from holotorch.experiments.tracking.devices import load_camera, load_catheter, load_headset

_GRID: dict[str, Any] = {"grid": {"shape": [32, 24], "pitch": "9 um"}}
_HOLOGRAM = {"shape": [64, 64], "pitch": "3.74 um", "distance": "5 mm", "depths": 4, "rays": 32}
_SMALL = {"volume": {"phantom": "shells", "samples": 16}, "hologram": _HOLOGRAM}
# Files of each kind and the settings that make them small; several have more of the settings that there are.
KINDS: dict[str, list[tuple[str, dict[str, Any]]]] = {
    "pec": [
        ("pec/fourier.yaml", _GRID),
        ("pec/fresnel.yaml", _GRID),
        ("pec/depths.yaml", _GRID),
        ("pec/capped.yaml", _GRID),
        ("pec/peripheral.yaml", _GRID),
        ("pec/fourier.yaml", {**_GRID, "solver": {"kind": "adam"}, "frames": 2, "multiplexing": "independent"}),
    ],
    "pec-study": [(f"pec/studies/{name}.yaml", {}) for name in ("limits", "focus", "lowpass")],
    "volume": [
        ("volume/c60.yaml", _SMALL),
        ("volume/hand.yaml", _SMALL),
        ("volume/tooth.yaml", {**_SMALL, "hologram": {**_HOLOGRAM, "depths": ["4 mm", "5 mm"], "cone": "disc"}}),
        ("demo_volume.yaml", {**_SMALL, "report": {"refocus": ["5 mm"], "seeds": 2}, "scale": 2, "phase": "ray"}),
    ],
    "eye": [
        ("eye/tooth.yaml", {"scene": {"config": "scene.yaml"}}),
        ("eye/focus.yaml", {"scene": {"config": "scene.yaml"}}),
        ("eye/tooth.yaml", {"scene": {"config": "scene.yaml"}, "display": {"kind": "planar", "distance": "30 mm"}}),
    ],
    "joint": [
        ("joint/teapot.yaml", {"volume": {"phantom": "shells", "samples": 16}}),
        ("joint/bonsai.yaml", {"volume": {"phantom": "shells", "samples": 16}}),
        ("joint/tooth.yaml", {"volume": {"phantom": "shells", "samples": 16}}),
    ],
    "measure": [
        ("tracking/measure.yaml", {"grid": {"rows": 3, "columns": 2}}),
        ("tracking/measure.yaml", {"protocol": "still"}),
        ("tracking/measure.yaml", {"protocol": "grid3d", "grid": {"rows": 2, "columns": 3, "reference": [2, 1]}}),
    ],
    "layout": [("perception/layout.yaml", {})],
    "analysis": [("perception/analysis.yaml", {})],
}


def configuration(name: str, changes: dict[str, Any]) -> bytes:
    """A configuration of the project with some of its settings changed."""
    data = yaml.safe_load((CONFIGS / name).read_text()) | changes
    return yaml.safe_dump(data, sort_keys=False).encode()


def _samples(kind: str, _: Path) -> list[Input]:
    made = [{"config.yaml": configuration(*each)} for each in KINDS[kind]]
    if kind == "eye":
        made = [each | {"scene.yaml": configuration("volume/c60.yaml", _SMALL)} for each in made]
    return made


def _only(_: Path, *, name: str, words: list[str]) -> list[Input]:
    return [{name: (CONFIGS / word).read_bytes()} for word in words]


def _yaml(rng: Random, made: Input, other: Input) -> Input:
    name = rng.choice([name for name in made if name.endswith(".yaml")])
    return made | {name: yaml_mutated(rng, made[name], other.get(name, made[name]))}


def _check(folder: Path) -> None:
    text = (folder / "config.yaml").read_bytes()
    (folder / "config.yaml").write_bytes(text.replace(b"scene.yaml", str(folder / "scene.yaml").encode()))
    printed = command("check", str(folder / "config.yaml"))
    assert printed.strip() and "Traceback" not in printed


def _words(rng: Random, made: Input, other: Input) -> Input:
    """Settings of the command line, instead of in the file."""
    words = []
    for _ in range(rng.choice((1, 1, 2, 3))):
        key = rng.choice(_keys(yaml.safe_load(made["config.yaml"])))
        value = rng.choice(
            (*NUMBERS, *LENGTHS, "[]", "{}", "[[]]", "null", "true", "x", "[1, 2]", "*a", "&a [*a]", "{", "'")
        )
        key = rng.choice((key, key, key, key, key + ".x", "x." + key, "." + key, key + ".", ""))
        words.append(f"{key}={value}" if rng.random() < 0.95 else key)
    return made | {"words.json": json.dumps(words).encode()}


def _keys(data: dict[str, Any]) -> list[str]:
    inside = [f"{key}.{below}" for key, value in data.items() if isinstance(value, dict) for below in _keys(value)]
    return [*map(str, data), *inside]


def _check_words(folder: Path) -> None:
    words = json.loads((folder / "words.json").read_text()) if (folder / "words.json").is_file() else []
    words = [word.replace("\0", "") for word in words]  # no argument can hold it
    command("check", str(folder / "config.yaml"), "--", *words)


def _panels(_: Path) -> list[Input]:
    table = b"level, phase\n0, 0\n32, 0.45\n128, 3.0  # half\n255, 6.26\n"
    own = yaml.safe_load((CONFIGS / "slm/lcos_2048.yaml").read_text())
    own["calibration"][0] = {"wavelength": "636 nm", "lut_file": "lut.txt"}
    own["dispersion"] = {"table": [["400 nm", 0.25], ["520 nm", 0.22], ["700 nm", 0.2]]}
    names = ("slm/lcos_1080p.yaml", "slm/lcos_2048.yaml")
    made = [{"panel.yaml": (CONFIGS / name).read_bytes(), "lut.txt": table} for name in names]
    return [*made, {"panel.yaml": yaml.safe_dump(own).encode(), "lut.txt": table}]


def _panel(folder: Path) -> None:
    panel = build_panel(load_panel(folder / "panel.yaml"), (636e-9, 520e-9, 455e-9))
    assert torch.isfinite(panel.lut).all()


def _table(rng: Random, made: Input, other: Input) -> Input:
    if rng.random() < 0.5:
        return _yaml(rng, made, other)
    return made | {"lut.txt": rng.choice((mutated, table_mutated))(rng, made["lut.txt"], other["lut.txt"])}


def _study(folder: Path) -> None:
    settings = load_study(folder / "config.yaml")
    try:
        design = settings.design(1)
    except ValueError as error:  # as the command words it
        raise Refused(str(error)) from None
    assert design.trials


_HEADSET = {"headset_from_camera": [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0.02], [0, 0, 0, 1]], "alignments": 3}
_BOTH = (ConfigError, Refused)

TARGETS = [
    *(Target(f"config-{kind}", partial(_samples, kind), _yaml, _check, (Refused,)) for kind in KINDS),
    *(Target(f"words-{kind}", partial(_samples, kind), _words, _check_words, (Refused,)) for kind in ("pec", "volume")),
    Target("config-panel", _panels, _table, _panel, (ConfigError,)),
    Target("config-study", partial(_only, name="config.yaml", words=["perception/study.yaml"]), _yaml, _study, _BOTH),
    Target(
        "config-camera",
        partial(_only, name="camera.yaml", words=["tracking/camera.yaml"]),
        _yaml,
        lambda folder: load_camera(folder / "camera.yaml") and None,
        (ConfigError,),
    ),
    Target(
        "config-catheter",
        partial(_only, name="catheter.yaml", words=["tracking/catheter.yaml"]),
        _yaml,
        lambda folder: load_catheter(folder / "catheter.yaml") and None,
        (ConfigError,),
    ),
    Target(
        "config-headset",
        lambda _: [{"headset.yaml": yaml.safe_dump(_HEADSET).encode()}],
        _yaml,
        lambda folder: load_headset(folder / "headset.yaml") and None,
        (ConfigError,),
    ),
]
