"""The folder of a run: claimed by one run alone, and never emptied of what was computed, whatever fails."""

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from pydantic import BaseModel

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.messages import validated
from holotorch.experiments.config.source import read_source
from holotorch.experiments.runs.environment import environment
from holotorch.experiments.runs.fingerprint import differences, fingerprint
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import Pressed, deferred, interruptible
from holotorch.io.files import write_json, write_text

_HALF = re.compile(r"\.(env\.json|config\.yaml)\.\d+\.partial")  # the first files of a run that was killed at once
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


@dataclass
class RunFolder:
    """The folder of a run at work.

    Attributes:
        path: The folder.
        name: Of the run.
        plan: What the run is to do.
        pressed: Signals that have come.
        resumes: Whether the run can be continued after an interruption.
        write_page: Writes the page of the folder to a path, from what is in the folder; None where there is none yet.
    """

    path: Path
    name: str
    plan: RunPlan
    pressed: Pressed
    resumes: bool = True
    write_page: Callable[[Path], Any] | None = None


@contextmanager
def open_run(
    out: Path | None, name: str, settings: BaseModel, plan: RunPlan, device: str, *, resumes: bool = True
) -> Iterator[RunFolder]:
    """Fill a folder within this block: a new one, or ``out`` where that holds an unfinished run of the same settings.

    A run that cannot be continued (not ``resumes``) always takes a new folder.

    The folder is this run's alone, on systems that can lock one, and gets config.yaml and env.json at once. Within the
    block the first signal raises KeyboardInterrupt. Where the block fails, the folder keeps what was computed; a new
    one in which nothing was is removed, so that a corrected run can have it.

    Raises:
        ConfigError: The folder is in use, holds something else, or cannot be written.
    """
    with interruptible() as pressed, ExitStack() as stack:
        if out is not None:
            with suppress(OSError):  # the claim says what is wrong
                out.mkdir(parents=True, exist_ok=True)
            if out.is_dir():
                stack.enter_context(_locked(out))
        new = out is None or not (resumes and _unfinished(out, settings))
        folder = claim(out, name) if new or out is None else out
        if out is None:
            stack.enter_context(_locked(folder))
        with _kept(folder, new, resumes):
            (folder / "images").mkdir(exist_ok=True)
            write_json(folder / "env.json", environment(getattr(settings, "seed", 0), torch.device(device)))
            if new:
                write_text(folder / "config.yaml", yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
            yield RunFolder(folder, name, plan, pressed, resumes)


def _unfinished(folder: Path, settings: BaseModel) -> bool:
    """Whether a folder holds a run of these settings that is not complete; ConfigError for one of other settings.

    What a killed run leaves is cleared away: half-written files, and folders without a file.
    """
    if not folder.is_dir():
        return False
    files = {path.name for path in folder.rglob("*") if not path.is_dir()}
    halves = {name for name in files if _HALF.fullmatch(name)}
    if files - halves <= {"env.json"}:
        with suppress(OSError):  # the claim says what is wrong
            for name in (*halves, "env.json"):
                (folder / name).unlink(missing_ok=True)
            for path in (folder / "arrays", folder / "images"):
                if path.is_dir():
                    path.rmdir()
    if "summary.json" in files or not files >= {"env.json", "config.yaml"}:
        return False
    try:
        held = validated(read_source(folder / "config.yaml", []), type(settings))
    except ConfigError:
        return False
    if changed := differences(fingerprint(held, {}), fingerprint(settings, {})):
        cure = f"choose another --out, or go on with that one: holotorch resume {folder}"
        raise ConfigError([f"{folder} holds an unfinished run of another configuration: {', '.join(changed)}; {cure}"])
    for path in folder.rglob(".*.partial"):
        path.unlink()
    return True


def tidied(folder: Path) -> bool:
    """Clear away what a run that was killed after its last number has left; whether its page is missing.

    ConfigError where a run is in the folder.
    """
    with _locked(folder):
        for path in (*folder.rglob(".*.partial"), folder / "checkpoint.pt", folder / "interrupted.json"):
            with suppress(OSError):  # what cannot be removed does no harm
                path.unlink(missing_ok=True)
        return not (folder / "report.html").is_file()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder until the block, or the process, ends. ConfigError where one is in it."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # of a network's file system without locks
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError([f"{folder} is in use by another run; choose another --out"]) from None
        yield
    finally:
        os.close(handle)


@contextmanager
def _kept(folder: Path, new: bool, resumes: bool) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        if resumes:
            print(f"interrupted; start it again with: holotorch resume {folder}", file=sys.stderr)
        elif new:
            _remove_setup(folder)
        raise
    except BaseException as error:
        removed = new and _remove_setup(folder)
        if not removed and not isinstance(error, ConfigError):
            cure = f"; when the cause is mended, go on with: holotorch resume {folder}" if resumes else ""
            if (folder / "summary.json").is_file():
                cure = f"; make its page with: holotorch report {folder}"
            print(f"failed; what was computed until then is in {folder}{cure}", file=sys.stderr)
        raise


def _remove_setup(folder: Path) -> bool:
    """Remove a folder that holds nothing but what is written before the work begins; whether that was so."""
    files = [path for path in folder.rglob("*") if not path.is_dir()]
    if not {path.name for path in files} <= _SETUP:
        return False
    with suppress(OSError):  # what cannot be removed does no harm
        for path in files:
            path.unlink()
        for path in (folder / "arrays", folder / "images", folder):
            if path.is_dir():
                path.rmdir()
    return True


def conclude(
    run: RunFolder,
    summary: dict[str, Any],
    results: Results,
    *,
    done: bool,
    checkpoint: Checkpoint | None = None,
) -> bool:
    """Write the numbers of a run, last of all: what has summary.json is complete, what has interrupted.json is not.

    Args:
        run: The run, whose signals no longer count once it is complete.
        summary: Numbers, with a ``status`` that is set here.
        results: Files written so far.
        done: Whether all was computed.
        checkpoint: Removed from a complete run. Of one that is not done, that it was written.

    Returns:
        Whether the run is complete.

    Raises:
        OSError: A file could not be written; everything else is.
    """
    with deferred(run.pressed):
        if not done and checkpoint is not None:
            results.fail(checkpoint.failure)
        complete = done and results.failure is None
        summary["status"] = "complete" if complete else "interrupted"
        if results.failure is not None:
            summary["failure"] = f"{results.failure.filename}: {results.failure.strerror}"
        name = "summary.json" if complete else "interrupted.json"
        if results.write(write_json, run.path / name, summary):
            if complete:
                run.pressed.settled = True
                for path in (run.path / "checkpoint.pt", run.path / "interrupted.json"):
                    path.unlink(missing_ok=True)
            if run.write_page is not None:  # last, as it shows what is in the folder
                results.write(run.write_page, run.path / "report.html")
        if results.failure is not None:
            raise results.failure
    if not complete:
        cure = f"go on with: holotorch resume {run.path}" if run.resumes else f"it is in {run.path}"
        print(f"interrupted; what was computed is saved; {cure}", file=sys.stderr)
    return complete
