"""Medical formats: NIfTI files and folders of DICOM slices, with lengths in millimetres."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from holotorch.io.formats.limits import affordable, readable_at_once
from holotorch.io.formats.scan import Scan, extra, placed, readable, three_axes

_NIFTI_METRES = {"unknown": 1e-3, "mm": 1e-3, "meter": 1.0, "micron": 1e-6}
_UNEVEN = 0.05  # tolerated deviation of a slice distance, relative to the median; files round positions to 0.01 mm


def read_nifti(path: Path) -> Scan:
    """Read NIfTI, .nii (mapped if large) or .nii.gz, in the dtype of the file, or as float32 if it states a scale.

    If a file states no unit, millimetres are assumed, as in other readers of the format.
    """
    nibabel = extra("nibabel", "reading NIfTI")
    with readable(path, "NIfTI file"):
        image = nibabel.load(path, mmap=not readable_at_once(path.stat().st_size))
        scaled = 8 if image.dataobj.slope != 1 or image.dataobj.inter != 0 else image.get_data_dtype().itemsize
        affordable(path, math.prod(image.shape) * scaled, path.stat().st_size)
        values = np.asanyarray(image.dataobj)
        matrix = np.asarray(image.affine, dtype=np.float64)
        unit = image.header.get_xyzt_units()[0]
    if values.dtype != image.get_data_dtype() and values.dtype.kind == "f":
        # nibabel scales in float64; float32 is precise enough for scaled integers.
        values = values.astype(np.float32)
    values = three_axes(values.T, path)
    return placed(values, matrix[:3, :3].T, matrix[:3, 3], "m", _NIFTI_METRES[unit])


def is_dicom(path: Path) -> bool:
    """Whether the file has the DICOM signature; such files often have no extension."""
    with open(path, "rb") as stream:
        return stream.read(132)[128:] == b"DICM"


@dataclass(frozen=True, eq=False)
class _Slice:
    """Header of one DICOM slice, with lengths in millimetres and vectors (x, y, z)."""

    path: Path
    series: str
    single: bool  # whether the file has one frame and one number per pixel
    size: tuple[int, int]  # (rows, columns)
    position: np.ndarray  # position of the first pixel
    cosines: np.ndarray  # [2, 3]: unit vectors from column to column and from row to row
    spacing: np.ndarray | None  # distances from row to row and from column to column
    thickness: float | None
    scale: tuple[float, float]  # slope and intercept
    signed: bool
    bits: tuple[int, int]  # bits allocated and bits stored per pixel

    @property
    def normal(self) -> np.ndarray:
        return np.cross(self.cosines[0], self.cosines[1])

    @property
    def height(self) -> float:
        return float(self.normal @ self.position)


def read_dicom(folder: Path) -> Scan:
    """Read one DICOM series of single slices, sorted by position and rescaled as stated in the headers.

    The result has integers if slope and intercept are whole numbers and equal for all slices; otherwise float32.
    """
    pydicom = extra("pydicom", "reading DICOM")
    paths = sorted(path for path in folder.iterdir() if path.is_file() and is_dicom(path))
    found = [_header(pydicom, path) for path in paths]
    slices = [header for header in found if header is not None]
    if not slices:
        raise ValueError(f"{folder} holds no DICOM images")
    _one_series(slices, folder)
    slices.sort(key=lambda header: header.height)
    across = _step(slices, folder)
    kind = _rescaled_type(slices)
    stored = sum(header.path.stat().st_size for header in slices)
    affordable(folder, len(slices) * math.prod(slices[0].size) * kind.itemsize, stored)
    values = np.empty((len(slices), *slices[0].size), kind)
    for index, header in enumerate(slices):
        slope, intercept = header.scale
        with readable(header.path, "DICOM image (if it is compressed, decompress it or install pylibjpeg)"):
            plane = pydicom.dcmread(header.path).pixel_array
        values[index] = plane if header.scale == (1, 0) else plane * slope + intercept
    first = slices[0]
    if first.spacing is None or across is None:
        return Scan(values)
    axes = [first.cosines[0] * first.spacing[1], first.cosines[1] * first.spacing[0], across]
    return placed(values, axes, first.position, "m", 1e-3)


def _header(pydicom: Any, path: Path) -> _Slice | None:
    """Header of a slice, or None for a DICOM file that holds no image."""

    def numbers(tag: str, shape: tuple[int, ...]) -> np.ndarray | None:
        value = data.get(tag)
        return None if value is None else np.array([float(x) for x in value]).reshape(shape)

    with readable(path, "DICOM file"):
        data = pydicom.dcmread(path, stop_before_pixels=True)
        if "Rows" not in data:
            return None
        position, cosines = numbers("ImagePositionPatient", (3,)), numbers("ImageOrientationPatient", (2, 3))
        if position is None or cosines is None:
            raise ValueError("it lacks position or orientation, so that the place of the slice is unknown")
        thickness = data.get("SpacingBetweenSlices") or data.get("SliceThickness")
        allocated = int(data.BitsAllocated)
        return _Slice(
            path,
            str(data.get("SeriesInstanceUID", "")),
            int(data.get("SamplesPerPixel", 1)) == 1 and int(data.get("NumberOfFrames", 1)) == 1,
            (int(data.Rows), int(data.Columns)),
            position,
            cosines,
            numbers("PixelSpacing", (2,)),
            None if thickness is None else float(thickness),
            (float(data.get("RescaleSlope", 1)), float(data.get("RescaleIntercept", 0))),
            bool(data.get("PixelRepresentation", 0)),
            (allocated, int(data.get("BitsStored", allocated))),
        )


def _one_series(slices: Sequence[_Slice], folder: Path) -> None:
    series = sorted({header.series for header in slices})
    if len(series) > 1:
        raise ValueError(f"{folder} holds {len(series)} series, expected one; move each to its own folder: {series}")
    first = slices[0]
    for header in slices:
        name = header.path.name
        if not header.single:
            raise ValueError(
                f"{folder}: expected files of one grey slice each, but {name} has colour or several frames"
            )
        for what in ("size", "cosines", "spacing", "signed", "bits"):
            here, there = (getattr(x, what) for x in (header, first))
            if (here is None) != (there is None) or (here is not None and not np.allclose(here, there, atol=1e-4)):
                raise ValueError(f"{folder}: slices must agree in {what}, but {name} has {here} and another {there}")


def _step(slices: Sequence[_Slice], folder: Path) -> np.ndarray | None:
    """Vector from one slice to the next in millimetres; None for a single slice that states no thickness."""
    first, last = slices[0], slices[-1]
    if len(slices) == 1:
        return None if first.thickness is None else first.normal * first.thickness
    gaps = np.diff([header.height for header in slices])
    usual = float(np.median(gaps))
    worst = int(np.argmax(np.abs(gaps - usual)))
    if abs(gaps[worst] - usual) > _UNEVEN * usual or usual <= 0:
        between = f"{slices[worst].path.name} and {slices[worst + 1].path.name}"
        reason = "a slice is missing" if gaps[worst] > usual else "a slice is there twice, or positions are uneven"
        raise ValueError(
            f"{folder}: slices must be evenly spaced, but {between} are {gaps[worst]:g} mm apart and most {usual:g} "
            f"mm: {reason}"
        )
    return (last.position - first.position) / (len(slices) - 1)


def _rescaled_type(slices: Sequence[_Slice]) -> np.dtype:
    (slope, intercept), *others = {header.scale for header in slices}
    allocated, bits = slices[0].bits
    if others or not (slope.is_integer() and intercept.is_integer()):
        return np.dtype(np.float32)
    if (slope, intercept) == (1, 0):
        return np.dtype(f"{'i' if slices[0].signed else 'u'}{allocated // 8}")
    limits = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if slices[0].signed else (0, 2**bits - 1)
    ends = [int(slope) * limit + int(intercept) for limit in limits]
    # The smallest signed type that holds both ends. min_scalar_type would return an unsigned type for a positive
    # maximum, so -maximum - 1 is used, which needs the signed type that also holds the maximum.
    return np.min_scalar_type(min(-1, *ends, -max(ends) - 1))
