"""One static HTML page for one or more run folders: pictures inline, no scripts, opens from disk years later."""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from holotorch.experiments.errors import ConfigError
from holotorch.experiments.eye_report import eye_section
from holotorch.experiments.markup import element, figure, heading, plain, table
from holotorch.experiments.volume_report import volume_section
from holotorch.experiments.zone_table import zone_rows
from holotorch.io.files import read_json, write_text

_PICTURES = {
    "target": "Target",
    "none": "No correction",
    "chopping": "Matrix inverse, negative entries chopped",
    "shifting": "Matrix inverse, shifted",
    "nonnegative": "Non-negative deconvolution",
    "basic_ipec": "Basic iterative correction",
    "ipec": "Iterative correction",
    "unweighted": "Corrected, all errors alike",
    "corrected": "Corrected",
    "isolated": "Corrected, on a chip that stands alone",
}
_FIGURES = {
    "phase": "Heater phases, before the heat spreads",
    "temperature": "Temperature of the chip above ambient, after the heat has spread",
    "convergence": "Convergence of the solver",
    "weight": "Weight of the squared error, mean 1",
}
_KINDS = ("pec", "volume", "eye")
_METHOD_NAMES = {
    "none": "no correction",
    "basic_ipec": "basic IPEC",
    "ipec": "IPEC",
    "unweighted": "corrected, all errors alike",
}


def write_report(folders: Sequence[Path], path: Path, more: Mapping[str, str] | None = None) -> None:
    """Write the page of ``folders`` to ``path``. ConfigError for a folder that holds no run.

    ``more``: pages to point to, where each lies seen from ``path``, by what they show.
    """
    runs = [_Run(folder) for folder in folders]
    corrected = [run for run in runs if run.methods]
    body = [_comparison(corrected)] if len(corrected) > 1 else []
    body += [run.section for run in runs]
    links = [f'<li><a href="{html.escape(place)}">{html.escape(what)}</a></li>' for what, place in (more or {}).items()]
    body += ["<h2>More</h2>", "<ul>", *links, "</ul>"] if links else []
    title = "holotorch: " + (runs[0].title if len(runs) == 1 else f"{len(runs)} runs")
    write_text(path, page(title, "\n".join(body)))


def page(title: str, body: str) -> str:
    """The page around a body of HTML."""
    return _PAGE.format(title=html.escape(title), style=_STYLE, body=body)


