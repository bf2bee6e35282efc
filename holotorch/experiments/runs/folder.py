"""The folder of a run. Only one run can use it at a time, and a failure does not delete results in it."""

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
from holotorch.experiments.config.inputs import started_in, with_its_files
from holotorch.experiments.config.messages import validated
from holotorch.experiments.config.source import read_source
from holotorch.experiments.config.version import FIRST_LINE, upgraded
from holotorch.experiments.runs.environment import environment
from holotorch.experiments.runs.fingerprint import differences, fingerprint
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.runs.saving import Checkpoint, Results
from holotorch.experiments.runs.signals import Signals, deferred, interruptible
from holotorch.io.files import write_json, write_text

_HALF_WRITTEN = re.compile(r"\.(env\.json|config\.yaml)\.\d+\.partial")  # temporary names of the first files of a run
_SETUP = {"config.yaml", "env.json", "plan.json"}  # files written before the computation starts


def claim(out: Path | None, name: str) -> Path:
    """Create the folder of a run: ``out``, or the next free ``runs/NAME-001``. ConfigError if it is not free."""
    if out is None:
        parent = Path("runs")
        pattern = re.compile(re.escape(name) + r"-(\d+)")
        try:
            parent.mkdir(exist_ok=True)
            while True:
                matches = [pattern.fullmatch(path.name) for path in parent.iterdir()]
                folder = parent / f"{name}-{max((int(match[1]) for match in matches if match), default=0) + 1:03d}"
                with suppress(FileExistsError):  # another run has just created it
                    folder.mkdir()
                    return folder
        except OSError as error:
            raise ConfigError([f"cannot write to {parent}: {error.strerror}; choose a place with --out"]) from None
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise ConfigError([f"{out} holds files already; choose another --out or delete it"])
        (out / "images").mkdir()  # succeeds for only one of two runs that start at the same time
    except FileExistsError:
        raise ConfigError([f"{out} is a file, or in use by another run; choose another --out"]) from None
    except OSError as error:
        raise ConfigError([f"cannot write to {out}: {error.strerror}; choose another place with --out"]) from None
    return out


def refuse_complete(out: Path | None) -> None:
    """ConfigError if ``out`` holds a complete run, before the inputs are read: a plan may take a minute."""
    if out is not None and (out / "summary.json").exists():
        raise ConfigError([f"{out} holds files already; choose another --out or delete it: its run is complete"])


@dataclass
class RunFolder:
    """The folder of a running experiment."""

    path: Path
    name: str
    plan: RunPlan
    signals: Signals  # signals that have been received
    resumes: bool = True  # whether the run can be continued after an interruption
    write_page: Callable[[Path], Any] | None = None  # writes the report to a path; None if there is no report


@contextmanager
def open_run(
    out: Path | None, name: str, settings: BaseModel, plan: RunPlan, device: str, *, resumes: bool = True
) -> Iterator[RunFolder]:
    """Context manager that provides the folder of a run, with config.yaml and env.json.

    The folder is new, or is ``out`` if that holds an unfinished run of the same settings. A run that cannot be
    continued (``resumes`` False) always needs a new folder. The folder is locked against other runs if the system
    supports this. Within the block, the first signal raises KeyboardInterrupt. If the block fails, the folder keeps all
    results; a new folder without results is removed, so that a corrected run can use it. ConfigError if the folder is
    in use, holds other files, or cannot be written.
    """
    with interruptible() as signals, ExitStack() as stack:
        if out is not None:
            with suppress(OSError):  # ``claim`` reports the error
                out.mkdir(parents=True, exist_ok=True)
            if out.is_dir():
                stack.enter_context(_locked(out))
        new = out is None or not (resumes and _unfinished(out, settings))
        folder = claim(out, name) if new or out is None else out
        if out is None:
            stack.enter_context(_locked(folder))
        with _keep_results(folder, new, resumes):
            (folder / "images").mkdir(exist_ok=True)
            contents = environment(getattr(settings, "seed", 0), torch.device(device))
            if not new and (start := started_in(folder)) is not None:
                contents["folder"] = str(start)
            write_json(folder / "env.json", contents)
            if new:
                text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False)
                write_text(folder / "config.yaml", FIRST_LINE + text)
            yield RunFolder(folder, name, plan, signals, resumes)


