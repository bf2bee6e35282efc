"""Checkpoints and results on a disk that may be full: what cannot be written is told, and the rest is written."""

import hashlib
import math
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.fingerprint import Fingerprint, differences
from holotorch.io.files import replacing


class Checkpoint:
    """What it takes to go on with a run. A failure to write it is told once per cause, and is no reason to stop.

    Attributes:
        path: The file; the one before stays until a new one is complete.
        fingerprint: Of the configuration and inputs of the run; what another one has left is refused.
        failure: Why the last :meth:`save` wrote nothing, or None.
    """

    def __init__(self, path: Path, fingerprint: Fingerprint):
        self.path, self.fingerprint = path, fingerprint
        self.failure: OSError | None = None
        self._told: set[int | None] = set()

    def load(self) -> dict[str, Any] | None:
        """What was saved last; None where nothing was. ConfigError for one of another configuration, or damaged."""
        if not self.path.is_file():
            return None
        try:
            with zipfile.ZipFile(self.path) as archive:
                if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                    raise ValueError("packed, which may take any memory to unpack, and torch packs nothing")
            content = torch.load(self.path, weights_only=True)
            stated = content.pop("checksum", None)
            if "fingerprint" in content and stated != checksum(content, self.path.stat().st_size):
                raise ValueError("changed after it was written")
        except Exception as error:  # what damaged bytes raise when unpickled is anyone's guess
            raise self.unreadable(error) from None
        self._check(content.get("fingerprint"))
        return content

    def _check(self, before: Fingerprint | None) -> None:
        config = self.path.parent / "config.yaml"
        cure = f"run into a new folder: holotorch run {config} --out NEW"
        if not isinstance(before, dict):
            words = f"{self.path} does not say which configuration it belongs to, as those of older versions do not"
            raise ConfigError([f"{words}; {cure}"])
        if changed := differences(before, self.fingerprint):
            words = f"{self.path} belongs to another configuration: {', '.join(changed)}"
            raise ConfigError([f"{words}; undo that in {config}, or {cure}"])

    def unreadable(self, error: Exception) -> ConfigError:
        """What to say of a checkpoint whose content is not what it should be."""
        reason = error.strerror if isinstance(error, OSError) else "it is damaged"
        return ConfigError([f"{self.path} cannot be read: {reason}; delete the folder and run again"])

    def save(self, content: dict[str, Any]) -> bool:
        """Write tensors and plain values; False where that is not possible."""
        self.failure = None
        try:
            with replacing(self.path, needed=_bytes(content)) as stream:
                try:
                    content = content | {"fingerprint": self.fingerprint}
                    torch.save(content | {"checksum": checksum(content)}, stream)
                except RuntimeError as error:  # torch's own, raised while it handled the one of the disk
                    raise error.__context__ if isinstance(error.__context__, OSError) else error from None
        except (OSError, RuntimeError) as error:
            is_disk = isinstance(error, OSError)
            self.failure = error if is_disk else OSError(None, str(error), str(self.path))
            if self.failure.errno not in self._told:
                self._told.add(self.failure.errno)
                left = "that of before stays" if self.path.is_file() else "there is none before it"
                _warn(f"{self.path} cannot be written: {self.failure.strerror}; {left}, and the run goes on")
        return self.failure is None


class Results:
    """Files of results. One that cannot be written is told, once per cause, and the others are written all the same.

    Attributes:
        failure: The first error.
    """

    def __init__(self):
        self.failure: OSError | None = None
        self._told: set[int | None] = set()

    def fail(self, error: OSError | None) -> None:
        """Take note of an error that was told already."""
        self.failure = self.failure or error

    def write(self, write: Callable[..., Any], *words: Any) -> bool:
        """Call ``write(*words)``; False where the disk does not take it."""
        try:
            write(*words)
            return True
        except OSError as error:
            if error.errno not in self._told:
                self._told.add(error.errno)
                _warn(f"{error.filename} cannot be written: {error.strerror}; the other results are written")
            self.fail(error)
            return False


def checksum(content: Any, most: float = math.inf) -> str:
    """Of tensors and plain values, nested as they may be; ValueError for others, and for tensors beyond ``most`` bytes.

    torch checks nothing that it reads: a run would go on from damaged numbers as if they were its own.
    """
    total = hashlib.blake2b(digest_size=16)

    def add(value: Any) -> None:
        if isinstance(value, Tensor):
            if value.layout != torch.strided or value.nbytes > most:
                raise ValueError(f"a tensor {list(value.shape)} that no run has saved")
            total.update(f"{tuple(value.shape)} {value.dtype}".encode())
            flat = value.detach().cpu().contiguous().reshape(-1)
            total.update(flat.view(torch.uint8).numpy().data if len(flat) else b"")
        elif isinstance(value, dict | list | tuple):
            total.update(f"{'{' if isinstance(value, dict) else '['}{len(value)}".encode())
            for each in value.items() if isinstance(value, dict) else value:
                add(each)
        elif value is None or isinstance(value, str | int | float):
            total.update(f"{value!r};".encode())
        else:
            raise ValueError(f"a value of {type(value).__name__} that no run has saved")

    add(content)
    return total.hexdigest()


def _warn(text: str) -> None:
    tqdm.write(f"warning: {text}", file=sys.stderr)  # beside a progress bar


def _bytes(content: Any) -> int:
    """Of the tensors in a checkpoint; what else is in it is small."""
    if isinstance(content, Tensor):
        return content.nbytes
    values = content.values() if isinstance(content, dict) else content if isinstance(content, list | tuple) else ()
    return sum(map(_bytes, values))
