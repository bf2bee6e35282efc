"""Files that belong to a volume: which ones a header may name, and what becomes of a volume whose file changes."""

import mmap
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from holotorch.io.formats.scan import uncompressed_from
from holotorch.io.volumes import load_volume

SHAPE = (4, 5, 6)
VOXELS = np.arange(120, dtype=np.uint8).reshape(SHAPE)
HEADERS = {
    "a.mhd": "NDims = 3\nDimSize = 6 5 4\nElementType = MET_UCHAR\nElementSpacing = 1 1 1\nElementDataFile = {name}\n",
    "a.nhdr": "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 6 5 4\nspacings: 1 1 1\nencoding: raw\n"
    "data file: {name}\n\n",
}


def header(folder: Path, kind: str, name: str) -> Path:
    (folder / kind).write_text(HEADERS[kind].format(name=name))
    return folder / kind


@pytest.mark.parametrize("kind", HEADERS)
def test_a_header_names_files_of_its_own_folder_only(tmp_path, kind):
    folder = tmp_path / "scan"
    (folder / "data").mkdir(parents=True)
    VOXELS.tofile(tmp_path / "secret.raw")
    VOXELS.tofile(folder / "data" / "a.raw")
    (folder / "link.raw").symlink_to(tmp_path / "secret.raw")
    (folder / "below").symlink_to(tmp_path)
    (folder / "same.raw").symlink_to("data/a.raw")
    for name in (
        str(tmp_path / "secret.raw"),
        "../secret.raw",
        "data/../../secret.raw",
        "link.raw",
        "below/secret.raw",
    ):
        with pytest.raises(
            ValueError, match="lies outside the header's folder; move the file itself .* beside the header, or load"
        ):
            load_volume(header(folder, kind, name))
    for name in ("data/a.raw", "same.raw", "./data/../data/a.raw", str(folder / "data" / "a.raw")):
        assert np.array_equal(load_volume(header(folder, kind, name)).values.numpy(), VOXELS)
    with pytest.raises(ValueError, match="which .* names, is not a file"):
        load_volume(header(folder, kind, "data"))


@pytest.mark.parametrize("kind", HEADERS)
def test_a_name_too_long_for_a_file_is_no_data_file(tmp_path, kind):
    with pytest.raises(ValueError, match="the data file .* names, cannot be read: File name too long"):
        load_volume(header(tmp_path, kind, "d" * 5000))


CUT = """
import os, sys
from holotorch.io.formats import limits
from holotorch.io.volumes import load_volume
limits.MEMORY_LIMIT = 1000  # as if it were a large one
for path in sys.argv[1:]:
    volume = load_volume(path, spacing=1, unit="relative")
    os.truncate(path, 200)
    print(int(volume.values.sum()), flush=True)
"""


def test_a_volume_outlives_its_file(tmp_path):
    """A mapped file that is cut short ends the program; what is less than half of the free memory is read."""
    values, files = np.ones((64, 64, 64), np.uint8), [tmp_path / "a_64x64x64_uint8.raw", tmp_path / "a.npy"]
    values.tofile(files[0])
    np.save(files[1], values)
    done = subprocess.run([sys.executable, "-c", CUT, *map(str, files)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, 2 * f"{64**3}\n"), done.stderr


def test_a_volume_larger_than_the_free_memory_is_mapped(tmp_path, monkeypatch):
    path = tmp_path / "a_64x64x64_uint8.raw"
    np.ones((64, 64, 64), np.uint8).tofile(path)
    monkeypatch.setattr("holotorch.io.formats.limits.MEMORY_LIMIT", 1000)
    for free, mapped in ((None, True), (2 * 64**3 - 1, True), (2 * 64**3, False)):
        monkeypatch.setattr("holotorch.io.formats.limits.available_memory", lambda free=free: free)
        values = uncompressed_from(path, (64, 64, 64), np.dtype(np.uint8), 0)
        assert values.sum() == 64**3 and isinstance(values.base, mmap.mmap | np.memmap) == mapped
