"""Physical quantities: their units, plausible ranges, and the message for a value outside its range.

A range is as wide as the physics that this package is used for, and no wider, so that a length in nanometres,
micrometres or millimetres that stands where metres belong is refused. Used by ``checks.quantity`` and by the fields of
configurations; imports nothing, so that configurations are checked before torch is loaded.
"""

import math
from dataclasses import dataclass

_PREFIXES = (("nanometres", 1e-9), ("micrometres", 1e-6), ("millimetres", 1e-3), ("centimetres", 1e-2))
_SYMBOLS = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9), ("pm", 1e-12), ("fm", 1e-15))


@dataclass(frozen=True)
class Quantity:
    """A kind of physical quantity.

    Attributes:
        name: What it is called in messages.
        unit: Its unit, such as "m".
        low: Least magnitude that can be meant, besides 0 where that is allowed.
        high: Greatest one.
        usual: Where most values lie, least and greatest: tells which prefix was forgotten.
        zero: 0 is allowed.
        negative: Values below zero are allowed, their magnitude in the same range.
        infinite: Infinity is allowed.
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
        """What is wrong with ``value``, as the end of a sentence that begins with its name; None if nothing is."""
        size = abs(value)
        if math.isnan(value) or (math.isinf(value) and not self.infinite):
            return f"must be finite{self._in()}{', or infinite' * self.infinite}, got {value!r}"
        if (value < 0 and not self.negative) or (value == 0 and not self.zero):
            wanted = "other than zero" if self.negative else "at least zero" if self.zero else "above zero"
            return f"must be {wanted}{self._in()}, got {value!r}"
        if value == 0 or math.isinf(value) or self.low <= size <= self.high:
            return None
        return f"must lie {self.range}, got {value:g} {self.unit}{self.cure(value)}"

    @property
    def range(self) -> str:
        """The range in words, such as "between 1 nm and 2 mm"."""
        low, high = shown(self.low, self.unit), shown(self.high, self.unit)
        if self.high == math.inf:
            return f"at {low} or more"
        if self.low == 0:
            return f"within {'-' * self.negative}{high if self.negative else low} .. {high}"
        return f"within {low} .. {high}" + " in magnitude" * self.negative + " or be 0" * self.zero

    def cure(self, value: float) -> str:
        """What to change, such as the prefix that was forgotten."""
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
        """The unit in full."""
        return "metres" if self.unit == "m" else self.unit

    def _in(self) -> str:
        return f" in {self.words}"


def shown(value: float, unit: str) -> str:
    """A value with its unit, metres with the prefix that suits them, such as "3.74 um"."""
    if unit == "m" and value:
        symbol, scale = next((pair for pair in _SYMBOLS if abs(value) >= pair[1] * (1 - 1e-9)), _SYMBOLS[-1])
        return f"{value / scale:g} {symbol}"
    return f"{value:g} {unit}".rstrip()


# Light, from the extreme ultraviolet to 1 THz: visible light in millimetres (5e-4) lies above.
WAVELENGTH = Quantity("wavelength", "m", 10e-9, 300e-6, (200e-9, 20e-6))
# Full width of a spectrum, or a difference of wavelengths: the line of a stabilised laser to white light.
BANDWIDTH = Quantity("fwhm", "m", 1e-15, 100e-6, (0.1e-9, 500e-9))
WAVELENGTH_CHANGE = Quantity("change", "m", 0.0, 100e-6, (0.1e-9, 500e-9), zero=True, negative=True)
# Samples of a plane: of a wave in fine detail, to a wall some metres away. Pixels in micrometres or millimetres
# (8, 8e-3) lie above.
PITCH = Quantity("pitch", "m", 1e-9, 2e-3, (100e-9, 200e-6))
# Along the axis that light travels on a bench, in a room or through the open air, to either side.
DISTANCE = Quantity("distance", "m", 0.0, 1e3, (1e-3, 3.0), zero=True, negative=True)
# Of pictures and planes of an experiment on either side of a hologram.
PLANE = Quantity("distance", "m", 0.0, 10.0, (1e-3, 3.0), zero=True, negative=True)
# From a hologram, or an eye, to something in front of it.
DEPTH = Quantity("depth", "m", 1e-9, 100.0, (1e-3, 3.0))
# Across the axis: sizes and positions on a plane.
WIDTH = Quantity("width", "m", 1e-9, 10.0, (1e-3, 0.5))
SPREAD = Quantity("spread", "m", 1e-9, 1e3, (1e-6, 0.1))
OFFSET = Quantity("offset", "m", 0.0, 10.0, (1e-6, 0.1), zero=True, negative=True)
# A microlens to a weak spectacle lens.
FOCAL_LENGTH = Quantity("focal_length", "m", 1e-6, 100.0, (1e-3, 1.0), negative=True, infinite=True)
APERTURE_RADIUS = Quantity("aperture radius", "m", 10e-9, 0.5, (10e-6, 50e-3))
# Between the elements of a headset or a bench.
SPACING = Quantity("distance", "m", 0.0, 10.0, (1e-3, 0.5), zero=True)
# Eyes and cameras that stand for them.
PUPIL_RADIUS = Quantity("pupil_radius", "m", 10e-6, 50e-3, (0.5e-3, 10e-3))
EYE_LENGTH = Quantity("axial_length", "m", 1e-3, 0.2, (10e-3, 50e-3))
ACCOMMODATION = Quantity("accommodation", "m", 1e-3, math.inf, (0.05, 10.0), infinite=True)
WAVEFRONT_ERROR = Quantity("wavefront error", "m", 0.0, 1e-3, (1e-9, 10e-6), zero=True, negative=True)
SOFTNESS = Quantity("softness", "m", 0.0, 10e-3, (1e-6, 1e-3), zero=True)
# Voxels of a scan: atoms to a room.
VOXEL = Quantity("volume spacing", "m", 1e-12, 0.1, (1e-6, 5e-3))
# Cauchy's b of a birefringence; 0.0085 um^2 is 8.5e-15.
CAUCHY_B = Quantity("b", "square metres", 0.0, 1e-12, (1e-16, 1e-13), zero=True, negative=True)
# Crosstalk of heaters; beyond it the kernel is singular to double precision.
SIGMA_PX = Quantity("sigma_px", "pixels", 0.0, 100.0, (0.1, 5.0), zero=True)
# Catheters and other tools that are tracked, and where they are.
TOOL_RADIUS = Quantity("radius", "m", 10e-6, 50e-3, (0.2e-3, 20e-3))
TOOL_LENGTH = Quantity("length", "m", 1e-3, 3.0, (10e-3, 2.0))
TOOL_POSITION = Quantity("position", "m", 0.0, 3.0, (5e-3, 2.0), zero=True, negative=True)
EDGE_DEVIATION = Quantity("deviation", "pixels", 1e-9, 1e6, (0.01, 2.0))
TOOL_OFFSET = Quantity("offset", "m", 0.0, 50e-3, (0.1e-3, 20e-3), zero=True, negative=True)
TOOL_DEVIATION = Quantity("deviation", "m", 1e-9, 1.0, (0.1e-3, 50e-3))
# In front of a camera, beside a tool or on a headset.
POSITION = Quantity("position", "m", 0.0, 10.0, (10e-3, 5.0), zero=True, negative=True)
SCREEN = Quantity("size", "m", 1e-3, 100.0, (0.05, 5.0))  # of a display that is looked at, to a planetarium
CAMERA_DEPTH = Quantity("depth", "m", 1e-3, 10.0, (10e-3, 5.0))
BOARD_SQUARE = Quantity("square", "m", 10e-6, 1.0, (1e-3, 0.2))
