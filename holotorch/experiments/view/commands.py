"""The command ``holotorch view``. Other modules are imported when it runs."""

import argparse
import os
from pathlib import Path


def add_view(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser of ``holotorch``."""
    view = commands.add_parser("view", help="a finished run in a browser: choose depth, focus, pupil, light or heat")
    view.add_argument("folder", type=Path, metavar="DIR", help="folder of a run of kind pec, volume, eye or joint")
    view.add_argument("--port", type=int, default=0, help="port of the local server (default: any free port)")
    about = "measure the pictures per second of each control, and leave"
    view.add_argument("--check", action="store_true", help=about)
    view.set_defaults(action=_view)


def _view(options: argparse.Namespace) -> int:
    from holotorch.experiments.config.errors import ConfigError

    if not 0 <= options.port < 65536:
        raise ConfigError([f"--port: expected 0 (any that is free) to 65535, got {options.port}"])
    import torch

    from holotorch.experiments.view.opening import open_viewer

    viewer = open_viewer(options.folder)
    # Threads of one picture wait for each other, and the browser needs a core: if both of two cores are used, a picture
    # of 60 ms takes up to 1.7 s.
    torch.set_num_threads(max(1, (os.cpu_count() or 1) - 1))
    if options.check:
        from holotorch.experiments.view.check import check

        check(viewer)
        return 0
    from holotorch.experiments.view.run import run_view

    run_view(viewer, options.port)
    return 0
