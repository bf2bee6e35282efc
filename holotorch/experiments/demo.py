"""``holotorch demo``: a small real run of each system on bundled data."""

from pathlib import Path

from holotorch.experiments.execute import execute
from holotorch.experiments.registry import load_config
from holotorch.experiments.report import write_report
from holotorch.experiments.runs.folder import claim
from holotorch.experiments.tracking.run import run_tracking
from holotorch.experiments.tracking.synthetic import write_synthetic
from holotorch.io.bundled import find_config


def demo(out: Path | None) -> tuple[Path, bool]:
    """Carry out the runs and write one page for all; returns the folder, and whether all are complete."""
    names = ("demo", "demo_volume", "perception/layout")
    paths = [find_config(f"configs/{name}.yaml") for name in names]
    image, scene, layout = (load_config(path) for path in paths if path is not None)
    folder = claim(out, "demo")
    if (folder / "images").is_dir():
        (folder / "images").rmdir()  # made by ``claim``; the runs have their own folders
    parts, complete = [], True
    for settings, name in ((image, "correction"), (scene, "volume")):
        if complete:
            part, complete = execute(settings, folder / name, name)
            parts.append(part)
    more = {}
    if complete:
        recording = write_synthetic(folder / "recording", 10)
        _, complete = run_tracking(recording, out=folder / "tracking")
        execute(layout, folder / "layout", "layout")
        more["Catheter tracking, in a synthetic recording"] = "tracking/report.html"
        more["Icons over a wide field, as large as they must be"] = "layout/report.html"
    write_report(parts, folder / "report.html", more)
    return folder, complete
