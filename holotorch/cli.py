"""The ``holotorch`` command. Each subcommand loads only what it needs; ``--help`` loads nothing."""

import argparse
import errno
import re
import sys
from contextlib import nullcontext
from pathlib import Path

from holotorch import __version__
from holotorch.experiments.runs.signals import interruptible
from holotorch.experiments.streaming.commands import add_stream
from holotorch.experiments.study_commands import add_study
from holotorch.experiments.tracking.commands import add_tracking

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand and return its exit status: 0 done, 2 bad input, 1 failure, 130 interrupted and saved."""
    options = _parser().parse_args(arguments)
    from holotorch.experiments.config.errors import ConfigError

    try:
        # Servers and streams handle interruptions themselves.
        with interruptible() if options.action in (_run, _resume, _demo, _chart, _export_slm) else nullcontext():
            return options.action(options)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except (MemoryError, RuntimeError) as error:
        # When memory runs out, torch raises RuntimeError or a subclass of it, on the CPU and on CUDA.
        if isinstance(error, RuntimeError) and not re.search(r"(?i)can.t allocate memory|out of memory", str(error)):
            raise
        # An operation that estimates its memory in advance raises MemoryError with an explanation.
        refused = str(error) if isinstance(error, MemoryError) else ""
        print(refused or "out of memory; use a smaller grid", file=sys.stderr)
        return FAILED
    except OSError as error:
        print(f"{error.filename or 'file'}: {error.strerror or error}", file=sys.stderr)
        return BAD_INPUT if error.errno == errno.ENAMETOOLONG else FAILED
    except KeyboardInterrupt:
        print(_before(options), file=sys.stderr)
        return INTERRUPTED


def _before(options: argparse.Namespace) -> str:
    """Message for an interruption before this command computed anything; it changed no results of an earlier run."""
    folder = options.folder if options.action is _resume else getattr(options, "out", None)
    if folder is not None and (folder / "config.yaml").is_file() and not (folder / "summary.json").is_file():
        return f"interrupted before it went on; start it again with: holotorch resume {folder}"
    return "interrupted before anything could be saved"


def _run(options: argparse.Namespace) -> int:
    from holotorch.experiments.registry import load_config

    settings = load_config(options.config, options.overrides)
    from holotorch.experiments.execute import execute

    return _finish(*execute(settings, options.out, Path(options.config).stem))


def _resume(options: argparse.Namespace) -> int:
    from holotorch.experiments.execute import resume

    return _finish(*resume(options.folder))


def _demo(options: argparse.Namespace) -> int:
    from holotorch.experiments.demo import demo

    return _finish(*demo(options.out))


def _finish(folder: Path, complete: bool) -> int:
    page = folder / "report.html"
    print(page if page.is_file() else folder)
    return OK if complete else INTERRUPTED


def _check(options: argparse.Namespace) -> int:
    from holotorch.experiments.config.errors import ConfigError
    from holotorch.experiments.registry import load_config

    settings = load_config(options.config, options.overrides)
    from holotorch.experiments.execute import check

    plan = check(settings)
    print(plan.text)
    if plan.shortage:
        raise ConfigError([plan.shortage])
    return OK


def _new(options: argparse.Namespace) -> int:
    from holotorch.experiments.beginnings import write_example

    out = options.out or Path(f"{options.kind}.yaml")
    write_example(options.kind, out)
    print(f"{out}; look at what it will do with: holotorch check {out}")
    return OK


def _schema(options: argparse.Namespace) -> int:
    from holotorch.experiments.beginnings import schema

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

    out = options.out or Path("scripts/charts") / options.subject
    print("\n".join(chart(options.subject, out)))
    print(out)
    return OK


def _doctor(_: argparse.Namespace) -> int:
    from holotorch.experiments.doctor import diagnose

    return OK if diagnose() else FAILED


def _export_slm(options: argparse.Namespace) -> int:
    from holotorch.experiments.panel.export import export_slm, export_text

    out, report = export_slm(
        options.folder,
        options.slm[0],
        options.out,
        encoding=options.encoding,
        form=options.format,
        overrides=options.slm[1:],
    )
    print(export_text(report))
    print(out)
    return OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="holotorch", description="Differentiable optics for VR and AR displays.")
    parser.add_argument("--version", action="version", version=f"holotorch {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="a small real run of each system on bundled data, under a minute")
    demo.add_argument("--out", type=Path, help="folder of the run (default: runs/demo-001, ...)")
    demo.set_defaults(action=_demo)

    run = commands.add_parser("run", help="one experiment: pictures, numbers and a report in a folder of its own")
    _add_config(run)
    run.add_argument("--out", type=Path, help="folder of the run (default: runs/CONFIG-001, ...)")
    run.set_defaults(action=_run)

    resume = commands.add_parser("resume", help="go on with an interrupted run, as if it had never stopped")
    resume.add_argument("folder", type=Path, metavar="DIR", help="folder of the run")
    resume.set_defaults(action=_resume)

    check = commands.add_parser("check", help="validate a configuration, print its plan and physics, compute nothing")
    _add_config(check)
    check.set_defaults(action=_check)

    new = commands.add_parser("new", help="a configuration to begin with: an example of a kind of experiment")
    new.add_argument("kind", metavar="KIND", help="such as pec, volume, eye")
    new.add_argument("--out", type=Path, help="file to write (default: KIND.yaml)")
    new.set_defaults(action=_new)

    schema = commands.add_parser("schema", help="JSON Schema of the configurations of a kind, for editors")
    schema.add_argument("kind", metavar="KIND", help="such as pec, volume, eye")
    schema.set_defaults(action=_schema)

    report = commands.add_parser("report", help="one HTML page for one or more run folders")
    report.add_argument("folders", nargs="+", type=Path, metavar="DIR")
    report.add_argument("--out", type=Path, help="file to write (default: DIR/report.html; ./report.html for several)")
    report.set_defaults(action=_report)

    chart = commands.add_parser("chart", help="speed against accuracy of every method, drawn and tabled")
    chart.add_argument("subject", help="what to chart: eye, pec, propagation, tracking, volume")
    chart.add_argument("--out", type=Path, help="folder for the chart (default: scripts/charts/SUBJECT)")
    chart.set_defaults(action=_chart)

    words = "holotorch export-slm DIR --slm FILE [key=value ...] [--out OUT] [--encoding ENCODING] [--format FORMAT]"
    about = "frames for a phase panel from a run, and what those files show"
    export = commands.add_parser("export-slm", help=about, usage=words)
    export.add_argument("folder", type=Path, metavar="DIR", help="folder of a run of kind pec or volume")
    panel = "a panel, such as configs/slm/lcos_2048.yaml, and its settings to change"
    export.add_argument("--slm", nargs="+", required=True, metavar=("FILE", "key=value"), help=panel)
    export.add_argument("--out", type=Path, help="folder for the files (default: DIR/slm)")
    export.add_argument("--encoding", help="of a volume: double_phase (default), kinoform, error_diffusion")
    export.add_argument("--format", default="png", help="png (default), bmp, or exr for phases instead of levels")
    export.set_defaults(action=_export_slm)

    add_tracking(commands)
    add_stream(commands)
    add_study(commands)
    doctor = commands.add_parser("doctor", help="check the installation and print what repairs it")
    doctor.set_defaults(action=_doctor)
    return parser


def _add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", metavar="CONFIG", help="YAML file, such as configs/pec/fourier.yaml")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="settings to change, such as grid.pitch=8um")


if __name__ == "__main__":
    sys.exit(main())
