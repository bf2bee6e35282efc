"""Implementation of the commands ``check``, ``run`` and ``resume`` for an experiment of any kind."""

import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.source import read_source
from holotorch.experiments.registry import KINDS, find_kind, load_config
from holotorch.experiments.report import outcome_lines, write_report
from holotorch.experiments.runs.folder import RunFolder, open_run, refuse_complete, tidied
from holotorch.experiments.runs.plan import RunPlan
from holotorch.experiments.runs.processes import joined_processes
from holotorch.experiments.runs.record import runs_inside
from holotorch.experiments.runs.signals import interruptible
from holotorch.io.files import write_bytes, write_json

_SILENT = 3.0  # seconds
NO_FOLDER = Path(os.devnull)  # what ``execute`` returns as the folder in all processes of a run but the first


def execute(settings: Any, out: Path | None, name: str = "run") -> tuple[Path, bool]:
    """Carry out a run with settings of any kind; returns its folder, and whether the run is complete.

    Of several processes that share the run, all but the first return ``NO_FOLDER``.

    The folder is ``out``, or the next free ``runs/NAME-001``. If ``out`` holds an unfinished run of the same settings,
    that run is continued. The folder of an interrupted run holds the results so far.

    Raises:
        ConfigError: The folder holds other files already or cannot be written, an input cannot be used, or the run does
            not fit into memory or cannot start.
    """
    kind = find_kind(settings.experiment)
    refuse_complete(out)
    with _announced():
        experiment = kind.build(settings)
        plan = kind.plan(experiment)
    with joined_processes(kind.parallel) as rank:
        if rank > 0:  # only the first process writes to the folder
            with interruptible() as signals:
                return NO_FOLDER, kind.run(experiment, RunFolder(Path(), name, plan, signals))
        if kind.announces:
            print(emphasised(plan.text), flush=True)
        if plan.shortage:
            raise ConfigError([plan.shortage])
        kind.prepare(experiment)

        def write_page(path: Path) -> None:
            write_report([path.parent], path)

        restart = kind.restart(out or Path(), settings.model_dump())
        with open_run(out, name, settings, plan, kind.device(experiment), resumes=restart is None) as folder:
            folder.write_page = write_page
            if plan.values:
                write_json(folder.path / "plan.json", plan.values)
            return folder.path, kind.run(experiment, folder)


def emphasised(text: str) -> str:
    """The lines of a plan or result, those of notes and warnings in bold where they are printed on a terminal."""
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR"):  # see no-color.org
        return text
    return re.sub(r"^(Note|Warning|WARNING) .*", "\033[1m\\g<0>\033[0m", text, flags=re.MULTILINE)


def print_outcome(folder: Path) -> None:
    """Print the main numbers of a run, and where its pictures and its report are; nothing for ``NO_FOLDER``.

    ConfigError if the summary in the folder cannot be read.
    """
    if folder == NO_FOLDER:
        return
    for line in outcome_lines(folder):
        print(emphasised(line))
    report = folder / "report.html"
    print(report if report.is_file() else folder)


def check(settings: Any) -> RunPlan:
    """Plan a run without computing anything."""
    kind = find_kind(settings.experiment)
    with _announced():
        return kind.plan(kind.build(settings))


@contextmanager
def _announced() -> Iterator[None]:
    """Says that a plan is being made if it takes long: that of an eye may take a minute."""
    words = "reading the inputs and planning ..."
    timer = threading.Timer(_SILENT, print, (words,), {"file": sys.stderr, "flush": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def write_preview(settings: Any, path: Path) -> str:
    """Write a picture of a run's inputs, and say what it shows. ConfigError for a kind without one, or a used path."""
    kind = find_kind(settings.experiment)
    if path.exists():
        raise ConfigError([f"{path} is there already; choose another --preview"])
    if (shown := kind.preview(kind.build(settings))) is None:
        raise ConfigError([f"a {settings.experiment} has no preview; only kinds with a volume have one"])
    picture, text = shown
    try:
        write_bytes(path, picture)
    except OSError as error:
        raise ConfigError([f"cannot write {path}: {error.strerror}; choose another --preview"]) from None
    return f"{text}\n{path}"


def resume(folder: Path) -> tuple[Path, bool]:
    """Continue an interrupted run in its folder, as if it had never stopped; returns the same as :func:`execute`.

    ConfigError if the folder holds no run, or if its configuration is no longer valid or contradicts its checkpoint.
    """
    config = folder / "config.yaml"
    if not config.is_file() or not (folder / "env.json").is_file():
        inside = runs_inside(folder, "holotorch resume {}", lambda run: not (run / "summary.json").is_file())
        if not inside and runs_inside(folder, ""):
            inside = "; the runs in it are complete"
        raise ConfigError([f"{folder} holds no run to resume: config.yaml and env.json are not both there{inside}"])
    if (folder / "summary.json").is_file():
        print("this run is complete; nothing is left to do")
        if tidied(folder):
            write_report([folder], folder / "report.html")
        return folder, True
    data = read_source(config, []).data
    name = data.get("experiment")
    if isinstance(name, str) and name in KINDS and (advice := find_kind(name).restart(folder, data)):
        raise ConfigError([f"{folder} holds an interrupted run of kind {name}, which cannot be continued: {advice}"])
    return execute(load_config(config), folder, folder.resolve().name)
