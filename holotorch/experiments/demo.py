"""``holotorch demo``: a small real run of each system on bundled data."""

from pathlib import Path

from holotorch.experiments.execute import execute
from holotorch.experiments.registry import load_config
from holotorch.experiments.report import write_report
from holotorch.experiments.runs.folder import claim
from holotorch.io.bundled import find_config


def demo(out: Path | None) -> tuple[Path, bool]:
    """Carry out the runs and write one page for all; returns the folder, and whether all are complete."""
    changes = {"demo": [], "demo_volume": [], "tracking/track": ["frames=10"], "perception/layout": []}
    paths = [(find_config(f"configs/{name}.yaml"), overrides) for name, overrides in changes.items()]
    image, scene, tracking, layout = (load_config(path, words) for path, words in paths if path is not None)
    folder = claim(out, "demo")
    if (folder / "images").is_dir():
        (folder / "images").rmdir()  # created by ``claim``; each run has a folder of its own inside
    parts, complete = [], True
    for settings, name in ((image, "correction"), (scene, "volume")):
        if complete:
            part, complete = execute(settings, folder / name, name)
            parts.append(part)
    more = {}
    if complete:
        _, complete = execute(tracking, folder / "tracking", "tracking")
        execute(layout, folder / "layout", "layout")
        more["Catheter tracking, in a synthetic recording"] = "tracking/report.html"
        more["Icons over a wide field, as large as they must be"] = "layout/report.html"
    write_report(parts, folder / "report.html", more)
    return folder, complete
