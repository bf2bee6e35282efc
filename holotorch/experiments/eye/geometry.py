"""Geometry of a display and its observer as numbers, text and a drawing to scale (thesis Sec. 5.4 and 5.6.2)."""

import math
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from holotorch.experiments.eye.config import MagnifyingSettings, PlanarSettings, SphericalSettings
from holotorch.experiments.eye.experiment import PRESETS, Observer
from holotorch.experiments.runs.figures import figure_png
from holotorch.optics.viewing import display_geometry as viewing

_COLOURS = ("tab:red", "tab:green", "tab:blue")  # colours of the curves of the first wavelengths
_ROMAN = ("none", "I", "II", "III")  # names of the regions 0 to 3 of ``display_geometry.region``
_REGIONS = (  # meanings of the regions
    "no light of the point reaches the hologram",
    "the hologram holds the whole cone of light of a point, so spots are smallest",
    "the hologram holds part of the cone of light",
    "the cone of light covers the whole hologram, so spots grow with distance",
)
_INVISIBLE = 0.005  # the edge of the scene is invisible if a smaller fraction of its light enters the pupil
_NEAREST = 1e3 / 11  # mm; eyes of 20 years accommodate by 11 dioptres, and older ones by fewer (Duane 1912)
_AGES = "eyes accommodate by 11 at the age of 20, by 4 at 45"
_LITTLE = 0.01  # share of the light of the scene's centre in the pupil below which pictures are dim


def geometry(eye: Observer) -> dict[str, Any]:
    """Fields of view, eye box, regions and spots of an observer's display as JSON values; each key names its unit."""
    scene, display = eye.scene, eye.settings.display
    width, pitch, wavelengths = scene.grid.extent[1], scene.grid.pitch[1], scene.settings.wavelengths
    near, far = min(scene.depths), max(scene.depths)
    values: dict[str, Any] = {
        "wavelengths_nm": [1e9 * w for w in wavelengths],
        "planar_fov_deg": [math.degrees(viewing.planar_fov(pitch, w)) for w in wavelengths],
        "scene_mm": [1e3 * scene.width, 1e3 * (far - near)],
        "region_of_centre": [viewing.region(0.0, scene.distance, width, pitch, w) for w in wavelengths],
        "region_of_edge": [viewing.region(scene.width / 2, near, width, pitch, w) for w in wavelengths],
        "placement_mm": 1e3 * max(viewing.placement(scene.width, width, pitch, w, far - near) for w in wavelengths),
        "smallest_spot_um": [
            [1e6 * viewing.smallest_spot(w, z, viewing.section(0.0, z, width, pitch, w)) for w in wavelengths]
            for z in (near, far)
        ],
        "accommodation_mm": [_accommodation_mm(eye, z) for z in (far, near)],  # ``far`` appears nearer to the eye
    }
    first, second, _, _ = (float(value) for value in eye.display.matrix(scene.distance))
    pupil = eye.settings.eye.pupil_radius
    # The pitch or the width of the hologram limits the half angle of the light cone of a point.
    sines = [min(w / (2 * pitch), math.sin(math.atan(width / 2 / scene.distance))) for w in wavelengths]
    values["eye_box_mm"] = [1e3 * viewing.eye_box(scene.width, first, second, sine) for sine in sines]
    spread = abs(second) * np.array(sines)  # radius of the light of the scene's centre on the pupil's plane
    values["light_in_pupil"] = [float(min(1.0, pupil / width) ** 2) for width in spread]
    values["light_of_edge"] = [viewing.vignetting(scene.width / 2, first, second, pupil, sine) for sine in sines]
    if isinstance(display, MagnifyingSettings):
        to_lens = float(eye.display.lens_distance) - scene.distance
        lengths = display.focal_length, display.eye_distance
        field = viewing.magnified_fov(width, display.focal_length)
        values |= {
            "magnified_fov_deg": math.degrees(field),
            "scene_fov_deg": math.degrees(viewing.scene_fov(scene.width, to_lens, *lengths)),
            "filling_scene_mm": 1e3 * viewing.volume_size(field, display.focus_distance, *lengths),
        }
    if isinstance(display, SphericalSettings):
        field = viewing.magnified_fov(width, display.focal_length)
        values |= {
            "magnified_fov_deg": math.degrees(field),
            "scene_fov_deg": 2 * math.degrees(math.atan(scene.width / 2 / display.focal_length)),
            "filling_scene_mm": 1e3 * width,
        }
    return values


