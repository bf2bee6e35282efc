"""The study of one participant, from the files it begins with to the summary at its end."""

import asyncio
import os
import re
import secrets
from contextlib import suppress
from pathlib import Path

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.study.config import beyond_screen, build_screen, load_study
from holotorch.experiments.perception.study.frames import quantisation
from holotorch.experiments.perception.study.log import TrialLog
from holotorch.experiments.perception.study.server import StudyServer
from holotorch.experiments.perception.study.session import StudySession
from holotorch.experiments.runs.signals import handling
from holotorch.io.files import write_json


def run_study_server(
    config: str | Path,
    *,
    port: int | None = None,
    participant: int = 1,
    out: Path | None = None,
    script: str | None = None,
) -> int:
    """Run the study of one participant in a browser, from where the log ends, until it is complete or interrupted.

    SIGINT, SIGTERM and SIGHUP interrupt it. The token is in participant-NNN.token beside the log, so that a page which
    is open goes on with the next start; it is removed when the study is complete.

    Args:
        config: File of the study.
        port: Of the server; None for any free one.
        participant: 1, 2, ...
        out: Folder of the logs and designs of all participants; runs/CONFIG by default.
        script: See ``StudyServer``.

    Returns:
        0 when every trial is recorded, 130 when it was interrupted before; what was recorded is on the disk.

    Raises:
        ConfigError: A mistake in the file; a number that is in use, complete, or was begun with another configuration;
            a port that is taken; a log that cannot be read.
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
        "screen": settings.screen.model_dump(mode="json"),
        "timing": settings.timing.model_dump(mode="json"),
        "cut": [[cut.eccentricity_deg, cut.size_deg] for cut in beyond_screen(settings)],
    }
    with TrialLog(path, header) as log:
        session = StudySession(settings, design, log)
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
        place = f"trial {done + 1} of {len(design.trials)}"
        lines.append(f"participant {design.participant} goes on at {place}; a new person needs a new number")
    rows, columns = settings.screen.shape
    lines.append(f"open in full screen ({columns} x {rows} pixels): {server.address}#{server.token}")
    return "\n".join(lines)


def _summary(session: StudySession) -> str:
    log = session.log
    trials = [trial for trial in log.trials if not trial["practice"]]
    right = sum(trial["responded"] == trial["target"] for trial in trials)
    total = len(session.design.trials)
    lines = [f"{len(log.trials)} of {total} trials in {log.path}; without practice {right} of {len(trials)} right"]
    steps = quantisation([trial["frame_s"] for trial in log.trials])
    return "\n".join(lines + ([str(steps)] if steps else []))


def _token(path: Path) -> str:
    """The token in a file that only its owner can read, a new one where there is none; the log's lock is held."""
    with suppress(OSError, ValueError):
        text = path.read_text(encoding="ascii")
        if (os.name == "nt" or path.stat().st_mode & 0o077 == 0) and re.fullmatch(r"[\w-]{43}", text):
            return text
    path.unlink(missing_ok=True)
    token = secrets.token_urlsafe(32)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as stream:
        stream.write(token)
    return token
