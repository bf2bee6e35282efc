import gzip
import sys
import zlib

import numpy as np
import pytest

from holotorch.io.volumes import load_volume

SHAPE = (4, 5, 6)
CUBES = {"spacing": 1, "unit": "relative"}


def voxels(dtype="u2", shape=SHAPE):
    return np.random.default_rng(3).integers(0, 120, shape).astype(dtype)


def check(volume, values):
    assert volume.values.numpy().dtype == values.dtype.newbyteorder("=")
    np.testing.assert_array_equal(volume.values.numpy(), values)


def metaimage(folder, values, name="a.mhd", data="a.raw", **changes):
    depth, height, width = values.shape
    kinds = {"u1": "UCHAR", "i2": "SHORT", "u2": "USHORT", "f4": "FLOAT", "f8": "DOUBLE"}
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryDataByteOrderMSB": str(values.dtype.str[0] == ">"),
        "DimSize": f"{width} {height} {depth}",
        "ElementSpacing": "0.5 0.75 2",
        "ElementType": f"MET_{kinds[values.dtype.str[1:]]}",
    } | changes
    lines = [f"{key} = {value}\n" for key, value in fields.items() if value] + [f"ElementDataFile = {data}\n"]
    (folder / name).write_text("".join(lines))
    return folder / name


@pytest.mark.parametrize("dtype", ["u1", "i1", "<u2", ">i2", "<i4", ">u4", "<f4", ">f8"])
def test_raw_with_shape_and_type(tmp_path, dtype):
    values = voxels(dtype)
    values.tofile(tmp_path / "a.raw")
    volume = load_volume(tmp_path / "a.raw", shape=SHAPE, dtype=dtype, spacing=(3e-3, 1e-3, 2e-3))
    check(volume, values)
    assert volume.spacing == (3e-3, 1e-3, 2e-3) and volume.unit == "m"


def test_raw_takes_what_its_name_says(tmp_path):
    values = voxels("<i2")
    path = tmp_path / "thing_6x5x4_int16.raw"
    values.tofile(path)
    volume = load_volume(path, **CUBES)
    check(volume, values)
    assert volume.spacing == (1, 1, 1) and volume.unit == "relative"
    # What is said in the call counts for more.
    check(load_volume(path, dtype=">i2", **CUBES), values.view(">i2"))
    (tmp_path / "thing_6x5x4_int16.raw.gz").write_bytes(gzip.compress(values.tobytes()))
    check(load_volume(tmp_path / "thing_6x5x4_int16.raw.gz", **CUBES), values)
    path.rename(tmp_path / "thing.bin")
    check(load_volume(tmp_path / "thing.bin", shape=SHAPE, dtype="int16", **CUBES), values)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere mappings reserve memory, and files are not sparse")
def test_raw_is_mapped_not_read(tmp_path):
    """A sparse file of 64 GB, more than memory holds; and writing to the voxels leaves the file alone."""
    path = tmp_path / "large_4096x4096x4096_uint8.raw"
    with open(path, "wb") as stream:
        stream.truncate(4096**3)
        stream.seek(7 * 4096**2 + 5 * 4096 + 3)
        stream.write(b"\x2a")
    volume = load_volume(path, **CUBES)
    assert volume.shape == (4096, 4096, 4096) and volume.values[7, 5, 3] == 42 and volume.values[-1, -1, -1] == 0
    volume.values[7, 5, 3] = 1
    assert load_volume(path, **CUBES).values[7, 5, 3] == 42
    path.unlink()


def test_one_voxel(tmp_path):
    (tmp_path / "dot_1x1x1_uint8.raw").write_bytes(b"\x07")
    volume = load_volume(tmp_path / "dot_1x1x1_uint8.raw", **CUBES)
    assert volume.values.tolist() == [[[7]]] and volume.bricks().flatten().tolist() == [7, 7]


