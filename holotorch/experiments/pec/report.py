"""Section of the report page for a run of kind ``pec``, and the table that compares several runs."""

from collections.abc import Sequence
from typing import Any

from holotorch.experiments.planning.errors import error_line, error_sentence
from holotorch.experiments.runs.page import element, figure, heading, plain, table
from holotorch.experiments.runs.record import RunRecord

METHOD_NAMES = {
    "none": "No correction",
    "chopping": "Matrix inverse, negative entries set to zero",
    "shifting": "Matrix inverse, shifted",
    "nonnegative": "Non-negative deconvolution",
    "basic_ipec": "Basic iterative correction (basic IPEC: no deconvolution)",
    "ipec": "Iterative proximity effect correction (IPEC)",
    "unweighted": "Corrected, errors weighted equally",
    "corrected": "Corrected",
}
ISOLATED_NAME = "Corrected, on a chip that stands alone"
BETWEEN_NAME = "Corrected, midway between the samples"
_PICTURES = {"target": "Target", **METHOD_NAMES, "between": BETWEEN_NAME, "isolated": ISOLATED_NAME}
_MELTING = 1390.0  # K above ambient at which silicon melts (1414 degC)
_HOTTER = 1.1  # ratio of temperatures above which that without correction is named
_OTHER = {"ssim": 5e-3, "psnr": 0.5}  # differences of scores above which both are named
_POOR = 0.8  # SSIM of a corrected picture below which more frames are advised
_FIGURES = {
    "phase": "Heater phases, before the heat spreads{frame}",
    "temperature": "Temperature of the chip above ambient, after the heat has spread{frame}",
    "convergence": "Convergence of the solver",
    "weight": "Weight of the squared error, mean 1",
}


def pec_outcome(summary: dict[str, Any]) -> list[str]:
    """Lines to print: scores with and without correction, heat, and the errors of the calculation."""
    methods: dict[str, Any] = summary["methods"]
    corrected, before = methods["corrected"], methods.get("none", {})
    scores = []
    for key, name, digits, unit in (("ssim", "SSIM", 3, ""), ("psnr", "PSNR", 1, " dB")):
        if (value := corrected.get(f"{key}_mean")) is not None:
            others = []
            if without := _fixed(before.get(f"{key}_mean"), digits):
                others.append(f"{without} without correction{_unlike(corrected, before)}")
            # Scored by exact light, where the run is paraxial or repeats the chip without end.
            alone = corrected.get("isolated", {}).get(f"{key}_mean")
            if alone is not None and abs(alone - value) > _OTHER[key]:
                others.append(f"{_fixed(alone, digits)} of the chip alone by exact light")
            scores.append(f"{name} {_fixed(value, digits)}{unit}" + (f" ({'; '.join(others)})" if others else ""))
    if (between := corrected.get("between_samples", {}).get("ssim_mean")) is not None:
        scores.append(
            f"SSIM {_fixed(between, 3)} midway between the samples (between.png), which a viewer sees as well"
        )
    scores.append(f"hottest pixel {_hottest(corrected)}")
    ended = summary.get("status") != "interrupted"
    if ended and not all(corrected.get("converged", [True])) and not any(corrected.get("stalled", ())):
        scores.append(f"the solver took all of its {max(corrected['steps'])} steps")
    kernel = [f"Kernel     {words}" for words in _other_kernels(corrected)]
    advice = []
    if corrected.get("frames") == 1 and corrected.get("ssim_mean", 1.0) < _POOR:
        advice.append("Note       several frames in turn, whose mean is seen, come closer to the picture: frames=4")
    elif corrected.get("at_limit") and corrected.get("ssim_mean", 1.0) < _POOR:
        advice.append(
            "Note       the phases are at their limit: a higher one (modulator.max_temperature), more frames or a "
            "nearer picture come closer"
        )
    return [f"Result     {', '.join(scores)}", *kernel, *advice, *error_line(summary)]


