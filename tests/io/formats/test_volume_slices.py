import cv2
import numpy as np
import pytest
import tifffile

from holotorch.io.volumes import load_volume

SHAPE = (5, 7, 9)
CUBES = {"spacing": 1, "unit": "relative"}


def voxels(dtype="u2", shape=SHAPE):
    return np.random.default_rng(6).integers(1, 120, shape).astype(dtype)


def check(volume, values):
    assert volume.values.numpy().dtype == values.dtype
    np.testing.assert_array_equal(volume.values.numpy(), values)


@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "f4"])
@pytest.mark.parametrize("options", [{}, {"bigtiff": True}, {"byteorder": ">"}, {"compression": "zlib"}])
def test_tiff_stack(tmp_path, dtype, options):
    values = voxels(dtype)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", **options)
    check(load_volume(tmp_path / "a.tif", **CUBES), values)
    with pytest.raises(ValueError, match="does not state the spacing"):
        load_volume(tmp_path / "a.tif")


def test_tiff_of_one_page(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tiff"), voxels()[0])
    check(load_volume(tmp_path / "a.tiff", **CUBES), voxels()[:1])


@pytest.mark.parametrize("writer", ["opencv", "tifffile"])
@pytest.mark.parametrize("share", [0.001, 0.3, 0.6, 0.9, 0.99])
def test_truncated_tiff(tmp_path, writer, share, capfd):
    """OpenCV returns the pages before the cut and calls that a success."""
    values, path = voxels("u2", (5, 40, 50)), tmp_path / "a.tif"
    if writer == "opencv":
        cv2.imwritemulti(str(path), list(values))
    else:
        tifffile.imwrite(path, values, photometric="minisblack")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match="truncated|is not a TIFF file"):
        load_volume(path, **CUBES)


def test_tiff_refusals(tmp_path):
    def load(name, message):
        with pytest.raises(ValueError, match=message):
            load_volume(tmp_path / name, **CUBES)

    tifffile.imwrite(tmp_path / "rgb.tif", voxels("u1", (5, 7, 9, 3)), photometric="rgb")
    load("rgb.tif", "page 0 of .*rgb.tif has 3 colour channels, expected grey: one scalar per voxel")
    with tifffile.TiffWriter(tmp_path / "uneven.tif") as writer:
        for size in (7, 8):
            writer.write(voxels("u1", (size, 9)), photometric="minisblack")
    load(
        "uneven.tif",
        r"slices must be equal in shape and type, but page 1 of .* is \(8, 9\) of uint8 and the first is \(7, 9\)",
    )
    (tmp_path / "text.tif").write_text("II, but no picture")
    load("text.tif", "is not a TIFF file")
    # The only page's directory says that it follows itself.
    ring = b"II*\0\x08\0\0\0\x00\x00\x08\0\0\0"
    (tmp_path / "ring.tif").write_bytes(ring)
    load("ring.tif", "form a loop")


@pytest.mark.parametrize(("suffix", "dtype"), [("png", "u1"), ("png", "u2"), ("tif", "f4"), ("bmp", "u1")])
def test_folder_of_numbered_slices(tmp_path, suffix, dtype):
    """Numbers decide, not the order of the names: slice 10 comes after slice 9."""
    values = voxels(dtype, (4, 7, 9))
    for number, plane in enumerate(values, start=8):
        cv2.imwrite(str(tmp_path / f"ct2_{number}.{suffix}"), plane)
    (tmp_path / "notes.txt").write_text("not a slice")
    volume = load_volume(tmp_path, spacing=(2e-3, 1e-3, 1e-3))
    check(volume, values)
    assert volume.unit == "m" and volume.extent == pytest.approx((8e-3, 7e-3, 9e-3))


def test_folder_refusals(tmp_path):
    def load(message):
        with pytest.raises(ValueError, match=message):
            load_volume(tmp_path, **CUBES)

    load("holds no slices: neither DICOM, Zarr nor pictures")
    for number in (1, 2, 4, 6):
        cv2.imwrite(str(tmp_path / f"s{number}.png"), voxels()[0])
    load("of the slices 1 to 6, 2 are missing, the first is 3")
    for number in (3, 5):
        cv2.imwrite(str(tmp_path / f"s{number}.png"), voxels()[0, 1:] if number == 5 else voxels()[0])
    load(r"equal in shape and type, but .*s5.png is \(6, 9\) of uint16 and the first is \(7, 9\)")
    cv2.imwrite(str(tmp_path / "s5.png"), voxels("u1", (7, 9, 3)))
    load("s5.png has 3 colour channels")
    (tmp_path / "s5.png").write_bytes(b"\x89PNG")
    load("s5.png is not a readable picture")
    cv2.imwrite(str(tmp_path / "s05.png"), voxels()[0])
    load("holds slice 5 twice: s")
    (tmp_path / "s05.png").rename(tmp_path / "cover.png")
    load("cover.png has no number in its name")


def tiled(values, rows, columns):
    sheet = np.zeros((rows * values.shape[1], columns * values.shape[2]), values.dtype)
    for index, plane in enumerate(values):
        top, left = index // columns * plane.shape[0], index % columns * plane.shape[1]
        sheet[top : top + plane.shape[0], left : left + plane.shape[1]] = plane
    return sheet


@pytest.mark.parametrize(("rows", "columns"), [(1, 5), (5, 1), (2, 3), (3, 4)])
@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_tiled_picture(tmp_path, rows, columns, dtype):
    values = voxels(dtype)
    cv2.imwrite(str(tmp_path / "a.png"), tiled(values, rows, columns))
    check(load_volume(tmp_path / "a.png", shape=SHAPE, **CUBES), values)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (None, r"is one picture: pass shape=\(D, H, W\) if its tiles are slices"),
        ((7, 7, 9), "is 14 x 27 px and cannot be cut into 7 tiles of 7 x 9 px"),
        ((5, 6, 9), "cannot be cut into 5 tiles of 6 x 9"),
        ((5, 70, 9), "cannot be cut"),
        ((4, 7, 9), r"holds 5 slices of 7 x 9 px, got shape=\(4, 7, 9\)"),
    ],
)
def test_tiled_picture_refusals(tmp_path, shape, message):
    cv2.imwrite(str(tmp_path / "a.png"), tiled(voxels("u1"), 2, 3))
    with pytest.raises(ValueError, match=message):
        load_volume(tmp_path / "a.png", shape=shape, **CUBES)