@pytest.mark.parametrize("found", [119, 121, 1])
def test_wrong_size_is_said_in_bytes(tmp_path, found):
    (tmp_path / "a.raw").write_bytes(bytes(found))
    with pytest.raises(
        ValueError, match=rf"expected 120 bytes = 4 x 5 x 6 \(D x H x W\) of uint8, found {found}; check"
    ):
        load_volume(tmp_path / "a.raw", shape=SHAPE, dtype="uint8", **CUBES)
    metaimage(tmp_path, voxels("u1"))
    with pytest.raises(ValueError, match=rf"a.raw: expected 120 bytes .* found {found}"):
        load_volume(tmp_path / "a.mhd")


def test_nan_is_found_where_it_lies(tmp_path):
    values = voxels("<f4")
    values[2, 4, 1] = values[3, 0, 0] = np.nan
    values.tofile(tmp_path / "a.raw")
    volume = load_volume(tmp_path / "a.raw", shape=SHAPE, dtype="<f4", **CUBES)
    with pytest.raises(ValueError, match=r"voxel \(z, y, x\) = \(2, 4, 1\) is nan \(2 of 120"):
        volume.check_finite()


@pytest.mark.parametrize("dtype", ["u1", "<i2", ">u2", ">f4"])
def test_metaimage_in_millimetres(tmp_path, dtype):
    values = voxels(dtype)
    values.tofile(tmp_path / "a.raw")
    volume = load_volume(metaimage(tmp_path, values, Offset="10 20 30", TransformMatrix="0 1 0 -1 0 0 0 0 1"))
    check(volume, values)
    assert volume.unit == "m" and volume.spacing == pytest.approx((2e-3, 0.75e-3, 0.5e-3))
    assert volume.origin == pytest.approx((30e-3, 20e-3, 10e-3))
    # Axis x runs along the world's y, axis y along its -x.
    assert volume.orientation == ((1, 0, 0), (0, 0, -1), (0, 1, 0))


def test_metaimage_variants(tmp_path):
    values = voxels("<i2")
    header = metaimage(tmp_path, values, "local.mha", "LOCAL", DistanceUnits="um").read_bytes()
    (tmp_path / "local.mha").write_bytes(header + values.tobytes())
    volume = load_volume(tmp_path / "local.mha")
    check(volume, values)
    assert volume.spacing == pytest.approx((2e-6, 0.75e-6, 0.5e-6))
    (tmp_path / "a.raw").write_bytes(b"seven b" + values.tobytes())
    for size in ("7", "-1"):
        check(load_volume(metaimage(tmp_path, values, HeaderSize=size)), values)
    for data, packed in (("a.zraw", zlib.compress(values.tobytes())), ("a.raw.gz", gzip.compress(values.tobytes()))):
        (tmp_path / data).write_bytes(packed)
        check(load_volume(metaimage(tmp_path, values, data=data, CompressedData="True")), values)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ElementNumberOfChannels": "3"}, "ElementNumberOfChannels = 3; expected one scalar"),
        ({"NDims": "4"}, "NDims = 4"),
        ({"ElementType": "MET_LONG"}, "ElementType = MET_LONG; known are MET_CHAR"),
        ({"DimSize": "6 5"}, "must give 3 numbers as DimSize, got '6 5'"),
        ({"DimSize": ""}, "must give 3 numbers as DimSize, got None"),
        ({"BinaryData": "False"}, "holds its voxels as text"),
        ({"ElementSpacing": ""}, "does not state the spacing.*pass spacing="),
        ({"ElementSpacing": "1 0 1"}, "does not state the spacing"),
        ({"DistanceUnits": "inch"}, "spacing in 'inch'; known are m, "),
        ({"data": "gone.raw"}, "data file .*gone.raw, which .*a.mhd names, does not exist"),
        ({"data": "a%03d.raw"}, "one file per slice; load the folder"),
        ({"data": "empty.raw"}, r"which .*a.mhd names, is empty \(0 bytes\)"),
        ({"TransformMatrix": "1 0 0.2 0 1 0 0 0 1"}, "resample a sheared volume"),
    ],
)
def test_metaimage_refusals(tmp_path, changes, message):
    voxels("u1").tofile(tmp_path / "a.raw")
    (tmp_path / "empty.raw").touch()
    with pytest.raises(ValueError, match=message):
        load_volume(metaimage(tmp_path, voxels("u1"), **changes))


