"""Readers of NumPy, HDF5 and Zarr arrays with the axes (z, y, x). No spacing is read from them."""

import math
from pathlib import Path

import numpy as np

from holotorch.io.formats.limits import affordable
from holotorch.io.formats.scan import Scan, chosen, extra, readable, three_axes, uncompressed_from


def read_npy(path: Path) -> Scan:
    """Read a NumPy array; a large one is memory-mapped."""
    with readable(path, ".npy array"):
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
    if stored.flags.c_contiguous:
        values = uncompressed_from(path, stored.shape, stored.dtype, stored.offset)
    else:  # Fortran order: the bytes are those of the transposed array in C order
        values = uncompressed_from(path, stored.T.shape, stored.dtype, stored.offset).T
    return Scan(three_axes(values, path))


def read_npz(path: Path, member: str | None = None) -> Scan:
    """Read the array ``member`` of an .npz archive, or its only array."""
    with readable(path, ".npz archive"):
        archive = np.load(path, allow_pickle=False)
    with archive:
        name = chosen(archive.files, member, path)
        with readable(path, ".npz archive"):
            # The size that the header of the array states is checked before numpy allocates memory for it.
            entry = next(item for item in archive.zip.infolist() if item.filename in (name, f"{name}.npy"))
            with archive.zip.open(entry) as stream:
                version = np.lib.format.read_magic(stream)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(stream)
                stated, present = math.prod(shape) * dtype.itemsize, entry.file_size - stream.tell()
            if stated != present:
                raise ValueError(f"the header of its array {name} states {stated} bytes, and {present} follow")
            affordable(path, stated, path.stat().st_size)
            values = archive[name]
    return Scan(three_axes(values, path))


def read_hdf5(path: Path, member: str | None = None) -> Scan:
    """Read the dataset ``member`` of an HDF5 file, or its only dataset with three axes."""
    h5py = extra("h5py", "reading HDF5")
    axes: dict[str, int] = {}
    with readable(path, "HDF5 file"):
        file = h5py.File(path, "r")
    with file:
        with readable(path, "HDF5 file"):
            file.visititems(lambda name, item: axes.update({name: item.ndim}) if hasattr(item, "ndim") else None)
        name = chosen([name for name, count in axes.items() if count == 3 or name == member], member, path)
        with readable(path, "HDF5 file"):
            affordable(path, file[name].size * file[name].dtype.itemsize, path.stat().st_size)
            values = file[name][...]
    return Scan(three_axes(values, path))


def read_zarr(path: Path, member: str | None = None) -> Scan:
    """Read a Zarr array, or the array ``member`` of a Zarr group, by default its only array with three axes."""
    zarr = extra("zarr", "reading Zarr")
    with readable(path, "Zarr folder"):
        node = zarr.open(str(path), mode="r")
        single = hasattr(node, "ndim")
        arrays = {} if single else {name: item for name, item in node.members(max_depth=None) if hasattr(item, "ndim")}
    if single and member:
        raise ValueError(f"{path} is a single array; load it without ::{member}")
    if not single:
        node = arrays[chosen([name for name in arrays if arrays[name].ndim == 3 or name == member], member, path)]
    with readable(path, "Zarr folder"):
        stored = sum(item.stat().st_size for item in path.rglob("*") if item.is_file())
        affordable(path, node.size * node.dtype.itemsize, stored)
        values = np.asarray(node[...])
    return Scan(three_axes(values, path))
