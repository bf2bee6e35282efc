"""An eye beside the axis, simulated by a tilt and shift of the field for an eye on the axis."""

from torch import Tensor
from torch.nn import functional

from holotorch.core import checks
from holotorch.core.grid import Grid, Pair
from holotorch.optics.light.incoherent import tilted_wave
from holotorch.optics.viewing.display import Display, number


def displaced_eye(
    field: Tensor, grid: Grid, wavelength: float, display: Display, plane: float, position: Pair
) -> tuple[Tensor, Grid]:
    """Field and grid with which an eye on the axis sees what an eye at ``position`` sees of a hologram.

    Light is tilted in ``plane``, by the sine of the angle under which the eye is displaced there: what is sharp in this
    plane stays where it is, and what lies in front of it or behind it moves, as for the displaced eye. On the hologram
    this is a tilt and a shift. The position is rounded such that the shift is a whole number of pixels, 0.02 mm at 30
    mm of depth and 3.74 um. The model is paraxial: beside the axis the eyepiece has no aberrations and no edge.

    Args:
        field: Field of the hologram, complex [..., H, W].
        grid: Its sampling.
        wavelength: In metres.
        display: Positions of hologram, eyepiece and eye.
        plane: Distance in metres from the hologram to the plane that the eye looks at.
        position: Displacement (y, x) of the eye in metres.

    Returns:
        Complex [..., H + 2 |shift y|, W + 2 |shift x|] and its grid, whose middle is that of ``grid``.

    Raises:
        ValueError: No light of the hologram reaches this position, since the pixels do not diffract that far.
    """
    checks.field("field", field, grid.shape)
    (dy, dx), sines = displacement(grid, wavelength, display, plane, position)
    height, width = grid.shape
    wide = Grid((height + 2 * abs(dy), width + 2 * abs(dx)), grid.pitch)
    moved = functional.pad(field, (abs(dx) + dx, abs(dx) - dx, abs(dy) + dy, abs(dy) - dy))
    tilt = tilted_wave(wide, wavelength, sines).to(field.device, field.dtype)
    return (moved * tilt if any(sines) else moved), wide


def displacement(
    grid: Grid, wavelength: float, display: Display, plane: float, position: Pair
) -> tuple[tuple[int, int], Pair]:
    """Shift (y, x) in pixels and sines (y, x) of the tilt of :func:`displaced_eye`; its arguments and ValueError."""
    spread, plane = number(display.matrix(plane)[1]), checks.finite("plane", plane, "metres")
    sines, shift = [], []
    for name, at, pitch in zip("yx", checks.pair("position", position, "metres"), grid.pitch, strict=True):
        pixels = round(plane * at / spread / pitch)
        sine = at / spread if plane == 0 else pixels * pitch / plane
        if abs(sine) >= wavelength / (2 * pitch):
            raise ValueError(
                f"position of the eye must be within {abs(spread) * wavelength / (2 * pitch):.3g} m of the axis, where "
                f"pixels of {pitch:g} m send light of {wavelength:g} m, got {name} = {at:g} m"
            )
        sines.append(-sine)
        shift.append(pixels)
    return (shift[0], shift[1]), (sines[0], sines[1])
