import bz2
import gzip
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
import pytest
from paths import SHARED

from holotorch.io.volumes import load_volume

SHAPE = (4, 5, 6)
CUBES = {"spacing": 1, "unit": "relative"}


def voxels(dtype="u2"):
    return np.random.default_rng(4).integers(0, 120, SHAPE).astype(dtype)


def write(path, data=b"", **fields):
    lines = {"type": "uint8", "dimension": "3", "sizes": "6 5 4", "encoding": "raw", "spacings": "1 2 3"} | fields
    text = "".join(f"{key.replace('_', ' ')}: {value}\n" for key, value in lines.items() if value)
    path.write_bytes(b"NRRD0004\n# a comment\n" + text.encode() + b"\n" + data)
    return path


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2", "ascii"])
@pytest.mark.parametrize("dtype", ["u1", "<i2", ">u2", ">f4", "<f8"])
def test_what_pynrrd_writes(tmp_path, encoding, dtype):
    values = voxels(dtype)
    for name in ("a.nrrd", "a.nhdr"):
        header = {"spacings": [0.5, 0.75, 2], "encoding": encoding, "units": ["mm", "mm", "um"]}
        nrrd.write(str(tmp_path / name), values, header, index_order="C")
        volume = load_volume(tmp_path / name)
        np.testing.assert_array_equal(volume.values.numpy(), values)
        assert volume.values.numpy().dtype == values.dtype.newbyteorder("=")
        assert volume.unit == "m" and volume.spacing == pytest.approx((2e-6, 0.75e-3, 0.5e-3))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere mappings reserve memory, and files are not sparse")
def test_uncompressed_data_are_mapped(tmp_path):
    path = write(tmp_path / "a.nrrd", sizes="4096 4096 4096")
    header = path.stat().st_size
    with open(path, "r+b") as stream:
        stream.truncate(header + 4096**3)
    assert load_volume(path).shape == (4096, 4096, 4096)
    path.unlink()


def test_space_directions(tmp_path):
    directions = {"space_directions": "(0,0.5,0) (-0.75,0,0) (0,0,2)", "space": "left-posterior-superior"}
    fields = directions | {"spacings": "", "space_origin": "(10,20,30)"}
    volume = load_volume(write(tmp_path / "a.nrrd", voxels("u1").tobytes(), **fields))
    assert volume.unit == "relative" and volume.spacing == pytest.approx((2, 0.75, 0.5))
    assert volume.origin == (30, 20, 10) and volume.orientation == ((1, 0, 0), (0, 0, -1), (0, 1, 0))
    units = write(tmp_path / "b.nrrd", voxels("u1").tobytes(), space_units='"mm" "mm" "mm"', **fields)
    volume = load_volume(units)
    assert volume.unit == "m" and volume.spacing == pytest.approx((2e-3, 0.75e-3, 0.5e-3))
    assert volume.origin == pytest.approx((30e-3, 20e-3, 10e-3))


def test_detached_data_and_skips(tmp_path):
    values = voxels("<i2")
    base: dict[str, Any] = {"type": "short", "endian": "little", "data_file": "data.bin"}
    for fields, data in (
        ({"line_skip": 2, "byte_skip": 3}, b"one\ntwo\n...%b" % values.tobytes()),
        ({"byte_skip": -1}, b"whatever length%b" % values.tobytes()),
        ({"encoding": "gzip", "byte_skip": 3}, gzip.compress(b"...%b" % values.tobytes())),
        ({"encoding": "bz2", "byte_skip": -1}, bz2.compress(b"any%b" % values.tobytes())),
    ):
        (tmp_path / "data.bin").write_bytes(data)
        volume = load_volume(write(tmp_path / "a.nhdr", b"", **base, **fields))
        np.testing.assert_array_equal(volume.values.numpy(), values)


