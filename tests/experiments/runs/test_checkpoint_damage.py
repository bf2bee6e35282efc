"""A checkpoint goes on only with what was written into it."""

import io
import zipfile
from pathlib import Path

import pytest
import torch

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.saving import Checkpoint

STATE = {"x": torch.arange(1000, dtype=torch.float64) / 7, "active": torch.ones(3, dtype=torch.bool)}
CONTENT = {"state": STATE, "rows": [["0", "1.5"]], "seconds": 1.25, "nothing": None, "empty": torch.empty(0)}


def saved(folder: Path) -> Checkpoint:
    made = Checkpoint(folder / "checkpoint.pt", {"seed": 1})
    assert made.save(CONTENT)
    return made


def test_what_was_saved_comes_back(tmp_path):
    found = saved(tmp_path).load()
    assert found is not None and torch.equal(found["state"]["x"], STATE["x"])
    assert (found["rows"], found["seconds"], found["nothing"]) == ([["0", "1.5"]], 1.25, None)


def test_one_bit_of_a_number_is_damage(tmp_path):
    checkpoint = saved(tmp_path)
    data = bytearray(checkpoint.path.read_bytes())
    place = data.index(STATE["x"].numpy().tobytes())
    data[place + 8 * 500 + 3] ^= 1  # a relative change of 1e-9
    checkpoint.path.write_bytes(data)
    with pytest.raises(ConfigError, match=r"checkpoint\.pt cannot be read: it is damaged"):
        checkpoint.load()


def test_an_archive_that_unpacks_to_more_is_not_unpacked(tmp_path):
    checkpoint = saved(tmp_path)
    stream = io.BytesIO()
    with zipfile.ZipFile(checkpoint.path) as before, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as after:
        for name in before.namelist():
            after.writestr(name, before.read(name))
    checkpoint.path.write_bytes(stream.getvalue())
    with pytest.raises(ConfigError, match="it is damaged"):
        checkpoint.load()


def test_a_tensor_larger_than_its_file_is_not_looked_at(tmp_path):
    checkpoint = saved(tmp_path)
    content = CONTENT | {"x": torch.zeros(1).expand(10**13), "fingerprint": {"seed": 1}, "checksum": "0"}
    torch.save(content, checkpoint.path)
    with pytest.raises(ConfigError, match="it is damaged"):
        checkpoint.load()
