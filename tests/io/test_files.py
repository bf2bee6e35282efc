import json
from pathlib import Path

import numpy as np
import pytest
import torch

from holotorch.io.files import append, read_bytes, read_json, replacing, save_array, write_json, write_text


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    class Cut(Exception):
        pass

    def write_half():
        with replacing(path) as stream:
            stream.write(b"half of the new")
            raise Cut

    with pytest.raises(Cut):
        write_half()
    assert path.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["a.txt"]


def test_what_was_written_whole_outlives_a_full_disk(tmp_path, full_disk):
    path = tmp_path / "a.txt"
    with replacing(path, buffering=0) as stream:
        with pytest.raises(OSError), full_disk(1000):
            for _ in range(1000):
                append(stream, b"a line\n" * 9)
        append(stream, b"room again\n")
    assert path.read_bytes() == b"a line\n" * (9 * (1000 // 63)) + b"room again\n"
    assert [item.name for item in tmp_path.iterdir()] == ["a.txt"]


def test_arrays_keep_precision_and_values_even_when_strided(tmp_path):
    for dtype in (torch.float32, torch.float64, torch.complex64):
        tensor = torch.randn(3, 8, 9, dtype=dtype)[:, ::2, 1:]
        save_array(tmp_path / "a.npy", tensor)
        back = np.load(tmp_path / "a.npy")
        assert back.dtype == tensor.numpy().dtype
        np.testing.assert_array_equal(back, tensor.numpy())


def test_json_refuses_what_json_lacks(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"psnr": float("inf")})
    assert not list(tmp_path.iterdir())
    write_json(tmp_path / "a.json", {"unit": "µm"})
    assert json.loads((tmp_path / "a.json").read_text()) == {"unit": "µm"}


@pytest.mark.skipif(not Path("/dev/zero").is_char_device(), reason="this system has no devices among its files")
def test_a_device_that_never_ends_is_no_file():
    for read in (read_bytes, read_json):
        with pytest.raises(OSError, match="a device, not a file"):
            read(Path("/dev/zero"))
