"""Arguments and actions of ``track`` and ``calibrate``. Other modules are imported only when a command runs."""

import argparse
import json
import re
from pathlib import Path

OK, INTERRUPTED = 0, 130
# File options that ``track`` and ``stream`` share, with their help texts.
FILES = {
    "--camera": "its intrinsics: a YAML file, as calibrate writes it",
    "--catheter": "YAML file, such as configs/tracking/catheter.yaml",
}


def add_tracking(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add both commands to the parser of ``holotorch``."""
    track = commands.add_parser("track", help="a catheter's tip on every frame of a video, a folder or a camera")
    what = "video, folder of pictures or of a recording, number of a camera, or: synthetic"
    track.add_argument("source", metavar="SOURCE", help=what)
    track.add_argument("overrides", nargs="*", metavar="key=value", help="settings to change, such as frames=10")
    about = "folder of the run (default: runs/track-001, ..., or runs/VIDEO-track-001, ...)"
    track.add_argument("--out", type=Path, help=about)
    track.add_argument("--method", default="ours", help="ours (default) or thesis")
    track.add_argument("--record", action="store_true", help="keep every frame, losslessly, to be tracked again")
    track.add_argument("--no-video", action="store_true", help="write no videos")
    track.add_argument("--still", action="store_true", help="the catheter is at rest: measure its stability")
    track.add_argument("--rate", type=float, metavar="HZ", help="frames per second of a source without times")
    about = "frames tracked at a time (default: 1); above 1, each is searched as a whole, without the pose before"
    track.add_argument("--batch", type=int, default=1, metavar="N", help=about)
    track.set_defaults(action=_track)

    about = "a camera's intrinsics from photographs, its place on a headset, or the colours of a catheter's bands"
    calibrate = commands.add_parser("calibrate", help=about)
    what = "photographs of a board, or folders of them; or: headset ALIGNMENTS.csv; or: catheter PHOTOGRAPH_OR_VIDEO"
    calibrate.add_argument("files", nargs="+", type=Path, metavar="FILE", help=what)
    board = "chessboard 9x6 25mm (default; inner corners, square) or charuco 5x7 40mm 20mm DICT_6X6_250"
    calibrate.add_argument("--board", nargs="+", metavar="WORD", help=board)
    # Without this pattern, argparse would read -25mm as an option instead of an (invalid) length.
    calibrate._negative_number_matcher = re.compile(r"-\.?\d")
    calibrate.add_argument("--axes", help="of the headset's frame: RDF (default), RUB (WebXR), RUF (Unity), ...")
    about = (
        "of a catheter: where each band is on the photograph, from the tip on, in pixels: X,Y, or X0,Y0,X1,Y1 of a box "
        "that lies within the band; without it, the first frame of a video is saved as a picture"
    )
    calibrate.add_argument("--bands", nargs="+", metavar="PLACE", help=about)
    about = "of a catheter: YAML file whose edges, radius and length are kept (default: configs/tracking/catheter.yaml)"
    calibrate.add_argument("--catheter", type=Path, metavar="FILE", help=about)
    about = "of a catheter: distances of the edges of its bands from the tip, such as 70mm 108mm 146mm 184mm"
    calibrate.add_argument("--edges", nargs="+", metavar="LENGTH", help=about)
    calibrate.add_argument("--radius", metavar="LENGTH", help="of a catheter: half its diameter, such as 1mm")
    calibrate.add_argument("--length", metavar="LENGTH", help="of a catheter: from its tip on, such as 350mm")
    calibrate.add_argument("--out", type=Path, help="file (default: camera.yaml, headset.yaml or catheter.yaml)")
    calibrate.set_defaults(action=_calibrate)

    track.add_argument(
        "--headset", type=Path, metavar="FILE", help="write poses in its frame too; see calibrate headset"
    )
    for name, explanation in FILES.items():
        track.add_argument(name, type=Path, help=explanation)


def _track(options: argparse.Namespace) -> int:
    from holotorch.experiments.config.errors import ConfigError
    from holotorch.experiments.config.messages import validated
    from holotorch.experiments.config.source import Key, Source, override
    from holotorch.experiments.execute import execute, print_outcome
    from holotorch.experiments.registry import run_name
    from holotorch.experiments.tracking.config import TrackSettings

    given = {"source": options.source, "method": options.method, "record": options.record, "still": options.still}
    given |= {"video": not options.no_video, "rate_hz": options.rate, "batch": options.batch}
    given |= {name: str(path) for name in ("camera", "catheter", "headset") if (path := getattr(options, name))}
    arguments: dict[Key, str] = {("method",): "argument --method", ("rate_hz",): "argument --rate"}
    arguments |= {("batch",): "argument --batch"}
    source, mistakes = Source(Path("track"), {"experiment": "track", **given}, arguments), list[str]()
    for word in options.overrides:
        override(source, word, mistakes)
    if mistakes:
        raise ConfigError(mistakes)
    settings = validated(source, TrackSettings)
    name = run_name("track", [f"source={json.dumps(options.source)}"], "track")
    folder, complete = execute(settings, options.out, name)
    print_outcome(folder)
    return OK if complete else INTERRUPTED


def _calibrate(options: argparse.Namespace) -> int:
    from holotorch.experiments.config.errors import ConfigError

    if options.files[0] == Path("catheter"):
        from holotorch.experiments.tracking.photograph import calibrate_catheter, save_first_frame
        from holotorch.experiments.tracking.source import first_frame
        from holotorch.io.video import PICTURES

        alone = len(options.files) == 2 and not (options.board or options.axes)
        if alone and not options.bands and options.files[1].suffix.lower() not in PICTURES:
            print(save_first_frame(options.files[1], options.out or first_frame(options.files[1])))
            return OK
        if not alone or not options.bands:
            expected = "calibrate catheter: expected one photograph and --bands X,Y X,Y X,Y, without --board and --axes"
            raise ConfigError([expected])
        out = options.out or Path("catheter.yaml")
        measured = {"edges": f"[{', '.join(options.edges)}]"} if options.edges else {}
        measured |= {key: value for key in ("radius", "length") if (value := getattr(options, key))}
        _, lines = calibrate_catheter(options.files[1], options.bands, out, options.catheter, measured)
        print(*lines, out, sep="\n")
        return OK
    if any(getattr(options, name) for name in ("bands", "catheter", "edges", "radius", "length")):
        expected = "--bands, --catheter, --edges, --radius and --length belong to: calibrate catheter PHOTOGRAPH"
        raise ConfigError([expected])
    if options.files[0] == Path("headset"):
        if len(options.files) != 2 or options.board:
            raise ConfigError(["calibrate headset: expected one file of alignments, and no --board"])
        from holotorch.experiments.tracking.headset import alignment_text, calibrate_headset

        out = options.out or Path("headset.yaml")
        print(alignment_text(*calibrate_headset(options.files[1], out, options.axes or "RDF")), out, sep="\n")
        return OK
    if options.axes:
        raise ConfigError(["--axes belongs to: calibrate headset ALIGNMENTS.csv"])
    from holotorch.experiments.tracking.calibrate import BOARD, calibrate_photographs, calibration_text

    board, out = options.board or BOARD, options.out or Path("camera.yaml")
    calibration, missing = calibrate_photographs(options.files, out, board)
    print(calibration_text(calibration, missing, board), out, sep="\n")
    return OK
