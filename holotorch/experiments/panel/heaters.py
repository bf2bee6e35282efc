"""Files for the heaters of a phased array from a finished run: drive phases, temperatures, and phases of the light."""

import csv
import io
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch import __version__
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.joint.config import JointSettings
from holotorch.experiments.joint.experiment import build as build_joint
from holotorch.experiments.panel.place import claim
from holotorch.experiments.panel.source import joint_heaters, pec_heaters
from holotorch.experiments.pec.config import PECSettings
from holotorch.experiments.pec.experiment import build
from holotorch.experiments.registry import load_config
from holotorch.experiments.runs.record import kind_of, runs_inside
from holotorch.io.files import save_array, write_json, write_text
from holotorch.io.panel_files import write_levels
from holotorch.modulator import PhasedArray

_MEANINGS = {
    "heater": (
        "rad",
        "phase that each heater alone causes at its own pixel, before the heat spreads: what to drive it with",
    ),
    "rise": ("K", "temperature above ambient that each heater alone causes at its own pixel, before the heat spreads"),
    "temperature": ("K", "temperature of each pixel above ambient, after the heat has spread"),
    "optical": ("rad", "phase of the light of each pixel, after the heat has spread, not modulo 2 pi"),
}


@dataclass(frozen=True)
class _Chip:
    """The heaters of a finished run, and the chip that the run assumed.

    Attributes:
        phase: Heater phases in rad, float64 [F, C, H, W].
        array: The chip's response to heat.
        spread: Function from heater phases to the phases of the light, with the model of the heat of the run.
        limit: Upper limit of the run on the phases of the light in rad; None without one.
    """

    phase: Tensor
    array: PhasedArray
    spread: Callable[[Tensor], Tensor]
    limit: float | None


def export_heaters(folder: Path, out: Path | None = None, *, bits: int = 16) -> tuple[Path, dict[str, Any]]:
    """Write the heater phases and rises, temperatures and optical phases of a run of kind ``pec`` or ``joint``.

    For each frame and colour and each of the four, a NumPy file (float32 [H, W]), a CSV file (a line for each row of
    pixels) and a 16-bit PNG; ``export.json`` gives the quantity and unit of each file, and the step of the PNG. The
    PNG of the heaters holds drive levels of ``bits`` bits, evenly spaced from 0 to the largest phase of the run, and
    ``*_levels.csv`` holds the same integers. Heat
    left from earlier frames is included if the run includes it; the values are then those at the end of each frame.

    Returns:
        The folder of the files (``out``, by default ``heaters``, then ``heaters-002``, ... in that of the run), and the
        content of export.json.

    Raises:
        ConfigError: There is no such run, its phases contain NaN, or ``out`` is not empty.
    """
    if not 1 <= bits <= 16:
        raise ConfigError([f"expected heaters of 1 to 16 bits, got {bits}"])
    chip = _load(folder)
    place = claim(out, folder / "heaters")
    try:
        report = _export(place, chip, bits) | {"source": str(folder), "holotorch": __version__}
        write_json(place / "export.json", report)
    except BaseException:
        shutil.rmtree(place)  # the folder was empty before, so all files are of this export
        raise
    return place, report


def _export(place: Path, chip: _Chip, bits: int) -> dict[str, Any]:
    """Write all files but export.json, whose content it returns."""
    phase, array = chip.phase, chip.array
    optical = chip.spread(phase)
    maps = {
        "heater": phase,
        "rise": array.temperature(phase),
        "temperature": array.temperature(optical),
        "optical": optical,
    }
    steps = {name: values.max().item() / (2**16 - 1) for name, values in maps.items()}
    steps["heater"] = phase.max().item() / (2**bits - 1)
    driven = chip.spread((phase / (steps["heater"] or 1.0)).round() * steps["heater"])
    files: list[dict[str, Any]] = []
    for name, values in maps.items():
        unit, meaning = _MEANINGS[name]
        for frame, colour in np.ndindex(*values.shape[:2]):
            wavelength = array.wavelengths[colour]
            # The index of the colour keeps files apart whose wavelengths are the same nanometres.
            stem = f"{name}_frame{frame:02d}_colour{colour}_{wavelength * 1e9:.0f}nm"
            about = {"quantity": name, "unit": unit, "meaning": meaning, "frame": frame, "colour": colour}
            about["wavelength_m"] = wavelength
            names = [f"{stem}.npy", f"{stem}.csv", f"{stem}.png"] + [f"{stem}_levels.csv"] * (name == "heater")
            _write([place / each for each in names], values[frame, colour], steps[name] or 1.0, about)
            files.append({"files": names, **about, "png_step": steps[name]})
    return {
        "frames": phase.shape[0],
        "wavelengths_m": list(array.wavelengths),
        "rad_per_K": list(array.response),
        "heater_bits": bits,
        "peak_temperature_K": maps["temperature"].max().item(),
        "peak_temperature_of_levels_K": array.temperature(driven).max().item(),
        "peak_phase_of_levels_rad": driven.max().item(),
        "limit_rad": chip.limit,
        "files": files,
    }


