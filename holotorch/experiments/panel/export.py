"""Frames for a phase panel from a finished run, and what those files show: read back, simulated, compared."""

import hashlib
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from holotorch import __version__
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.panel.config import build_panel, described, load_panel
from holotorch.experiments.panel.source import Wanted, load_wanted
from holotorch.io.files import write_json
from holotorch.io.panel_files import read_levels, read_phases, write_levels, write_phases
from holotorch.modulator.panel import PhaseModulator

FORMATS = ("png", "bmp", "exr")
_TURN = 2 * math.pi


def export_slm(
    folder: Path,
    description: Path | str,
    out: Path | None = None,
    *,
    encoding: str | None = None,
    form: str = "png",
    overrides: Sequence[str] = (),
) -> tuple[Path, dict[str, Any]]:
    """Write one file for each frame and colour of a run, read them back and simulate what they show.

    A hologram smaller than the panel lies in its middle, axis on axis, and phase 0 around it; the simulation takes what
    is around it as covered. A run of kind ``pec`` gives the phases after spreading: a liquid crystal has no heat that
    would spread them. A run of kind ``volume`` gives its first realisation's field, encoded.

    Args:
        folder: Of the run.
        description: YAML file of the panel.
        out: Folder for the files, new or empty; ``slm`` in that of the run by default.
        encoding: One of ``export_source.ENCODINGS``, for a volume; double phase by default.
        form: ``png`` (16 bits where the panel has more than 8), ``bmp``, or ``exr`` for the phases themselves.
        overrides: ``key=value`` words for the panel's description.

    Returns:
        The folder, and what its ``export.json`` says.

    Raises:
        ConfigError: No such run, NaN in it, a panel of another pitch or too few pixels, or a folder in use.
    """
    if form not in FORMATS:
        raise ConfigError([f"expected one of {', '.join(FORMATS)} as the format, got {form!r}"])
    settings = load_panel(description, overrides)
    wanted = load_wanted(folder, encoding)
    panel = build_panel(settings, wanted.wavelengths)
    if form == "bmp" and panel.bits > 8:
        raise ConfigError([f"a BMP holds 8 bits and the panel {settings.name} has {panel.bits}; use png"])
    window = _window(wanted.grid, panel.grid, settings.name)
    place = folder / "slm" if out is None else out
    _claim(place)
    try:
        names = _write(place, wanted, panel, window, form, folder, settings.name)
        report = {
            "source": str(folder),
            "panel": described(settings),
            "encoding": wanted.encoding,
            "format": form,
            "files": [name for row in names for name in row],
            "padded": wanted.grid.shape != panel.grid.shape,
            **resimulate(place, names, wanted, panel, window, form),
        }
        write_json(place / "export.json", report)
    except BaseException:
        shutil.rmtree(place)  # claimed empty a moment ago: only these files are in it
        raise
    return place, report


def resimulate(
    place: Path, names: list[list[str]], wanted: Wanted, panel: PhaseModulator, window: tuple, form: str
) -> dict[str, Any]:
    """Numbers of files, from nothing but the files and the panel.

    Per colour: rms error in rad of the phases that the levels stand for, against the wanted ones and beside the one
    that phases uniform on the circle have; and relative L2 change and correlation of the picture, by the levels alone
    and by the whole panel with its fringing fields and gaps, at the best scale.
    """
    square = torch.zeros(len(wanted.wavelengths), dtype=torch.float64)
    fields: dict[str, list[Tensor]] = {"levels": [], "panel": []}
    for frame, row in zip(wanted.phase, names, strict=True):
        found = [(read_phases if form == "exr" else read_levels)(place / name) for name in row]
        for c, (name, (_, facts)) in enumerate(zip(row, found, strict=True)):
            if facts.get("lut_sha256") != panel.lut_hash(c):
                raise ConfigError([f"{name} was written for another table of levels, or has lost its metadata"])
        whole = torch.stack([each for each, _ in found])
        whole = whole.flip(panel.flips) if form == "exr" else panel.phase(whole)
        error = torch.remainder(whole[window].double() - frame.double() + math.pi, _TURN) - math.pi
        square += error.square().mean((-2, -1)) / len(names)
        fields["levels"].append(phasor(whole[window].float()))
        fields["panel"].append(panel.emitted(whole.float())[window])
    before = wanted.picture(phasor(wanted.phase))
    numbers: dict[str, Any] = {
        "rms_phase_error_rad": square.sqrt().tolist(),
        "expected_rms_phase_error_rad": [0.0] * len(square) if form == "exr" else list(panel.expected_rms),
    }
    for name, frames in fields.items():
        after = wanted.picture(torch.stack(frames))
        pairs = [_compared(a, b) for a, b in zip(after, before, strict=True)]
        numbers[f"picture_change_by_{name}"] = [change for change, _ in pairs]
        numbers[f"picture_correlation_{name}"] = [correlation for _, correlation in pairs]
    if wanted.losses:
        numbers["encoding_loss"] = wanted.losses
    return numbers


