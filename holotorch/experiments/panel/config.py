"""Settings of the description of a phase panel, and the panel that is built from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from holotorch.core.grid import Grid
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.config.messages import validated
from holotorch.experiments.config.settings import Count, GridSettings, Number, Settings, Wavelength
from holotorch.experiments.config.source import Key, read_source
from holotorch.io.files import read_bytes
from holotorch.modulator.dispersion import Birefringence, BirefringenceTable, Cauchy, phase_scale
from holotorch.modulator.panel import PhaseModulator, checked_lut, even_lut

# Largest relative deviation of a wavelength that uses a calibration unchanged: real lasers deviate from nominal values.
_SAME = 1e-3


def _rising(points: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    for before, after in zip(points, points[1:], strict=False):
        if after[0] <= before[0]:
            raise PydanticCustomError("lut", "expected levels that rise from row to row")
    return points


Points = Annotated[tuple[tuple[Number, Number], ...], Field(min_length=2), AfterValidator(_rising)]


class CalibrationSettings(Settings):
    """Phases of the grey levels at one wavelength: evenly spaced, or a table of [level, phase in rad].

    ``full_turn``: level at which the phase is 2 pi, not necessarily whole; 2^bits by default. ``lut``: rows from level
    0 to the top level, interpolated linearly. ``lut_file``: the same table as a text file of ``level, phase`` lines,
    with its path relative to the description.
    """

    wavelength: Wavelength
    full_turn: Annotated[Number, Field(gt=0, le=1e6)] | None = None
    lut: Points | None = None
    lut_file: str | None = None


class DispersionSettings(Settings):
    """Birefringence a + b / wavelength^2 with b in m^2, or a measured ``table`` of [wavelength, birefringence]."""

    a: Number | None = None
    b: Number | None = None
    table: Annotated[tuple[tuple[Wavelength, Number], ...], Field(min_length=2)] | None = None


class PanelSettings(GridSettings):
    """A phase panel: its pixels, grey levels, calibration and orientation; see ``PhaseModulator``."""

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
    """Read the description of a panel, apply ``overrides``, and check it.

    Raises:
        ConfigError: All mistakes, one line each with file, line and column.
    """
    source = read_source(Path(path), list(overrides))
    settings = validated(source, PanelSettings)
    mistakes: list[tuple[Key, str]] = []
    tables: list[CalibrationSettings] = []
    for i, row in enumerate(settings.calibration):
        key = ("calibration", i)
        if sum(item is not None for item in (row.full_turn, row.lut, row.lut_file)) > 1:
            mistakes.append((key, "expected one of full_turn, lut or lut_file"))
            continue
        try:
            points = _read_points(Path(path).parent / row.lut_file) if row.lut_file else row.lut
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

    The phase table of each channel is that of the calibration at its wavelength (to 0.1 %), or that of the nearest
    calibration, scaled by the dispersion of the crystal.

    Raises:
        ConfigError: A wavelength has no calibration and the panel no dispersion, or it is outside the dispersion table.
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
    return PhaseModulator(
        Grid(settings.shape, settings.pitch),
        wavelengths,
        bits=settings.bits,
        lut=torch.stack(rows),
        fill_factor=settings.fill_factor,
        gap=settings.gap,
        flip_rows=settings.flip_rows,
        flip_columns=settings.flip_columns,
        crosstalk=settings.crosstalk_px,
        birefringence=law,
    )


def _table(row: CalibrationSettings, bits: int) -> torch.Tensor:
    """Phase in rad of every level, float64 [2^bits]."""
    if row.lut is None:
        return even_lut(bits, row.full_turn)
    top = 2**bits - 1
    if row.lut[0][0] != 0 or row.lut[-1][0] != top:
        raise ValueError(
            f"expected rows from level 0 to {top}, the top one of {bits} bits, got {row.lut[0][0]:g} to "
            f"{row.lut[-1][0]:g}"
        )
    points = torch.tensor(row.lut, dtype=torch.float64)
    levels = torch.arange(top + 1, dtype=torch.float64)
    upper = torch.bucketize(levels, points[:, 0].contiguous()).clamp(min=1)
    (x0, y0), (x1, y1) = points[upper - 1].T, points[upper].T
    return checked_lut(y0 + (levels - x0) / (x1 - x0) * (y1 - y0), bits)


def _read_points(path: Path) -> tuple[tuple[float, float], ...]:
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a UTF-8 text file"
        raise ValueError(f"cannot read {path}: {reason}") from None
    points = []
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words or (number == 1 and words[0].isalpha()):  # a comment, or a header of column names
            continue
        try:
            level, phase = map(float, words)
        except ValueError:
            raise ValueError(f"{path}:{number}: expected a level and a phase in rad, got {line!r}") from None
        points.append((level, phase))
    if len(points) < 2 or any(after[0] <= before[0] for before, after in zip(points, points[1:], strict=False)):
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


def described(settings: PanelSettings) -> dict[str, Any]:
    """The description as plain data for ``export.json``."""
    return settings.model_dump(mode="json", exclude_none=True)
