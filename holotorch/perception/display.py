"""Thesis Table 2.1 as data, and a check whether a display can show the sizes of a scale."""

from dataclasses import dataclass
from typing import Any, Literal

from torch import Tensor

from holotorch.core import checks
from holotorch.perception import angles
from holotorch.perception.scale import EqualEfficiencyScale

Axis = Literal["horizontal", "diagonal", "full"]


@dataclass(frozen=True)
class WideDisplay:
    """A display technique of Table 2.1, with its largest field of view and its angular resolution.

    Attributes:
        name: Name in the table, with examples.
        field_deg: Field of view along ``axis``.
        height_deg: Vertical field of view; None if it is not reported.
        axis: Axis of ``field_deg``; "full" for a display that surrounds the viewer.
        arcmin: Size of a pixel, (finest, coarsest) in minutes of arc; None if only a pitch is known.
        pitch: Pixel pitch in metres of a holographic display; the angular size of its pixels depends on the eyepiece.
        colour: Whether the display shows RGB; otherwise it has one colour.
        derived: Whether the values are calculated from other reported numbers (* in the table).
        year: Year in the table, if any.
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
        """Greatest eccentricity on the horizon; an upper bound if the field of view is diagonal."""
        return self.field_deg / 2

    @property
    def pixels_per_degree(self) -> float | None:
        """Resolution of the coarsest pixels; None if only a pitch is known."""
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
    """Whether a display can show the sizes of a scale at N eccentricities, both left and right of the fixation point.

    Attributes:
        size_deg: S(E), [N].
        covered: Whether the whole pattern lies within the field of view, [N] bool. If the field of view is diagonal,
            the horizontal one is smaller, so that True only means that the pattern may fit.
        needed: Pixels per degree needed to draw the pattern with the requested samples, [N].
        resolved: Whether the display has this resolution, [N] bool; None if its angular resolution is not known.
        reach_deg: Half the field of view of the display in degrees.
        tested: Whether the size was tested in the study, [N] bool.
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
    """Compare a display with the sizes of patterns on the horizon that ``scale`` gives.

    Args:
        display: A row of ``TABLE_2_1``, or another display.
        scale: Scale of the sizes.
        eccentricity_deg: Eccentricities of the patterns, [N].
        samples: Pixels across a pattern needed to recognise it. With 12, the strokes of a cross or ring are 2.4 pixels
            wide. The resolution of the eye is not considered, because it is no stricter at these sizes.
        extrapolate: As in the call of ``scale``.

    Raises:
        ValueError: As in the call of ``scale``, or ``samples`` is below 1.
    """
    checks.whole("samples", samples, 1)
    eccentricity = angles.eccentricity(eccentricity_deg)
    sizes = scale(eccentricity, extrapolate=extrapolate)
    needed, available = samples / sizes, display.pixels_per_degree
    resolved = None if available is None else needed <= available
    covered = eccentricity + sizes / 2 <= display.half_field_deg
    return DisplayCheck(sizes, covered, needed, resolved, display.half_field_deg, scale.tested(eccentricity))