def heaters_text(report: dict[str, Any]) -> str:
    """The export in words."""
    step, limit, peak = report["files"][0]["png_step"], report["limit_rad"], report["peak_phase_of_levels_rad"]
    warning = ""
    # Rounding to 16 bits exceeds it by less: half a level at each pixel, times the sum of the kernel, 7 at 1.5 px.
    if limit is not None and peak > limit * (1 + 5e-5):
        warning = (
            f"\nWARNING: rounded to {report['heater_bits']} bits, the heaters take the light to {peak:.6g} rad, "
            f"{report['peak_temperature_of_levels_K']:.1f} K above ambient, and the limit of the run is {limit:.6g} "
            "rad; use more bits, or compute the run for them (modulator.bits of kind pec)"
        )
    return (
        f"{report['frames']} frame(s), {len(report['wavelengths_m'])} colour(s)\n"
        "heater_*       phases in rad that each heater alone causes at its own pixel, before the heat spreads; a step "
        f"of the PNG is {step:.4g} rad, {report['heater_bits']} bits, so that few bits look black in a viewer; "
        "*_levels.csv has the integers\n"
        "rise_*         the same as K above ambient, for a driver that takes temperatures\n"
        f"temperature_*  K above ambient after spreading, at most {report['peak_temperature_K']:.0f}\n"
        "optical_*      phases of the light in rad after spreading, not modulo 2 pi\n"
        "Note           holotorch view of the run shows what fewer bits cost (Levels of the heaters), and "
        "modulator.bits of kind pec computes a run for them; a liquid-crystal panel needs holotorch export-slm instead"
        + warning
    )


def _write(paths: list[Path], values: Tensor, step: float, about: dict[str, Any]) -> None:
    """The values [H, W] as an array, a table and a picture of levels, and if there is a fourth path its levels."""
    array, table, picture, *integers = paths
    save_array(array, values.float())
    write_text(table, _table([[f"{v:.6g}" for v in row] for row in values.tolist()]))
    levels = torch.from_numpy((values / step).round().clamp(0, 2**16 - 1).numpy().astype(np.uint16))
    write_levels(picture, levels, about | {"step": step})
    for path in integers:
        write_text(path, _table(levels.tolist()))


def _table(rows: list[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _load(folder: Path) -> _Chip:
    """The heaters of a run; ConfigError for a folder that has none."""
    if not (folder / "config.yaml").is_file():
        inside = runs_inside(folder, "holotorch export-heaters {}", lambda run: kind_of(run) in ("pec", "joint"))
        raise ConfigError([f"{folder} holds no run: config.yaml is not there{inside}"])
    settings = load_config(folder / "config.yaml")
    try:
        if isinstance(settings, PECSettings):
            experiment = build(settings)
            phase = pec_heaters(folder, experiment)[:, experiment.lit].double()
            return _Chip(phase, experiment.array, experiment.array.crosstalk, experiment.limit)
        if isinstance(settings, JointSettings):
            joint = build_joint(settings)
            response = settings.display.reference_response
            array = PhasedArray(settings.wavelengths, joint.crosstalk.cpu(), reference_response=response)
            return _Chip(joint_heaters(folder, settings).double(), array, joint.heat.cpu(), settings.limit)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError([f"{folder}: {error}"]) from error
    raise ConfigError([f"{folder} holds a {settings.experiment}; only runs of kind pec and joint have heaters"])
