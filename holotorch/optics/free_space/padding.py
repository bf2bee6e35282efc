"""How many samples the transforms of kernels with short reach take."""

import math

from holotorch.core.fourier import good_length
from holotorch.optics.free_space.plane_pair import PlanePair

FINEST = 0.9  # wavelengths of pitch below which the factor beyond Fresnel no longer separates
CROP_PAD = 2.25  # of CroppedKernel


def resampled_padding(planes: PlanePair, wavelength: float, distance: float, tails: float = 0.125) -> tuple[int, int]:
    """Samples that hold the window, and on each side what the factor beyond Fresnel moves and its tails.

    ``tails``: their room, as a part of the window.
    """
    steepest = wavelength * math.hypot(*(0.5 / step for step in planes.grid.pitch))
    sizes = []
    for axis, size in enumerate(planes.grid.shape):
        reach = planes.grid.extent[axis] + planes.out.extent[axis] + 2 * abs(planes.offset[axis])
        sine = min(steepest, 0.99, reach / math.hypot(reach, distance))
        moved = distance * (sine / math.sqrt(1 - sine * sine) - sine) / planes.grid.pitch[axis]
        sizes.append(good_length(size + 2 * math.ceil(size * tails + moved)))
    return sizes[0], sizes[1]


def crop_length(
    size: int,
    window: int,
    pitch: float,
    wavelength: float,
    distance: float,
    shift: float = 0.0,
    room: float = CROP_PAD,
) -> int:
    """Samples of a transform that holds the taps of one axis, and twice what is beyond Fresnel adds to their reach.

    Args:
        size: Samples of the source.
        window: Samples of the result.
        pitch: In metres.
        wavelength: In metres.
        distance: In metres, >= 0.
        shift: Where sample 0 of the result lies beside sample 0 of the source, in samples.
        room: Times half of source and result together; 2 holds the taps alone.
    """
    # Light steeper than what lands in the window need not be followed; sqrt(2) for the corner of the band.
    reach = (size + window) * pitch + abs(shift) * pitch
    sine = min(math.sqrt(2) * wavelength * 0.5 / pitch, reach / math.hypot(reach, distance), 0.99)
    moved = distance * (sine / math.sqrt(1 - sine * sine) - sine) if room > 2 else 0.0
    return math.ceil(room * (size + window) / 2 + 2 * moved / pitch) - 1
