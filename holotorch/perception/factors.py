"""Laws of the perception time over the contrast and the motion of a pattern, beside its size and eccentricity.

The thesis names both as open questions (Sec. 6.1) and measures neither. The laws are taken from the abstracts of other
studies, with other patterns and mostly nearer to the fixation point; how large their effects are in the far periphery
is unknown.
"""

from typing import Any

from torch import Tensor

from holotorch.perception import angles

MOTION_E2_DEG = 8.0  # degrees: speeds count as slower by the factor 1 + E / 8 deg at eccentricity E


def contrast_term(contrast: Any) -> Tensor:
    """1 / C - 1: perception time grows linearly with the reciprocal of the contrast C; 0 at a contrast of 1.

    Args:
        contrast: Weber contrast of a dark pattern, in (0, 1]: 1 - L / L0 for luminance L on a background L0; any shape.

    Raises:
        ValueError: A contrast is outside (0, 1].

    Source: Plainis and Murray, Neuropsychologia 38, 1555 (2000), for gratings of 7.2 deg with contrasts up to 0.5.
    Burkhardt, Gottesman and Keenan, J. Opt. Soc. Am. A 4, 530 (1987), find the power -0.67 of the luminance step for
    small foveal spots, of which this is a steeper variant. Assumed: the law extends to a contrast of 1 and to the
    far periphery.
    """
    values = angles.as_tensor("contrast", contrast, "one of 0 .. 1")
    angles.require((values > 0) & (values <= 1), "contrast must be above 0 and at most 1", values)
    return 1 / values - 1


def motion_term(speed_deg_s: Any, eccentricity_deg: Any) -> Tensor:
    """1 - (1 + v)^(-2/3) with v = V / (1 + E / 8 deg) in deg/s: from 0 for a pattern at rest to 1 for a fast one.

    Args:
        speed_deg_s: Speed V >= 0 in degrees per second; broadcasts with the eccentricity.
        eccentricity_deg: Eccentricity E in degrees, 0 to 180.

    Raises:
        ValueError: A speed is below 0, or an eccentricity outside 0 to 180 deg.

    Source: the power -2/3 is that of reaction times to the onset of motion up to 16 deg/s (Dzhafarov, Sekuler and
    Allik, Perception & Psychophysics 54, 733 (1993)). The scale of the speed is linear in the eccentricity, as in
    McKee and Nakayama, Vision Research 24, 25 (1984): speeds are discriminated best from 5 deg/s in the fovea and
    from 30 deg/s at 40 deg, so that 1 + 40 / E2 = 6 and E2 = 8 deg. Assumed: 1 is added to v so that a pattern at rest
    has a finite time, since its appearance alone is perceived; the law extends beyond 40 deg; and motion shortens the
    time of a pattern that appears, as it does for motion that begins.
    """
    speed, eccentricity = angles.as_tensor("speed_deg_s", speed_deg_s, "deg/s"), angles.eccentricity(eccentricity_deg)
    angles.require(speed >= 0, "speed_deg_s must not be below 0", speed)
    return 1 - (1 + speed / (1 + eccentricity / MOTION_E2_DEG)) ** (-2 / 3)
