"""Building blocks of configurations: units, ranges, and sections that all kinds share."""

import re
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from holotorch.core.quantities import PITCH, PLANE, WAVELENGTH, Quantity
from holotorch.experiments.config.errors import short

_POWERS = {"m": 0, "cm": -2, "mm": -3, "um": -6, "µm": -6, "μm": -6, "nm": -9}  # of ten, in metres
# No two parts of it match the same characters, so that a text that fits in no way takes linear time.
_LENGTH = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zµμ]*)")


def metres(value: Any) -> Any:
    """A length with its unit, or a number of metres, as metres."""
    if isinstance(value, str):
        match = _LENGTH.fullmatch(value.strip())
        if not match or (match[2] and match[2] not in _POWERS):
            raise PydanticCustomError(
                "length", "expected a length such as 530 nm, 3.74 um, 100 mm or a number of metres"
            )
        try:
            return float(Decimal(match[1]).scaleb(_POWERS[match[2] or "m"]))  # rounded once: 0.57 um is 5.7e-07
        except ArithmeticError:  # an exponent beyond those of a decimal
            raise PydanticCustomError("length", "expected a length that a number can hold, such as 100 mm") from None
    return number(value)


def number(value: Any) -> Any:
    """Anything but true and false, which are numbers in Python."""
    if isinstance(value, bool):
        raise PydanticCustomError("number", "expected a number")
    return value


def within(least: float, most: float, words: str) -> AfterValidator:
    """A range, and the words for it."""

    def check(value: float) -> float:
        if not least <= value <= most:
            raise PydanticCustomError("range", "expected {words}", {"words": words})
        return value

    return AfterValidator(check)


def plausible(kind: Quantity) -> AfterValidator:
    """The range of a quantity, in the words of :mod:`holotorch.core.quantities`."""

    def check(value: float) -> float:
        if kind.problem(value):
            what = "a length" if kind.unit == "m" else f"a number of {kind.words}"
            words = {"words": f"{what} {kind.range}", "cure": kind.cure(value) if kind.unit == "m" else ""}
            raise PydanticCustomError("quantity", "expected {words}", words)
        return value

    return AfterValidator(check)


def pair(value: Any) -> Any:
    """One value for both axes."""
    return value if isinstance(value, list | tuple) else (value, value)


def several(value: Any) -> Any:
    """One value as a list."""
    return value if isinstance(value, list | tuple) else (value,)


def existing(there: Callable[[str], object], missing: Callable[[str], str]) -> BeforeValidator:
    """A path that ``there`` accepts; ``missing`` words the refusal of any other, such as a name too long for a file."""

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
    return f"expected a file or folder that exists, got {short(value)}"


Number = Annotated[float, BeforeValidator(number), Field(allow_inf_nan=False)]
Count = Annotated[int, BeforeValidator(number), Field(ge=1)]
Length = Annotated[float, BeforeValidator(metres), Field(allow_inf_nan=False)]
Wavelength = Annotated[Length, plausible(WAVELENGTH)]
Distance = Annotated[Length, plausible(PLANE)]  # of an image or a plane, either side of the hologram
Pitch = Annotated[Length, plausible(PITCH)]
ExistingPath = Annotated[str, existing(lambda value: Path(value).exists(), _no_path)]
ExistingArray = Annotated[str, existing(lambda value: Path(value.split("::")[0]).exists(), _no_path)]
Side = Annotated[Count, Field(le=16384)]


class Settings(BaseModel):
    """Base of all sections: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class GridSettings(Settings):
    """Samples (H, W) and their pitch (y, x); one pitch means both axes."""

    shape: Annotated[tuple[Side, Side], BeforeValidator(pair)]
    pitch: Annotated[tuple[Pitch, Pitch], BeforeValidator(pair)]