def _unfinished(folder: Path, settings: BaseModel) -> bool:
    """Whether a folder holds an unfinished run of these settings; ConfigError for an unfinished run of other settings.

    Half-written files and empty folders of a killed run are removed.
    """
    files = {path.name for path in folder.rglob("*") if not path.is_dir()}
    half_written = {name for name in files if _HALF_WRITTEN.fullmatch(name)}
    if files - half_written <= {"env.json"}:
        with suppress(OSError):  # ``claim`` reports the error
            for name in (*half_written, "env.json"):
                (folder / name).unlink(missing_ok=True)
            _remove_folders(folder / "arrays", folder / "images")
    if "summary.json" in files or not files >= {"env.json", "config.yaml"}:
        return False
    try:
        previous = validated(with_its_files(upgraded(read_source(folder / "config.yaml", []))), type(settings))
    except ConfigError:
        return False
    if changed := differences(fingerprint(previous, {}), fingerprint(settings, {})):
        hint = f"choose another --out, or go on with that one: holotorch resume {folder}"
        raise ConfigError([f"{folder} holds an unfinished run of another configuration: {', '.join(changed)}; {hint}"])
    for path in folder.rglob(".*.partial"):
        path.unlink()
    return True


def tidied(folder: Path) -> bool:
    """Remove temporary files of a complete run; returns whether its page is missing. ConfigError if it is in use."""
    with _locked(folder):
        for path in (*folder.rglob(".*.partial"), folder / "checkpoint.pt", folder / "interrupted.json"):
            with suppress(OSError):  # a remaining file does no harm
                path.unlink(missing_ok=True)
        return not (folder / "report.html").is_file()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder until the block or the process ends. ConfigError if another run has locked it."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a network file system may have no locks
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError(
                    [f"{folder} is in use by another run: wait for its end, or choose another --out"]
                ) from None
        yield
    finally:
        os.close(handle)


@contextmanager
def _keep_results(folder: Path, new: bool, resumes: bool) -> Iterator[None]:
    """If the block fails, say where its results are and how to go on; remove a new folder without results."""
    try:
        yield
    except KeyboardInterrupt:
        if resumes:
            print(f"interrupted; start it again with: holotorch resume {folder}", file=sys.stderr)
        elif new:
            _remove_setup(folder)
        raise
    except BaseException as error:
        if not (new and _remove_setup(folder)) and not isinstance(error, ConfigError):
            hint = f"; once the cause is removed, go on with: holotorch resume {folder}" if resumes else ""
            if (folder / "summary.json").is_file():
                hint = f"; make its page with: holotorch report {folder}"
            print(f"failed; the results so far are in {folder}{hint}", file=sys.stderr)
        raise


def _remove_setup(folder: Path) -> bool:
    """Remove a folder if it holds only the files written before the computation starts; returns whether it did."""
    files = [path for path in folder.rglob("*") if not path.is_dir()]
    if not {path.name for path in files} <= _SETUP:
        return False
    with suppress(OSError):  # a remaining file does no harm
        for path in files:
            path.unlink()
        _remove_folders(folder / "arrays", folder / "images", folder)
    return True


def _remove_folders(*folders: Path) -> None:
    for folder in folders:
        if folder.is_dir():
            folder.rmdir()


def conclude(
    run: RunFolder, summary: dict[str, Any], results: Results, *, done: bool, checkpoint: Checkpoint | None = None
) -> bool:
    """Write the numbers of a run as its last file, summary.json or interrupted.json; returns whether it is complete.

    A run is complete if everything was computed (``done``) and ``results``, the writer of its other files, has no
    error; from then on its signals are ignored, and its checkpoint is removed. This function adds ``status`` to the
    ``summary``. An error in writing a file, or the checkpoint if the run is not done, is raised as OSError after all
    other files are written.
    """
    with deferred(run.signals):
        if not done and checkpoint is not None:
            results.failure = results.failure or checkpoint.failure
        complete = done and results.failure is None
        summary["status"] = "complete" if complete else "interrupted"
        if results.failure is not None:
            summary["failure"] = f"{results.failure.filename}: {results.failure.strerror}"
        name = "summary.json" if complete else "interrupted.json"
        if results.write(write_json, run.path / name, summary):
            if complete:
                run.signals.settled = True
                for path in (run.path / "checkpoint.pt", run.path / "interrupted.json"):
                    path.unlink(missing_ok=True)
            if run.write_page is not None:  # written last, since it shows the other files
                results.write(run.write_page, run.path / "report.html")
        if results.failure is not None:
            raise results.failure
    if not complete:
        cure = f"go on with: holotorch resume {run.path}" if run.resumes else f"it is in {run.path}"
        print(f"interrupted; what was computed is saved; {cure}", file=sys.stderr)
    return complete
