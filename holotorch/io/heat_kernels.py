"""Measured heat kernels: tables of the temperature rises around one heated pixel."""

import io
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from holotorch.io.files import read_bytes

_MOST_BYTES = 1 << 24


def load_heat_kernel(path: Path | str) -> Tensor:
    """Temperature rises [h, w], float64, from a NumPy file (.npy) or a table of numbers (.csv, .txt).

    ValueError for another suffix, a file that cannot be read, or one that is no table [h, w] of real numbers.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npy", ".csv", ".txt"):
        picture = path.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".exr")
        reason = ": levels of a picture are no temperatures, write the rises as numbers" if picture else ""
        raise ValueError(f"expected a heat kernel as .npy, .csv or .txt, got {path.name}{reason}")
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"more than {_MOST_BYTES >> 20} MiB")
        data = read_bytes(path)
        if path.suffix.lower() == ".npy":
            values = np.load(io.BytesIO(data), allow_pickle=False)
        else:
            text = data.decode("utf-8")
            delimiter = next((character for character in ",;\t" if character in text), None)
            values = np.loadtxt(io.StringIO(text), delimiter=delimiter, ndmin=2)
        if values.ndim != 2 or values.dtype.kind not in "iuf":
            raise ValueError(f"got {values.dtype} of shape {values.shape}")
    except (ValueError, OSError, EOFError, MemoryError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        expected = "expected a table of temperature rises, a line for each row of pixels"
        raise ValueError(f"{path}: {expected}: {reason}") from None
    return torch.from_numpy(values.astype(np.float64))
