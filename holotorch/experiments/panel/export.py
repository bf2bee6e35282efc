"""Frames for a phase panel from a finished run, and a simulation of the picture that the written files form."""

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
from holotorch.experiments.panel.source import PanelPhases, load_panel_phases
from holotorch.io.files import write_json
from holotorch.io.panel_files import read_levels, read_phases, write_levels, write_phases
from holotorch.modulator.panel import PhaseModulator

FORMATS = ("png", "bmp", "exr")
_CYCLE = 2 * math.pi
# Content of the files of a pec run.
_AFTER_SPREADING = (
    "phase after the heat has spread, modulo 2 pi, for a liquid-crystal panel; for the heaters of a thermal chip use "
    "arrays/phase.npy, [F, C, H, W] in rad before spreading and not modulo 2 pi"
)


def export_slm(
    folder: Path,
    description: Path | str,
    out: Path | None = None,
    *,
    encoding: str | None = None,
    form: str = "png",
    overrides: Sequence[str] = (),
) -> tuple[Path, dict[str, Any]]:
    """Write one file for each frame and colour of a run, read the files back and simulate their picture.

    A hologram smaller than the panel is centred on the optical axis, with phase 0 around it; the simulation assumes
    that no light comes from the pixels around it. The files of a run of kind ``pec`` hold the phases after the heat has
    spread, modulo 2 pi: they suit a liquid crystal, which has no thermal crosstalk, but not a thermal chip. Those of a
    run of kind ``volume`` hold the encoded field of its first realisation.

    Args:
        folder: Folder of the run.
        description: YAML file of the panel.
        out: Folder for the files, new or empty; by default ``slm`` in the folder of the run.
        encoding: For a volume, one of ``source.ENCODINGS``; double phase by default.
        form: ``png`` (16 bits for a panel of more than 8 bits), ``bmp``, or ``exr`` for the phases in rad.
        overrides: ``key=value`` words for the description of the panel.

    Returns:
        The folder of the files, and the content of its ``export.json``.

    Raises:
        ConfigError: There is no such run, it contains NaN, the panel has another pitch or too few pixels, or the folder
            for the files is not empty.
    """
    if form not in FORMATS:
        raise ConfigError([f"expected one of {', '.join(FORMATS)} as the format, got {form!r}"])
    settings = load_panel(description, overrides)
    source = load_panel_phases(folder, encoding)
    panel = build_panel(settings, source.wavelengths)
    if form == "bmp" and panel.bits > 8:
        raise ConfigError([f"a BMP holds 8 bits and the panel {settings.name} has {panel.bits}; use png"])
    window = _window(source.grid, panel.grid, settings.name)
    place = folder / "slm" if out is None else out
    _claim(place)
    try:
        names = _write(place, source, panel, window, form, folder, settings.name)
        report = {
            "source": str(folder),
            "panel": described(settings),
            "encoding": source.encoding,
            **({"content": _AFTER_SPREADING} if source.encoding == "phase" else {}),
            "format": form,
            "files": [name for row in names for name in row],
            "padded": source.grid.shape != panel.grid.shape,
            **resimulate(place, names, source, panel, window, form),
        }
        write_json(place / "export.json", report)
    except BaseException:
        shutil.rmtree(place)  # it was empty before, so it holds only files of this export
        raise
    return place, report


def resimulate(
    place: Path, names: list[list[str]], source: PanelPhases, panel: PhaseModulator, window: tuple, form: str
) -> dict[str, Any]:
    """Errors of the written files, computed from the files and the panel alone, one value per colour.

    The errors are the rms error in rad of the phases of the levels, with its expected value for uniformly distributed
    phases, and the relative L2 change and the correlation of the picture at its best scale: once due to the levels
    alone, and once due to the whole panel with fringing fields and gaps.
    """
    square = torch.zeros(len(source.wavelengths), dtype=torch.float64)
    fields: dict[str, list[Tensor]] = {"levels": [], "panel": []}
    for frame, row in zip(source.phase, names, strict=True):
        files = [(read_phases if form == "exr" else read_levels)(place / name) for name in row]
        for c, (name, (_, facts)) in enumerate(zip(row, files, strict=True)):
            if facts.get("lut_sha256") != panel.lut_hash(c):
                raise ConfigError([f"{name} was written for another table of levels, or has lost its metadata"])
        whole = torch.stack([each for each, _ in files])
        whole = whole.flip(panel.flips) if form == "exr" else panel.phase(whole)
        error = torch.remainder(whole[window].double() - frame.double() + math.pi, _CYCLE) - math.pi
        square += error.square().mean((-2, -1)) / len(names)
        fields["levels"].append(phasor(whole[window].float()))
        fields["panel"].append(panel.emitted(whole.float())[window])
    before = source.picture(phasor(source.phase))
    numbers: dict[str, Any] = {
        "rms_phase_error_rad": square.sqrt().tolist(),
        "expected_rms_phase_error_rad": [0.0] * len(square) if form == "exr" else list(panel.expected_rms),
    }
    for name, frames in fields.items():
        after = source.picture(torch.stack(frames))
        pairs = [_compared(a, b) for a, b in zip(after, before, strict=True)]
        numbers[f"picture_change_by_{name}"] = [change for change, _ in pairs]
        numbers[f"picture_correlation_{name}"] = [correlation for _, correlation in pairs]
    if source.losses:
        numbers["encoding_loss"] = source.losses
    return numbers