def export_text(report: dict[str, Any]) -> str:
    """What an export has given, in a few lines."""

    def listed(values: list[float]) -> str:
        return " / ".join(format(value, ".2g") for value in values)

    lines = [
        f"Files      {len(report['files'])} {report['format']} for {report['panel']['name']}, {report['encoding']}"
    ]
    if report["padded"]:
        lines.append("Padding    the hologram lies in the panel's middle, phase 0 around it")
    error, expected = listed(report["rms_phase_error_rad"]), listed(report["expected_rms_phase_error_rad"])
    lines.append(f"Phase      rms error {error} rad from the files, {expected} rad expected of these levels")
    levels, panel = listed(report["picture_change_by_levels"]), listed(report["picture_change_by_panel"])
    lines.append(f"Picture    changes by {levels} through the levels, {panel} with the panel's gaps and fringes")
    losses = report.get("encoding_loss", {})
    words = [f"{listed(values)} by {name}" for name, values in losses.items()]
    if words:
        lines.append(f"Encoding   costs {', '.join(words)} (relative squared error of the picture, no aperture)")
    return "\n".join(lines)


def _window(hologram: Grid, panel: Grid, name: str) -> tuple:
    """Where the hologram lies in frames [..., H, W] of the panel."""
    if any(abs(a / b - 1) > 1e-4 for a, b in zip(hologram.pitch, panel.pitch, strict=True)):
        at, has = (" x ".join(f"{step * 1e6:g}" for step in grid.pitch) for grid in (hologram, panel))
        raise ConfigError(
            [f"the run was computed for pixels of {at} um, the panel {name} has {has} um; run it again with its pitch"]
        )
    if any(a > b for a, b in zip(hologram.shape, panel.shape, strict=True)):
        at, has = (" x ".join(map(str, grid.shape)) for grid in (hologram, panel))
        raise ConfigError(
            [f"the hologram has {at} pixels, more than the {has} of the panel {name}; use a smaller grid"]
        )
    # Axis on axis: sample n // 2 of the one on that of the other.
    begin = [whole // 2 - part // 2 for whole, part in zip(panel.shape, hologram.shape, strict=True)]
    return (..., *(slice(start, start + part) for start, part in zip(begin, hologram.shape, strict=True)))


def _claim(place: Path) -> None:
    try:
        place.mkdir(parents=True, exist_ok=True)
        if any(place.iterdir()):
            raise ConfigError([f"{place} holds files already; choose another --out or delete it"])
    except OSError as error:
        raise ConfigError([f"cannot write to {place}: {error.strerror}; choose another place with --out"]) from None


def _write(
    place: Path, wanted: Wanted, panel: PhaseModulator, window: tuple, form: str, folder: Path, name: str
) -> list[list[str]]:
    """Write all files, and return their names, frame by frame."""
    common = {
        "program": f"holotorch {__version__}",
        "panel": name,
        "pitch_m": list(panel.grid.pitch),
        "encoding": wanted.encoding,
        "bits": panel.bits,
        "source": str(folder),
        "config_sha256": hashlib.sha256((folder / "config.yaml").read_bytes()).hexdigest(),
        "window": [[part.start, part.stop] for part in window[1:]],
        "flipped_axes": list(panel.flips),
        "content": "phase in rad" if form == "exr" else "grey levels",
    }
    names = []
    for f, phase in enumerate(wanted.phase):
        whole = phase.new_zeros(len(phase), *panel.grid.shape)
        whole[window] = phase
        frames = whole.flip(panel.flips) if form == "exr" else panel.levels(whole)
        names.append([])
        for c, wave in enumerate(wanted.wavelengths):
            own = {"wavelength_m": wave, "lut_sha256": panel.lut_hash(c), "frame": f, "colour": c}
            file = f"frame-{f:03d}_{wave * 1e9:.6g}nm.{form}"
            write = write_phases if form == "exr" else write_levels
            write(place / file, frames[c], common | own)
            names[-1].append(file)
    return names


def _compared(after: Tensor, before: Tensor) -> tuple[float, float]:
    """Relative L2 change at the best scale, and correlation, of two pictures."""
    a, b = after.double().flatten(), before.double().flatten()
    scale = (a @ b) / (a @ a).clamp(min=torch.finfo(a.dtype).tiny)
    change = (scale * a - b).norm() / b.norm().clamp(min=torch.finfo(a.dtype).tiny)
    a, b = a - a.mean(), b - b.mean()
    return change.item(), ((a @ b) / (a.norm() * b.norm()).clamp(min=torch.finfo(a.dtype).tiny)).item()
