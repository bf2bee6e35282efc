"""Files for a phase panel from a finished run, and a simulation of the picture that these files form."""

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
from holotorch.experiments.panel.config import build_panel, load_panel
from holotorch.experiments.panel.place import claim
from holotorch.experiments.panel.source import PanelPhases, load_panel_phases
from holotorch.io.files import write_json
from holotorch.io.panel_files import read_levels, read_phases, write_levels, write_phases
from holotorch.modulator.panel import PhaseModulator

FORMATS = ("png", "bmp", "exr")
# Entry "content" of export.json for a run of kind ``pec``.


def export_slm(
    folder: Path,
    description: Path | str,
    out: Path | None = None,
    *,
    encoding: str | None = None,
    form: str = "png",
    overrides: Sequence[str] = (),
) -> tuple[Path, dict[str, Any]]:
    """Write one file for each frame and colour of a run, read the files back and simulate the picture they form.

    A hologram smaller than the panel is centred on the optical axis and surrounded by pixels of phase 0; the simulation
    assumes that these pixels emit no light. The files of a run of kind ``pec`` hold the phases after the heat has
    spread, modulo 2 pi: they suit a liquid crystal, which has no thermal crosstalk, but not a thermal chip. The files
    of a run of kind ``volume`` hold the encoded field of its first realisation.

    Args:
        folder: Folder of the run.
        description: YAML file of the panel.
        out: Folder for the files, new or empty; by default ``slm``, then ``slm-002``, ... in the folder of the run.
        encoding: For a volume, one of ``source.ENCODINGS``; double phase by default.
        form: ``png`` (16 bits for a panel of more than 8 bits), ``bmp``, or ``exr`` for the phases in rad.
        overrides: ``key=value`` words for the description of the panel.

    Returns:
        The folder of the files, and the content of its ``export.json``.

    Raises:
        ConfigError: There is no such run, its result contains NaN, the panel has another pitch or too few pixels, or
            ``out`` is not empty.
    """
    if form not in FORMATS:
        raise ConfigError([f"expected one of {', '.join(FORMATS)} as the format, got {form!r}"])
    settings = load_panel(description, overrides)
    source = load_panel_phases(folder, encoding)
    panel = build_panel(settings, source.wavelengths)
    if form == "bmp" and panel.bits > 8:
        raise ConfigError([f"a BMP holds 8 bits and the panel {settings.name} has {panel.bits}; use png"])
    window = _window(source.grid, panel.grid, settings.name)
    place = claim(out, folder / "slm")
    try:
        names = _write(place, source, panel, window, form, folder, settings.name)
        report = {
            "source": str(folder),
            "panel": settings.model_dump(mode="json", exclude_none=True),
            "encoding": source.encoding,
            **({"content": source.content} if source.content else {}),
            "format": form,
            "files": sum(names, []),
            "padded": source.grid.shape != panel.grid.shape,
            **resimulate(place, names, source, panel, window, form),
        }
        write_json(place / "export.json", report)
    except BaseException:
        shutil.rmtree(place)  # the folder was empty before, so all files are of this export
        raise
    return place, report


def resimulate(
    place: Path, names: list[list[str]], source: PanelPhases, panel: PhaseModulator, window: tuple, form: str
) -> dict[str, Any]:
    """Compare the phases in the written files, and the picture that they form, with those of the run.

    The results have one value per colour: the rms error of the phase in rad, its expected value for uniformly
    distributed phases, the relative L2 change of the picture at the best scale, and the correlation of the two
    pictures. Change and correlation are given for the levels alone, and for the panel with fringing fields and gaps.

    ``names`` are the names of the files in the folder ``place``, a list over colours for each frame; ``window`` are the
    slices of the hologram in frames [..., H, W] of the panel. ConfigError if a file was made for another level table.
    """
    square = torch.zeros(len(source.wavelengths), dtype=torch.float64)
    fields: dict[str, list[Tensor]] = {"levels": [], "panel": []}  # one field [C, H, W] for each frame
    for frame, row in zip(source.phase, names, strict=True):
        files = [(read_phases if form == "exr" else read_levels)(place / name) for name in row]
        for c, (name, (_, facts)) in enumerate(zip(row, files, strict=True)):
            if facts.get("lut_sha256") != panel.lut_hash(c):
                raise ConfigError([f"{name} was written for another table of levels, or has lost its metadata"])
        whole = torch.stack([each for each, _ in files])
        whole = whole.flip(panel.flips) if form == "exr" else panel.phase(whole)
        error = torch.remainder(whole[window].double() - frame.double() + math.pi, 2 * math.pi) - math.pi
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
        changes, correlations = zip(*map(_compared, after, before), strict=True)
        numbers |= {f"picture_change_by_{name}": list(changes), f"picture_correlation_{name}": list(correlations)}
    if source.losses:
        numbers["encoding_loss"] = source.losses
    return numbers