@pytest.mark.parametrize("spacings", ["", "nan 1 1", "nan nan nan", "0 1 1"])
def test_unstated_spacing_is_asked_for(tmp_path, spacings):
    path = write(tmp_path / "a.nrrd", voxels("u1").tobytes(), spacings=spacings)
    with pytest.raises(ValueError, match="does not state the spacing of its voxels: pass spacing="):
        load_volume(path)
    assert load_volume(path, spacing=(1e-3, 2e-3, 3e-3)).extent == pytest.approx((4e-3, 10e-3, 18e-3))


@pytest.mark.parametrize(
    ("fields", "size", "message"),
    [
        (
            {},
            119,
            r"expected 120 bytes = 4 x 5 x 6 \(D x H x W\) of uint8, found 119; check shape and dtype, or .*trunc",
        ),
        ({}, 121, "found 121"),
        ({"type": "short"}, 240, "must state endian: little or endian: big for type short, got None"),
        ({"type": "block"}, 120, "type 'block', which is not a type of real numbers"),
        (
            {"sizes": "3 6 5 4", "dimension": "4", "kinds": "RGB-color domain domain domain"},
            360,
            "4 axes of kinds RGB-c",
        ),
        ({"sizes": "24 5", "dimension": "2"}, 120, "2 axes, sizes .24, 5.; expected one scalar on three axes"),
        ({"encoding": "hex"}, 240, "encoded as 'hex'; known are raw, gzip"),
        ({"encoding": "gzip"}, 120, "holds damaged gzip data"),
        ({"encoding": "bzip2"}, 120, "holds damaged bzip2 data"),
        ({"sizes": ""}, 120, "header of .*a.nrrd lacks sizes"),
        ({"units": '"mm" "mm" ""'}, 120, "gives units for 2 of three axes"),
        ({"units": '"inch" "mm" "mm"'}, 120, "spacing in 'inch'"),
        ({"data_file": "gone.raw"}, 0, "gone.raw, which .*a.nrrd names, does not exist"),
        ({"data_file": "LIST"}, 0, "one file per slice; load the folder"),
        ({"spacings": "", "space_directions": "(1,0) (0,1) (1,1)"}, 120, "three vectors of three components"),
    ],
)
def test_refusals(tmp_path, fields, size, message):
    with pytest.raises(ValueError, match=message):
        load_volume(write(tmp_path / "a.nrrd", bytes(size), **fields))


def test_truncated_gzip_and_foreign_content(tmp_path):
    path = write(tmp_path / "a.nrrd", gzip.compress(voxels("u1").tobytes())[:-12], encoding="gzip")
    with pytest.raises(ValueError, match="a.nrrd is truncated: its gzip data stop after"):
        load_volume(path)
    for content in (b"this is no volume", b"NRRD0004\nnonsense\n\n", b"NRRD0009\n"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="a.nrrd is not a readable NRRD header"):
            load_volume(path)


def shared_volumes():
    manifest = SHARED / "manifest.json"
    if not manifest.is_file():
        reason = "the shared volumes are not beside this checkout; small files above cover the same path"
        return [pytest.param(None, marks=pytest.mark.skip(reason=reason))]
    entries = json.loads(manifest.read_text())["files"]
    return [pytest.param(entry, id=Path(entry["file"]).stem) for entry in entries if entry["kind"] == "volume"]


@pytest.mark.parametrize("entry", shared_volumes())
def test_shared_volumes(entry):
    volume = load_volume(SHARED / entry["file"], shape=entry["shape"], dtype=entry["dtype"])
    metre = {"mm": 1e-3, "angstrom": 1e-10}.get(entry["spacing_unit"])
    assert volume.unit == ("m" if metre else "relative")
    assert volume.spacing == pytest.approx([step * (metre or 1) for step in entry["spacing_xyz"][::-1]])
    if "raw_sha512_published" in entry:
        assert hashlib.sha512(volume.values.numpy().tobytes()).hexdigest() == entry["raw_sha512_published"]
