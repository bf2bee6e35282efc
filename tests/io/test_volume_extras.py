"""Formats whose libraries are extras: each test is skipped, with its reason, where the library is not installed."""

import gzip
import importlib

import cv2
import numpy as np
import pytest

from holotorch.io.volumes import load_volume

SHAPE = (4, 5, 6)
CUBES = {"spacing": 1, "unit": "relative"}
EXTRA = "an extra: pip install 'holotorch[volumes]'"
# x runs along the world's y, y along its -x: 0.5, 0.75 and 2 mm.
AFFINE = np.array([[0, -0.75, 0, 10], [0.5, 0, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1]])
TURNED = ((1, 0, 0), (0, 0, -1), (0, 1, 0))


def voxels(dtype="i2", shape=SHAPE):
    return np.random.default_rng(9).integers(0, 120, shape).astype(dtype)


def check(volume, values):
    assert volume.values.numpy().dtype == values.dtype.newbyteorder("=")
    np.testing.assert_array_equal(volume.values.numpy(), values)


def placed_like_the_affine(volume):
    assert volume.unit == "m" and volume.spacing == pytest.approx((2e-3, 0.75e-3, 0.5e-3))
    assert volume.origin == pytest.approx((30e-3, 20e-3, 10e-3))
    np.testing.assert_allclose(volume.orientation, TURNED, atol=1e-7)  # stored as float32


@pytest.fixture
def nibabel():
    return pytest.importorskip("nibabel", reason=EXTRA)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
@pytest.mark.parametrize("dtype", ["u1", "<i2", ">i2", "<f4"])
def test_nifti(tmp_path, nibabel, suffix, dtype):
    values = voxels(dtype)
    header = nibabel.Nifti1Header(endianness=">" if dtype[0] == ">" else "<")
    header.set_data_dtype(np.dtype(dtype))
    nibabel.save(nibabel.Nifti1Image(values.T, AFFINE, header), tmp_path / f"a{suffix}")
    volume = load_volume(tmp_path / f"a{suffix}")
    check(volume, values)
    # The header names no unit: millimetres.
    placed_like_the_affine(volume)


def test_nifti_units_scale_and_single_time(tmp_path, nibabel):
    image = nibabel.Nifti1Image(voxels().T[..., None], AFFINE)
    image.header.set_xyzt_units("micron")
    image.header.set_slope_inter(0.5, 3)
    nibabel.save(image, tmp_path / "a.nii")
    volume = load_volume(tmp_path / "a.nii")
    assert volume.spacing == pytest.approx((2e-6, 0.75e-6, 0.5e-6))
    stored = np.frombuffer((tmp_path / "a.nii").read_bytes()[352:], "<i2").reshape(SHAPE)
    check(volume, (stored * 0.5 + 3).astype("f4"))


def test_nifti_refusals(tmp_path, nibabel):
    def load(name, message):
        with pytest.raises(ValueError, match=message):
            load_volume(tmp_path / name)

    nibabel.save(nibabel.Nifti1Image(voxels("i2", (6, 5, 4, 3)), AFFINE), tmp_path / "series.nii")
    load("series.nii", r"got shape \(3, 4, 5, 6\): colours, vectors or a time series")
    colour = np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.save(nibabel.Nifti1Image(np.zeros((6, 5, 4), colour), AFFINE), tmp_path / "rgb.nii")
    load("rgb.nii", "not one real number per voxel; convert it to scalars")
    nibabel.save(nibabel.Nifti1Image(voxels().T, np.eye(4) + 0.3 * np.eye(4, k=1)), tmp_path / "sheared.nii")
    load("sheared.nii", "resample a sheared volume")
    for name in ("a.nii", "a.nii.gz"):
        nibabel.save(nibabel.Nifti1Image(voxels("i2", (9, 30, 40)), AFFINE), tmp_path / name)
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) // 2])
        load(name, "not a readable NIfTI file, or is truncated")
    (tmp_path / "text.nii.gz").write_bytes(gzip.compress(b"no volume"))
    load("text.nii.gz", "not a readable NIfTI file")


@pytest.fixture
def pydicom():
    return pytest.importorskip("pydicom", reason=EXTRA)


