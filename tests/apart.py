"""Processes of their own for tests, which begin with the library loaded: they are copies of one that has loaded it."""

import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

_COPIES = "forkserver" in multiprocessing.get_all_start_methods()
_CONTEXT = multiprocessing.get_context("forkserver") if _COPIES else multiprocessing.get_context("spawn")
_LOADED = [
    *("torch", "torch.distributed", "matplotlib.backends.backend_agg", "scipy.special", "skimage.metrics"),
    *("holotorch.experiments.execute", "holotorch.experiments.report", "holotorch.experiments.registry"),
    *(f"holotorch.experiments.{kind}.kind" for kind in ("pec", "volume", "eye", "joint")),
]
if _COPIES:
    _CONTEXT.set_forkserver_preload(_LOADED)


def start_apart(
    job: Callable[..., Any], *words: Any, said: Path | None = None, env: Mapping[str, str] | None = None
) -> BaseProcess:
    """A process that runs ``job(*words)``.

    Args:
        job: A function of a module, since the process imports it.
        words: Its arguments.
        said: File for what the process writes to its output and its errors.
        env: Variables of its environment besides those of this process.
    """
    process = _CONTEXT.Process(target=_run, args=(job, words, said, {**os.environ, **(env or {})}))
    process.start()
    return process


def printed_by(code: str, folder: Path, *, strict: bool = False) -> str:
    """What ``code`` prints when a process of its own runs it in ``folder``; with ``strict``, a warning is an error."""
    said = folder / "said.txt"
    process = start_apart(_execute, code, str(folder), strict, said=said)
    process.join()
    assert process.exitcode == 0, said.read_text()
    return said.read_text()


def _execute(code: str, folder: str, strict: bool) -> None:
    os.chdir(folder)
    if strict:
        warnings.simplefilter("error")
    exec(code, {"__name__": "__main__"})


def _run(job: Callable[..., Any], words: tuple[Any, ...], said: Path | None, env: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(env)
    if said is not None:
        with open(said, "wb", buffering=0) as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        sys.stdout, sys.stderr = (open(stream, "w", buffering=1, closefd=False) for stream in (1, 2))  # noqa: SIM115
    job(*words)
