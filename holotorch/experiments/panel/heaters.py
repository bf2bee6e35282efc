"""Files for the heaters of a phased array from a finished run: what drives them, how warm it gets, what it emits."""

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch import __version__
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.joint.config import JointSettings
from holotorch.experiments.joint.experiment import build as build_joint
from holotorch.experiments.pec.config import PECSettings
from holotorch.experiments.pec.experiment import build
from holotorch.experiments.registry import load_config
from holotorch.io.files import save_array, write_json, write_text
from holotorch.io.panel_files import write_levels
from holotorch.modulator import PhasedArray

_MEANINGS = {
    "heater": (
        "rad",
        "phase that the heater of each pixel alone causes, before the heat spreads: what to drive it with",
    ),
    "temperature": ("K", "temperature of each pixel above ambient, after the heat has spread"),
    "optical": ("rad", "phase of the light of each pixel, after the heat has spread, not modulo 2 pi"),
}


def export_heaters(folder: Path, out: Path | None = None, *, bits: int = 16) -> tuple[Path, dict[str, Any]]:
    """Write the heater phases, temperatures and optical phases of a run of kind ``pec`` or ``joint``.

    For each frame and colour and each of the three, a NumPy file (float32 [H, W]), a CSV file (a line for each row of
    pixels) and a 16-bit PNG; ``export.json`` says which is which, its unit, and what a step of the PNG stands for. The
    PNG of the heaters holds drive levels of ``bits`` bits, evenly spaced from 0 to the largest phase of the run.

    Returns:
        The folder of the files (``out``, by default ``heaters`` in that of the run), and the content of export.json.

    Raises:
        ConfigError: There is no such run, its phases contain NaN, or the folder for the files is not empty.
    """
    if not 1 <= bits <= 16:
        raise ConfigError([f"expected heaters of 1 to 16 bits, got {bits}"])
    phase, array = _load(folder)
    place = folder / "heaters" if out is None else out
    try:
        place.mkdir(parents=True, exist_ok=True)
        if any(place.iterdir()):
            raise ConfigError([f"{place} holds files already; choose another --out or delete it"])
    except OSError as error:
        raise ConfigError([f"cannot write to {place}: {error.strerror}"]) from None
    optical = array.crosstalk(phase)
    maps = {"heater": phase, "temperature": array.temperature(optical), "optical": optical}
    steps = {name: values.max().item() / (2**16 - 1) for name, values in maps.items()}
    steps["heater"] = phase.max().item() / (2**bits - 1)
    files: list[dict[str, Any]] = []
    for name, values in maps.items():
        unit, meaning = _MEANINGS[name]
        for frame, colour in np.ndindex(*values.shape[:2]):
            wavelength = array.wavelengths[colour]
            stem = f"{name}_frame{frame:02d}_{wavelength * 1e9:.0f}nm"
            about = {"quantity": name, "unit": unit, "meaning": meaning, "frame": frame, "wavelength_m": wavelength}
            _write(place / stem, values[frame, colour], steps[name] or 1.0, about)
            files.append({"files": [f"{stem}.npy", f"{stem}.csv", f"{stem}.png"], **about, "png_step": steps[name]})
    report = {
        "source": str(folder),
        "frames": phase.shape[0],
        "wavelengths_m": list(array.wavelengths),
        "rad_per_K": list(array.response),
        "heater_bits": bits,
        "peak_temperature_K": maps["temperature"].max().item(),
        "files": files,
        "holotorch": __version__,
    }
    write_json(place / "export.json", report)
    return place, report


def heaters_text(report: dict[str, Any]) -> str:
    """The export in words."""
    step = report["files"][0]["png_step"]
    return (
        f"{report['frames']} frame(s), {len(report['wavelengths_m'])} colour(s): heater_*: phases that the heaters "
        f"alone cause, in rad before the heat spreads (a step of the PNG is {step:.4g} rad, {report['heater_bits']} "
        f"bits); temperature_*: K above ambient, at most {report['peak_temperature_K']:.0f}; optical_*: phases of the "
        "light in rad after spreading, not modulo 2 pi. A liquid-crystal panel needs holotorch export-slm instead"
    )


def _write(stem: Path, values: Tensor, step: float, about: dict[str, Any]) -> None:
    save_array(stem.with_suffix(".npy"), values.float())
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([[f"{v:.6g}" for v in row] for row in values.tolist()])
    write_text(stem.with_suffix(".csv"), text.getvalue())
    levels = torch.from_numpy((values / step).round().clamp(0, 2**16 - 1).numpy().astype(np.uint16))
    write_levels(stem.with_suffix(".png"), levels, about | {"step": step})


def _load(folder: Path) -> tuple[Tensor, PhasedArray]:
    """Heater phases [F, C, H, W], float64, and the array of a run."""
    if not (folder / "config.yaml").is_file():
        raise ConfigError([f"{folder} holds no run: config.yaml is not there"])
    settings = load_config(folder / "config.yaml")
    if isinstance(settings, PECSettings):
        experiment = build(settings)
        array = experiment.array
        lit = experiment.lit.tolist()
    elif isinstance(settings, JointSettings):
        joint = build_joint(settings)
        array = PhasedArray(settings.wavelengths, joint.crosstalk.cpu())
        lit = [True] * len(settings.wavelengths)
    else:
        raise ConfigError([f"{folder} holds a {settings.experiment}; only runs of kind pec and joint have heaters"])
    path = folder / "arrays" / "phase.npy"
    try:
        phase = torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float64))
    except (OSError, ValueError, EOFError) as error:
        raise ConfigError([f"{path}: cannot read the heater phases: {error}"]) from None
    if phase.ndim != 4 or phase.shape[1] != len(lit) or not math.isfinite(phase.sum().item()):
        raise ConfigError([f"{path}: expected finite phases [F, {len(lit)}, H, W], got {tuple(phase.shape)}"])
    return phase[:, torch.tensor(lit)], array