def write_series(folder, values, **changes):
    """Slices in files whose names run against their positions; a change may be a function of the slice's number."""
    from pydicom.dataset import FileDataset, FileMetaDataset  # pyright: ignore[reportMissingImports]
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid  # pyright: ignore[reportMissingImports]

    series = generate_uid()
    folder.mkdir(exist_ok=True)
    for index, plane in enumerate(values):
        meta = FileMetaDataset()
        meta.TransferSyntaxUID, meta.MediaStorageSOPClassUID = ExplicitVRLittleEndian, CTImageStorage
        meta.MediaStorageSOPInstanceUID = generate_uid()
        path = folder / f"IM{len(values) - index:03d}"
        data = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
        fields = {
            "SeriesInstanceUID": series,
            "Rows": plane.shape[0],
            "Columns": plane.shape[1],
            "SamplesPerPixel": 1,
            "PhotometricInterpretation": "MONOCHROME2",
            "BitsAllocated": 8 * plane.itemsize,
            "BitsStored": 8 * plane.itemsize,
            "HighBit": 8 * plane.itemsize - 1,
            "PixelRepresentation": int(plane.dtype.kind == "i"),
            "PixelSpacing": [0.75, 0.5],
            "ImageOrientationPatient": [0, 1, 0, -1, 0, 0],
            "ImagePositionPatient": [10, 20, 30 + 2 * index],
            "PixelData": plane.tobytes(),
        } | {key: value(index) if callable(value) else value for key, value in changes.items()}
        for key, value in fields.items():
            if value is not None:
                setattr(data, key, value)
        data.save_as(path, enforce_file_format=True)
    return folder


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2"])
def test_dicom_series(tmp_path, pydicom, dtype):
    (tmp_path / "README.txt").write_text("not a slice")
    volume = load_volume(write_series(tmp_path, voxels(dtype)))
    check(volume, voxels(dtype))
    placed_like_the_affine(volume)


@pytest.mark.parametrize(
    ("options", "dtype"),
    [
        ({"RescaleSlope": 1, "RescaleIntercept": -1024, "BitsStored": 12, "HighBit": 11}, "i2"),
        ({"RescaleSlope": 1, "RescaleIntercept": -1024}, "i4"),
        ({"RescaleSlope": 0.25, "RescaleIntercept": 3}, "f4"),
        ({"RescaleSlope": lambda index: 1 + index, "RescaleIntercept": 0}, "f4"),
    ],
)
def test_dicom_rescaling(tmp_path, pydicom, options, dtype):
    stored = voxels("u2", (4, 5, 6))
    stored[0, 0, 0] = 2 ** options.get("BitsStored", 16) - 1
    slope = options["RescaleSlope"]
    slopes = np.array([slope(i) if callable(slope) else slope for i in range(4)])[:, None, None]
    volume = load_volume(write_series(tmp_path / "ct", stored, **options))
    check(volume, (stored * slopes.astype(float) + options["RescaleIntercept"]).astype(dtype))


def test_dicom_single_slice(tmp_path, pydicom):
    volume = load_volume(write_series(tmp_path / "thick", voxels()[:1], SliceThickness=3))
    assert volume.shape == (1, 5, 6) and volume.spacing == pytest.approx((3e-3, 0.75e-3, 0.5e-3))
    with pytest.raises(ValueError, match="does not state the spacing"):
        load_volume(write_series(tmp_path / "thin", voxels()[:1]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ImagePositionPatient": lambda i: [10, 20, 30 + 2 * i + 2 * (i > 2)]}, "IM002 and IM001 are 4 mm apart, and "
         "the median distance is 2 mm: a slice is missing"),
        ({"ImagePositionPatient": lambda i: [10, 20, 30 + 2 * min(i, 2)]}, "0 mm apart.* a slice exists twice"),
        ({"ImagePositionPatient": [10, 20, 30]}, "0 mm apart"),
        ({"ImagePositionPatient": None}, "IM.* lacks ImagePositionPatient or ImageOrientationPatient"),
        ({"ImagePositionPatient": lambda i: [10 + i, 20, 30 + 2 * i]}, "resample a sheared volume .a tilted gantry"),
        ({"PixelSpacing": None}, "does not state the spacing"),
        ({"PixelSpacing": lambda i: [0.75, 0.5 + (i == 1)]}, "slices must agree in spacing, but IM003 has"),
        ({"SeriesInstanceUID": lambda i: f"1.2.{i // 2}"}, "holds 2 series, expected one; .*1.2.0.*1.2.1"),
        ({"SamplesPerPixel": 3}, "one grey slice in each file, but IM.* has colour"),
        ({"NumberOfFrames": 2}, "or several frames"),
        ({"PixelData": lambda i: bytes(20)}, "IM.* is not a readable DICOM image .if it is compressed"),
    ],
)  # fmt: skip
def test_dicom_refusals(tmp_path, pydicom, changes, message):
    with pytest.raises(ValueError, match=message):
        load_volume(write_series(tmp_path, voxels(), **changes))