def _hottest(corrected: dict[str, Any]) -> str:
    """The temperature of the hottest pixel in words."""
    hottest = max(corrected["peak_temperature_rise_K"])
    melts = ", where silicon has melted: modulator.max_temperature sets a limit" if hottest > _MELTING else ""
    return f"{hottest:.0f} degC above ambient{melts}"


def _unlike(corrected: dict[str, Any], before: dict[str, Any]) -> str:
    """What else differs between the picture without correction and the corrected one, in words."""
    frames = ", in one frame" if before.get("frames") == 1 < corrected["frames"] else ""
    hottest, limited = (max(each["peak_temperature_rise_K"]) for each in (before, corrected))
    return frames + (f", at {hottest:.0f} degC" if hottest > _HOTTER * limited else "")


def comparison(runs: Sequence[RunRecord]) -> list[str]:
    """HTML of a table that compares the corrected holograms of several runs."""
    rows = [{"run": run.title} | _cells(run.summary["methods"]["corrected"]) for run in runs]
    return ["<h1>Runs</h1>" + _table(rows)]


def pec_section(run: RunRecord) -> list[str]:
    """HTML of a run: scores by method, pictures side by side, figures and plan."""
    methods: dict[str, Any] = run.summary["methods"]
    parts = [heading(run.title, run.summary["status"])]
    parts.append(_table([{"method": METHOD_NAMES.get(name, name)} | _cells(each) for name, each in methods.items()]))
    parts.append(element("p", _verdict(run)))
    for words in _other_kernels(methods["corrected"]):
        parts.append(element("p", f"Should the heat kernel be wrong: {words}."))
    if sentence := error_sentence(run.summary):
        parts.append(element("p", sentence))
    parts += [*_zone_table(methods), '<div class="row">']
    for name, caption in _PICTURES.items():
        if source := run.picture(name):
            parts.append(figure(source, f"{caption}{_score(run, name)}", "picture"))
    parts.append("</div>")
    frames = methods["corrected"]["frames"]
    which = f"; frame 1 of {frames}, arrays/phase.npy holds all" if frames > 1 else ""
    for name, caption in _FIGURES.items():
        if source := run.picture(name):
            parts.append(figure(source, caption.format(frame=which), "wide"))
    plan = [[name.replace("_", " "), plain(value)] for name, value in run.plan.items() if name != "notes"]
    parts.append("<h2>Plan</h2>" + table(["", ""], plan, head=False))
    return parts + [element("p", note, "warn") for note in run.plan["notes"]]


def _table(rows: Sequence[dict[str, str]]) -> str:
    return table(list(rows[0]), [list(row.values()) for row in rows])


def _cells(method: dict[str, Any]) -> dict[str, str]:
    return {
        "frames": str(method["frames"]),
        "SSIM": _fixed(method.get("ssim_mean"), 4),
        "PSNR (dB)": _fixed(method.get("psnr_mean"), 1),
        "SSIM half a sample off": _fixed(method["between_samples"].get("ssim_mean"), 3),
        "SSIM, chip alone (exact)": _fixed(method.get("isolated", {}).get("ssim_mean"), 3),
        "light in window": f"{100 * _lit_mean(method['efficiency']):.0f} %",
        "hottest pixel (degC above ambient)": f"{max(method['peak_temperature_rise_K']):.0f}",
        "heating power (mean drive, K)": f"{_lit_mean(method['heating_power_K_per_pixel']):.0f}",
        "evaluations": str(method["evaluations"]),
        "seconds": f"{method['seconds']:.2f}",
    }


