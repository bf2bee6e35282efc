"""Display: positions of hologram, eyepiece and eye, and the ray matrices between them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import APERTURE_RADIUS, FOCAL_LENGTH, PLANE, SPACING

Length = float | Tensor
Matrix = tuple[Length, Length, Length, Length]


@dataclass(frozen=True)
class Display:
    """Hologram, eyepiece and eye on one axis, such as the volume-magnifying display of the thesis (Fig. 5.5).

    All lengths are in metres; each may be a tensor that carries a gradient.

    Attributes:
        lens_distance: d_el from hologram to eyepiece, at least 0; above ``focal_length`` to magnify a volume.
        focal_length: f_el of the eyepiece, infinite without an eyepiece.
        eye_distance: d_eye from eyepiece to the lens of the eye, at least 0.
        lens_radius: r_el, half the clear width of the eyepiece; None for an unlimited width.

    Raises:
        ValueError: An implausible length, such as a distance below 0, a focal length of 0, or one in millimetres.
    """

    lens_distance: Length
    focal_length: Length
    eye_distance: Length
    lens_radius: Length | None = None

    def __post_init__(self):
        for name in ("lens_distance", "eye_distance"):
            checks.quantity(SPACING, number(getattr(self, name)), name)
        checks.quantity(FOCAL_LENGTH, number(self.focal_length))
        if self.lens_radius is not None:
            checks.quantity(APERTURE_RADIUS, number(self.lens_radius), "lens_radius")

    @classmethod
    def planar(cls, distance: Length) -> "Display":
        """Hologram under a plane wave with the eye at ``distance`` metres, no eyepiece (thesis Fig. 5.4 top)."""
        return cls(distance, math.inf, 0.0)

    @classmethod
    def spherical(cls, focal_length: Length, lens_radius: Length | None = None) -> "Display":
        """Spherical illumination: lens at the hologram, eye at its focal point (thesis Fig. 5.4 bottom)."""
        return cls(0.0, focal_length, focal_length, lens_radius)

    def matrix(self, plane: Length) -> Matrix:
        """Ray matrix (A, B, C, D) from the plane ``plane`` metres from the hologram to the pupil of the eye.

        A = 1 - d_eye / f, B = s0 + d_eye (1 - s0 / f) in metres, C = -1 / f in 1 / metres, D = 1 - s0 / f, with
        s0 = d_el - plane.
        """
        power, s0 = inverse(self.focal_length), self.lens_distance - plane
        back = 1 - s0 * power
        return 1 - self.eye_distance * power, s0 + self.eye_distance * back, -power, back

    def object_plane(self, plane: Length | None, accommodation: Length) -> Length:
        """``plane`` in metres from the hologram, or :meth:`focus_plane` for None; ValueError if implausible."""
        if plane is None:
            return self.focus_plane(accommodation)
        checks.quantity(PLANE, number(plane), "plane")
        return plane

    def focus_plane(self, accommodation: Length) -> Length:
        """Distance in metres from the hologram to the plane that an eye focused at ``accommodation`` sees sharply.

        d_el - s0 with 1 / s0 = 1 / (accommodation - d_eye) + 1 / f; negative on the side away from the eye.

        Raises:
            ValueError: The plane is at infinity.
        """
        s1, power = accommodation - self.eye_distance, inverse(self.focal_length)
        if math.isinf(number(s1)):
            if number(power) == 0:
                raise ValueError("an eye focused at infinity sees no plane of a display without eyepiece; give plane")
            return self.lens_distance - 1 / power
        ratio = 1 + s1 * power  # s1 / s0
        if abs(number(ratio)) < 1e-9:
            raise ValueError(f"an eye focused at {number(accommodation):g} m sees no plane in front of this eyepiece")
        return self.lens_distance - s1 / ratio


def number(value: Length) -> float:
    """The value as a float, without gradient."""
    return float(value.detach() if isinstance(value, Tensor) else value)


def inverse(value: Length) -> Length:
    """1 / value, 0 for infinity."""
    return torch.reciprocal(value) if isinstance(value, Tensor) else (0.0 if math.isinf(value) else 1 / value)
