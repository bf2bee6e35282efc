"""Physical quantities: their units, plausible ranges, and the message for a value outside its range.

A range is only as wide as the applications of this package, so that most lengths given in nanometres, micrometres or
millimetres instead of metres are refused. This module does not import torch, so that configurations are checked fast.
"""

import math
from dataclasses import dataclass

_PREFIXES = (("nanometres", 1e-9), ("micrometres", 1e-6), ("millimetres", 1e-3), ("centimetres", 1e-2))
_SYMBOLS = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9), ("pm", 1e-12), ("fm", 1e-15))


@dataclass(frozen=True)
class Quantity:
    """A kind of physical quantity.

    Attributes:
        name: Name in messages.
        unit: Unit, such as "m".
        low: Least plausible magnitude, apart from 0.
        high: Greatest plausible magnitude.
        usual: Range (least, greatest) of most values, from which a forgotten SI prefix is inferred.
        zero: Whether 0 is allowed.
        negative: Whether negative values with a magnitude in the range are allowed.
        infinite: Whether infinity is allowed.
    """

    name: str
    unit: str
    low: float
    high: float
    usual: tuple[float, float]
    zero: bool = False
    negative: bool = False
    infinite: bool = False

    def problem(self, value: float) -> str | None:
        """Why ``value`` is refused, as the end of a sentence whose subject is its name; None if it is accepted."""
        size = abs(value)
        if math.isnan(value) or (math.isinf(value) and not self.infinite):
            return f"must be finite in {self.words}{', or infinite' * self.infinite}, got {value!r}"
        if (value < 0 and not self.negative) or (value == 0 and not self.zero):
            wanted = "other than zero" if self.negative else "at least zero" if self.zero else "above zero"
            return f"must be {wanted} in {self.words}, got {value!r}"
        if value == 0 or math.isinf(value) or self.low <= size <= self.high:
            return None
        return f"must lie {self.range}, got {value:g} {self.unit}{self.cure(value)}"

    @property
    def range(self) -> str:
        """The range in words, such as "within 1 nm .. 2 mm"."""
        low, high = shown(self.low, self.unit), shown(self.high, self.unit)
        if self.high == math.inf:
            return f"at {low} or more"
        if self.low == 0:
            return f"within {'-' * self.negative}{high if self.negative else low} .. {high}"
        return f"within {low} .. {high}" + " in magnitude" * self.negative + " or be 0" * self.zero

    def cure(self, value: float) -> str:
        """What to change, as the end of a message, such as the SI prefix that was forgotten."""
        if value == 0 or (value < 0 and not self.negative):
            return ""
        for name, scale in _PREFIXES if self.unit == "m" else ():
            if self.usual[0] <= abs(value) * scale * (1 + 1e-9) and abs(value) * scale <= self.usual[1] * (1 + 1e-9):
                short = 0.1 <= abs(value) < 1e5
                meant = f"{value:g}e{round(math.log10(scale))}" if short else f"{value * scale:g}"
                return f"; {value:g} looks like {name}: pass {meant}"
        low, high = (shown(end, self.unit) for end in self.usual)
        return f"; pass a number of {self.words}, usually {low} to {high}"

    @property
    def words(self) -> str:
        """The unit, spelled out for metres."""
        return "metres" if self.unit == "m" else self.unit


def shown(value: float, unit: str) -> str:
    """A value with its unit and, for metres, the appropriate SI prefix, such as "3.74 um"."""
    if unit == "m" and value:
        symbol, scale = next((pair for pair in _SYMBOLS if abs(value) >= pair[1] * (1 - 1e-9)), _SYMBOLS[-1])
        return f"{value / scale:g} {symbol}"
    return f"{value:g} {unit}".rstrip()


