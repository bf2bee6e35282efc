"""What a configuration may say: frozen models, checked all at once, before torch is loaded."""

import re
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError

from holotorch.experiments.errors import ConfigError
from holotorch.experiments.messages import describe, nearest, position
from holotorch.experiments.source import Key, read_source
from holotorch.io.bundled import BUNDLED_IMAGES, no_such_picture

_POWERS = {"m": 0, "cm": -2, "mm": -3, "um": -6, "µm": -6, "μm": -6, "nm": -9}  # of ten, in metres
_LENGTH = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zµμ]*)")


def _metres(value: Any) -> Any:
    if isinstance(value, str):
        match = _LENGTH.fullmatch(value.strip())
        if not match or (match[2] and match[2] not in _POWERS):
            raise PydanticCustomError(
                "length", "expected a length such as 530 nm, 3.74 um, 100 mm or a number of metres"
            )
        return float(Decimal(match[1]).scaleb(_POWERS[match[2] or "m"]))  # rounded once: 0.57 um is 5.7e-07
    return _number(value)


def _number(value: Any) -> Any:
    if isinstance(value, bool):
        raise PydanticCustomError("number", "expected a number")
    return value


def _not_zero(value: float) -> float:
    if abs(value) < 1e-6:
        raise PydanticCustomError("distance", "expected a distance of 1 um or more: closer, a phase forms no image")
    return value


def _within(least: float, most: float, words: str) -> AfterValidator:
    def check(value: float) -> float:
        if not least <= value <= most:
            raise PydanticCustomError("range", "expected {words}", {"words": words})
        return value

    return AfterValidator(check)


