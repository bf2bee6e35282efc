import base64
import struct
import zlib

import numpy as np
import pytest

from holotorch.io.volumes import load_volume

SHAPE = (4, 5, 6)
NAMES = {"u1": "UInt8", "i2": "Int16", "f4": "Float32"}


def voxels(dtype="u1", shape=SHAPE):
    return np.random.default_rng(8).integers(0, 120, shape).astype(dtype)


def packed(values, header, compress):
    """Length, or table of blocks, and the data, as VTK lays them out; blocks of 100 bytes to have several."""
    data, order = values.tobytes(), values.dtype.str[0].replace("|", "<")
    if not compress:
        return struct.pack(order + header, len(data)), data
    blocks = [zlib.compress(data[i : i + 100]) for i in range(0, len(data), 100)]
    table = [len(blocks), 100, len(data) % 100, *map(len, blocks)]
    return struct.pack(f"{order}{len(table)}{header}", *table), b"".join(blocks)


def write(path, values, form="ascii", *, header="I", compress=False, cells=False, together=False, **changes):
    depth, height, width = (n if cells else n - 1 for n in values.shape)
    table, data = packed(values, header, compress)
    code = base64.b64encode
    coded = code(table + data) if together else code(table) + code(data)
    text = {"ascii": " ".join(map(str, values.flat)).encode(), "binary": b"\n  " + coded + b"\n"}.get(form, b"")
    root = {
        "type": "ImageData",
        "byte_order": "BigEndian" if values.dtype.str[0] == ">" else "LittleEndian",
        "header_type": "UInt64" if header == "Q" else "UInt32",
    } | ({"compressor": "vtkZLibDataCompressor"} if compress else {})
    extent = f"0 {width} 0 {height} 0 {depth}"
    image = {"WholeExtent": extent, "Origin": "10 20 30", "Spacing": "0.5 0.75 2"}
    piece, array = {"Extent": extent}, {"type": NAMES[values.dtype.str[1:]], "Name": "density"}
    array["format"] = "appended" if form.startswith("appended") else form
    array |= {"offset": "0"} if form.startswith("appended") else {}
    optional = {"compressor": root, "Direction": image, "NumberOfComponents": array}
    for key, value in changes.items():
        target = next((tag for tag in (array, piece, image, root) if key in tag), None) or optional[key]
        target[key] = value

    def tag(name, attributes):
        return (f"<{name} " + " ".join(f'{k}="{v}"' for k, v in attributes.items() if v) + ">").encode()

    holder = b"CellData" if cells else b"PointData"
    out = [b'<?xml version="1.0"?>\n', tag("VTKFile", root), tag("ImageData", image), tag("Piece", piece)]
    out += [b"<", holder, b">", tag("DataArray", array), text, b"</DataArray></", holder, b">"]
    out += [b"</Piece></ImageData>"]
    if form == "appended raw":
        out += [b'<AppendedData encoding="raw">\n  _', table, data, b"\n</AppendedData>"]
    if form == "appended base64":
        out += [b'<AppendedData encoding="base64">\n  _', coded, b"\n</AppendedData>"]
    path.write_bytes(b"".join([*out, b"</VTKFile>\n"]))
    return path


@pytest.mark.parametrize("form", ["ascii", "binary", "appended raw", "appended base64"])
@pytest.mark.parametrize("dtype", ["u1", "<i2", ">f4"])
@pytest.mark.parametrize("options", [{}, {"compress": True}, {"header": "Q"}, {"header": "Q", "compress": True}])
def test_every_encoding(tmp_path, form, dtype, options):
    values = voxels(dtype)
    volume = load_volume(write(tmp_path / "a.vti", values, form, **options))
    np.testing.assert_array_equal(volume.values.numpy(), values)
    assert volume.values.numpy().dtype == values.dtype.newbyteorder("=")
    assert volume.unit == "relative" and volume.spacing == (2, 0.75, 0.5) and volume.origin == (30, 20, 10)