def export_text(report: dict[str, Any]) -> str:
    """Summary of an export in a few lines."""
    text = {
        name: " / ".join(f"{value:.2g}" for value in values)
        for name, values in (report | report.get("encoding_loss", {})).items()
        if isinstance(values, list) and name != "files"
    }
    lines = [
        f"Files      {len(report['files'])} {report['format']} for {report['panel']['name']}, {report['encoding']}",
        *(["Padding    the hologram lies in the panel's middle, phase 0 around it"] if report["padded"] else []),
        f"Phase      rms error {text['rms_phase_error_rad']} rad from the files, "
        f"{text['expected_rms_phase_error_rad']} rad expected of these levels",
        f"Picture    changes by {text['picture_change_by_levels']} through the levels, "
        f"{text['picture_change_by_panel']} with the panel's gaps and fringes",
    ]
    if losses := ", ".join(f"{text[name]} by {name}" for name in report.get("encoding_loss", {})):
        lines.append(
            f"Encoding   costs {losses} (relative squared error of the picture without an aperture; 0 is best)"
        )
        lines += _better(report)
    if "content" in report:
        lines.append(f"Content    {report['content']}")
    return "\n".join(lines)


def _better(report: dict[str, Any]) -> list[str]:
    """A line that names the colours in which the kinoform errs less than the encoding of the files, if any."""
    losses, files = report["encoding_loss"], report["files"]
    pairs = zip(files, losses[report["encoding"]], losses["kinoform"], strict=False)  # of the first frame
    better = [Path(file).stem.split("_")[1] for file, loss, other in pairs if other < loss]
    if not better:
        return []
    advice = f"--encoding kinoform would be closer at {', '.join(better)}"
    return [f"Better     {advice}; behind an aperture in the Fourier plane double_phase is meant to be"]


def _window(hologram: Grid, panel: Grid, name: str) -> tuple:
    """Slices of the hologram in frames [..., H, W] of the panel."""
    if any(abs(a / b - 1) > 1e-4 for a, b in zip(hologram.pitch, panel.pitch, strict=True)):
        run, has = (" x ".join(f"{step * 1e6:g}" for step in grid.pitch) for grid in (hologram, panel))
        problem = f"the run was computed for pixels of {run} um, the panel {name} has {has} um"
        raise ConfigError([f"{problem}; run it again with its pitch"])
    if any(a > b for a, b in zip(hologram.shape, panel.shape, strict=True)):
        run, has = (" x ".join(map(str, grid.shape)) for grid in (hologram, panel))
        problem = f"the hologram has {run} pixels, more than the {has} of the panel {name}"
        raise ConfigError([f"{problem}; use a smaller grid"])
    # Hologram and panel share the optical axis, which is at sample n // 2 of n samples.
    begin = [large // 2 - small // 2 for large, small in zip(panel.shape, hologram.shape, strict=True)]
    return (..., *(slice(start, start + part) for start, part in zip(begin, hologram.shape, strict=True)))


def _write(
    place: Path, source: PanelPhases, panel: PhaseModulator, window: tuple, form: str, folder: Path, panel_name: str
) -> list[list[str]]:
    """Write all files. Returns their names, a list over colours for each frame."""
    write = write_phases if form == "exr" else write_levels
    common = {
        "program": f"holotorch {__version__}",
        "panel": panel_name,
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
        names.append([f"frame-{f:03d}_{wavelength * 1e9:.6g}nm.{form}" for wavelength in source.wavelengths])
        for c, (name, wavelength) in enumerate(zip(names[-1], source.wavelengths, strict=True)):
            facts = {"wavelength_m": wavelength, "lut_sha256": panel.lut_hash(c), "frame": f, "colour": c}
            write(place / name, frames[c], common | facts)
    return names


def _compared(after: Tensor, before: Tensor) -> tuple[float, float]:
    """Relative L2 change of a picture from ``before`` to the best-scaled ``after``, and correlation of the two."""
    a, b, tiny = after.double().flatten(), before.double().flatten(), torch.finfo(torch.float64).tiny
    scale = (a @ b) / (a @ a).clamp(min=tiny)
    change = (scale * a - b).norm() / b.norm().clamp(min=tiny)
    a, b = a - a.mean(), b - b.mean()
    return change.item(), ((a @ b) / (a.norm() * b.norm()).clamp(min=tiny)).item()
