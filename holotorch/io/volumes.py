"""One function that loads volumes of all supported formats and asks for a spacing that a file does not state."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import DTypeLike

from holotorch.core import checks
from holotorch.core.quantities import VOXEL
from holotorch.io.formats import array_files, medical, raw_volumes, slices, vti
from holotorch.io.formats.scan import Scan, existing, number_type, split_member, triple
from holotorch.scene.volume import Volume

_READERS: dict[str, Callable[[Path], Scan]] = {
    ".mhd": raw_volumes.read_metaimage,
    ".mha": raw_volumes.read_metaimage,
    ".nrrd": raw_volumes.read_nrrd,
    ".nhdr": raw_volumes.read_nrrd,
    ".tif": slices.read_tiff,
    ".tiff": slices.read_tiff,
    ".npy": array_files.read_npy,
    ".nii": medical.read_nifti,
    ".nii.gz": medical.read_nifti,
}
# Readers of files that may hold several arrays, selected as path::name.
_MEMBER_READERS: dict[str, Callable[[Path, str | None], Scan]] = {
    ".npz": array_files.read_npz,
    ".vti": vti.read_vti,
    ".h5": array_files.read_hdf5,
    ".hdf5": array_files.read_hdf5,
    ".zarr": array_files.read_zarr,
}


def load_volume(
    path: str | Path,
    *,
    spacing: float | Sequence[float] | None = None,
    shape: Sequence[int] | None = None,
    dtype: DTypeLike | None = None,
    unit: str | None = None,
) -> Volume:
    """Read a volume with the dtype of the file; its spacing is in metres or marked as relative.

    Args:
        path: A file: raw (.raw, .raw.gz), MetaImage (.mhd, .mha), NRRD (.nrrd, .nhdr), TIFF with one page per slice
            (.tif, .tiff), one picture with the slices as tiles (.png), NumPy (.npy, .npz), VTK (.vti), NIfTI (.nii,
            .nii.gz) or HDF5 (.h5, .hdf5). Or a folder: numbered pictures, a DICOM series or Zarr. In a .npz, .vti, HDF5
            or Zarr with several arrays, path::name selects one.
        spacing: Distance between voxels along (z, y, x), or one number for cubic voxels. Required if the file states no
            spacing; otherwise it replaces the spacing of the file.
        shape: Number of voxels (D, H, W). Required for a tiled picture and for raw files whose names do not contain it;
            for other files it must equal the shape that they state.
        dtype: Type of raw voxels, such as "uint8", or ">i2" for big-endian. Required for raw files whose names do not
            contain it; for other files it must equal the dtype that they state.
        unit: Unit of ``spacing``: "m" (default), or "relative" for a volume whose size in metres is unknown.

    Returns:
        Voxels [D, H, W]. If they take over 1 GiB and over half of the free memory, and the file holds them in native
        byte order without compression, they are memory-mapped: the file is read on access and never written. Do not
        truncate such a file while it is in use: the operating system would end the program. NaN is not detected here,
        since this would read the whole file; :meth:`Volume.check_finite` detects it.

    Raises:
        ValueError: No such file, an unknown format, a spacing that neither the file nor the caller states or whose unit
            is unknown, a file that is shorter or longer than its header states, more than one number per voxel, or
            compressed voxels beyond the memory limit of :mod:`holotorch.io.formats.limits`.
        ImportError: The library for the format is not installed; the message states the command that installs it.
    """
    file, member = split_member(path)
    if shape is not None:
        shape = tuple(checks.whole("size of the volume", size, 1) for size in shape)
        if len(shape) != 3:
            raise ValueError(f"shape must be three sizes (D, H, W), got {shape}")
    scan = _read(existing(file), member, shape, dtype)
    if shape is not None and shape != scan.values.shape:
        raise ValueError(f"{file} holds {scan.values.shape} voxels (D, H, W), but shape={shape} was asked for")
    if dtype is not None and number_type(dtype).newbyteorder("=") != scan.values.dtype.newbyteorder("="):
        raise ValueError(f"{file} holds {scan.values.dtype.name}, but dtype={dtype!r} was asked for")
    if spacing is None:
        return _as_stated(file, scan, unit)
    steps = (spacing,) * 3 if isinstance(spacing, int | float | np.number) else tuple(spacing)
    if unit is None and any(checks.positive("spacing", step, "metres") > VOXEL.high for step in steps):
        hint = "1 mm is 1e-3. If the size of the volume is unknown, add unit='relative'"
        raise ValueError(f"spacing between voxels must be in metres, got {spacing!r}; {hint}")
    unit = unit or "m"
    # The origin is meaningful only in the unit of the spacing.
    origin = scan.origin if scan.spacing is not None and scan.unit == unit else (0.0, 0.0, 0.0)
    return Volume(_tensor(scan.values, file), steps, unit, origin, scan.orientation, scan.frame)  # type: ignore[arg-type]


def _as_stated(file: Path, scan: Scan, unit: str | None) -> Volume:
    if unit is not None:
        raise ValueError(f"unit={unit!r} is the unit of spacing=, which was not given")
    if scan.spacing is None or not all(np.isfinite(scan.spacing)) or min(scan.spacing) <= 0:
        hint = "such as (1e-3, 5e-4, 5e-4), or spacing=1, unit='relative' for cubic voxels of unknown size"
        raise ValueError(f"{file} does not state the spacing of its voxels: pass spacing=(z, y, x) in metres, {hint}")
    return Volume(
        _tensor(scan.values, file), triple(scan.spacing), scan.unit, scan.origin, scan.orientation, scan.frame
    )


def _read(file: Path, member: str | None, shape: Sequence[int] | None, dtype: DTypeLike | None) -> Scan:
    name = file.name.lower()
    for suffix, reader in _MEMBER_READERS.items():
        if name.endswith(suffix):
            return reader(file, member)
    if any((file / mark).exists() for mark in ("zarr.json", ".zarray", ".zgroup")):
        return array_files.read_zarr(file, member)
    if member is not None:
        raise ValueError(f"only {', '.join(_MEMBER_READERS)} hold named arrays, got {file}::{member}")
    if file.is_dir():
        is_series = any(path.is_file() and medical.is_dicom(path) for path in file.iterdir())
        return medical.read_dicom(file) if is_series else slices.read_folder(file)
    if name.endswith((".raw", ".raw.gz")):
        return raw_volumes.read_raw(file, shape, dtype)
    if name.endswith(".png"):
        return slices.read_tiles(file, shape)
    suffix = max((known for known in _READERS if name.endswith(known)), key=len, default=None)
    if suffix:
        return _READERS[suffix](file)
    if medical.is_dicom(file):
        raise ValueError(f"{file} is one DICOM slice; load the folder of its series")
    if shape is not None and dtype is not None:
        return raw_volumes.read_raw(file, shape, dtype)
    known = ", ".join((".raw", ".raw.gz", ".png", *_READERS, *_MEMBER_READERS))
    known += ", and folders of DICOM files or numbered pictures"
    hint = "For raw voxels under another extension, pass shape=(D, H, W) and dtype="
    raise ValueError(f"{file} has no known extension; known are {known}. {hint}")


def _tensor(values: np.ndarray, file: Path) -> torch.Tensor:
    if values.dtype.kind not in "buif" or values.dtype.itemsize > 8:
        raise ValueError(f"{file} holds {values.dtype} elements; convert them to integers or floats of up to 64 bits")
    if values.dtype == bool:
        values = values.view(np.uint8)
    elif values.dtype.kind == "u" and values.dtype.itemsize == 8:
        if values.size and int(values.max()) > np.iinfo(np.int64).max:
            raise ValueError(f"{file} holds unsigned 64-bit values above 2^63 - 1; divide or convert them first")
        values = values.astype(np.int64)
    if not values.dtype.isnative:  # torch supports only the native byte order
        values = values.astype(values.dtype.newbyteorder("="))
    if not values.flags.writeable or any(stride < 0 for stride in values.strides):
        values = values.copy()
    return torch.from_numpy(values)
