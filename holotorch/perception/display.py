"""Thesis Table 2.1 as data, and whether a display can show what the scale asks for."""

from dataclasses import dataclass
from typing import Any, Literal

from torch import Tensor

from holotorch.core import checks
from holotorch.perception import angles
from holotorch.perception.scale import EqualEfficiencyScale

Axis = Literal["horizontal", "diagonal", "full"]


@dataclass(frozen=True)
class WideDisplay:
    """A display technique of Table 2.1, with its greatest field and its angular resolution.

    Attributes:
        name: As printed, with examples; ``year`` where one is printed.
        field_deg: Field of view along ``axis``.
        height_deg: Vertical field, where it is reported.
        axis: Along which ``field_deg`` is. "full" surrounds the viewer.
        arcmin: Size of a pixel, (finest, coarsest) in minutes of arc; None where only a pitch is known.
        pitch: In metres, of a holographic display inside its depth of field; its angle depends on the eyepiece.
        colour: RGB, or else one colour.
        derived: Calculated from other reported numbers (* in the table).
    """

    name: str
    field_deg: float
    height_deg: float | None = None
    axis: Axis = "horizontal"
    arcmin: tuple[float, float] | None = None
    pitch: float | None = None
    colour: bool = True
    derived: bool = True
    year: int | None = None

    @property
    def half_field_deg(self) -> float:
        """Greatest eccentricity that it covers on the horizon; for a diagonal field, more than that."""
        return self.field_deg / 2

    @property
    def pixels_per_degree(self) -> float | None:
        """Of its coarsest pixels; None where only a pitch is known."""
        return None if self.arcmin is None else 60 / self.arcmin[1]


TABLE_2_1 = (
    WideDisplay("Spherical wave holographic display", 80, pitch=3.74e-6, derived=False, year=2017),
    WideDisplay("Stereoscopic factored light field synthesis", 87, 91, arcmin=(4.1, 4.1), year=2015),
    WideDisplay("Flexible mirror membrane", 90, 45, arcmin=(3.4, 3.4), year=2017),
    WideDisplay("LCD and optics (Meta 2)", 90, 50, arcmin=(3, 3), derived=False),
    WideDisplay(
        "Detachable display and optics (Samsung Gear VR, Google Daydream)", 100, axis="diagonal", arcmin=(2.5, 2.5)
    ),
    WideDisplay("Pinlight", 110, axis="diagonal", arcmin=(4.5, 4.5), colour=False, year=2014),
    WideDisplay("Tiling display and Fresnel lenses", 150, 100, arcmin=(3, 3), derived=False, year=2003),
    WideDisplay("LCD and catadioptrical optics", 180, arcmin=(5.7, 10.5), year=2003),
    WideDisplay("Projector and hyperbolic mirror", 190, arcmin=(60, 60), year=2007),
    WideDisplay("Sparse peripheral display", 190, arcmin=(5.5, 5.5), year=2016),
    WideDisplay("OLED and Fresnel optics (HTC Vive, Oculus Rift, StarVR)", 210, 130, arcmin=(5.5, 5.5)),
    WideDisplay("Curve display and optics", 318, 130, arcmin=(5.4, 7.5), year=2016),
    WideDisplay("CAVE", 360, axis="full", arcmin=(1.5, 3)),
    WideDisplay("Tiled desktop displays", 360, axis="full", arcmin=(3, 4)),
)


@dataclass(frozen=True, eq=False)
class DisplayCheck:
    """What a display can do of what a scale asks, for N eccentricities to both sides of the fixation point.

    Attributes:
        size_deg: S(E), [N].
        covered: The pattern lies within the field of view entirely, [N] bool. For a diagonal field, whose horizontal
            part is smaller, True is a "perhaps".
        needed: Pixels per degree to draw it with the samples asked for, [N].
        resolved: The display has as many, [N] bool; None where its angular resolution is not known.
        reach_deg: Half the field of view.
        tested: Sizes among those that the study showed, [N] bool.
    """

    size_deg: Tensor
    covered: Tensor
    needed: Tensor
    resolved: Tensor | None
    reach_deg: float
    tested: Tensor


def check_display(
    display: WideDisplay,
    scale: EqualEfficiencyScale,
    eccentricity_deg: Any,
    *,
    samples: int = 12,
    extrapolate: bool = False,
) -> DisplayCheck:
    """Compare a display with the patterns that ``scale`` asks for on the horizon.

    Args:
        display: A row of ``TABLE_2_1``, or one's own.
        scale: Gives the sizes.
        eccentricity_deg: Where patterns are wanted, [N].
        samples: Pixels across a pattern that tell it from others; 12 leave a cross or a ring a stroke of two and gaps
            of four. The eye's own limit is not part of this: at these sizes it is no stricter.
        extrapolate: As in the call of ``scale``.

    Raises:
        ValueError: As the call of ``scale``; ``samples`` below 1.
    """
    checks.whole("samples", samples, 1)
    where = angles.eccentricity(eccentricity_deg)
    sizes = scale(where, extrapolate=extrapolate)
    needed = samples / sizes
    have = display.pixels_per_degree
    resolved = None if have is None else needed <= have
    covered = where + sizes / 2 <= display.half_field_deg
    return DisplayCheck(sizes, covered, needed, resolved, display.half_field_deg, scale.tested(where))
