"""The folder of a run: claimed by one run alone, and never emptied of what was computed, whatever fails."""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from holotorch.experiments.errors import ConfigError
from holotorch.experiments.fingerprint import Fingerprint, differences
from holotorch.experiments.signals import Pressed
from holotorch.io.files import replacing, write_json

_SETUP = {"config.yaml", "env.json", "plan.json"}  # what is written before anything is computed


def claim(out: Path | None, name: str) -> Path:
    """Make the folder of a run so that no other run can have it too. ConfigError where that is not possible."""
    if out is None:
        parent = Path("runs")
        pattern = re.compile(re.escape(name) + r"-(\d+)")
        try:
            parent.mkdir(exist_ok=True)
            while True:
                matches = [pattern.fullmatch(path.name) for path in parent.iterdir()]
                folder = parent / f"{name}-{max((int(match[1]) for match in matches if match), default=0) + 1:03d}"
                try:
                    folder.mkdir()
                    return folder
                except FileExistsError:
                    continue  # another run was faster
        except OSError as error:
            raise ConfigError([f"cannot write to {parent}: {error.strerror}; choose a place with --out"]) from None
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise ConfigError([f"{out} holds files already; choose another --out or delete it"])
        (out / "images").mkdir()  # the claim: of two runs only one can make it
    except FileExistsError:
        raise ConfigError([f"{out} is a file, or in use by another run; choose another --out"]) from None
    except OSError as error:
        raise ConfigError([f"cannot write to {out}: {error.strerror}; choose another place with --out"]) from None
    return out


@contextmanager
def kept(folder: Path, *, new: bool = True) -> Iterator[None]:
    """Fill ``folder`` within this block. Where that fails, it says where the results so far are and how to go on.

    A ``new`` folder that holds nothing computed yet is removed, so that a corrected run can have it.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        files = [path for path in folder.rglob("*") if not path.is_dir()]
        if new and {path.name for path in files} <= _SETUP:
            _remove(folder, files)
        elif not isinstance(error, ConfigError):
            done = (folder / "summary.json").is_file()
            cure = (
                "make its page with: holotorch report"
                if done
                else "when the cause is mended, go on with: holotorch resume"
            )
            print(f"failed; what was computed until then is in {folder}; {cure} {folder}", file=sys.stderr)
        raise


def _remove(folder: Path, files: list[Path]) -> None:
    with suppress(OSError):  # what cannot be removed does no harm
        for path in files:
            path.unlink()
        for path in (folder / "arrays", folder / "images", folder):
            if path.is_dir():
                path.rmdir()


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
            content = torch.load(self.path, weights_only=True)
            if not isinstance(content, dict):
                raise ValueError("not a checkpoint")
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
                    torch.save(content | {"fingerprint": self.fingerprint}, stream)
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

    def remove(self) -> None:
        """Delete it, as the run is complete."""
        self.path.unlink(missing_ok=True)


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


def conclude(
    folder: Path,
    summary: dict[str, Any],
    results: Results,
    checkpoint: Checkpoint,
    pressed: Pressed,
    page: Callable[[Path], Any],
    *,
    done: bool,
) -> bool:
    """Write the numbers of a run, last of all: what has summary.json is complete, what has interrupted.json is not.

    Args:
        folder: Of the run.
        summary: With a ``status`` that is set here.
        results: Files written so far.
        checkpoint: Removed from a complete run.
        pressed: Settled once the run is complete: signals that come later no longer count.
        page: Writes the report of the folder to a path.
        done: Whether all was computed.

    Returns:
        Whether the run is complete.

    Raises:
        OSError: A file could not be written; everything else is.
    """
    complete = done and results.failure is None
    summary["status"] = "complete" if complete else "interrupted"
    if results.failure is not None:
        summary["failure"] = f"{results.failure.filename}: {results.failure.strerror}"
    if results.write(write_json, folder / ("summary.json" if complete else "interrupted.json"), summary):
        if complete:
            pressed.settled = True
            checkpoint.remove()
            (folder / "interrupted.json").unlink(missing_ok=True)
        results.write(page, folder / "report.html")
    if results.failure is not None:
        raise results.failure
    return complete


def _warn(text: str) -> None:
    tqdm.write(f"warning: {text}", file=sys.stderr)  # beside a progress bar


def _bytes(content: Any) -> int:
    """Of the tensors in a checkpoint; what else is in it is small."""
    if isinstance(content, Tensor):
        return content.nbytes
    values = content.values() if isinstance(content, dict) else content if isinstance(content, list | tuple) else ()
    return sum(map(_bytes, values))
