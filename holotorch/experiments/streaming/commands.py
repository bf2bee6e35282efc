"""The command ``stream``: its arguments and action. Other modules are imported when it runs."""

import argparse
import sys
from pathlib import Path

from holotorch.experiments.tracking.commands import FILES

OK, FAILED, INTERRUPTED = 0, 1, 130


def add_stream(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser of ``holotorch``."""
    stream = commands.add_parser("stream", help="send poses to headsets and 3D Slicer, or see what arrives")
    stream.add_argument("sources", nargs="*", metavar="SOURCE", help="a poses.csv, or what track takes")
    stream.add_argument("--to", action="append", metavar="HOST[:PORT]", help="receiver; may be given again")
    stream.add_argument("--igtl", type=_port, metavar="PORT", help="serve OpenIGTLink, such as on 18944")
    stream.add_argument("--rate", type=float, metavar="HZ", help="poses per second of a poses.csv, or of pictures")
    stream.add_argument("--smooth", action="store_true", help="One-Euro filter; packets tell its lag")
    stream.add_argument("--view", action="store_true", help="show what arrives")
    stream.add_argument("--check", action="store_true", help="send to this machine itself, also with losses, and count")
    stream.add_argument("--port", type=_port, default=18950, help="where --view and --check listen (default: 18950)")
    stream.set_defaults(action=_stream)
    for name, words in FILES.items():
        stream.add_argument(name, type=Path, help=words)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"expected a port from 0 (any that is free) to 65535, got {text!r}")
    return int(text)


def _stream(options: argparse.Namespace) -> int:
    if options.check or options.view:
        _need_no_source(options)
    if options.check:
        from holotorch.experiments.streaming.check import check

        return OK if check(options.port) else FAILED
    from holotorch.experiments.streaming import stream

    if options.view:
        stream.view(options.port)
        return OK
    from holotorch.experiments.tracking.run import live
    from holotorch.io.video import is_camera

    result = stream.stream(
        options.sources,
        options.to or (),
        igtl=options.igtl,
        rate=options.rate,
        smooth=options.smooth,
        track=lambda sources: live(sources, options.camera, options.catheter, options.rate),
    )
    if not result.delivered:
        print("nothing could be delivered: does a receiver run there? holotorch stream --view is one", file=sys.stderr)
        return FAILED
    # A camera never ends, so that Ctrl-C is the normal end of its stream.
    return OK if result.complete or is_camera(options.sources[0]) else INTERRUPTED


def _need_no_source(options: argparse.Namespace) -> None:
    """Raise ConfigError for arguments that ``--check`` or ``--view`` would ignore: neither sends poses of a source."""
    from holotorch.experiments.config.errors import ConfigError

    unused = ["SOURCE"] if options.sources else []
    names = ("to", "igtl", "rate", "smooth", "camera", "catheter", *(["view"] if options.check else []))
    given = {name: getattr(options, name) for name in names}
    unused += [f"--{name}" for name, value in given.items() if value is not None and value is not False]
    if unused:
        listening = "--view only listens; send from another terminal"
        option = "--check sends to this computer itself" if options.check else listening
        raise ConfigError([f"{option}: it takes no {', '.join(unused)}"])
