"""Description of a phase panel: the settings of its YAML file, and the panel that is built from them."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from holotorch.core.grid import Grid
from holotorch.experiments.config.errors import ConfigError, short
from holotorch.experiments.config.messages import validated
from holotorch.experiments.config.settings import Count, GridSettings, Number, Settings, Wavelength
from holotorch.experiments.config.source import Key, read_source
from holotorch.io.bundled import find_config
from holotorch.io.files import read_bytes
from holotorch.modulator.dispersion import Birefringence, BirefringenceTable, Cauchy, phase_scale
from holotorch.modulator.panel import PhaseModulator, checked_lut, even_lut

_SAME = 1e-3  # largest relative difference of the wavelengths at which a calibration is used unchanged


def _rises(points: Sequence[tuple[float, float]]) -> bool:
    return all(before[0] < after[0] for before, after in pairwise(points))


def _rising(points: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    if not _rises(points):
        raise PydanticCustomError("lut", "expected levels that rise from row to row")
    return points


Points = Annotated[tuple[tuple[Number, Number], ...], Field(min_length=2), AfterValidator(_rising)]


class CalibrationSettings(Settings):
    """Phases of the grey levels at one wavelength: evenly spaced, or from a table of [level, phase in rad].

    ``full_turn``: level at which the phase is 2 pi, not necessarily an integer; 2^bits by default. ``lut``: rows of
    the table, the first at level 0 and the last at the top level; phases between are interpolated linearly.
    ``lut_file``: the table as a text file of ``level, phase`` lines, relative to the folder of the description.
    """

    wavelength: Wavelength
    full_turn: Annotated[Number, Field(gt=0, le=1e6)] | None = None
    lut: Points | None = None
    lut_file: str | None = None


class DispersionSettings(Settings):
    """Birefringence: a + b / wavelength^2 with b in m^2, or a measured ``table`` of [wavelength, birefringence]."""

    a: Number | None = None
    b: Number | None = None
    table: Annotated[tuple[tuple[Wavelength, Number], ...], Field(min_length=2)] | None = None


class PanelSettings(GridSettings):
    """A phase panel: its pixels, grey levels, calibration and orientation, as in ``PhaseModulator``."""

    name: str = "panel"
    bits: Annotated[Count, Field(le=16)] = 8
    calibration: Annotated[tuple[CalibrationSettings, ...], Field(min_length=1)]
    fill_factor: Annotated[Number, Field(gt=0, le=1)] = 1.0
    gap: Annotated[Number, Field(ge=0, le=1)] = 0.0
    flip_rows: bool = False
    flip_columns: bool = False
    crosstalk_px: Annotated[Number, Field(ge=0, le=20)] = 0.0
    dispersion: DispersionSettings | None = None


def load_panel(path: Path | str, overrides: Sequence[str] = ()) -> PanelSettings:
    """Read the description of a panel, a file or a bundled one, apply ``key=value`` overrides, and check it.

    Raises:
        ConfigError: The description has mistakes; the message gives file, line and column of each.
    """
    path = find_config(path) or Path(path)
    source = read_source(path, list(overrides))
    settings = validated(source, PanelSettings)
    mistakes: list[tuple[Key, str]] = []
    tables: list[CalibrationSettings] = []
    for i, row in enumerate(settings.calibration):
        key = ("calibration", i)
        if sum(item is not None for item in (row.full_turn, row.lut, row.lut_file)) > 1:
            mistakes.append((key, "expected one of full_turn, lut or lut_file"))
            continue
        try:
            points = _read_points(path.parent / row.lut_file) if row.lut_file else row.lut
            row = row.model_copy(update={"lut": points, "lut_file": None})
            _table(row, settings.bits)
            tables.append(row)
        except ValueError as error:
            mistakes.append(((*key, "lut_file" if row.lut_file else "lut"), str(error)))
    if settings.dispersion is not None:
        try:
            law = _law(settings.dispersion)
            law(torch.tensor([row.wavelength for row in settings.calibration], dtype=torch.float64))
        except ValueError as error:
            mistakes.append((("dispersion",), str(error)))
    if mistakes:
        raise ConfigError([source.mistake(key, message) for key, message in mistakes])
    return settings.model_copy(update={"calibration": tuple(tables)})


def build_panel(settings: PanelSettings, wavelengths: Sequence[float]) -> PhaseModulator:
    """Build the panel for light of ``wavelengths`` in metres, one per channel.

    A channel takes the phases of the levels from the calibration with the nearest wavelength. If the wavelengths differ
    by more than 0.1 %, the phases are scaled by the dispersion of the liquid crystal.

    Raises:
        ConfigError: A wavelength without calibration if the panel has no dispersion, or outside the dispersion table.
    """
    law = _law(settings.dispersion) if settings.dispersion is not None else None
    rows = []
    for wavelength in wavelengths:
        nearest = min(settings.calibration, key=lambda row, to=wavelength: abs(row.wavelength - to))
        table = _table(nearest, settings.bits)
        if abs(nearest.wavelength / wavelength - 1) > _SAME:
            calibrated = ", ".join(f"{row.wavelength * 1e9:g} nm" for row in settings.calibration)
            if law is None:
                at = f"not calibrated at {wavelength * 1e9:g} nm but at {calibrated}"
                cure = "add a calibration, or the crystal's dispersion: {a: 0.18, b: 8.5e-15}"
                raise ConfigError([f"the panel {settings.name} is {at}; {cure}"])
            try:
                table = table * phase_scale(wavelength, nearest.wavelength, law).item()
            except ValueError as error:
                raise ConfigError([f"the panel {settings.name}: {error}"]) from error
        rows.append(table)
    options = settings.model_dump(include={"bits", "fill_factor", "gap", "flip_rows", "flip_columns"})
    options |= {"crosstalk": settings.crosstalk_px, "birefringence": law}
    return PhaseModulator(Grid(settings.shape, settings.pitch), wavelengths, lut=torch.stack(rows), **options)


def _table(row: CalibrationSettings, bits: int) -> torch.Tensor:
    """Phase in rad of every level, float64 [2^bits]."""
    if row.lut is None:
        return even_lut(bits, row.full_turn)
    levels, phases = zip(*row.lut, strict=True)
    top = 2**bits - 1
    if levels[0] != 0 or levels[-1] != top:
        expected = f"expected rows from level 0 to {top}, the top one of {bits} bits"
        raise ValueError(f"{expected}, got {levels[0]:g} to {levels[-1]:g}")
    return checked_lut(torch.from_numpy(np.interp(np.arange(top + 1), levels, phases)), bits)


def _read_points(path: Path) -> tuple[tuple[float, float], ...]:
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a UTF-8 text file"
        raise ValueError(f"cannot read {path}: {reason}") from None
    points = []
    for number, line in enumerate(lines, 1):
        cells = line.split("#")[0].replace(",", " ").split()
        if not cells or (number == 1 and cells[0].isalpha()):  # a comment, or a header of column names
            continue
        try:
            level, phase = map(float, cells)
        except ValueError:
            raise ValueError(f"{path}:{number}: expected a level and a phase in rad, got {short(line)}") from None
        points.append((level, phase))
    if len(points) < 2 or not _rises(points):
        raise ValueError(f"{path}: expected at least two rows with levels that rise from row to row")
    return tuple(points)


def _law(settings: DispersionSettings) -> Birefringence:
    if settings.table is not None:
        if settings.a is not None or settings.b is not None:
            raise ValueError("expected a and b, or a table, not both")
        return BirefringenceTable(*zip(*settings.table, strict=True))
    if settings.a is None or settings.b is None:
        raise ValueError("expected both a and b, such as {a: 0.18, b: 8.5e-15}, or a table")
    return Cauchy(settings.a, settings.b)
