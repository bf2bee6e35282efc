"""Building blocks of configurations: units, ranges, and sections that several kinds share."""

import itertools
import math
import re
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from holotorch.core.quantities import PITCH, PLANE, WAVELENGTH, Quantity
from holotorch.experiments.config.errors import short
from holotorch.io.bundled import similar_path

_POWERS = {"m": 0, "cm": -2, "mm": -3, "um": -6, "µm": -6, "μm": -6, "nm": -9}  # powers of ten, in metres
# No two neighbouring parts of the pattern match the same characters, so a text without a match takes linear time.
_LENGTH = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zµμ]*)")


def metres(value: Any) -> Any:
    """A length in metres, from a text with a unit or a number of metres."""
    if isinstance(value, str):
        match = _LENGTH.fullmatch(value.strip())
        if not match or (match[2] and match[2] not in _POWERS):
            expected = "expected a length such as 530 nm, 3.74 um, 100 mm or a number of metres"
            raise PydanticCustomError("length", expected)
        try:
            return float(Decimal(match[1]).scaleb(_POWERS[match[2] or "m"]))  # decimal, so that 0.57 um is 5.7e-07
        except ArithmeticError:  # the exponent is too large
            raise PydanticCustomError("length", "expected a length that a number can hold, such as 100 mm") from None
    return number(value)


_COLOURS = ("red", "orange", "amber", "yellow", "green", "cyan", "blue", "violet", "white", "rgb")


def _no_name(value: Any) -> Any:
    """An error for the name of a colour in place of its wavelength."""
    if isinstance(value, str) and value.strip().lower() in _COLOURS:
        usual = "usual are 630 nm for red, 530 nm for green, 450 nm for blue"
        raise PydanticCustomError("wavelength", f"expected a wavelength in nm ({usual})")
    return value


_PI = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)?)\s*\*?\s*(?:pi|π)")
_RISE = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*(?:K|degC|°C)")


def radians(value: Any) -> Any:
    """A phase in radians, from a number of them or a text such as 4pi or 2.5 pi."""
    if isinstance(value, str):
        if (match := _PI.fullmatch(value.strip())) and match[1] not in ("+", "-"):
            return float(match[1] or 1) * math.pi
        raise PydanticCustomError("phase", "expected a phase such as 4pi, or a number of radians")
    return number(value)


_LARGEST = 10**300  # whole numbers that become floats; the largest float is 1.8e308


def kelvin(value: Any) -> Any:
    """A temperature rise in kelvin, from a number of them or a text such as 500 degC or 500 K."""
    if isinstance(value, str):
        if match := _RISE.fullmatch(value.strip()):
            return float(match[1])
        expected = "expected a temperature above ambient such as 500 degC, or a number of degrees"
        raise PydanticCustomError("temperature", expected)
    return number(value)


def number(value: Any) -> Any:
    """The value itself; an error for true and false, which Python takes as numbers, and for what no float can be."""
    if isinstance(value, bool):
        raise PydanticCustomError("number", "expected a number")
    if isinstance(value, int) and abs(value) > _LARGEST:
        raise PydanticCustomError("number", "expected a number of at most 300 digits")
    return value


def within(minimum: float, maximum: float, expected: str) -> AfterValidator:
    """A validator of the range from ``minimum`` to ``maximum``, which ``expected`` describes in the message."""

    def check(value: float) -> float:
        if not minimum <= value <= maximum:
            raise PydanticCustomError("range", "expected {words}", {"words": expected})
        return value

    return AfterValidator(check)


def plausible(kind: Quantity) -> AfterValidator:
    """A validator of the range of a quantity; see :mod:`holotorch.core.quantities`."""

    def check(value: float) -> float:
        if kind.problem(value):
            name = "a length" if kind.unit == "m" else f"a number of {kind.words}"
            hints = (_missing_unit(kind, value), _other_unit(kind, value)) if kind.unit == "m" else ("", "")
            words = {"words": f"{name} {kind.range}", "hint": hints[0], "hint_of_text": hints[1]}
            raise PydanticCustomError("quantity", "expected {words}", words)
        return value

    return AfterValidator(check)


