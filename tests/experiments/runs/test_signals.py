"""Signals while a checkpoint is written."""

import signal

import pytest
import torch

from holotorch.experiments.runs import saving
from holotorch.experiments.runs.saving import Checkpoint
from holotorch.experiments.runs.signals import interruptible


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_torch_writes_takes_effect_when_the_file_is_whole(number, tmp_path, monkeypatch):
    """An exception within torch's writer ends the process by SIGABRT (a find of scripts/kills.py)."""
    save, checkpoint = torch.save, Checkpoint(tmp_path / "checkpoint.pt", {})
    went_on = []

    def interrupted(content, stream):
        signal.raise_signal(number)
        save(content, stream)
        went_on.append(True)

    monkeypatch.setattr(saving.torch, "save", interrupted)
    with interruptible() as signals, pytest.raises(KeyboardInterrupt):
        checkpoint.save({"step": 3, "x": torch.ones(5)})
    assert signals == [number] and went_on
    content = checkpoint.load()
    assert content and content["step"] == 3 and torch.equal(content["x"], torch.ones(5))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