def _verdict(run: RunRecord) -> str:
    corrected = run.summary["methods"]["corrected"]
    steps, done = max(corrected["steps"]), all(corrected["converged"])
    stop = "met its stop rule" if done else "ran out of steps"
    if any(corrected["stalled"]):
        stop = "stopped where no step lowered the loss any more, at float precision or in a corner of the limit"
    speckle = ", where a Fourier hologram is speckled" if "isolated" not in corrected else ""
    spots = sum(corrected.get("dark_spots", ()))
    if spots:
        stop += (
            f"; {spots} bright pixels (of all colours) came out dark by speckle: solver.reruns or solver.start may help"
        )
    fewer = any(method["frames"] < corrected["frames"] for method in run.summary["methods"].values())
    single = " The methods that it is compared with show a single frame." if fewer else ""
    return (
        f"The hottest pixel of the corrected hologram is {_hottest(corrected)}. The solver took {steps} "
        f"steps and {stop}. Peak memory {run.summary['peak_memory_bytes'] / 1e9:.2f} GB. Heating power is the mean "
        "temperature rise that the heaters alone would cause, before the heat spreads; times the number of pixels and "
        "the chip's watts per kelvin it is the power in watts. 'Light in window' is the share of the light that falls "
        "into the picture. Scores are of a float64 simulation of the phases. They "
        "are taken at the samples of the image, one per pixel, where the solver controls the light. 'SSIM half a "
        f"sample off' is the score midway between four samples{speckle}; a viewer sees that light as well.{single}"
    )


def _other_kernels(corrected: dict[str, Any]) -> list[str]:
    """Scores of the corrected picture where the heat kernel is not the assumed one, in words."""
    names, lines = {"ssim_mean": "SSIM {:.3f}", "psnr_mean": "PSNR {:.1f} dB"}, []
    if numbers := corrected.get("kernel_noise"):
        scores = [text.format(min(numbers[name])) for name, text in names.items() if name in numbers]
        chips = f"at worst of {max(len(value) for value in numbers.values() if isinstance(value, list))} chips"
        lines.append(f"noise of {100 * numbers['noise']:g} % of the centre in every tap: {', '.join(scores)} {chips}")
    if numbers := corrected.get("kernel_even"):
        scores = [text.format(numbers[name]) for name, text in names.items() if numbers.get(name) is not None]
        lines.append(
            f"opposite taps of the measured table differ as by noise of {numbers['noise']:.1g} of the centre; if heat "
            f"spreads as their means: {', '.join(scores)}"
        )
    if numbers := corrected.get("kernel_continued"):
        scores = [text.format(numbers[name]) for name, text in names.items() if numbers.get(name) is not None]
        size = " x ".join(map(str, numbers["taps"]))
        lines.append(
            f"the measured table is cut off; if the rise falls on beyond it as it does within (to {size} px): "
            f"{', '.join(scores)}"
        )
    return lines


def _zone_table(methods: dict[str, dict[str, Any]]) -> list[str]:
    """HTML of a table of scores by zone of the visual field, one row per method; empty if the run has no zones."""
    scored = {name: numbers["zones"] for name, numbers in methods.items() if "zones" in numbers}
    if not scored:
        return []
    *zones, outermost = next(iter(scored.values()))
    head = ["method", *(f"{zone['zone']}, {zone['from_deg']} to {zone['to_deg']} deg" for zone in zones)]
    head.append(f"{outermost['zone']}, from {outermost['from_deg']} deg")
    rows = [[METHOD_NAMES.get(name, name), *map(_zone_cell, row)] for name, row in scored.items()]
    words = (
        "Eccentricities are those of a picture that fills target.weight.field_deg, as optics that this run does not "
        "model would show it. Each zone's share of the squared error is that of all pixels alike, without the weight."
    )
    return ["<h2>By eccentricity</h2>" + table(head, rows), element("p", words)]


def _zone_cell(zone: dict[str, Any]) -> str:
    parts = [] if zone["ssim"] is None else [f"SSIM {zone['ssim']:.3f}"]
    parts += [] if zone["psnr"] is None else [f"{zone['psnr']:.1f} dB"]
    return ", ".join([*parts, f"{100 * zone['error']:.0f} % of the error"])


def _score(run: RunRecord, name: str) -> str:
    methods = run.summary["methods"]
    own = {"between": "between_samples", "isolated": "isolated"}.get(name)
    value = (methods["corrected"].get(own, {}) if own else methods.get(name, {})).get("ssim_mean")
    return "" if value is None else f": SSIM {value:.3f}"


def _fixed(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _lit_mean(values: list[float]) -> float:
    """Mean over the lit colours, whose values are above zero."""
    lit = [value for value in values if value > 0]
    return sum(lit) / len(lit) if lit else 0.0