def _missing_unit(kind: Quantity, value: float) -> str:
    """A hint for a number of metres outside the range: a unit with which the same number is a usual length."""
    for unit in ("nm", "um", "mm", "cm"):
        if math.isfinite(value) and kind.usual[0] <= abs(metres(f"{value!r} {unit}")) <= kind.usual[1]:
            return f"; {value:g} means metres: did you mean '{value:g} {unit}'?"
    return kind.cure(value)


def _other_unit(kind: Quantity, value: float) -> str:
    """A hint for a length with a unit outside the range: another unit with which the same number is a usual length."""
    for power, unit in itertools.product((-3, -2, -6, -9), ("um", "mm", "cm", "nm")):
        number = value / 10.0**power  # as it was written, if its unit has this power
        if 1 <= number < 1000 and kind.usual[0] <= metres(f"{number:.6g} {unit}") <= kind.usual[1]:
            return f"; did you mean '{number:.6g} {unit}'?"
    return ""


_TIMES = re.compile(r"(\d[^x×]{0,20}?)\s*[x×]\s*(\d[^x×]{0,20})")


def pair(value: Any) -> Any:
    """A single value becomes a pair for both axes; an error for a text such as 100x200."""
    if isinstance(value, str) and (match := _TIMES.fullmatch(value)):
        wanted = f"expected [rows, columns] in brackets, such as [{match[1]},{match[2]}]"
        raise PydanticCustomError("pair", "{message}", {"message": wanted})
    return value if isinstance(value, list | tuple) else (value, value)


def several(value: Any) -> Any:
    """A single value becomes a sequence of one value."""
    return value if isinstance(value, list | tuple) else (value,)


def existing(there: Callable[[str], object], missing: Callable[[str], str]) -> BeforeValidator:
    """A validator of paths: ``there(path)`` tells whether a path exists; if not, ``missing(path)`` is the message."""

    def check(value: Any) -> Any:
        reason = ""
        try:
            if not isinstance(value, str) or there(value):
                return value
        except OSError as error:
            reason = f" ({error.strerror})"
        except ValueError:  # a zero byte
            reason = " (no file can have this name)"
        raise PydanticCustomError("path", "{message}", {"message": missing(value) + reason})

    return BeforeValidator(check)


def _no_path(value: str) -> str:
    near = similar_path(value)
    hint = f"; did you mean {near}?" if near else ""
    return f"expected a file or folder that exists, got {short(value)}{hint}"


Number = Annotated[float, BeforeValidator(number), Field(allow_inf_nan=False)]
Count = Annotated[int, BeforeValidator(number), Field(ge=1)]
Length = Annotated[float, BeforeValidator(metres), Field(allow_inf_nan=False)]
Phase = Annotated[float, BeforeValidator(radians), Field(ge=0.1, le=1000, allow_inf_nan=False)]
TemperatureRise = Annotated[float, BeforeValidator(kelvin), Field(ge=1, le=1e5, allow_inf_nan=False)]
Wavelength = Annotated[Length, plausible(WAVELENGTH), BeforeValidator(_no_name)]
Distance = Annotated[Length, plausible(PLANE)]  # from the hologram to an image or a plane, on either side
Pitch = Annotated[Length, plausible(PITCH)]
ExistingPath = Annotated[str, existing(lambda value: Path(value).exists(), _no_path)]
ExistingArray = Annotated[str, existing(lambda value: Path(value.split("::")[0]).exists(), _no_path)]
Side = Annotated[Count, Field(le=16384)]


class Settings(BaseModel):
    """Base of all sections: frozen, and an unknown key is an error.

    ``elsewhere`` names the right place of keys that users may write here by mistake.
    """

    elsewhere: ClassVar[dict[str, str]] = {}

    model_config = ConfigDict(frozen=True, extra="forbid")


class GridSettings(Settings):
    """Samples (H, W) and their pitch (y, x); a single value is used for both axes."""

    shape: Annotated[tuple[Side, Side], BeforeValidator(pair)]
    pitch: Annotated[tuple[Pitch, Pitch], BeforeValidator(pair)]
