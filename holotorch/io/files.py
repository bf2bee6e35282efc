"""Atomic writing of files: everything is written under a temporary name and renamed when complete."""

import errno
import io
import json
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

    With ``buffering`` 0 and :func:`append`, a block that handles the error of a full disk can end normally, since no
    buffered data remain whose writing could fail again. ``needed`` is the number of bytes to be written, which the
    message about a full disk states.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb", buffering=buffering) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):  # removed here, before ``_reason`` measures the free space
            partial.unlink()
        # The message names the final path, since the temporary one means nothing to the user.
        raise OSError(error.errno, _reason(error, path, needed), str(path)) from None
    finally:
        partial.unlink(missing_ok=True)


def _reason(error: OSError, path: Path, needed: int | None) -> str:
    """Error message of the system; for a full disk it adds the needed and the free space."""
    reason = error.strerror or str(error)
    if needed is None or error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return reason
    free = shutil.disk_usage(path.parent).free
    return f"{reason} ({needed / 1e6:.3f} MB needed, {free / 1e6:.3f} MB free)"


def append(stream: IO[bytes], data: bytes | memoryview) -> None:
    """Append ``data`` to an unbuffered file; if an OSError is raised, the file has its previous length."""
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
    """Write ``value`` as indented JSON, atomically; ValueError for NaN and infinity, which JSON lacks."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def read_bytes(path: Path) -> bytes:
    """Content of a file; OSError if it cannot be read or is a device, such as /dev/zero, which never ends."""
    if path.is_char_device() or path.is_block_device():
        raise OSError(errno.EINVAL, "a device, not a file", str(path))
    return path.read_bytes()


def read_json(path: Path) -> Any:
    """Content of a JSON file; ValueError if it is damaged or nested too deeply."""
    try:
        return json.loads(read_bytes(path).decode("utf-8"))
    except RecursionError:
        raise ValueError("nested too deeply to be read") from None


def save_array(path: Path, tensor: Tensor) -> None:
    """Write a tensor as .npy atomically, without changing its dtype."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(tensor.detach().cpu().numpy()))
    write_bytes(path, buffer.getvalue())
