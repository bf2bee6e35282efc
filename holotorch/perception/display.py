"""The wide displays of thesis Table 2.1, and a check whether a display can show patterns of given sizes."""

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
        field_deg: Field of view along ``axis``, from edge to edge.
        height_deg: Vertical field of view; None if not reported.
        axis: Direction in which ``field_deg`` is measured; "full" for a display that surrounds the viewer.
        arcmin: Angular size of the (finest, coarsest) pixels in minutes of arc; None if only ``pitch`` is known.
        pitch: Pixel pitch of a holographic display in metres; its ``arcmin`` would depend on the eyepiece.
        colour: Whether the display is in full colour; otherwise it is monochrome.
        derived: Whether the table marks its values with *, as calculated from other reported numbers.
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
        """Half of ``field_deg``, the greatest eccentricity on the horizon; an upper bound if ``axis`` is diagonal."""
        return self.field_deg / 2

    @property
    def pixels_per_degree(self) -> float | None:
        """Pixels per degree where the pixels are coarsest; None if ``arcmin`` is None."""
        return None if self.arcmin is None else 60 / self.arcmin[1]


# Displays for the far periphery, thesis Table 2.1.
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
    """Whether a display can show patterns of size S(E) at N eccentricities E to the left and right of fixation.

    Attributes:
        size_deg: S(E) in degrees, [N].
        covered: Whether the whole pattern lies within the field of view, [N] bool. If the field of view is diagonal,
            the horizontal one is smaller, so that True only means that the pattern may fit.
        needed: Pixels per degree for ``samples`` pixels across the pattern, [N].
        resolved: Whether the display has the ``needed`` resolution, [N] bool; None if its resolution is not known.
        reach_deg: Half the field of view of the display in degrees.
        tested: Whether S(E) is within the sizes that the study of thesis chapter 2 tested, [N] bool.
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
    """Check whether a display is wide and fine enough for patterns on the horizon whose sizes ``scale`` gives.

    Args:
        display: A row of ``TABLE_2_1``, or another display.
        scale: Size S(E) of a pattern over eccentricity.
        eccentricity_deg: Eccentricities E of the pattern centres, [N].
        samples: Pixels that a pattern needs across its width to be recognised. With 12, the strokes of a cross or ring
            are 2.4 pixels wide. The eye's resolution is not checked, because it is finer than these strokes.
        extrapolate: Allow eccentricities outside the fit of ``scale``.

    Raises:
        ValueError: As ``scale(eccentricity_deg)``, or ``samples`` is below 1.
    """
    checks.whole("samples", samples, 1)
    eccentricity = angles.eccentricity(eccentricity_deg)
    sizes = scale(eccentricity, extrapolate=extrapolate)
    needed, available = samples / sizes, display.pixels_per_degree
    resolved = None if available is None else needed <= available
    covered = eccentricity + sizes / 2 <= display.half_field_deg
    return DisplayCheck(sizes, covered, needed, resolved, display.half_field_deg, scale.tested(eccentricity))
