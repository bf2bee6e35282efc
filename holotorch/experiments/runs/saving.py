"""Writing of checkpoints and results. An error, as on a full disk, is reported, and other files are still written."""

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
from holotorch.experiments.runs.signals import delayed
from holotorch.io.files import replacing


class _Writer:
    """Base class of writers that report each kind of error, by its ``errno``, once."""

    def __init__(self):
        self.failure: OSError | None = None
        self._reported: set[int | None] = set()

    def _warn(self, error: OSError, problem: str) -> None:
        if error.errno not in self._reported:
            self._reported.add(error.errno)
            tqdm.write(f"warning: {problem}", file=sys.stderr)  # leaves progress bars intact


class Checkpoint(_Writer):
    """The file from which a run can be resumed. An error in writing it is reported once and does not stop the run.

    The file at ``path`` is replaced only when a new checkpoint is complete. A checkpoint whose ``fingerprint`` (of
    configuration and inputs) differs is refused. ``failure`` is the error of the last :meth:`save`, or None.
    """

    def __init__(self, path: Path, fingerprint: Fingerprint):
        super().__init__()
        self.path, self.fingerprint = path, fingerprint

    def load(self) -> dict[str, Any] | None:
        """The last saved content, or None. ConfigError if the file is damaged or belongs to another configuration."""
        if not self.path.is_file():
            return None
        try:
            with zipfile.ZipFile(self.path) as archive:
                if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                    raise ValueError("compressed, which torch never does, and might need any memory to decompress")
            content = torch.load(self.path, weights_only=True)
            stated = content.pop("checksum", None)
            if "fingerprint" in content and stated != checksum(content, self.path.stat().st_size):
                raise ValueError("changed after it was written")
        except Exception as error:  # unpickling damaged bytes can raise anything
            raise self.unreadable(error) from None
        config = self.path.parent / "config.yaml"
        hint = f"run into a new folder: holotorch run {config} --out NEW"
        if not isinstance(before := content.get("fingerprint"), dict):
            problem = f"{self.path} does not say which configuration it belongs to, as those of older versions do not"
            raise ConfigError([f"{problem}; {hint}"])
        if changed := differences(before, self.fingerprint):
            problem = f"{self.path} belongs to another configuration: {', '.join(changed)}"
            raise ConfigError([f"{problem}; undo that in {config}, or {hint}"])
        return content

    def unreadable(self, error: Exception) -> ConfigError:
        """The ConfigError for a checkpoint that cannot be read or has unexpected content."""
        reason = error.strerror if isinstance(error, OSError) else "it is damaged"
        return ConfigError([f"{self.path} cannot be read: {reason}; delete the folder and run again"])

    def save(self, content: dict[str, Any]) -> bool:
        """Write tensors and plain values; returns False if that fails."""
        self.failure = None
        try:
            with delayed(), replacing(self.path, needed=_bytes(content)) as stream:
                try:
                    content = content | {"fingerprint": self.fingerprint}
                    torch.save(content | {"checksum": checksum(content)}, stream)
                except RuntimeError as error:  # torch raises it, with the OSError of the failed write as context
                    raise error.__context__ if isinstance(error.__context__, OSError) else error from None
        except (OSError, RuntimeError) as error:
            self.failure = error if isinstance(error, OSError) else OSError(None, str(error), str(self.path))
            left = "the previous one stays" if self.path.is_file() else "there is no previous one"
            problem = f"{self.path} cannot be written: {self.failure.strerror}"
            self._warn(self.failure, f"{problem}; {left}, and the run goes on")
        return self.failure is None


class Results(_Writer):
    """Writer of result files. An error in writing one file is reported once, and the other files are still written.

    ``failure`` is the first error, or None.
    """

    def write(self, write: Callable[..., Any], *arguments: Any) -> bool:
        """Call ``write(*arguments)``; returns False if that raises an OSError."""
        try:
            write(*arguments)
            return True
        except OSError as error:
            self._warn(error, f"{error.filename} cannot be written: {error.strerror}; the other results are written")
            self.failure = self.failure or error
            return False


def checksum(content: Any, max_bytes: float = math.inf) -> str:
    """Checksum of nested tensors and plain values, since torch does not detect damaged numbers when it loads a file.

    ValueError for values of other types, and for a tensor of more than ``max_bytes`` bytes.
    """
    total = hashlib.blake2b(digest_size=16)

    def add(value: Any) -> None:
        if isinstance(value, Tensor):
            if value.layout != torch.strided or value.nbytes > max_bytes:
                raise ValueError(f"a tensor {list(value.shape)} that no run has saved")
            total.update(f"{tuple(value.shape)} {value.dtype}".encode())
            flat = value.detach().cpu().contiguous().reshape(-1)
            total.update(flat.view(torch.uint8).numpy().data if len(flat) else b"")
        elif isinstance(value, dict | list | tuple):
            total.update(f"{'{' if isinstance(value, dict) else '['}{len(value)}".encode())
            for item in value.items() if isinstance(value, dict) else value:
                add(item)
        elif value is None or isinstance(value, str | int | float):
            total.update(f"{value!r};".encode())
        else:
            raise ValueError(f"a value of {type(value).__name__} that no run has saved")

    add(content)
    return total.hexdigest()


def _bytes(content: Any) -> int:
    """Size of the tensors in a checkpoint; all else in a checkpoint is small."""
    if isinstance(content, Tensor):
        return content.nbytes
    values = content.values() if isinstance(content, dict) else content if isinstance(content, list | tuple) else ()
    return sum(map(_bytes, values))
