"""``holotorch calibrate headset``: from recorded alignments to a file, and what is said about bad ones."""

import csv
import math

import pytest
import torch
from oracles import boards as oracle

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking.devices import build_headset, headset_covariance, load_headset
from holotorch.experiments.tracking.headset import COLUMNS, alignment_text, axes_matrix, calibrate_headset

TURN = torch.tensor(oracle.rotation((0.3, -0.2, 0.5)))
SHIFT = torch.tensor([0.03, -0.08, 0.05], dtype=torch.float64)


def alignments(count=6, noise=0.0, axes="RDF", spread=1.0, seed=0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    tips = (torch.rand(count, 3, dtype=torch.float64, generator=generator) - 0.5) * 0.2 + torch.tensor([0, 0, 0.5])
    directions = torch.randn(count, 3, dtype=torch.float64, generator=generator) * spread + torch.tensor([0, 0.6, -0.6])
    directions = directions / directions.norm(dim=1, keepdim=True)
    seen = tips @ TURN.mT + SHIFT + noise * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    back = torch.linalg.inv(axes_matrix(axes)).mT  # coordinates along these axes
    return torch.cat([tips, directions, seen @ back, directions @ TURN.mT @ back], 1)


def write(path, values: torch.Tensor, columns=COLUMNS):
    with open(path, "w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(columns)
        table.writerows([[repr(value) for value in row] for row in values.tolist()])
    return path


@pytest.mark.parametrize("axes", ["RDF", "RUB", "ruf", "FLU"])
def test_the_map_comes_back_from_its_file_whatever_the_axes_of_the_headset(axes, tmp_path):
    path = write(tmp_path / "a.csv", alignments(axes=axes))
    found, _ = calibrate_headset(path, tmp_path / "headset.yaml", axes)
    torch.testing.assert_close(found.headset_from_camera[:3, :3], TURN, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.headset_from_camera[:3, 3], SHIFT, rtol=0, atol=1e-9)
    settings = load_headset(tmp_path / "headset.yaml")
    assert torch.equal(build_headset(settings), found.headset_from_camera) and settings.frame == "headset"
    covariance = headset_covariance(settings)
    assert covariance is not None
    torch.testing.assert_close(covariance, found.covariance, rtol=1e-9, atol=1e-15)


def test_the_command_says_what_the_alignment_is_worth(tmp_path, capsys):
    path, out = write(tmp_path / "a.csv", alignments(5, noise=1e-3)), tmp_path / "headset.yaml"
    assert main(["calibrate", "headset", str(path), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    for words in (
        "Alignments 5, residuals ",
        "Tip        expected within",
        "Alignment  3: ",
        "only 5 alignments",
        str(out),
    ):
        assert words in text
    stated = float(text.partition("expected within ")[2].split()[0])
    assert 0.2 < stated < 3
    assert main(["calibrate", "headset", str(path), "--out", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_an_alignment_that_slipped_is_named(tmp_path):
    values = alignments(7, noise=2e-4)
    values[3, 6:9] += torch.tensor([0.0, 0.02, 0.0])
    found, points = calibrate_headset(write(tmp_path / "a.csv", values), tmp_path / "headset.yaml")
    assert "alignment 4 does not fit the others; repeat it" in alignment_text(found, points)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (alignments(2), "needs 3 poses"),
        (alignments(6, spread=0.0), "hold the tool in directions that are"),
        (alignments(6, axes="RUF"), "left-handed"),
        (torch.where(torch.arange(12) == 3, math.nan, alignments()), "direction"),
        (1e3 * alignments(), "tip"),
    ],
)
def test_sets_that_determine_nothing_are_refused_with_advice(values, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        calibrate_headset(write(tmp_path / "a.csv", values), tmp_path / "headset.yaml")
    assert not (tmp_path / "headset.yaml").exists()


def test_what_is_wrong_in_a_file_or_an_order_is_said(tmp_path, capsys):
    path = write(tmp_path / "a.csv", alignments())
    for words, message in (
        (["headset", str(tmp_path / "none.csv")], "No such file"),
        (["headset", str(path), str(path)], "expected one file of alignments"),
        (["headset", str(path), "--board", "chessboard"], "no --board"),
        (["headset", str(path), "--axes", "RDD"], "expected one of R L, one of U D and one of F B"),
        (["photographs", "--axes", "RUB"], "--axes belongs to"),
    ):
        assert main(["calibrate", *words, "--out", str(tmp_path / "out.yaml")]) == 2
        assert message in capsys.readouterr().err
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[1].replace(lines[1].split(",")[2], "far", 1)]))
    with pytest.raises(ConfigError, match="a.csv:2: cannot be read as an alignment: could not convert"):
        calibrate_headset(path, tmp_path / "out.yaml")
    write(path, alignments(), [name.replace("headset", "glasses") for name in COLUMNS])
    with pytest.raises(ConfigError, match="columns headset_tip_x_m, .* are missing"):
        calibrate_headset(path, tmp_path / "out.yaml")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a text file"):
        calibrate_headset(path, tmp_path / "out.yaml")
