"""The joint correction through display and eye, in a tiny form, and its wanted images."""

import csv

import pytest
import torch

from holotorch import Grid
from holotorch.cli import main
from holotorch.correction import PECProblem
from holotorch.experiments.joint.charts import chain
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Display, Eye, Retina, RetinaViews


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
def test_a_small_chain_is_complete_and_ahead(tmp_path, monkeypatch, capsys):
    for name, value in {
        "FULL": chain.Amount(size=96, frames=2, steps=6, seeds=(7, 8), checked=9),
        "PLANES": 3,
        "TRAINED": 2,
        "SOURCES": {None: "one wavelength"},
    }.items():
        monkeypatch.setattr(chain, name, value)
    monkeypatch.setattr(chain, "DISTANCE", "30 mm")
    monkeypatch.delenv("HOLOTORCH_VOLUMES", raising=False)
    made = chain.load_config
    phantom = ["volume={phantom: shells, samples: 24}"]
    monkeypatch.setattr(
        chain, "load_config", lambda path, words=(): made(path, [*words, *(phantom if "volume" in str(path) else [])])
    )
    assert main(["chart", "chain", "--out", str(tmp_path / "c")]) == 0
    assert {path.name for path in (tmp_path / "c").iterdir()} == {"chart.csv", "chart.png", "cost.csv", "verdict.txt"}
    out = capsys.readouterr().out
    deviation = float(out.partition("differs from them by ")[2].split()[0])
    assert deviation == pytest.approx(9**-0.5, rel=0.15)  # what the mean of nine differs from the exact one by
    lines = [line.partition("SSIM ")[2].split()[:2] for line in out.splitlines() if "; shown: " in line]
    means, worst = ([float(words[k].strip("(),")) for words in lines] for k in (0, 1))
    assert all(low <= mean for low, mean in zip(worst, means, strict=True)) and worst != means
    one_wavelength, sled, light_field, *others = means
    assert min(one_wavelength, sled, light_field) > max(others) + 0.05 and one_wavelength > light_field
    with (tmp_path / "c" / "chart.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["seed"] for row in rows] == ["7"] * 5 + ["8"] * 5


def test_a_magnified_picture_keeps_its_light_and_its_middle():
    picture = torch.zeros(1, 40, 50)
    picture[0, 18:23, 23:28] = 1  # about sample n // 2
    for scale in (0.8, 1.0, 1.25):
        moved = chain._scaled(picture, scale)
        assert moved.sum() == pytest.approx(25, rel=0.05)
        y, x = (moved[0].sum(axis) for axis in (1, 0))
        assert (y * torch.arange(40)).sum() / y.sum() == pytest.approx(20, abs=0.05)
        assert (x * torch.arange(50)).sum() / x.sum() == pytest.approx(25, abs=0.05)


def test_views_of_different_arrays_are_refused():
    one, other = (
        Retina(Grid(size, 16e-6), 530e-9, Display.planar(0.2), Eye(accommodation=0.25), tolerance=0.5)
        for size in (16, 18)
    )
    with pytest.raises(ValueError, match="the same grid and wavelengths"):
        RetinaViews([one, other])
    with pytest.raises(ValueError, match="at least one retina"):
        RetinaViews([])


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
def test_the_gradient_from_the_retina_to_the_heaters_is_that_of_finite_differences():
    grid = Grid((8, 9), 16e-6)
    retinas = [
        Retina(grid, 530e-9, Display.planar(0.2), Eye(1.2e-3, accommodation=z), tolerance=0.5) for z in (0.2, 0.3)
    ]
    target = 0.1 + torch.rand(1, 2, *grid.shape, dtype=torch.float64)
    options = {"frames": True, "amplitude": True, "limit": 3.5}
    problem = PECProblem(ThermalCrosstalk(0.7, 5), RetinaViews(retinas), target, **options)
    phase = 3 + torch.rand(2, 1, *grid.shape, dtype=torch.float64)
    assert torch.autograd.gradcheck(problem, phase.requires_grad_(), eps=1e-6, atol=1e-6)
