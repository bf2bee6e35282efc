"""Every kind of experiment, from the command line as a new user gives it: without --out, in an empty directory."""

from pathlib import Path

import pytest
from paths import CONFIGS

from holotorch.cli import main

HOLOGRAM = "hologram={shape: [64, 64], pitch: 3.74 um, distance: 12 mm, depths: 4, rays: 32}"
SCENE = ["volume={phantom: c60, samples: 16}", HOLOGRAM]
QUICK = ["solver.max_steps=2", "report.baselines=[none]"]


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("pec/fourier", ["grid.shape=[16,16]", *QUICK]),
        ("pec/depths", ["grid.shape=[16,16]", *QUICK]),
        ("pec/peripheral", ["grid.shape=[16,32]", "solver.max_steps=2", "report.baselines=[unweighted]"]),
        ("pec/studies/iterations", ["size=24", "max_steps=2", "images=[coffee]"]),
        ("volume/c60", SCENE),
        (
            "eye/teapot",
            [
                f"scene={{config: configs/volume/c60.yaml, change: {SCENE}}}",
                *("seeds=1", "light={sources: [laser]}", "focus=[12 mm]", "eye.tolerance=0.5"),
            ],
        ),
        ("perception/layout", ["items=[{icon: boat, azimuth_deg: 50}]"]),
        (
            "perception/analysis",
            ["simulation.participants=6", "resamples=100", "power=null", "targets=[{seconds: 0.45}]"],
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_run_finds_its_own_folder(config, words, tmp_path, monkeypatch, capsys, tiny):
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(CONFIGS / f"{config}.yaml"), *words]) == 0
    folder = Path("runs") / f"{Path(config).name}-001"
    assert capsys.readouterr().out.splitlines()[-1] == str(folder / "report.html")
    assert (folder / "summary.json").is_file() and (folder / "report.html").is_file() and list(folder.glob("images/*"))
