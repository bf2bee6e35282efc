"""``holotorch demo``: a small real run of each system on bundled data."""

from collections.abc import Callable
from pathlib import Path

from holotorch.experiments.execute import execute, print_outcome
from holotorch.experiments.registry import load_config
from holotorch.experiments.report import write_report
from holotorch.experiments.runs.folder import claim
from holotorch.io.bundled import find_config


def demo(out: Path | None, screenshot: Callable[[Path, Path], str]) -> tuple[Path, bool]:
    """Carry out the runs and write one page for all of them; returns the folder, and whether all runs are complete.

    ``screenshot(run, file)`` writes a picture of the page that ``holotorch stream --view`` shows of a tracking run, or
    returns why there is none.
    """
    configs = {"demo": [], "demo_volume": [], "tracking/track": ["frames=10"], "perception/layout": []}
    correction, volume, tracking, layout = (
        load_config(find_config(f"configs/{name}.yaml") or name, overrides) for name, overrides in configs.items()
    )
    folder = claim(out, "demo")
    if (folder / "images").is_dir():
        (folder / "images").rmdir()  # ``claim`` creates it, but each run has its own folder of images
    parts, complete = [], True
    for settings, name in ((correction, "correction"), (volume, "volume")):
        if complete:
            part, complete = execute(settings, folder / name, name)
            print_outcome(part)
            parts.append(part)
    more = {}
    if complete:
        _, complete = execute(tracking, folder / "tracking", "tracking")
        print_outcome(folder / "tracking")
        print_outcome(execute(layout, folder / "layout", "layout")[0])
        if reason := screenshot(folder / "tracking", folder / "tracking" / "view.png"):
            print(f"no picture of the view in a browser: {reason}")
        else:
            more["The catheter in a browser, as holotorch stream --view shows it"] = "tracking/view.png"
        more["Catheter tracking, in a synthetic recording"] = "tracking/report.html"
        more["Icons over a wide field, scaled for equal perception time"] = "layout/report.html"
    write_report(parts, folder / "report.html", more)
    return folder, complete
