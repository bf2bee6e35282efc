"""The commands track, calibrate and stream: their arguments, and what they call. Nothing loads before it is used."""

import argparse
import re
import sys
from pathlib import Path

OK, FAILED, INTERRUPTED = 0, 1, 130


def add_tracking(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the three commands to the parser of ``holotorch``."""
    track = commands.add_parser("track", help="a catheter's tip on every frame of a video, a folder or a camera")
    what = "video, folder of pictures or of a recording, number of a camera, or: synthetic"
    track.add_argument("source", metavar="SOURCE", help=what)
    track.add_argument("--out", type=Path, help="folder of the run (default: runs/track-001, ...)")
    track.add_argument("--method", default="ours", help="ours (default) or thesis")
    track.add_argument("--record", action="store_true", help="keep every frame, losslessly, to be tracked again")
    track.add_argument("--no-video", action="store_true", help="write no overlay video")
    track.add_argument("--still", action="store_true", help="the catheter is at rest: measure its stability")
    track.add_argument("--rate", type=float, metavar="HZ", help="frames per second of a source without times")
    track.set_defaults(action=_track)

    calibrate = commands.add_parser("calibrate", help="a camera's intrinsics from photographs of a board")
    calibrate.add_argument("files", nargs="+", type=Path, metavar="FILE", help="photographs, or folders of them")
    board = "chessboard 9x6 25mm (default; inner corners, square) or charuco 5x7 40mm 20mm DICT_6X6_250"
    calibrate.add_argument("--board", nargs="+", metavar="WORD", help=board)
    # A size of -25mm is a wrong size, and no unknown option; argparse knows this of whole numbers only.
    calibrate._negative_number_matcher = re.compile(r"-\.?\d")
    calibrate.add_argument("--out", type=Path, default=Path("camera.yaml"), help="file (default: camera.yaml)")
    calibrate.set_defaults(action=_calibrate)

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
    for command in (track, stream):
        command.add_argument("--camera", type=Path, help="its intrinsics: a YAML file, as calibrate writes it")
        command.add_argument("--catheter", type=Path, help="YAML file, such as configs/tracking/catheter.yaml")


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"expected a port from 0 (any that is free) to 65535, got {text!r}")
    return int(text)


def _track(options: argparse.Namespace) -> int:
    from holotorch.experiments.tracking.run import run_tracking

    source = options.source
    if source == "synthetic":
        from holotorch.experiments.tracking.synthetic import write_synthetic

        source = str(write_synthetic(None, camera=options.camera, catheter=options.catheter))
        print(source)
    folder, complete = run_tracking(
        source,
        options.camera,
        options.catheter,
        options.out,
        method=options.method,
        record=options.record,
        video=not options.no_video,
        still=options.still,
        rate=options.rate,
    )
    page = folder / "report.html"
    print(page if page.is_file() else folder)
    return OK if complete else INTERRUPTED


def _calibrate(options: argparse.Namespace) -> int:
    from holotorch.experiments.tracking.calibrate import BOARD, calibrate_photographs, calibration_text

    board = options.board or BOARD
    found, missing = calibrate_photographs(options.files, options.out, board)
    print(calibration_text(found, missing, board))
    print(options.out)
    return OK


def _stream(options: argparse.Namespace) -> int:
    if options.check or options.view:
        _listens(options)
    if options.check:
        from holotorch.experiments.streaming.check import check

        return OK if check(options.port) else FAILED
    from holotorch.experiments.streaming import stream

    if options.view:
        stream.view(options.port)
        return OK
    from holotorch.experiments.tracking.run import live
    from holotorch.io.video import is_camera

    found = stream.stream(
        options.sources,
        options.to or (),
        igtl=options.igtl,
        rate=options.rate,
        smooth=options.smooth,
        track=lambda sources: live(sources, options.camera, options.catheter, options.rate),
    )
    if not found.delivered:
        print("nothing could be delivered: does a receiver run there? holotorch stream --view is one", file=sys.stderr)
        return FAILED
    # Of a camera, which never ends, Ctrl-C is the ordinary end.
    return OK if found.complete or is_camera(options.sources[0]) else INTERRUPTED


def _listens(options: argparse.Namespace) -> None:
    """ConfigError for what the two ways of ``stream`` that send no poses of the user's would leave unused."""
    from holotorch.experiments.config.errors import ConfigError

    chosen = "--check" if options.check else "--view"
    unused = ["SOURCE"] if options.sources else []
    names = ("to", "igtl", "rate", "smooth", "camera", "catheter", *(["view"] if options.check else []))
    given = {name: getattr(options, name) for name in names}
    unused += [f"--{name}" for name, value in given.items() if value is not None and value is not False]
    if unused:
        does = "sends to this computer itself" if options.check else "only listens; send from another terminal"
        raise ConfigError([f"{chosen} {does}: it takes no {', '.join(unused)}"])