def _pair(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else (value, value)


def _several(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else (value,)


def _picture(value: Any) -> Any:
    if isinstance(value, str) and value not in BUNDLED_IMAGES and not Path(value).is_file():
        raise PydanticCustomError("picture", "{message}", {"message": no_such_picture(value)})
    return value


Number = Annotated[float, BeforeValidator(_number), Field(allow_inf_nan=False)]
Count = Annotated[int, BeforeValidator(_number), Field(ge=1)]
Length = Annotated[float, BeforeValidator(_metres), Field(allow_inf_nan=False)]
# Ranges that catch a forgotten unit: 530 is no wavelength in metres and 9 no pitch.
Wavelength = Annotated[Length, _within(1e-7, 2e-5, "a wavelength between 100 nm and 20 um")]
Pitch = Annotated[Length, _within(1e-9, 1e-3, "a pitch between 1 nm and 1 mm")]


Side = Annotated[Count, Field(le=16384)]


class Settings(BaseModel):
    """Base of all sections: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class GridSettings(Settings):
    """Samples (H, W) and their pitch (y, x); one pitch means both axes."""

    shape: Annotated[tuple[Side, Side], BeforeValidator(_pair)]
    pitch: Annotated[tuple[Pitch, Pitch], BeforeValidator(_pair)]


class TargetSettings(Settings):
    """A bundled photograph or a picture file, and how it is brought to the grid's aspect."""

    image: Annotated[str, BeforeValidator(_picture)]
    fit: Literal["crop", "pad"] = "crop"


class ModulatorSettings(Settings):
    """The phased array: width of the heat kernel in pixels, number of taps (chosen from the width if not given)."""

    sigma_px: Annotated[Number, Field(ge=0, le=100)]
    kernel_size: Annotated[Count, Field(le=401)] | None = None


class FraunhoferSettings(Settings):
    """Image in the far field."""

    kind: Literal["fraunhofer"]


class NearFieldSettings(Settings):
    """Image at a distance. ``isolated``: the array stands alone; ``periodic``: it repeats without end (the thesis)."""

    kind: Literal["fresnel", "angular_spectrum"]
    distance: Annotated[Length, AfterValidator(_not_zero)]
    boundary: Literal["isolated", "periodic"] = "isolated"


class APGSettings(Settings):
    """Accelerated proximal gradient, thesis Algorithm 2."""

    kind: Literal["apg"]
    step: Annotated[Number, Field(ge=1e-6, le=1e6)] = 1.0
    shrink: Annotated[Number, Field(gt=0, lt=1)] = 0.5
    max_steps: Count = 400
    tolerance: Annotated[Number, Field(ge=0)] = 1e-3
    patience: Count = 10
    start: Literal["hot", "flat"] | None = None


class AdamSettings(Settings):
    """Adam with projection onto phases >= 0."""

    kind: Literal["adam"]
    learning_rate: Annotated[Number, Field(ge=1e-6, le=10)] = 0.1
    max_steps: Count = 400
    tolerance: Annotated[Number, Field(ge=0)] = 1e-3
    patience: Count = 10
    start: Literal["hot", "flat"] | None = None


class ReportSettings(Settings):
    """What is measured and compared in the report."""

    metrics: Annotated[tuple[Literal["ssim", "psnr"], ...], BeforeValidator(_several), Field(min_length=1)] = (
        "ssim",
        "psnr",
    )
    baselines: Annotated[tuple[Literal["none", "basic_ipec"], ...], BeforeValidator(_several)] = ("none", "basic_ipec")


class PECSettings(Settings):
    """Proximity effect correction of one picture on a thermally driven phased array."""

    experiment: Literal["pec"]
    seed: Annotated[int, BeforeValidator(_number), Field(ge=0, lt=2**63)] = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    grid: GridSettings
    wavelengths: Annotated[tuple[Wavelength, ...], BeforeValidator(_several)]
    target: TargetSettings
    modulator: ModulatorSettings
    propagator: Annotated[FraunhoferSettings | NearFieldSettings, Field(discriminator="kind")]
    solver: Annotated[APGSettings | AdamSettings, Field(discriminator="kind")]
    report: ReportSettings = ReportSettings()


KINDS: dict[str, type[PECSettings]] = {"pec": PECSettings}


def load_config(path: Path | str, overrides: list[str] | None = None) -> PECSettings:
    """Read, override and check a configuration.

    Raises:
        ConfigError: Everything that is wrong with it, one line per mistake with its file, line and column.
    """
    source = read_source(Path(path), overrides or [])
    kind = source.data.get("experiment")
    if not isinstance(kind, str) or kind not in KINDS:
        got = f"got {kind!r}" + nearest(str(kind), list(KINDS)) if "experiment" in source.data else "it is missing"
        raise ConfigError([source.mistake(("experiment",), f"expected one of {', '.join(KINDS)}, {got}")])
    try:
        settings = KINDS[kind].model_validate(source.data)
    except ValidationError as error:
        mistakes = {describe(source, KINDS[kind], entry): None for entry in error.errors()}
        raise ConfigError(sorted(mistakes, key=position)) from None
    mistakes = [source.mistake(key, message) for key, message in _contradictions(settings)]
    if mistakes:
        raise ConfigError(mistakes)
    return settings


def _contradictions(settings: PECSettings) -> list[tuple[Key, str]]:
    """Settings that are fine one by one and not together."""
    found: list[tuple[Key, str]] = []
    smallest = min(settings.grid.shape)
    if len(settings.wavelengths) not in (1, 3):
        found.append((("wavelengths",), f"expected 1 (grey) or 3 (red, green, blue), got {len(settings.wavelengths)}"))
    if "ssim" in settings.report.metrics and smallest < 11:
        hint = "use a larger grid, or report.metrics: [psnr]"
        found.append((("grid", "shape"), f"expected at least 11 x 11 px for ssim, got {settings.grid.shape}; {hint}"))
    size = settings.modulator.kernel_size
    if size is not None and size % 2 == 0:
        found.append((("modulator", "kernel_size"), f"expected an odd number of taps, got {size}; use {size + 1}"))
    elif size is not None and size > smallest:
        key = ("modulator", "kernel_size")
        found.append((key, f"expected at most {smallest}, the smaller side of the grid, got {size}"))
    light, finest, longest = settings.propagator, min(settings.grid.pitch), max(settings.wavelengths)
    if isinstance(light, NearFieldSettings) and finest < 0.9 * longest:
        least = f"at least 0.9 of the longest wavelength, {0.9 * longest:.3g} m, for an image at a distance"
        found.append((("grid", "pitch"), f"expected {least}, got {finest:g} m"))
    return found