class _Run:
    """What a run folder says of itself."""

    def __init__(self, folder: Path):
        self.folder, self.title = folder, folder.resolve().name
        names = [name for name in ("summary.json", "interrupted.json") if (folder / name).is_file()]
        if not names:
            cure = f"; finish it with: holotorch resume {folder}" if (folder / "plan.json").is_file() else ""
            raise ConfigError([f"{folder} holds no run: neither summary.json nor interrupted.json is there{cure}"])
        try:
            self.summary = read_json(folder / names[0])
            kind = str(self.summary["experiment"])
            if kind not in _KINDS:
                raise ConfigError([_other(folder, kind)])
            self.plan = read_json(folder / "plan.json")
            self.env = read_json(folder / "env.json")
            self.config = (folder / "config.yaml").read_text(encoding="utf-8")
            self.methods: dict[str, dict[str, Any]] = self.summary["methods"] if kind == "pec" else {}
            if kind == "pec":
                parts = _section(self)
            else:
                section = volume_section if kind == "volume" else eye_section
                parts = section(self.title, self.summary, self.plan, self.picture)
            self.section = "\n".join(parts + _repeat(self))
        except ConfigError:
            raise
        except (OSError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
            raise ConfigError([f"{folder} holds a run that cannot be read: {type(error).__name__} {error}"]) from None

    def picture(self, name: str) -> str:
        path = self.folder / "images" / f"{name}.png"
        if not path.is_file():
            return ""
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def _other(folder: Path, kind: str) -> str:
    page = folder / "report.html"
    own = f"; its own page is {page}" if page.is_file() else ""
    return f"{folder} holds a run of kind {kind}, and only those of {', '.join(_KINDS)} can be shown together{own}"


def _comparison(runs: list[_Run]) -> str:
    rows = [[run.title, *_numbers(run.methods["corrected"])] for run in runs]
    return "<h1>Runs</h1>" + table(["run", *_COLUMNS], rows)


def _section(run: _Run) -> list[str]:
    parts = [heading(run.title, run.summary["status"])]
    parts.append(
        table(["method", *_COLUMNS], [[_METHOD_NAMES.get(n, n), *_numbers(m)] for n, m in run.methods.items()])
    )
    parts.append(element("p", _verdict(run)))
    head, rows = zone_rows(run.methods)
    if rows:
        parts.append("<h2>By eccentricity</h2>" + table(head, rows))
    parts.append('<div class="row">')
    for name, caption in _PICTURES.items():
        if source := run.picture(name):
            parts.append(figure(source, f"{caption}{_score(run, name)}", "picture"))
    parts.append("</div>")
    for name, caption in _FIGURES.items():
        if source := run.picture(name):
            parts.append(figure(source, caption, "wide"))
    parts.append("<h2>Plan</h2>" + table(["", ""], _plan_rows(run.plan), head=False))
    return parts + [element("p", note, "warn") for note in run.plan["notes"]]


def _repeat(run: _Run) -> list[str]:
    command = f"holotorch run {run.folder / 'config.yaml'}"
    repeat = f"Repeat with {element('code', command)}. Configuration:{element('pre', run.config)}"
    rows = [[key, plain(value)] for key, value in run.env.items()]
    return [f"<h2>How to repeat</h2>{repeat}", table(["", ""], rows, head=False)]


_COLUMNS = (
    "frames",
    "SSIM",
    "PSNR (dB)",
    "SSIM between samples",
    "SSIM, chip alone (exact)",
    "light in window",
    "hottest pixel (degC above ambient)",
    "heating power (mean drive, K)",
    "evaluations",
    "seconds",
)


def _numbers(method: dict[str, Any]) -> list[str]:
    return [
        str(method["frames"]),
        _fixed(method.get("ssim_mean"), 4),
        _fixed(method.get("psnr_mean"), 1),
        _fixed(method["between_samples"].get("ssim_mean"), 3),
        _fixed(method.get("isolated", {}).get("ssim_mean"), 3),
        f"{100 * _lit_mean(method['efficiency']):.0f} %",
        _fixed(max(method["peak_temperature_rise_K"]), 0),
        _fixed(_lit_mean(method["heating_power_K_per_pixel"]), 0),
        str(method["evaluations"]),
        _fixed(method["seconds"], 2),
    ]


def _verdict(run: _Run) -> str:
    corrected = run.methods["corrected"]
    hottest = max(corrected["peak_temperature_rise_K"])
    steps, done = max(corrected["steps"]), all(corrected["converged"])
    stop = "met its stop rule" if done else "ran out of steps"
    if any(corrected["stalled"]):
        stop = "stopped where no step lowered the loss any more, at float precision or in a corner of the limit"
    between = " (see 'between samples')"
    if "isolated" not in corrected:
        between = f"; half a sample off, a Fourier hologram is speckled{between}"
    fewer = any(method["frames"] < corrected["frames"] for method in run.methods.values())
    alone = " Methods that are compared with show a single frame." if fewer else ""
    return (
        f"The hottest pixel of the corrected hologram is {hottest:.0f} degC above ambient. The solver took {steps} "
        f"steps and {stop}. Peak memory {run.summary['peak_memory_bytes'] / 1e9:.2f} GB. Heating power is the mean "
        "temperature rise that the heaters alone would cause, before the heat spreads; times the number of pixels and "
        "the chip's watts per kelvin it is the power in watts. Scores are of a float64 simulation of the phases. They "
        f"are taken at the samples of the image, where the solver controls the light{between}.{alone}"
    )


def _plan_rows(plan: dict[str, Any]) -> list[list[str]]:
    return [[name.replace("_", " "), plain(value)] for name, value in plan.items() if name != "notes"]


def _score(run: _Run, name: str) -> str:
    isolated = run.methods["corrected"].get("isolated", {})
    value = (isolated if name == "isolated" else run.methods.get(name, {})).get("ssim_mean")
    return "" if value is None else f": SSIM {value:.3f}"


def _fixed(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _lit_mean(values: list[float]) -> float:
    lit = [value for value in values if value > 0]
    return sum(lit) / len(lit) if lit else 0.0


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1150px; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; }
td, th { padding: .25em .8em; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top; }
.row { display: flex; flex-wrap: wrap; gap: 12px; }
figure { margin: 0 0 1em 0; }
.picture img { width: 270px; image-rendering: pixelated; display: block; }
.wide img { max-width: 100%; }
figcaption { color: #555; }
.warn { color: #a33; }
pre { background: #f5f5f5; padding: 1em; overflow-x: auto; }
"""
_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{style}</style></head>
<body>
{body}
</body></html>
"""
