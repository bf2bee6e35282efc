"""Appearance of a synthetic frame: light, colours, occluders and image errors."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Occluder:
    """Flat polygon in front of the catheter: corners (x, y) in pixels, to 0.2 pixels, and 8-bit sRGB colour."""

    corners: tuple[tuple[float, float], ...]
    colour: Colour

    def __post_init__(self) -> None:
        if len(self.corners) < 3:
            raise ValueError(f"an occluder needs at least 3 corners (x, y) in pixels, got {len(self.corners)}")
        if not all(len(corner) == 2 and all(abs(value) < 1e5 for value in corner) for corner in self.corners):
            raise ValueError(f"corners must be pairs (x, y) of finite pixels below 1e5, got {self.corners}")
        _colour("colour", self.colour)

    @staticmethod
    def capsule(start: tuple[float, float], end: tuple[float, float], radius: float, colour: Colour) -> "Occluder":
        """A line segment from ``start`` to ``end``, widened by ``radius`` to all sides, in pixels; such as a finger."""
        checks.positive("radius", radius, "pixels")
        along = math.atan2(end[1] - start[1], end[0] - start[0])
        angles = [along + math.pi * (0.5 + i / 16) for i in range(17)]
        first = [(start[0] + radius * math.cos(a), start[1] + radius * math.sin(a)) for a in angles]
        last = [(end[0] - radius * math.cos(a), end[1] - radius * math.sin(a)) for a in angles]
        return Occluder((*first, *last), colour)


@dataclass(frozen=True, eq=False)
class Look:
    """Appearance of a frame and its image errors. Colours are 8-bit sRGB triples.

    Attributes:
        background: Image uint8 [3, H, W] of the scene without the catheter, already blurred by the lens, or one colour.
        gain: Factor on all light, as by the exposure time.
        light: Direction towards the light in the camera's coordinates, of any length. Its strength is such that a
            surface that faces the camera appears in its given colour; but the strength is at most 4.
        ambient: Share of the light that comes equally from all directions, 0 to 1.
        ramp: Relative change of all light from the centre of the frame to its right and to its lower border.
        highlight: Brightness of the specular reflection of the tube; 1 is that of white paper.
        highlight_width: Standard deviation of the specular lobe in radians.
        tube: Colour of the tube outside the bands.
        opacity: Opacity of the tube outside the bands at normal incidence, 0 to 1; it is higher at oblique incidence.
        blur_px: Standard deviation of the lens's Gaussian point spread function in pixels.
        motion_px: Displacement (x, y) of catheter and occluders during the exposure, in pixels, at constant speed. The
            true pose is that at half of the exposure.
        noise_dn: Standard deviation of white Gaussian noise in 8-bit levels, added after the tone curve.
        video: Whether 2 x 2 pixels share the chroma of one of them (4:2:0), as in video of webcams.
        jpeg_quality: JPEG quality, 1 to 100, with smoothed chroma at half resolution (4:2:0); None for no compression.
        occluders: Polygons in front of the catheter, each in front of the previous ones; they are not shaded.

    Raises:
        TypeError, ValueError: Values outside these ranges.
    """

    background: Tensor | Colour = (120, 120, 120)
    gain: float = 1.0
    light: tuple[float, float, float] = (-0.4, -0.8, -0.6)
    ambient: float = 0.4
    ramp: tuple[float, float] = (0.0, 0.0)
    highlight: float = 0.2
    highlight_width: float = 0.15
    tube: Colour = (228, 228, 222)
    opacity: float = 0.35
    blur_px: float = 0.7
    motion_px: tuple[float, float] = (0.0, 0.0)
    noise_dn: float = 2.5
    video: bool = False
    jpeg_quality: int | None = None
    occluders: tuple[Occluder, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.background, Tensor):
            if self.background.dtype != torch.uint8 or self.background.ndim != 3 or self.background.shape[0] != 3:
                shape = list(self.background.shape)
                raise ValueError(f"background must be uint8 [3, H, W], got {self.background.dtype} {shape}")
        else:
            _colour("background", self.background)
        _colour("tube", self.tube)
        checks.positive("gain", self.gain)
        checks.positive("highlight_width", self.highlight_width, "radians")
        for name, most in (("ambient", 1), ("opacity", 1), ("highlight", 100), ("blur_px", 50), ("noise_dn", 255)):
            if not 0 <= checks.finite(name, getattr(self, name)) <= most:
                raise ValueError(f"{name} must be from 0 to {most}, got {getattr(self, name)!r}")
        for name, count, most in (("light", 3, math.inf), ("ramp", 2, 1), ("motion_px", 2, 200)):
            values = getattr(self, name)
            if len(values) != count or not sum(map(abs, values)) < most:
                raise ValueError(f"{name} must be {count} finite numbers, below {most} in all, got {values!r}")
        if not any(self.light):
            raise ValueError("light must point somewhere, got (0, 0, 0)")
        if self.jpeg_quality is not None and not 1 <= checks.whole("jpeg_quality", self.jpeg_quality, 1) <= 100:
            raise ValueError(f"jpeg_quality must be from 1 to 100 or None, got {self.jpeg_quality}")


def _colour(name: str, value: tuple[int, ...]) -> None:
    if len(value) != 3 or not all(isinstance(one, int) and 0 <= one <= 255 for one in value):
        raise ValueError(f"{name} must be three 8-bit levels (red, green, blue), got {value!r}")