@pytest.mark.parametrize("dtype", ["u1", "?", ">f4", "<u8", "<f2"])
def test_numpy(tmp_path, dtype):
    values = voxels(dtype)
    np.save(tmp_path / "a.npy", values)
    np.savez_compressed(tmp_path / "a.npz", density=values)
    wanted = values.astype({"?": "u1", "<u8": "i8"}.get(dtype, dtype))
    check(load_volume(tmp_path / "a.npy", **CUBES), wanted)
    check(load_volume(tmp_path / "a.npz", **CUBES), wanted)
    np.save(tmp_path / "columns.npy", np.asfortranarray(values))
    check(load_volume(tmp_path / "columns.npy", **CUBES), wanted)


def test_numpy_refusals(tmp_path):
    def load(name, message, error=ValueError):
        with pytest.raises(error, match=message):
            load_volume(f"{tmp_path}/{name}", **CUBES)

    np.savez(tmp_path / "two.npz", a=voxels(), b=voxels("f4"))
    load("two.npz", "exactly one volume; its arrays are: a, b; choose one by writing .*two.npz::name")
    load("two.npz::c", "has no array 'c'; its arrays are: a, b")
    check(load_volume(f"{tmp_path}/two.npz::b", **CUBES), voxels("f4"))
    for name, shape in (("colour", (4, 5, 6, 3)), ("flat", (5, 6))):
        np.save(tmp_path / f"{name}.npy", voxels("u1", shape))
    load(
        "colour.npy",
        r"one scalar on three axes \(z, y, x\), got shape \(4, 5, 6, 3\): colours, vectors or a time series",
    )
    load("flat.npy", "fewer than three axes")
    np.save(tmp_path / "complex.npy", voxels("c8"))
    load("complex.npy", "complex64 elements, not one real number")
    np.save(tmp_path / "large.npy", np.full(SHAPE, 2**63, "u8"))
    load("large.npy", "above 2.63 - 1; divide or convert")
    np.save(tmp_path / "objects.npy", np.full(SHAPE, None), allow_pickle=True)
    load("objects.npy", "not a readable .npy array")
    np.save(tmp_path / "none.npy", np.zeros((0, 2, 2)))
    load("none.npy", "not a readable .npy|every size must be above 0")
    for name in ("two.npz", "flat.npy"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) - 20])
        load(name, "truncated")


