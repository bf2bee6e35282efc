"""Arguments and action of ``measure``. Other modules are imported only when the command runs."""

import argparse
import json
import re
from pathlib import Path
from typing import Any

OK, INTERRUPTED = 0, 130


def add_measure(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser of ``holotorch``."""
    about = "accuracy and latency of the tracker with your camera, by the dissertation's protocols"
    measure = commands.add_parser("measure", help=about)
    measure.add_argument("protocol", metavar="PROTOCOL", help="still, grid2d, grid3d, latency, prediction, edges, tone")
    what = "video, folder of pictures or of a recording, number of a camera, run of track, poses.csv, or: synthetic"
    measure.add_argument("sources", nargs="*", metavar="SOURCE", help=f"{what}; for grid3d one for each face")
    measure.add_argument("--out", type=Path, help="folder of the run (default: runs/SOURCE-measure-001, ...)")
    measure.add_argument("--camera", help="its intrinsics: a YAML file, as calibrate writes it")
    measure.add_argument("--catheter", help="YAML file, such as configs/tracking/catheter.yaml")
    measure.add_argument("--rate", type=float, metavar="HZ", help="frames per second of a source without times")
    measure.add_argument("--rows", type=int, help="of the grid (default: 9; grid3d: 8)")
    measure.add_argument("--columns", type=int, help="of the grid (default: 9; grid3d: 8)")
    measure.add_argument("--spacing", metavar="LENGTH", help="of the grid's points (default: 10.2mm; grid3d: 10mm)")
    about = "a grid's reference point (default: the middle), or the log of the tracker that latency compares with"
    measure.add_argument("--reference", metavar="ROW,COLUMN or CSV", help=about)
    measure.add_argument("--partial", action="store_true", help="evaluate a grid of which points are missing")
    about = "of edges: distances that are exact, such as 0 (edge 0 and the tip) or 1-2 (edges 1 and 2)"
    measure.add_argument("--known", nargs="+", metavar="EDGE", help=about)
    measure.add_argument("--resting", action="store_true", help="of edges: the tip was in one place in all frames")
    about = "of tone: exposure times of the photographs, in the order of their names, such as 1/250 1/125"
    measure.add_argument("--exposures", nargs="+", metavar="SECONDS", help=about)
    measure.add_argument("--delay", type=float, metavar="MS", help="of prediction: capture to display (default: 95)")
    measure.add_argument("--print", type=Path, metavar="SVG", help="write the sheet of grid2d, to be printed")
    measure.set_defaults(action=_measure)


def _measure(options: argparse.Namespace) -> int:
    from holotorch.experiments.execute import execute, print_outcome
    from holotorch.experiments.registry import run_name

    if options.print is not None:
        return _print_sheet(options)
    settings = _settings(options)
    name = run_name("measure", [f"source={json.dumps(options.sources)}"], "measure")
    folder, complete = execute(settings, options.out, name)
    print_outcome(folder)
    return OK if complete else INTERRUPTED


def _settings(options: argparse.Namespace) -> Any:
    """The settings that the arguments describe. ConfigError with all mistakes."""
    from holotorch.experiments.config.errors import ConfigError
    from holotorch.experiments.config.messages import validated
    from holotorch.experiments.config.source import Key, Source
    from holotorch.experiments.measure.config import MeasureSettings
    from holotorch.experiments.registry import find_kind

    data: dict[str, Any] = {"experiment": "measure", "protocol": options.protocol, "source": options.sources}
    data |= {"camera": options.camera, "catheter": options.catheter, "rate_hz": options.rate}
    given = {name: getattr(options, name) for name in ("rows", "columns", "spacing")}
    data["grid"] = {name: value for name, value in given.items() if value is not None} | {"partial": options.partial}
    positions: dict[Key, str] = {
        ("protocol",): "argument PROTOCOL",
        ("source",): "argument SOURCE",
        ("rate_hz",): "argument --rate",
        ("delay",): "argument --delay",
        ("known",): "argument --known",
        ("exposures",): "argument --exposures",
        ("camera",): "argument --camera",
        ("reference_log",): "argument --reference",
        ("grid", "reference"): "argument --reference",
    }
    positions |= {("grid", name): f"argument --{name}" for name in given}
    data |= {"known": options.known or [], "resting": options.resting, "exposures": options.exposures or []}
    if options.delay is not None:
        data["delay"] = options.delay / 1e3
    if options.reference is not None and options.protocol == "latency":
        data["reference_log"] = options.reference
    elif options.reference is not None:
        if not (match := re.fullmatch(r"(\d{1,3}),(\d{1,3})", options.reference.replace(" ", ""))):
            text = "expected a point ROW,COLUMN, such as 5,5; a log belongs to the protocol latency"
            raise ConfigError([f"argument --reference: {text}, got {options.reference!r}"])
        data["grid"]["reference"] = [int(match[1]), int(match[2])]
    source = Source(Path("measure"), data, positions)
    settings = validated(source, MeasureSettings)
    if mistakes := [
        source.mistake(key, message) for key, message in find_kind(settings.experiment).contradictions(settings)
    ]:
        raise ConfigError(mistakes)
    return settings


def _print_sheet(options: argparse.Namespace) -> int:
    from holotorch.experiments.config.errors import ConfigError

    if options.protocol != "grid2d" or options.sources:
        raise ConfigError(
            ["--print writes the sheet of grid2d and takes no SOURCE: holotorch measure grid2d --print FILE"]
        )
    from holotorch.experiments.measure.grid import Grid
    from holotorch.experiments.measure.sheet import chessboard, write_sheet

    options.sources = ["synthetic"]  # the settings of a grid need one
    settings = _settings(options)
    write_sheet(options.print, Grid.of(settings), chessboard(settings.grid.board))
    print(f"{options.print}; print it at 100 % and check that its bar is 100 mm long")
    return OK
