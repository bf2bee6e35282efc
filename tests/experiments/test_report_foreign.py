"""A run folder from someone else: whatever its files say, nothing of it becomes a part of the page."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from foreign import ATTACK, foreign
from paths import CONFIGS
from tiny_runs import command

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.registry import load_config
from holotorch.experiments.report import write_report

SCENE = "hologram={shape: [32, 32], pitch: 3.74 um, distance: 5 mm, depths: 4}"
EYE = [
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 16}', "
    "'hologram={shape: [64, 64], pitch: 3.74 um, distance: 2 mm, depths: 4, rays: 32}']}",
    *("display={kind: planar, distance: 4 mm}", "eye={pupil_radius: 0.1 mm, axial_length: 2 mm}"),
    *("seeds=1", "light={sources: [laser]}", "focus=[2 mm]"),
]


@pytest.fixture(scope="module")
def runs(tmp_path_factory, tiny) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("runs")
    words = ["grid.shape=[16,16]", "solver.max_steps=2", "report.metrics=[psnr]"]
    execute(load_config(CONFIGS / "pec" / "fourier.yaml", words), base / "pec")
    volume = [SCENE, "volume.samples=8", "report.seeds=1"]
    execute(load_config(CONFIGS / "demo_volume.yaml", volume), base / "volume", "volume")
    execute(load_config(CONFIGS / "eye" / "teapot.yaml", EYE), base / "eye", "eye")
    for kind in ("study", "layout", "analysis"):
        assert main(command(kind, base / kind)) == 0
    return {kind: base / kind for kind in ("pec", "volume", "eye", "study", "layout", "analysis")}


def spoiled(value: Any) -> Iterator[Any]:
    """``value`` with each of its keys, texts, numbers and lists in turn replaced by markup."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from ({**value, key: each} for each in spoiled(item))
            yield {ATTACK if name == key else name: item for name, item in value.items()}
            yield {**value, ATTACK: item}
    elif isinstance(value, list):
        yield from (value[:k] + [each] + value[k + 1 :] for k, item in enumerate(value) for each in spoiled(item))
    yield ATTACK
    yield [ATTACK]


@pytest.mark.parametrize("kind", ["pec", "volume", "eye", "study", "layout", "analysis"])
def test_no_file_of_a_run_writes_into_its_page(runs, tmp_path, kind):
    folder, page = tmp_path / "run", tmp_path / "report.html"
    shutil.copytree(runs[kind], folder, ignore=shutil.ignore_patterns("*.png", "*.npy"))
    shown = 0
    for name in ("summary.json", "plan.json", "env.json"):
        if not (folder / name).is_file():
            continue
        text = (folder / name).read_text()
        for value in spoiled(json.loads(text)):
            (folder / name).write_text(json.dumps(value))
            try:
                write_report([folder], page)
            except ConfigError:
                continue
            found = page.read_text()
            shown += "&lt;script&gt;" in found
            assert foreign(found) == 0, json.dumps(value)[:400]
        (folder / name).write_text(text)
    assert shown > 10  # what is shown is shown as text
    (folder / "config.yaml").write_text(ATTACK)
    write_report([folder], page, {ATTACK: ATTACK})
    assert foreign(page.read_text()) == 0


def test_half_a_surrogate_pair_is_shown_as_a_question_mark(runs, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(runs["pec"], folder)
    env = json.loads((folder / "env.json").read_text())
    (folder / "env.json").write_text(json.dumps(env | {"machine": "half \ud800 pair"}))
    assert main(["report", str(folder)]) == 0
    assert "half ? pair" in (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("value", [10**400, "deep"])
def test_numbers_beyond_all_are_damage(runs, tmp_path, value):
    folder = shutil.copytree(runs["pec"], tmp_path / "run", ignore=shutil.ignore_patterns("*.png", "*.npy"))
    summary = json.loads((folder / "summary.json").read_text()) | {"peak_memory_bytes": value}
    text = json.dumps(summary).replace('"deep"', "[" * 100_000)
    (folder / "summary.json").write_text(text)
    with pytest.raises(ConfigError, match="holds a run that cannot be read: (OverflowError|ValueError)"):
        write_report([folder], tmp_path / "report.html")


def test_no_source_of_a_track_writes_into_its_page(tmp_path):
    (tmp_path / "images").mkdir()
    summary = {
        "experiment": "track",
        "source": ATTACK,
        "status": ATTACK,
        "failure": ATTACK,
        "answered": 1,
        "frames": 2,
        "notes": [ATTACK],
        "statuses": {ATTACK: 1},
        "stability": {ATTACK: ATTACK},
        "stages": [{"stage": ATTACK, "milliseconds": 1.0, "percent": 1.0}],
        "truth": {"frames": ATTACK, "wrong": ATTACK},
    }
    (tmp_path / "images" / "one.png").write_bytes(b"")
    (tmp_path / "summary.json").write_text(json.dumps(summary | {"pictures": {"one": ATTACK}}))
    (tmp_path / "env.json").write_text(json.dumps({ATTACK: ATTACK}))
    (tmp_path / "config.yaml").write_text(f"source: {ATTACK}")
    write_report([tmp_path], tmp_path / "report.html")
    found = (tmp_path / "report.html").read_text()
    assert foreign(found) == 0 and found.count("&lt;script&gt;") > 8