def test_damaged_gzip(tmp_path):
    values = voxels("u1", (20, 30, 40))
    packed = gzip.compress(values.tobytes())
    path = tmp_path / "a_40x30x20_uint8.raw.gz"
    for content, message in (
        (packed[:-9], "is truncated: its gzip data stop"),
        (packed[: len(packed) // 2], "is truncated: its gzip data stop"),
        (packed[:-8] + b"\0\0\0\0" + packed[-4:], "holds damaged gzip data: .*incorrect data check"),
        (b"no gzip at all", "holds damaged gzip data"),
        (gzip.compress(values.tobytes()[1:]), "expected 24000 bytes = 20 x 30 x 40 .* found 23999"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            load_volume(path, **CUBES)
    # Several members and padding are one file.
    half = [gzip.compress(values[:9].tobytes()), gzip.compress(values[9:].tobytes())]
    path.write_bytes(b"".join(half) + bytes(100))
    check(load_volume(path, **CUBES), values)


def test_what_is_not_said_is_asked_for(tmp_path):
    voxels("u1").tofile(tmp_path / "a.raw")
    (tmp_path / "empty_6x5x4_uint8.raw").touch()
    (tmp_path / "a.xyz").write_bytes(b"what")

    def load(name, message, **options):
        with pytest.raises(ValueError, match=message):
            load_volume(tmp_path / name, **options)

    whole = {"shape": SHAPE, "dtype": "uint8"}
    load("a.raw", r"has no header: pass shape=\(D, H, W\) and dtype=.*'>i2' if big-endian; or name it", **CUBES)
    metaimage(tmp_path, voxels("u1"))
    load("a.raw", "or load its header .*a.mhd", **CUBES)
    load("a.raw", r"does not state the spacing.*spacing=\(z, y, x\) in metres.*spacing=1, unit='relative'", **whole)
    load(
        "a.raw",
        "spacing between voxels must be in metres, got 1; 1 mm is 1e-3.*add unit='relative'",
        spacing=1,
        **whole,
    )
    load("a.raw", "must be 'm' or 'relative', got 'mm'", spacing=1, unit="mm", **whole)
    load("a.raw", "unit='m' is the unit of spacing=, which was not given", unit="m", **whole)
    load("a.raw", "dtype must name a type of number.*got 'uint9'", shape=SHAPE, dtype="uint9", **CUBES)
    load("a.raw", r"shape must be three sizes \(D, H, W\)", shape=(4, 30), dtype="uint8", **CUBES)
    load("a.raw", "size of the volume must be at least 1", shape=(4, 0, 30), dtype="uint8", **CUBES)
    load("empty_6x5x4_uint8.raw", r"is empty \(0 bytes\)", **CUBES)
    load("gone.raw", "gone.raw does not exist", **CUBES)
    load(
        "a.xyz",
        "no known extension; known are .raw, .raw.gz, .png, .mhd.*folders of DICOM.*raw voxels under another extension",
    )
    load("a.raw::b", "only .npz, .vti, .h5.* hold named arrays, got .*a.raw::b")
    load("a.mhd", r"holds \(4, 5, 6\) voxels \(D, H, W\), but shape=\(6, 5, 4\) was asked for", shape=(6, 5, 4))
    load("a.mhd", "holds uint8, but dtype='int16' was asked for", dtype="int16")


def test_spacing_given_replaces_what_the_file_states(tmp_path):
    values = voxels("u1")
    values.tofile(tmp_path / "a.raw")
    header = metaimage(tmp_path, values, Offset="10 20 30")
    volume = load_volume(header, spacing=(1e-3, 2e-3, 3e-3))
    assert volume.spacing == (1e-3, 2e-3, 3e-3) and volume.origin == pytest.approx((30e-3, 20e-3, 10e-3))
    relative = load_volume(header, spacing=2, unit="relative", shape=SHAPE, dtype="uint8")
    assert relative.spacing == (2, 2, 2) and relative.unit == "relative" and relative.origin == (0, 0, 0)


@pytest.mark.parametrize("size", ["inf inf inf", "nan 5 4", "6 5 0", "-6 -5 4", "6.5 5 4", "1e400 5 4"])
def test_sizes_that_are_no_counts_are_refused_by_name(tmp_path, size):
    voxels("u1").tofile(tmp_path / "a.raw")
    with pytest.raises(ValueError, match="a.mhd must give whole numbers of at least 1 as DimSize, got"):
        load_volume(metaimage(tmp_path, voxels("u1"), DimSize=size))
    with pytest.raises(ValueError, match="whole numbers of at least -1 as HeaderSize"):
        load_volume(metaimage(tmp_path, voxels("u1"), HeaderSize="inf"))


@pytest.mark.parametrize("dtype", ["cpu", "i4,i4", "O", "S4"])
def test_a_type_that_is_no_number_is_refused_for_every_format(tmp_path, dtype):
    voxels("u1").tofile(tmp_path / "a.raw")
    header = metaimage(tmp_path, voxels("u1"))
    for path in (header, tmp_path / "a.raw"):
        with pytest.raises(ValueError, match="dtype must name a type of number, such as 'uint8'"):
            load_volume(path, shape=SHAPE, dtype=dtype, **CUBES)
