"""The ``holotorch`` command. Each subcommand loads only what it needs; ``--help`` loads nothing."""

import argparse
import errno
import os
import re
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from holotorch import __version__
from holotorch.experiments.measure.commands import add_measure
from holotorch.experiments.runs.signals import interruptible
from holotorch.experiments.streaming.commands import add_stream
from holotorch.experiments.study_commands import add_study
from holotorch.experiments.sweep.commands import add_sweep
from holotorch.experiments.tracking.commands import add_tracking
from holotorch.experiments.view.commands import add_view

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand and return its exit status: 0 success, 1 failure, 2 bad input, 130 interruption."""
    options = _parsed(arguments)
    if not sys.stderr.isatty():  # each state of a bar is a line in a log
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    from holotorch.experiments.config.errors import ConfigError

    try:
        # The other commands compute nothing, or handle signals themselves.
        with interruptible() if options.action in _INTERRUPTIBLE else nullcontext():
            return options.action(options)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except (MemoryError, RuntimeError) as error:
        # torch raises RuntimeError when memory runs out; checks of holotorch raise MemoryError with an explanation.
        if isinstance(error, RuntimeError) and not re.search(r"(?i)can.t allocate memory|out of memory", str(error)):
            raise
        explanation = str(error) if isinstance(error, MemoryError) else ""
        print(explanation or "out of memory; use a smaller grid", file=sys.stderr)
        return FAILED
    except BrokenPipeError:  # the reader has closed the pipe, as ``head`` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that Python does not fail at exit
        return FAILED
    except ConnectionError as error:
        print(error, file=sys.stderr)
        return FAILED
    except OSError as error:
        print(f"{error.filename or 'file'}: {error.strerror or error}", file=sys.stderr)
        return BAD_INPUT if error.errno == errno.ENAMETOOLONG else FAILED
    except KeyboardInterrupt:
        print(_interruption_message(options), file=sys.stderr)
        return INTERRUPTED


def _interruption_message(options: argparse.Namespace) -> str:
    """Message for an interruption before the command has saved a result."""
    folder = options.folder if options.action is _resume else getattr(options, "out", None)
    if folder is not None and (folder / "config.yaml").is_file() and not (folder / "summary.json").is_file():
        return f"interrupted before it went on; start it again with: holotorch resume {folder}"
    return "interrupted before anything could be saved"


def _run(options: argparse.Namespace) -> int:
    from holotorch.experiments.registry import load_config, run_name

    settings = load_config(options.config, options.overrides)  # reports mistakes before torch is loaded
    from holotorch.experiments.execute import execute
    from holotorch.experiments.planning.threads import undisturbed

    name = run_name(options.config, options.overrides, settings.experiment)
    with undisturbed():
        return _finish(*execute(settings, options.out, name))


def _resume(options: argparse.Namespace) -> int:
    from holotorch.experiments.execute import resume
    from holotorch.experiments.planning.threads import undisturbed

    with undisturbed(resumed=options.folder):
        return _finish(*resume(options.folder))


def _demo(options: argparse.Namespace) -> int:
    from holotorch.experiments.demo import demo
    from holotorch.experiments.planning.threads import undisturbed
    from holotorch.experiments.streaming.screenshot import screenshot

    with undisturbed():
        return _finish(*demo(options.out, screenshot))


def _finish(folder: Path, complete: bool) -> int:
    from holotorch.experiments.execute import print_outcome

    print_outcome(folder)
    return OK if complete else INTERRUPTED


def _check(options: argparse.Namespace) -> int:
    from holotorch.experiments.config.errors import ConfigError
    from holotorch.experiments.registry import load_config

    settings = load_config(options.config, options.overrides)
    from holotorch.experiments.execute import check, emphasised, write_preview
    from holotorch.experiments.planning.threads import undisturbed

    with undisturbed():
        plan = check(settings)
        print(emphasised(plan.text))
        if options.preview is not None:
            print(write_preview(settings, options.preview))
    if plan.shortage:
        raise ConfigError([plan.shortage])
    return OK


def _new(options: argparse.Namespace) -> int:
    from holotorch.experiments.templates import write_example

    out = options.out or Path(f"{options.kind}.yaml")
    write_example(options.kind, out)
    print(f"{out}; look at what it will do with: holotorch check {out}")
    return OK


def _keys(options: argparse.Namespace) -> int:
    from holotorch.experiments.templates import keys_text

    print(keys_text(options.kind, options.prefix))
    return OK


def _schema(options: argparse.Namespace) -> int:
    from holotorch.experiments.templates import schema

    print(schema(options.kind))
    return OK


def _report(options: argparse.Namespace) -> int:
    from holotorch.experiments.report import write_report

    out = options.out or (options.folders[0] if len(options.folders) == 1 else Path()) / "report.html"
    write_report(options.folders, out)
    print(out)
    return OK


def _chart(options: argparse.Namespace) -> int:
    from holotorch.experiments.chart import chart

    # The committed charts are full ones; a quick chart is written to another folder.
    charts = Path("runs/charts-quick" if options.quick else "scripts/charts")
    if options.subject == "all":
        return _chart_all(options.out or charts, options.quick)
    out = options.out or charts / options.subject
    print("\n".join(chart(options.subject, out, quick=options.quick)))
    print(out)
    return OK


def _chart_all(out: Path, quick: bool) -> int:
    from holotorch.experiments.chart_all import PAGE, chart_all, interrupted

    outcomes = chart_all(out, quick=quick)
    print(out / PAGE)
    if interrupted(outcomes):
        return INTERRUPTED
    return FAILED if any(outcome.problem for outcome in outcomes.values()) else OK


def _doctor(_: argparse.Namespace) -> int:
    from holotorch.experiments.doctor import diagnose

    return OK if diagnose() else FAILED


def _export_slm(options: argparse.Namespace) -> int:
    from holotorch.experiments.panel.export import export_slm, export_text

    panel, *overrides = options.slm
    choices = {"encoding": options.encoding, "form": options.format}
    out, report = export_slm(options.folder, panel, options.out, overrides=overrides, **choices)
    print(export_text(report))
    print(out)
    return OK


def _export_heaters(options: argparse.Namespace) -> int:
    from holotorch.experiments.panel.heaters import export_heaters, heaters_text

    out, report = export_heaters(options.folder, options.out, bits=options.bits)
    print(heaters_text(report))
    print(out)
    return OK


_INTERRUPTIBLE = (_run, _resume, _demo, _chart, _export_slm, _export_heaters)


def _parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The arguments, with ``key=value`` also after options, where argparse takes no more positional arguments."""
    parser = _parser()
    options, left = parser.parse_known_args(arguments)
    if left and not (hasattr(options, "overrides") and all(re.match(r"[\w.]+=", word) for word in left)):
        parser.error(f"unrecognized arguments: {' '.join(left)}")
    if left:
        options.overrides = [*options.overrides, *left]
    return options


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="holotorch", description="Differentiable optics for VR and AR displays.")
    parser.add_argument("--version", action="version", version=f"holotorch {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, action: Callable[[argparse.Namespace], int], about: str, **more: Any):
        added = commands.add_parser(name, help=about, **more)
        added.set_defaults(action=action)
        return added

    config = argparse.ArgumentParser(add_help=False)  # the arguments that ``run`` and ``check`` share
    config.add_argument("config", metavar="CONFIG", help="YAML file, such as configs/pec/fourier.yaml")
    config.add_argument("overrides", nargs="*", metavar="key=value", help="settings to change, such as grid.pitch=8um")

    demo = command("demo", _demo, "a small real run of each system on bundled data, in a minute or two")
    demo.add_argument("--out", type=Path, help="folder of the run (default: runs/demo-001, ...)")

    about = "one experiment: pictures, numbers and a report in a folder of its own"
    run = command("run", _run, about, parents=[config])
    about = "folder of the run (default: runs/CONFIG-001, ..., or runs/FILE-001, ... of your own volume or picture)"
    run.add_argument("--out", type=Path, help=about)

    add_sweep(commands)
    resume = command("resume", _resume, "go on with an interrupted run, as if it had never stopped")
    resume.add_argument("folder", type=Path, metavar="DIR", help="folder of the run")

    about = "validate a configuration, print its plan and physics, compute nothing"
    check = command("check", _check, about, parents=[config])
    about = "write a picture of the inputs: of a volume a rendering, its histogram and transfer function"
    check.add_argument("--preview", type=Path, metavar="FILE.png", help=about)

    new = command("new", _new, "a configuration to begin with: an example of a kind of experiment")
    new.add_argument("kind", metavar="KIND", help="such as pec, volume, eye")
    new.add_argument("--out", type=Path, help="file to write (default: KIND.yaml)")

    keys = command("keys", _keys, "every key of a kind of experiment, with unit, default and meaning")
    keys.add_argument("kind", metavar="KIND", help="such as pec, volume, eye")
    keys.add_argument("prefix", nargs="?", default="", metavar="KEY", help="only this key and those within it")

    schema = command("schema", _schema, "JSON Schema of the configurations of a kind, for editors")
    schema.add_argument("kind", metavar="KIND", help="such as pec, volume, eye")

    report = command("report", _report, "one HTML page for one or more run folders")
    report.add_argument("folders", nargs="+", type=Path, metavar="DIR")
    report.add_argument("--out", type=Path, help="file to write (default: DIR/report.html; ./report.html for several)")

    chart = command("chart", _chart, "speed against accuracy of every method, as a figure and a table")
    subjects = (
        "camera, chain, devices, eye, joint, network, pec, propagation, retina, scaling, stability, tracking, volume, "
        "whole"
    )
    chart.add_argument("subject", help=f"what to chart: {subjects}, or all, on one page")
    chart.add_argument("--quick", action="store_true", help="a reduced form, which takes seconds and tests no goal")
    places = "scripts/charts/SUBJECT, with --quick runs/charts-quick/SUBJECT; of all: without SUBJECT"
    chart.add_argument("--out", type=Path, help=f"folder for the chart (default: {places})")

    usage = "holotorch export-slm DIR --slm FILE [key=value ...] [--out OUT] [--encoding ENCODING] [--format FORMAT]"
    about = "frames for a phase panel from a run, and what those files show"
    export = command("export-slm", _export_slm, about, usage=usage)
    export.add_argument("folder", type=Path, metavar="DIR", help="folder of a run of kind pec, joint or volume")
    panel = "a panel, such as configs/slm/lcos_2048.yaml, and its settings to change"
    export.add_argument("--slm", nargs="+", required=True, metavar=("FILE", "key=value"), help=panel)
    export.add_argument("--out", type=Path, help="folder for the files (default: DIR/slm, DIR/slm-002, ...)")
    export.add_argument("--encoding", help="of a volume: double_phase (default), kinoform, error_diffusion")
    export.add_argument("--format", default="png", help="png (default), bmp, or exr for phases instead of levels")

    about = "heater phases, temperatures and optical phases of a run, as NumPy, CSV and PNG files"
    heaters = command("export-heaters", _export_heaters, about)
    heaters.add_argument("folder", type=Path, metavar="DIR", help="folder of a run of kind pec or joint")
    heaters.add_argument("--out", type=Path, help="folder for the files (default: DIR/heaters, DIR/heaters-002, ...)")
    heaters.add_argument("--bits", type=int, default=16, help="resolution of the heaters' drive levels (default: 16)")

    add_tracking(commands)
    add_measure(commands)
    add_stream(commands)
    add_study(commands)
    add_view(commands)
    command("doctor", _doctor, "check the installation and print how to repair it")
    return parser


if __name__ == "__main__":
    sys.exit(main())