def in_words(values: dict[str, Any]) -> list[str]:
    """Lines of a plan for the result of :func:`geometry`."""
    fields = f"of view {_span(values['planar_fov_deg'])} deg without an eyepiece"
    if "scene_fov_deg" in values:
        fields += (
            f", {values['magnified_fov_deg']:.4g} deg with it, of which the scene spans {values['scene_fov_deg']:.3g} "
            f"deg; a scene {values['filling_scene_mm']:.4g} mm wide would fill it"
        )
    near, far = (f"{z:.4g}" if z else "beyond infinity" for z in values["accommodation_mm"])
    dioptres = " to ".join(f"{1e3 / z:.2g}" for z in values["accommodation_mm"] if z)
    regions = sorted({*values["region_of_centre"], *values["region_of_edge"]})
    meanings = "; ".join(f"{_ROMAN[number]}: {_REGIONS[number]}" for number in regions)
    meanings += "; this cone is as wide as the pixels can bend light"
    colours = " / ".join(f"{wavelength:.0f}" for wavelength in values["wavelengths_nm"])
    spots = [_span(row) for row in values["smallest_spot_um"]]
    entering = _span([100 * share for share in values["light_of_edge"]])
    lines = [
        f"Field      {fields}",
        f"Eye box    {_span(values['eye_box_mm'])} mm wide; {entering} % of the light from the scene's edge enters the "
        f"pupil; the scene appears {near} to {far} mm from the eye"
        + (f" ({dioptres} dioptres; {_AGES})" if dioptres else ""),
        f"Regions    by colour ({colours} nm): centre {_list(values['region_of_centre'])}, edge "
        f"{_list(values['region_of_edge'])} ({meanings}); the whole scene is in region III from "
        f"{values['placement_mm']:.4g} mm; spots of {spots[0]} um at the near end, {spots[1]} um at the far end",
    ]
    return [*lines, *(f"WARNING    {warning}" for warning in warnings(values))]


def warnings(values: dict[str, Any]) -> list[str]:
    """Reasons why pictures are dim or incomplete, from the result of :func:`geometry`; a sentence each."""
    lines = []
    if (least := min(values["light_of_edge"])) < _INVISIBLE:
        lines.append(
            "the edge of the scene is invisible to this eye; enlarge eye.pupil_radius or narrow the scene "
            f"(view.width of its configuration): {100 * least:.2g} % of the light of the edge enters the pupil, and "
            f"below {100 * _INVISIBLE:g} % it counts as invisible"
        )
    elif min(values["eye_box_mm"]) <= 0:
        lines.append(
            "no position of the pupil shows the whole scene at its full brightness (an eye box of 0 mm): its edge gets "
            "darker; narrow the scene (view.width of its configuration) or enlarge eye.pupil_radius"
        )
    if (least := min(values["light_in_pupil"])) < _LITTLE:
        lines.append(
            f"only {100 * least:.2g} % of the light of the scene's centre enters the pupil: pictures are dim (below "
            f"{100 * _LITTLE:g} %); enlarge eye.pupil_radius, or move eye or lens"
        )
    if 0 < (nearest := min(each or math.inf for each in values["accommodation_mm"])) < _NEAREST:
        lines.append(
            f"the scene appears {nearest:.3g} mm from the eye ({1e3 / nearest:.2g} dioptres), nearer than eyes focus: "
            "11 dioptres at the age of 20, 4 at 45; the simulated eye can; the distances and focal "
            "length in display say where the scene appears"
        )
    return lines


def _accommodation_mm(eye: Observer, depth: float) -> float | None:
    """Distance in mm from the eye at which a depth appears; None if it lies beyond the eyepiece's focal length."""
    try:
        return 1e3 * eye.accommodation(depth)
    except ValueError:
        return None


def draw(eye: Observer) -> bytes:
    """PNG: display and eye to scale along the axis, regions I to III with the scene, and spectra of the sources."""
    figure = Figure(figsize=(17, 4.8), layout="constrained")
    along, regions, spectra = figure.subplots(1, 3, width_ratios=(1.5, 1, 1))
    _draw_display(along, eye)
    _draw_regions(regions, eye)
    for source in eye.settings.light.sources:
        for c, wavelength in enumerate(eye.scene.settings.wavelengths):
            colour = _COLOURS[c] if c < len(_COLOURS) else f"C{c + 1}"
            spectrum = PRESETS[source](wavelength)
            band = np.linspace(*spectrum.band(), 201)
            power = spectrum.power(band).numpy()
            style = ("-", "--", "-.", ":")[list(PRESETS).index(source)]
            label = source.replace("_", " ") if colour == _COLOURS[0] else None
            spectra.plot(1e9 * band, power / power.max(), style, color=colour, label=label)
    spectra.set(xlabel="wavelength (nm)", ylabel="power relative to its peak, within the band that is used")
    spectra.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.62, 1.0))
    spectra.grid(alpha=0.3)
    return figure_png(figure)


