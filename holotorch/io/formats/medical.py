"""Readers of medical formats: NIfTI files and folders of DICOM slices."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from holotorch.io.formats.limits import affordable, readable_at_once
from holotorch.io.formats.scan import Scan, extra, metres, placed, readable, three_axes

# Tolerated deviation of the distance between two slices from the median distance, as a fraction of the median. Files
# round positions, for instance to 0.01 mm.
_UNEVEN = 0.05


def read_nifti(path: Path) -> Scan:
    """Read a NIfTI file, .nii or .nii.gz, in the dtype of the file, or as float32 if the values have to be rescaled.

    A large .nii is memory-mapped. If the file states no unit of length, it is millimetres, as in other NIfTI readers.
    """
    nibabel = extra("nibabel", "reading NIfTI")
    with readable(path, "NIfTI file"):
        image = nibabel.load(path, mmap=not readable_at_once(path.stat().st_size))
        scaled = 8 if image.dataobj.slope != 1 or image.dataobj.inter != 0 else image.get_data_dtype().itemsize
        affordable(path, math.prod(image.shape) * scaled, path.stat().st_size)
        values = np.asanyarray(image.dataobj)
        matrix = np.asarray(image.affine, dtype=np.float64)
        unit = image.header.get_xyzt_units()[0].replace("unknown", "mm")
    if values.dtype != image.get_data_dtype() and values.dtype.kind == "f":
        # nibabel returns scaled values as float64; float32 is precise enough for scaled integers.
        values = values.astype(np.float32)
    values = three_axes(values.T, path)
    return placed(values, matrix[:3, :3].T, matrix[:3, 3], "m", metres(unit, path), "RAS")


def is_dicom(path: Path) -> bool:
    """Whether the file has the DICOM signature, since DICOM files often have no extension."""
    with open(path, "rb") as stream:
        return stream.read(132)[128:] == b"DICM"


class _Slice:
    """Header of one DICOM slice; lengths are in millimetres and vectors are (x, y, z)."""

    def __init__(self, path: Path, data: Any):
        def numbers(tag: str, *shape: int) -> np.ndarray | None:
            value = data.get(tag)
            return None if value is None else np.array([float(x) for x in value]).reshape(shape)

        position, cosines = numbers("ImagePositionPatient", 3), numbers("ImageOrientationPatient", 2, 3)
        if position is None or cosines is None:
            raise ValueError("it lacks ImagePositionPatient or ImageOrientationPatient")
        self.path = path
        self.series = str(data.get("SeriesInstanceUID", ""))
        # Whether the file has one frame and one number per pixel.
        self.single = int(data.get("SamplesPerPixel", 1)) == 1 and int(data.get("NumberOfFrames", 1)) == 1
        self.size = int(data.Rows), int(data.Columns)
        self.position = position  # of the first pixel
        self.cosines = cosines  # unit vectors from column to column and from row to row, [2, 3]
        self.spacing = numbers("PixelSpacing", 2)  # distances between rows and between columns
        thickness = data.get("SpacingBetweenSlices") or data.get("SliceThickness")
        self.thickness = None if thickness is None else float(thickness)
        self.scale = float(data.get("RescaleSlope", 1)), float(data.get("RescaleIntercept", 0))
        self.signed = bool(data.get("PixelRepresentation", 0))
        allocated = int(data.BitsAllocated)
        self.bits = allocated, int(data.get("BitsStored", allocated))  # per pixel: in the file, and in use
        self.normal = np.cross(cosines[0], cosines[1])
        self.height = float(self.normal @ position)  # position along the normal of the slice


def read_dicom(folder: Path) -> Scan:
    """Read the DICOM series in a folder, with one slice per file, in order of position along the normal of the slices.

    Values are rescaled by the slope and intercept that the files state. They are integers if slope and intercept are
    integers and equal in all slices, else float32.
    """
    pydicom = extra("pydicom", "reading DICOM")
    slices: list[_Slice] = []
    for path in sorted(path for path in folder.iterdir() if path.is_file() and is_dicom(path)):
        with readable(path, "DICOM file"):
            data = pydicom.dcmread(path, stop_before_pixels=True)
            if "Rows" in data:  # other DICOM files hold no image
                slices.append(_Slice(path, data))
    if not slices:
        raise ValueError(f"{folder} holds no DICOM images")
    _one_series(slices, folder)
    slices.sort(key=lambda header: header.height)
    step, kind = _step(slices, folder), _rescaled_type(slices)
    stored = sum(header.path.stat().st_size for header in slices)
    affordable(folder, len(slices) * math.prod(slices[0].size) * kind.itemsize, stored)
    values = np.empty((len(slices), *slices[0].size), kind)
    for index, header in enumerate(slices):
        slope, intercept = header.scale
        with readable(header.path, "DICOM image (if it is compressed, decompress it or install pylibjpeg)"):
            plane = pydicom.dcmread(header.path).pixel_array
        values[index] = plane if header.scale == (1, 0) else plane * slope + intercept
    first = slices[0]
    if first.spacing is None or step is None:
        return Scan(values)
    axes = [first.cosines[0] * first.spacing[1], first.cosines[1] * first.spacing[0], step]
    return placed(values, axes, first.position, "m", 1e-3, "LPS")


def _one_series(slices: Sequence[_Slice], folder: Path) -> None:
    """Raise ValueError unless all slices belong to one series and have the same geometry and pixel type."""
    series = sorted({header.series for header in slices})
    if len(series) > 1:
        raise ValueError(f"{folder} holds {len(series)} series, expected one; put each in a folder: {series}")
    first = slices[0]
    for header in slices:
        name = header.path.name
        if not header.single:
            raise ValueError(f"{folder}: expected one grey slice in each file, but {name} has colour or several frames")
        for what in ("size", "cosines", "spacing", "signed", "bits"):
            value, other = getattr(header, what), getattr(first, what)
            if (value is None) != (other is None) or (value is not None and not np.allclose(value, other, atol=1e-4)):
                raise ValueError(f"{folder}: slices must agree in {what}, but {name} has {value} and another {other}")


def _step(slices: Sequence[_Slice], folder: Path) -> np.ndarray | None:
    """Vector from one slice to the next in millimetres, or None for a single slice without a thickness."""
    first, last = slices[0], slices[-1]
    if len(slices) == 1:
        return None if first.thickness is None else first.normal * first.thickness
    gaps = np.diff([header.height for header in slices])
    usual = float(np.median(gaps))
    worst = int(np.argmax(np.abs(gaps - usual)))
    if abs(gaps[worst] - usual) > _UNEVEN * usual or usual <= 0:
        between = f"{slices[worst].path.name} and {slices[worst + 1].path.name}"
        reason = "a slice is missing" if gaps[worst] > usual else "a slice exists twice, or positions are uneven"
        raise ValueError(
            f"{folder}: slices must be evenly spaced, but {between} are {gaps[worst]:g} mm apart, and the median "
            f"distance is {usual:g} mm: {reason}"
        )
    return (last.position - first.position) / (len(slices) - 1)


def _rescaled_type(slices: Sequence[_Slice]) -> np.dtype:
    """Smallest type that holds every rescaled value that the stored bits can represent."""
    (slope, intercept), *others = {header.scale for header in slices}
    allocated, bits = slices[0].bits
    if others or not (slope.is_integer() and intercept.is_integer()):
        return np.dtype(np.float32)
    if (slope, intercept) == (1, 0):
        return np.dtype(f"{'i' if slices[0].signed else 'u'}{allocated // 8}")
    limits = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if slices[0].signed else (0, 2**bits - 1)
    ends = [int(slope) * limit + int(intercept) for limit in limits]
    # min_scalar_type returns a signed type for a negative number; one that holds -m - 1 also holds m.
    return np.min_scalar_type(min(-1, *ends, -max(ends) - 1))
