"""The command ``holotorch study``. The server of the study is imported only when the command runs."""

import argparse
from pathlib import Path


def add_study(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser of ``holotorch``."""
    study = commands.add_parser("study", help="the far-periphery study with one participant, in a browser")
    study.add_argument("config", metavar="CONFIG", help="YAML file, such as configs/perception/study.yaml")
    study.add_argument("--port", type=int, help="port of the local server (default: any free port)")
    study.add_argument("--participant", type=int, default=1, metavar="N", help="number of the participant (default: 1)")
    study.add_argument("--out", type=Path, help="folder for the logs; an existing log is continued")
    study.set_defaults(action=_study)


def _study(options: argparse.Namespace) -> int:
    from holotorch.experiments.perception.study.run import run_study_server

    return run_study_server(options.config, port=options.port, participant=options.participant, out=options.out)