def _draw_display(axes: Any, eye: Observer) -> None:
    """Draw hologram, scene, eyepiece and eye, with rays from the ends of the scene to the edges of the pupil."""
    scene, display = eye.scene, eye.settings.display
    half, pupil = 1e3 * scene.grid.extent[0] / 2, 1e3 * eye.settings.eye.pupil_radius
    lens, back = (1e3 * float(value) for value in (eye.display.lens_distance, eye.display.eye_distance))
    end, retina = lens + back, 1e3 * eye.settings.eye.axial_length
    text: dict[str, Any] = {"ha": "center", "fontsize": 8}
    axes.plot([0, 0], [-half, half], "k", linewidth=4)
    axes.text(0, half * 1.05, "hologram", va="bottom", **text)
    _draw_scene(axes, eye)
    first, second, _, _ = (float(value) for value in eye.display.matrix(scene.distance))
    focal = math.inf if isinstance(display, PlanarSettings) else display.focal_length
    for height in (-scene.width / 2, 0.0, scene.width / 2):
        for side in (-1, 1):
            # The ray transfer matrix to the pupil gives the slope of the ray that ends at the edge of the pupil.
            slope = (side * pupil / 1e3 - first * height) / second
            at_lens = height + slope * (lens / 1e3 - scene.distance)
            behind_lens = slope - at_lens / focal
            positions, heights = [lens, end], [at_lens, at_lens + behind_lens * back / 1e3]
            if lens > scene.distance * 1e3:  # otherwise the lens is at the hologram
                positions, heights = [scene.distance * 1e3, *positions], [height, *heights]
            axes.plot(positions, [1e3 * value for value in heights], color="tab:orange", linewidth=0.8)
    if math.isfinite(focal):
        half_width = max(half, pupil) * 1.6
        arrow = {"arrowstyle": "<->", "color": "tab:blue"}
        axes.annotate("", (lens, half_width), (lens, -half_width), arrowprops=arrow)
        axes.text(
            lens, -half_width * 1.05, f"{'eyepiece' if lens else 'lens'}, f {1e3 * focal:.3g} mm", va="top", **text
        )
    for sign in (-1, 1):
        axes.plot([end, end], [sign * pupil, sign * max(2.5 * pupil, half)], "k", linewidth=2)
    axes.plot([end + retina] * 2, [-retina / 6, retina / 6], color="0.4", linewidth=3)
    share = axes.get_xaxis_transform()  # heights are fractions of the height of the axes
    for position, name in ((end, "pupil  "), (end + retina, "retina  ")):
        axes.text(position, 0.97, name, ha="right", va="top", fontsize=8, transform=share)
    axes.set(xlabel="along the axis (mm from the hologram)", ylabel="height (mm)")
    axes.set_title("display and eye: rays from the scene to the edge of the pupil", fontsize=10)
    axes.grid(alpha=0.3)


def _draw_regions(axes: Any, eye: Observer) -> None:
    """Draw the regions at the shortest wavelength, whose light cone is the narrowest, and the outline of the scene."""
    scene = eye.scene
    width, pitch, wavelength = scene.grid.extent[0], scene.grid.pitch[0], min(scene.settings.wavelengths)
    apex = viewing.region_apex(width, pitch, wavelength)
    deep = 1.15 * max(2 * apex, max(scene.depths))
    high = 1.1 * max(width, scene.width)
    # The half width of a cone grows with distance, by half the hologram's width up to the apex.
    z = 1e3 * np.array([0, apex, deep])
    cone, half = z / (1e3 * apex) * 1e3 * width / 2, 1e3 * width / 2
    for edge, kind in ((half + cone, 2), (np.maximum(half - cone, 0), 1), (np.maximum(cone - half, 0), 3)):
        axes.fill_between(z, -edge, edge, color=colormaps["Blues"](kind / 4), linewidth=0)
    for name, distance, height in (("I", 0.5 * apex, 0.0), ("II", apex, width / 2), ("III", 1.6 * apex, 0.0)):
        colour = "white" if name == "III" else "black"
        axes.text(1e3 * distance, 1e3 * height, name, ha="center", va="center", color=colour)
    axes.plot([0, 0], [-1e3 * width / 2, 1e3 * width / 2], "k", linewidth=4)
    _draw_scene(axes, eye)
    axes.set(xlabel="distance from the hologram (mm)", ylabel="height (mm)")
    axes.set(xlim=(0, 1e3 * deep), ylim=(-1e3 * high, 1e3 * high))
    axes.set_title(f"regions of a point at {1e9 * wavelength:.0f} nm, and the scene", fontsize=10)


def _draw_scene(axes: Any, eye: Observer) -> None:
    near, far, width = (1e3 * size for size in (min(eye.scene.depths), max(eye.scene.depths), eye.scene.width))
    corner, below = (near, -width / 2), -width / 2 * 1.1
    axes.add_patch(Rectangle(corner, far - near, width, fill=False, edgecolor="tab:red", linewidth=1.5))
    plate = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1}
    axes.text((near + far) / 2, below, "scene", ha="center", va="top", fontsize=8, color="tab:red", bbox=plate)


def _span(values: list[float]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def _list(values: list[int]) -> str:
    return _ROMAN[values[0]] if len({*values}) == 1 else " / ".join(_ROMAN[value] for value in values)
