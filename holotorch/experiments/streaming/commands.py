"""The command ``stream``: its arguments and action. Other modules are imported when it runs."""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from holotorch.experiments.tracking.commands import FILES

OK, FAILED, INTERRUPTED = 0, 1, 130
_OF_PAGE = ("page", "align", "volume", "panel")  # options that need the page, and therefore imply --view


def add_stream(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser of ``holotorch``."""
    stream = commands.add_parser("stream", help="send poses to headsets, 3D Slicer and browsers, or see what arrives")
    stream.add_argument(
        "sources", nargs="*", metavar="SOURCE", help="a poses.csv, or what track takes, also: synthetic"
    )
    receiver = "receiver, and its own headset file if it has one; may be given again"
    stream.add_argument("--to", action="append", metavar="HOST[:PORT][=FILE]", help=receiver)
    stream.add_argument("--headset", type=Path, metavar="FILE", help="send poses in its frame; see calibrate headset")
    stream.add_argument("--igtl", type=_port, metavar="PORT", help="serve OpenIGTLink, such as on 18944")
    stream.add_argument("--rate", type=float, metavar="HZ", help="poses per second of a poses.csv, or of pictures")
    stream.add_argument("--smooth", action="store_true", help="One-Euro filter; packets state its lag")
    about = "with a source: a page that shows the poses in a browser; without: print what arrives by UDP"
    stream.add_argument("--view", action="store_true", help=about)
    stream.add_argument("--replay", type=Path, metavar="DIR", help="a run of track as the source, again and again")
    stream.add_argument("--page", metavar="HOST[:PORT]", help="where the page is served (default: 127.0.0.1:8765)")
    about = "let a user of the page align the camera with a headset, and write its position to FILE (headset.yaml)"
    stream.add_argument("--align", type=Path, metavar="FILE", help=about)
    stream.add_argument(
        "--volume", type=Path, metavar="FILE", help="registered volume: the page shows slices at the tip"
    )
    about = "a picture in the page: a video, a camera's number, overlay (the tracked frames), or pattern (a test)"
    stream.add_argument("--panel", metavar="SOURCE", help=about)
    stream.add_argument("--tls", nargs=2, type=Path, metavar=("CERT", "KEY"), help="for a page on another computer")
    stream.add_argument("--check", action="store_true", help="send to this machine itself, also with losses, and count")
    about = "how many packets --check sends (default: 1000); more of them make its test of the memory more sensitive"
    stream.add_argument("--packets", type=_count, metavar="N", help=about)
    stream.add_argument("--port", type=_port, default=18950, help="where --view and --check listen (default: 18950)")
    stream.set_defaults(action=_stream)
    for name, explanation in FILES.items():
        stream.add_argument(name, type=Path, help=explanation)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"expected a port from 0 (any that is free) to 65535, got {text!r}")
    return int(text)


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 100 <= int(text) <= 10_000_000):
        raise argparse.ArgumentTypeError(f"expected a number from 100 to 10 million, got {text!r}")
    return int(text)


def _stream(options: argparse.Namespace) -> int:
    options.view = options.view or any(getattr(options, name) is not None for name in _OF_PAGE)
    if options.replay:
        if options.sources:
            from holotorch.experiments.config.errors import ConfigError

            raise ConfigError(
                [f"--replay {options.replay} is the source itself: leave {' '.join(options.sources)} out"]
            )
        options.sources = [str(_poses_of(options.replay))]
    if options.check or (options.view and not options.sources):
        _need_no_source(options)
    if options.check:
        from holotorch.experiments.streaming.check import check

        return OK if check(options.port, packets=options.packets or 1000) else FAILED
    if options.packets is not None:
        from holotorch.experiments.config.errors import ConfigError

        raise ConfigError(["--packets belongs to --check"])
    from holotorch.experiments.streaming import stream

    if options.view and not options.sources:
        stream.view(options.port)
        return OK
    with _rendered(options):
        return _send(options)


def _poses_of(folder: Path) -> Path:
    """The poses.csv of a run; ConfigError for a folder without one, which says what the folder holds."""
    poses = folder / "poses.csv"
    if not poses.is_file():
        from holotorch.experiments.config.errors import ConfigError
        from holotorch.experiments.runs.record import RunRecord

        command = "holotorch stream --view --replay {}"
        kind = RunRecord(folder, command, lambda run: (run / "poses.csv").is_file()).kind
        raise ConfigError([f"{folder} holds a run of kind {kind} without poses.csv; --replay takes a run of track"])
    return poses


@contextmanager
def _rendered(options: argparse.Namespace) -> Iterator[None]:
    """Context in which the source ``synthetic`` is a rendered recording, in a temporary folder."""
    from holotorch.experiments.streaming.stream import receivers_of
    from holotorch.experiments.tracking.config import FRAMES, SYNTHETIC

    receivers_of(options.to or (), options.headset)  # raises for a wrong one, before the time that rendering takes
    if options.sources != [SYNTHETIC] or not (options.to or options.view or options.igtl is not None):
        yield
        return
    from holotorch.experiments.tracking.synthetic import write_synthetic

    with tempfile.TemporaryDirectory() as folder:
        made = write_synthetic(Path(folder, SYNTHETIC), FRAMES, camera=options.camera, catheter=options.catheter)
        options.sources = [str(made)]
        yield


def _send(options: argparse.Namespace) -> int:
    from holotorch.experiments.streaming import stream

    page = None
    if options.view:
        from holotorch.experiments.streaming.opening import open_page

        more = {name: getattr(options, name) for name in ("tls", "align", "volume", "panel")}
        page = open_page(options.sources[0], options.camera, options.catheter, options.headset, options.page, **more)
    from holotorch.experiments.tracking.run import live
    from holotorch.io.video import is_camera

    result = stream.stream(
        options.sources,
        options.to or (),
        headset=options.headset,
        igtl=options.igtl,
        page=page,
        await_browser=not (options.to or options.replay or options.igtl is not None),
        repeat=options.replay is not None,
        rate=options.rate,
        smooth=options.smooth,
        track=lambda sources: live(sources, options.camera, options.catheter, options.rate, page.see if page else None),
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
    names = (
        "to",
        "headset",
        *_OF_PAGE,
        "tls",
        "igtl",
        "rate",
        "smooth",
        "camera",
        "catheter",
        *(["view"] if options.check else []),
    )
    given = {name: getattr(options, name) for name in names}
    unused += [f"--{name}" for name, value in given.items() if value is not None and value is not False]
    if unused:
        listening = "--view without a SOURCE only listens; name one, or send from another terminal"
        option = "--check sends to this computer itself" if options.check else listening
        raise ConfigError([f"{option}: it takes no {', '.join(unused)}"])