# Wavelengths from the extreme ultraviolet to 1 THz; the range excludes visible light given in millimetres (5e-4).
WAVELENGTH = Quantity("wavelength", "m", 10e-9, 300e-6, (200e-9, 20e-6))
# Full widths of spectra, from the line of a stabilised laser to white light, and differences of wavelengths.
BANDWIDTH = Quantity("fwhm", "m", 1e-15, 100e-6, (0.1e-9, 500e-9))
WAVELENGTH_CHANGE = Quantity("change", "m", 0.0, 100e-6, (0.1e-9, 500e-9), zero=True, negative=True)
# Sample pitches, from part of a wavelength to a distant wall; the range excludes pixels given in millimetres (8e-3).
PITCH = Quantity("pitch", "m", 1e-9, 2e-3, (100e-9, 200e-6))
# Lengths along the optical axis: of a propagation, to an image plane, to an object in front of a hologram or an eye.
DISTANCE = Quantity("distance", "m", 0.0, 1e3, (1e-3, 3.0), zero=True, negative=True)
PLANE = Quantity("distance", "m", 0.0, 10.0, (1e-3, 3.0), zero=True, negative=True)
DEPTH = Quantity("depth", "m", 1e-9, 100.0, (1e-3, 3.0))
# Lengths across the optical axis.
WIDTH = Quantity("width", "m", 1e-9, 10.0, (1e-3, 0.5))
SPREAD = Quantity("spread", "m", 1e-9, 1e3, (1e-6, 0.1))
OFFSET = Quantity("offset", "m", 0.0, 10.0, (1e-6, 0.1), zero=True, negative=True)
# Optical elements, from a microlens to a weak spectacle lens, and the distances between them.
FOCAL_LENGTH = Quantity("focal_length", "m", 1e-6, 100.0, (1e-3, 1.0), negative=True, infinite=True)
APERTURE_RADIUS = Quantity("aperture radius", "m", 10e-9, 0.5, (10e-6, 50e-3))
SPACING = Quantity("distance", "m", 0.0, 10.0, (1e-3, 0.5), zero=True)
# Eyes, and cameras in place of eyes.
PUPIL_RADIUS = Quantity("pupil_radius", "m", 10e-6, 50e-3, (0.5e-3, 10e-3))
EYE_LENGTH = Quantity("axial_length", "m", 1e-3, 0.2, (10e-3, 50e-3))
ACCOMMODATION = Quantity("accommodation", "m", 1e-3, math.inf, (0.05, 10.0), infinite=True)
WAVEFRONT_ERROR = Quantity("wavefront error", "m", 0.0, 1e-3, (1e-9, 10e-6), zero=True, negative=True)
SOFTNESS = Quantity("softness", "m", 0.0, 10e-3, (1e-6, 1e-3), zero=True)
VOXEL = Quantity("volume spacing", "m", 1e-12, 0.1, (1e-6, 5e-3))  # from atomic to room-sized volumes
CAUCHY_B = Quantity("b", "square metres", 0.0, 1e-12, (1e-16, 1e-13), zero=True, negative=True)  # birefringence
SIGMA_PX = Quantity("sigma_px", "pixels", 0.0, 100.0, (0.1, 5.0), zero=True)  # of heat crosstalk
# Catheters and other tools that are tracked, and their positions.
TOOL_RADIUS = Quantity("radius", "m", 10e-6, 50e-3, (0.2e-3, 20e-3))
TOOL_LENGTH = Quantity("length", "m", 1e-3, 3.0, (10e-3, 2.0))
TOOL_POSITION = Quantity("position", "m", 0.0, 3.0, (5e-3, 2.0), zero=True, negative=True)
EDGE_DEVIATION = Quantity("deviation", "pixels", 1e-9, 1e6, (0.01, 2.0))
TOOL_OFFSET = Quantity("offset", "m", 0.0, 50e-3, (0.1e-3, 20e-3), zero=True, negative=True)
TOOL_DEVIATION = Quantity("deviation", "m", 1e-9, 1.0, (0.1e-3, 50e-3))
# Scenes and screens in front of cameras and viewers.
POSITION = Quantity("position", "m", 0.0, 10.0, (10e-3, 5.0), zero=True, negative=True)
SCREEN = Quantity("size", "m", 1e-3, 100.0, (0.05, 5.0))  # of a display, up to a planetarium
CAMERA_DEPTH = Quantity("depth", "m", 1e-3, 10.0, (10e-3, 5.0))
BOARD_SQUARE = Quantity("square", "m", 10e-6, 1.0, (1e-3, 0.2))
