"""The command ``holotorch sweep``. What it needs is imported only when it runs."""

import argparse
from pathlib import Path


def add_sweep(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser of ``holotorch``."""
    about = "a grid of runs: key=a,b,c for each swept setting; a second call continues it"
    usage = (
        "holotorch sweep CONFIG key=a,b,c [key=value ...] [--jobs N | --slurm [key=value ...]] [--out DIR] [--check]"
    )
    sweep = commands.add_parser("sweep", help=about, usage=usage)
    sweep.add_argument("config", metavar="CONFIG", help="YAML file, such as configs/pec/fourier.yaml")
    sweep.add_argument("settings", nargs="+", metavar="key=a,b,c", help="settings; several values are swept")
    sweep.add_argument("--out", type=Path, help="folder of the sweep (default: runs/CONFIG-sweep)")
    engines = sweep.add_mutually_exclusive_group()
    engines.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="runs at a time on this computer (default: 1)"
    )
    slurm = "a Slurm job for each run, with parameters of submitit such as timeout_min=60 (cluster=local: no Slurm)"
    engines.add_argument("--slurm", nargs="*", metavar="key=value", help=slurm)
    sweep.add_argument("--check", action="store_true", help="validate all runs, print their number and cost")
    sweep.set_defaults(action=_sweep)


def _sweep(options: argparse.Namespace) -> int:
    from holotorch.experiments.sweep.run import check_sweep, run_sweep

    if options.check:
        print(check_sweep(options.config, options.settings))
        return 0
    out = options.out or Path("runs") / f"{Path(options.config).stem}-sweep"
    return run_sweep(options.config, options.settings, out, jobs=options.jobs, slurm=options.slurm)