def test_dicom_single_file_asks_for_the_folder(tmp_path, pydicom):
    write_series(tmp_path, voxels())
    with pytest.raises(ValueError, match="IM001 is one DICOM slice; load the folder of its series"):
        load_volume(tmp_path / "IM001")


def test_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py", reason=EXTRA)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["group/density"] = voxels(">f4")
        file["line"] = np.zeros(3)
    check(load_volume(tmp_path / "a.h5", **CUBES), voxels(">f4"))
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.create_dataset("other", data=voxels("u1"), compression="gzip")
    check(load_volume(f"{tmp_path}/a.h5::/other", **CUBES), voxels("u1"))
    for name, message in (
        ("a.h5", "exactly one volume; its arrays are: group/density, other; choose one by writing .*a.h5::name"),
        ("a.h5::lost", "has no array 'lost'; its arrays are: group/density, other"),
        ("a.h5::line", r"one scalar on three axes \(z, y, x\), got shape \(3,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            load_volume(f"{tmp_path}/{name}", **CUBES)
    content = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "a.h5").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="not a readable HDF5 file, or is truncated"):
        load_volume(tmp_path / "a.h5", **CUBES)


@pytest.mark.parametrize("version", [2, 3])
def test_zarr(tmp_path, version):
    zarr = pytest.importorskip("zarr", reason=EXTRA)
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=version)
    group.create_array("scan/density", data=voxels("f4"), chunks=(2, 2, 6))
    check(load_volume(tmp_path / "a.zarr", **CUBES), voxels("f4"))
    (tmp_path / "a.zarr").rename(tmp_path / "plain")
    check(load_volume(tmp_path / "plain", **CUBES), voxels("f4"))
    check(load_volume(tmp_path / "plain/scan/density", **CUBES), voxels("f4"))
    (tmp_path / "plain").rename(tmp_path / "a.zarr")
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="a")
    group.create_array("other", data=voxels("u1"))
    check(load_volume(f"{tmp_path}/a.zarr::other", **CUBES), voxels("u1"))
    with pytest.raises(ValueError, match="exactly one volume; its arrays are: .*scan/density"):
        load_volume(tmp_path / "a.zarr", **CUBES)
    with pytest.raises(ValueError, match="is a single array; load it without ::density"):
        load_volume(f"{tmp_path}/a.zarr/scan/density::density", **CUBES)
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(ValueError, match="not a readable Zarr folder"):
        load_volume(tmp_path / "empty.zarr", **CUBES)


@pytest.mark.parametrize(
    ("name", "module"), [("a.nii", "nibabel"), ("a.h5", "h5py"), ("a.zarr", "zarr"), ("series", "pydicom")]
)
def test_a_missing_extra_says_how_to_install_it(tmp_path, monkeypatch, name, module):
    def missing(wanted, package=None):
        assert wanted == module
        raise ImportError(wanted)

    monkeypatch.setattr(importlib, "import_module", missing)
    if "." in name:
        (tmp_path / name).write_bytes(b"x")
    else:
        (tmp_path / name).mkdir()
        (tmp_path / name / "IM1").write_bytes(bytes(128) + b"DICM")
    with pytest.raises(ImportError, match=rf"needs {module}, .*install it with: pip install 'holotorch\[volumes\]'"):
        load_volume(tmp_path / name)


def test_core_formats_need_no_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib, "import_module", lambda *names: pytest.fail(f"imported {names}"))
    np.save(tmp_path / "a.npy", voxels())
    cv2.imwrite(str(tmp_path / "a.png"), voxels("u1").reshape(20, 6))
    check(load_volume(tmp_path / "a.npy", **CUBES), voxels())
    check(load_volume(tmp_path / "a.png", shape=SHAPE, **CUBES), voxels("u1"))
