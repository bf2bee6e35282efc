"""Run the study of one participant: load the settings, serve the page until the study ends, and print a summary."""

import asyncio
import os
import re
import secrets
from contextlib import ExitStack, closing, suppress
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.config import beyond_screen, build_screen, load_study
from holotorch.experiments.perception.study.frames import quantisation
from holotorch.experiments.perception.study.gaze import GazeFile
from holotorch.experiments.perception.study.log import TrialLog
from holotorch.experiments.perception.study.server import StudyServer
from holotorch.experiments.perception.study.session import StudySession
from holotorch.experiments.runs.signals import handling
from holotorch.io.files import write_json

_INTRODUCE = {
    "tracker": "gaze: waiting for samples of the eye tracker at /gaze, with the token at the end of the address",
    "file": "gaze: fixation is checked by the analysis, from a CSV file of samples beside the log",
    "mouse": "gaze: the mouse stands in for an eye tracker; the analysis refuses these results",
}


def run_study_server(
    config: str | Path,
    *,
    port: int | None = None,
    participant: int = 1,
    out: Path | None = None,
    script: str | None = None,
) -> int:
    """Run the study of one participant in a browser until it is complete or interrupted; an existing log is continued.

    SIGINT, SIGTERM and SIGHUP interrupt the study. The access token is stored in participant-NNN.token beside the log,
    so that an open page can continue after a restart; the file is removed when the study is complete.

    Args:
        config: Configuration file of the study.
        port: Port of the server; None for any free port.
        participant: Number of the participant, 1, 2, ...
        out: Folder of the logs and designs of all participants; runs/CONFIG by default.
        script: JavaScript to add to the page; see ``StudyServer``.

    Returns:
        0 if every trial is recorded, 130 if the study was interrupted. All recorded trials are on the disk.

    Raises:
        ConfigError: The file has a mistake; the participant is being recorded, is complete, or was begun with another
            configuration; the port is in use; or the log cannot be read.
    """
    settings = load_study(config)
    try:
        design = settings.design(participant)
    except ValueError as error:
        raise ConfigError([f"{config}: {error}"]) from None
    folder = out or Path("runs") / Path(config).stem
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"participant-{participant:03d}.jsonl"
    header = {
        "participant": participant,
        "design": design.name,
        **settings.recorded(),
        "cut": [[cut.eccentricity_deg, cut.size_deg] for cut in beyond_screen(settings)],
    }
    with TrialLog(path, header) as log, ExitStack() as stack:
        live = settings.gaze is not None and settings.gaze.live
        gaze_file = stack.enter_context(closing(GazeFile(path.with_suffix(".gaze.csv")))) if live else None
        session = StudySession(settings, design, log, gaze_file)
        if session.complete:
            text = f"{path}: participant {participant} is complete; choose another number, or another folder with --out"
            raise ConfigError([text])
        write_json(path.with_suffix(".design.json"), design.to_json())
        server = StudyServer(session, _token(path.with_suffix(".token")), script)
        with asyncio.Runner() as runner:
            loop = runner.get_loop()
            with handling(lambda *_: loop.call_soon_threadsafe(server.stop.set)):
                runner.run(_serve(server, port or 0))
                if session.complete:
                    path.with_suffix(".token").unlink(missing_ok=True)
                else:
                    print("interrupted")
                print(_summary(session), flush=True)
    return 0 if session.complete else 130


async def _serve(server: StudyServer, port: int) -> None:
    async with server.listening(port):
        print(_introduction(server), flush=True)
        await server.stop.wait()


def _introduction(server: StudyServer) -> str:
    settings, design, done = server.session.settings, server.session.design, len(server.session.log.trials)
    lines = [f"cut at the edge of the screen: {cut.text}" for cut in beyond_screen(settings)]
    field = build_screen(settings.screen).field_deg[1]
    lines.append(f"screen: {field:.1f} deg wide, {settings.screen.distance:g} m away")
    if done:
        trial = f"trial {done + 1} of {len(server.session.order.appearances)}"
        lines.append(f"participant {design.participant} goes on at {trial}; a new person needs a new number")
    if settings.gaze:
        lines.append(_INTRODUCE[settings.gaze.source])
    rows, columns = settings.screen.shape
    lines.append(f"open in full screen ({columns} x {rows} pixels): {server.address}#{server.token}")
    return "\n".join(lines)


def _summary(session: StudySession) -> str:
    log = session.log
    trials = [trial for trial in log.trials if not trial["practice"]]
    correct = sum(trial["responded"] == trial["target"] for trial in trials)
    total = len(session.order.appearances)
    lines = [f"{len(log.trials)} of {total} trials in {log.path}; without practice {correct} of {len(trials)} correct"]
    if session.gaze:
        broken = sum(trial.get("fixated") is False for trial in trials)
        lines.append(f"fixation broken in {broken} of {len(trials)} trials; {session.gaze}")
    steps = quantisation([trial["frame_s"] for trial in log.trials])
    return "\n".join(lines + ([str(steps)] if steps else []))


def _token(path: Path) -> str:
    """Read the token from a file that only its owner can read, or write a new one. The caller holds the log's lock."""
    with suppress(OSError, ValueError):
        text = path.read_text(encoding="ascii")
        if (os.name == "nt" or path.stat().st_mode & 0o077 == 0) and re.fullmatch(r"[\w-]{43}", text):
            return text
    path.unlink(missing_ok=True)
    token = secrets.token_urlsafe(32)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as stream:
        stream.write(token)
    return token