@pytest.mark.parametrize("ending", ["===", "======="])  # behind 117 letters: the last group has one
def test_damaged_base64_is_refused_as_other_damage(tmp_path, ending):
    file = write(tmp_path / "a.vti", voxels(), "binary")
    before, tag, after = file.read_bytes().partition(b"\n</DataArray>")
    file.write_bytes(before[:-43] + ending.encode() + tag + after)
    with pytest.raises(ValueError, match="bytes") as caught:
        load_volume(file)
    assert type(caught.value) is ValueError


def test_length_encoded_together_with_the_data(tmp_path):
    """Some writers do not end the base64 text after the length."""
    volume = load_volume(write(tmp_path / "a.vti", voxels(), "binary", together=True))
    np.testing.assert_array_equal(volume.values.numpy(), voxels())


def test_cells_direction_and_spacing_given(tmp_path):
    path = write(tmp_path / "a.vti", voxels(), cells=True, Direction="0 -1 0 1 0 0 0 0 1")
    volume = load_volume(path)
    np.testing.assert_array_equal(volume.values.numpy(), voxels())
    # Columns are the axes: x runs along the world's y, y along its -x. The first cell's middle is half a step inside.
    assert volume.orientation == ((1, 0, 0), (0, 0, -1), (0, 1, 0))
    assert volume.origin == (31, 20.25, 9.625)
    assert load_volume(path, spacing=1e-3).spacing == (1e-3, 1e-3, 1e-3)
    unstated = write(tmp_path / "b.vti", voxels(), Spacing=None)
    with pytest.raises(ValueError, match="does not state the spacing"):
        load_volume(unstated)


def test_one_of_several_arrays(tmp_path):
    path = write(tmp_path / "a.vti", voxels())
    text = path.read_text()
    array = text[text.index("<DataArray") : text.index("</PointData>")]
    other = array.replace('"density"', '"labels"')
    path.write_text(text.replace(array, array + other))
    with pytest.raises(ValueError, match="its arrays are: density, labels; choose one by writing .*a.vti::name"):
        load_volume(path)
    np.testing.assert_array_equal(load_volume(f"{path}::labels").values.numpy(), voxels())
    path.write_text(text.replace(array, array + other).replace("<PointData", '<PointData Scalars="labels"'))
    np.testing.assert_array_equal(load_volume(path).values.numpy(), voxels())


@pytest.mark.parametrize(
    ("form", "changes", "message"),
    [
        ("ascii", {"Extent": "0 6 0 4 0 3"}, r"expected 140 bytes = 4 x 5 x 7 .* found 120"),
        ("appended raw", {"Extent": "0 6 0 4 0 3"}, r"expected 140 bytes = 4 x 5 x 7 .* found 120"),
        ("binary", {"Extent": "0 6 0 4"}, "must state its Extent as six whole numbers"),
        ("ascii", {"type": "Bit"}, "array of type 'Bit'; known are Int8"),
        ("ascii", {"NumberOfComponents": "3"}, "'density' has 3 components per voxel, expected a scalar"),
        (
            "binary",
            {"compressor": "vtkLZ4DataCompressor", "compress": True},
            "compressed by vtkLZ4DataCompressor; write",
        ),
        ("ascii", {"Spacing": "0 1 1"}, "does not state the spacing"),
    ],
)
def test_refusals(tmp_path, form, changes, message):
    with pytest.raises(ValueError, match=message):
        load_volume(write(tmp_path / "a.vti", voxels(), form, **changes))


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("form", ["ascii", "binary", "appended raw", "appended base64"])
def test_truncated(tmp_path, form, compress):
    path = write(tmp_path / "a.vti", voxels("i2"), form, compress=compress)
    content = path.read_bytes()
    # The tags behind the voxels take 28 bytes or more.
    for end in range(0, len(content) - 28, 7):
        path.write_bytes(content[:end])
        with pytest.raises(ValueError, match="truncated|not a readable VTK XML|is empty"):
            load_volume(path)