def export_text(report: dict[str, Any]) -> str:
    """Summary of an export in a few lines."""

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
    if "content" in report:
        lines.append(f"Content    {report['content']}")
    return "\n".join(lines)


def _window(hologram: Grid, panel: Grid, name: str) -> tuple:
    """Index of the hologram in frames [..., H, W] of the panel."""
    if any(abs(a / b - 1) > 1e-4 for a, b in zip(hologram.pitch, panel.pitch, strict=True)):
        run, has = (" x ".join(f"{step * 1e6:g}" for step in grid.pitch) for grid in (hologram, panel))
        raise ConfigError(
            [f"the run was computed for pixels of {run} um, the panel {name} has {has} um; run it again with its pitch"]
        )
    if any(a > b for a, b in zip(hologram.shape, panel.shape, strict=True)):
        run, has = (" x ".join(map(str, grid.shape)) for grid in (hologram, panel))
        raise ConfigError(
            [f"the hologram has {run} pixels, more than the {has} of the panel {name}; use a smaller grid"]
        )
    # Sample n // 2, the optical axis, of the hologram lies on that of the panel.
    begin = [large // 2 - small // 2 for large, small in zip(panel.shape, hologram.shape, strict=True)]
    return (..., *(slice(start, start + part) for start, part in zip(begin, hologram.shape, strict=True)))


def _claim(place: Path) -> None:
    """Create a folder; ConfigError if it has files or cannot be created."""
    try:
        place.mkdir(parents=True, exist_ok=True)
        if any(place.iterdir()):
            raise ConfigError([f"{place} holds files already; choose another --out or delete it"])
    except OSError as error:
        raise ConfigError([f"cannot write to {place}: {error.strerror}; choose another place with --out"]) from None


def _write(
    place: Path, source: PanelPhases, panel: PhaseModulator, window: tuple, form: str, folder: Path, name: str
) -> list[list[str]]:
    """Write all files; returns their names, a list of colours for each frame."""
    common = {
        "program": f"holotorch {__version__}",
        "panel": name,
        "pitch_m": list(panel.grid.pitch),
        "encoding": source.encoding,
        "bits": panel.bits,
        "source": str(folder),
        "config_sha256": hashlib.sha256((folder / "config.yaml").read_bytes()).hexdigest(),
        "window": [[part.start, part.stop] for part in window[1:]],
        "flipped_axes": list(panel.flips),
        "content": "phase in rad" if form == "exr" else "grey levels",
    }
    names = []
    for f, phase in enumerate(source.phase):
        whole = phase.new_zeros(len(phase), *panel.grid.shape)
        whole[window] = phase
        frames = whole.flip(panel.flips) if form == "exr" else panel.levels(whole)
        names.append([])
        for c, wavelength in enumerate(source.wavelengths):
            facts = {"wavelength_m": wavelength, "lut_sha256": panel.lut_hash(c), "frame": f, "colour": c}
            file = f"frame-{f:03d}_{wavelength * 1e9:.6g}nm.{form}"
            write = write_phases if form == "exr" else write_levels
            write(place / file, frames[c], common | facts)
            names[-1].append(file)
    return names


def _compared(after: Tensor, before: Tensor) -> tuple[float, float]:
    """Relative L2 change at the best scale, and correlation, of two pictures."""
    a, b = after.double().flatten(), before.double().flatten()
    scale = (a @ b) / (a @ a).clamp(min=torch.finfo(a.dtype).tiny)
    change = (scale * a - b).norm() / b.norm().clamp(min=torch.finfo(a.dtype).tiny)
    a, b = a - a.mean(), b - b.mean()
    return change.item(), ((a @ b) / (a.norm() * b.norm()).clamp(min=torch.finfo(a.dtype).tiny)).item()
