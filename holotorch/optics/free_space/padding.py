"""FFT lengths for cropped taps and for the factor beyond Fresnel (exact divided by paraxial transfer function)."""

import math

from holotorch.core.fourier import good_length
from holotorch.optics.free_space.plane_pair import PlanePair

FINEST = 0.9  # smallest pitch, in wavelengths, at which the factor beyond Fresnel may be applied separately
CROP_PAD = 2.25  # FFT length of CroppedKernel, as a multiple of the mean number of samples of source and result


def resampled_padding(planes: PlanePair, wavelength: float, distance: float, tails: float = 0.125) -> tuple[int, int]:
    """Number of samples (y, x) of the FFTs that apply the factor beyond Fresnel before resampling.

    They hold the source window and, on each side, the lateral shift by the factor and the tails of its impulse
    response, for which ``tails`` times the window is reserved.
    """
    steepest = wavelength * math.hypot(*(0.5 / step for step in planes.grid.pitch))
    sizes = []
    for axis, size in enumerate(planes.grid.shape):
        lateral = planes.grid.extent[axis] + planes.out.extent[axis] + 2 * abs(planes.offset[axis])
        moved = _shift_beyond_fresnel(steepest, lateral, distance) / planes.grid.pitch[axis]
        sizes.append(good_length(size + 2 * math.ceil(size * tails + moved)))
    return sizes[0], sizes[1]


def crop_length(
    size: int, window: int, pitch: float, wavelength: float, distance: float, shift: float = 0.0, pad: float = CROP_PAD
) -> int:
    """Number of samples of an FFT that holds the taps of one axis and the lateral shift beyond Fresnel.

    Args:
        size: Number of samples of the source.
        window: Number of samples of the result.
        pitch: In metres.
        wavelength: In metres.
        distance: In metres, >= 0.
        shift: Position of sample 0 of the result relative to sample 0 of the source, in samples.
        pad: Length as a multiple of the mean number of samples of source and result. 2 holds the taps alone.
    """
    lateral = (size + window) * pitch + abs(shift) * pitch
    steepest = math.sqrt(2) * wavelength * 0.5 / pitch  # in the corner of the band
    moved = _shift_beyond_fresnel(steepest, lateral, distance) if pad > 2 else 0.0
    return math.ceil(pad * (size + window) / 2 + 2 * moved / pitch) - 1


def _shift_beyond_fresnel(steepest: float, lateral: float, distance: float) -> float:
    """Shift in metres by the factor beyond Fresnel, for sines up to ``steepest`` and moves up to ``lateral``."""
    sine = min(steepest, lateral / math.hypot(lateral, distance), 0.99)
    return distance * (sine / math.sqrt(1 - sine * sine) - sine)
