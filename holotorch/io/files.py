"""Reading of files, and atomic writing: a new file gets a temporary name, and is renamed when it is complete."""

import errno
import io
import json
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from torch import Tensor


@contextmanager
def replacing(path: Path, *, buffering: int = -1, needed: int | None = None) -> Iterator[IO[bytes]]:
    """Context manager that opens a temporary file beside ``path`` and renames it to ``path`` if the block succeeds.

    Args:
        path: The file to create or replace.
        buffering: As for ``open``. With 0, every write fails or succeeds at once, so that the block can catch the error
            of a full disk and keep what was written before; buffered data would be written, and fail, after the block.
        needed: Number of bytes to be written, which the message about a full disk states.

    Raises:
        OSError: The file cannot be written; the error names ``path``, not the temporary file.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb", buffering=buffering) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):  # removed before the free space is measured
            partial.unlink()
        reason = error.strerror or str(error)
        if needed is not None and error.errno in (errno.ENOSPC, errno.EDQUOT):
            free = shutil.disk_usage(path.parent).free
            reason += f" ({needed / 1e6:.3f} MB needed, {free / 1e6:.3f} MB free)"
        raise OSError(error.errno, reason, str(path)) from None
    finally:
        partial.unlink(missing_ok=True)


def append(stream: IO[bytes], data: bytes | memoryview) -> None:
    """Append ``data`` to a file opened with ``buffering=0``; after an OSError the file has its previous length."""
    start, done = stream.tell(), 0
    try:
        while done < len(data):  # a single call may write only a part
            done += stream.write(data[done:]) or 0
    except OSError:
        stream.seek(start)
        stream.truncate()
        raise


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically: completely or not at all."""
    with replacing(path, needed=len(data)) as stream:
        stream.write(data)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8, atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically; ValueError for NaN and infinity, which JSON cannot represent."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def without_nan(value: Any) -> Any:
    """JSON values in which None replaces NaN and infinity, so that they can be written."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_bytes(path: Path) -> bytes:
    """Content of a file; OSError if it cannot be read, or is a device such as /dev/zero, whose content never ends."""
    if path.is_char_device() or path.is_block_device():
        raise OSError(errno.EINVAL, "a device, not a file", str(path))
    return path.read_bytes()


def read_json(path: Path) -> Any:
    """Content of a JSON file; ValueError if it is damaged or nested too deeply, OSError as from :func:`read_bytes`."""
    try:
        return json.loads(read_bytes(path).decode("utf-8"))
    except RecursionError:
        raise ValueError("nested too deeply to be read") from None


def cache_folder() -> Path:
    """The folder for files that can be made or fetched again: ``holotorch`` in the user's cache ($XDG_CACHE_HOME)."""
    import pooch  # takes a while to import, and few commands need it

    return Path(pooch.os_cache("holotorch"))


def save_array(path: Path, tensor: Tensor) -> None:
    """Write a tensor as .npy with its dtype, atomically."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(tensor.detach().cpu().numpy()))
    write_bytes(path, buffer.getvalue())
