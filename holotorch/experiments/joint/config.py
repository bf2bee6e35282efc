"""Settings of a volume that frames of a phased array show, corrected for the views of an eye."""

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from holotorch.core.quantities import SIGMA_PX
from holotorch.experiments.config.settings import (
    Count,
    ExistingPath,
    GridSettings,
    Number,
    Phase,
    Settings,
    TemperatureRise,
    Wavelength,
    number,
    plausible,
    several,
)
from holotorch.experiments.config.source import Key
from holotorch.experiments.volume.config import Depth, TransferSettings, ViewSettings, VolumeSource

MOST_PLANES = 256
PLANES = 5  # number of planes of a run without tolerance, if it is not stated
FOCI_PER_STEP = 2  # foci of the whole pupil that each step takes, if it takes some of the views
Baseline = Literal["random", "afterwards", "unheated", "light_field", "retrieved", "retrieved_pec", "slabs"]
BASELINES: tuple[Baseline, ...] = ("random", "afterwards", "slabs")  # of a run that names none


class DisplaySettings(GridSettings):
    """The phased array, and where the volume appears behind it.

    ``distance``: distance of the volume's middle. ``depth``: the volume is stretched along the axis to this extent,
    since one as deep as it is wide would be sharp at every focus; not stretched by default. ``planes``: number of
    planes that hold its light; by default 5, or as many as the tolerance of the run needs (up to 64, with slabs one
    per frame). ``sigma_px``: width of the heat kernel, see ``ThermalCrosstalk``. ``kernel``: in its place, whatever
    ``sigma_px`` says, a measured one, a NumPy or CSV file as in runs of kind pec. ``max_phase``: upper limit in rad on
    the phase of every pixel after the heat has spread (4 pi is 700 degC at 630 nm). ``max_temperature``: in its place a
    limit on the temperature of every pixel above ambient, such as 500 degC, which gives
    one limit in phase for all colours. ``rad_per_K``, ``rad_per_K_at``: as of a chip in runs of kind pec.
    """

    distance: Depth
    depth: Depth | None = None
    planes: Annotated[Count, Field(le=MOST_PLANES)] | None = None
    sigma_px: Annotated[Number, plausible(SIGMA_PX)] = 0.66
    kernel: ExistingPath | None = None
    max_phase: Phase = 4 * math.pi
    max_temperature: TemperatureRise | None = None
    rad_per_K: Annotated[Number, Field(ge=1e-5, le=10)] = math.pi / 175
    rad_per_K_at: Wavelength = 630e-9

    @property
    def reference_response(self) -> float:
        """Phase in rad per kelvin at the reference wavelength of ``PhasedArray``, 630 nm."""
        return self.rad_per_K * self.rad_per_K_at / 630e-9


class EyeSettings(Settings):
    """The eye, which looks from far away and may focus on every depth.

    ``pupil``: radius of the pupil, relative to the largest sine that the array emits at the shortest wavelength;
    pixels resolve the image up to 0.5. ``parallax``: number of parts of the pupil, with random foci, that are corrected
    too, so that the image also holds for parts of the pupil: in turn smaller circles and pupils that an edge covers by
    half. ``per_step``: number of these parts, and of two foci of the whole pupil, that each step takes at random, so
    that there may be many parts; by default each step takes all.
    ``occlusion``: for all pupils, planes occlude each other as along the axis (``axis``), or for each pupil as in its
    directions (``pupil``).
    """

    pupil: Annotated[Number, Field(gt=0, le=1)] = 0.5
    parallax: Annotated[int, BeforeValidator(number), Field(ge=0, le=1000)] = 0
    per_step: Count | None = None
    occlusion: Literal["axis", "pupil"] = "axis"


class HeatSettings(Settings):
    """Heat that is left from earlier frames: duration of a frame and time constant of a pixel, in microseconds."""

    frame_us: Annotated[Number, Field(gt=0, le=1e9)]
    time_constant_us: Annotated[Number, Field(gt=0, le=1e9)]


class JointReport(Settings):
    """Methods that the result is compared with.

    ``random``: an ideal display of complex fields with random phases, averaged over the frames. ``afterwards``: the
    phases of such fields, corrected for the heat frame by frame. ``unheated``: optimised for the same views without
    heat, then corrected for it. ``light_field``: the same by Adam for a single random view in each step, a whole pupil
    or a smaller one. ``retrieved``: Gerchberg-Saxton phase retrieval over all views, heat ignored;
    ``retrieved_pec``: the same with a deconvolution in each pass (thesis Algorithm 1). ``slabs``: each frame shows one
    plane of the volume, as in thesis Fig. 4.18; a run that names none leaves it out if frames are fewer than planes.
    """

    baselines: Annotated[tuple[Baseline, ...], BeforeValidator(several)] = BASELINES


class JointSettings(Settings):
    """A volume shown by ``frames`` heater patterns in turn, optimised together for what an eye sees at every focus.

    One wavelength shows the mean of the volume's colours, three show red, green and blue, others share these as in runs
    of kind volume. ``steps``: largest number of steps, of L-BFGS, or of Adam where each step takes other views
    (``eye.per_step``), which are shorter and more. ``light_weight``: weight of the light that misses the
    pupil or the window, against the error of the images.
    ``heat``: heat that is left from earlier frames is part of the model; by default each frame starts cold.
    ``tolerance``: allowed relative L2 error of the images, divided between the taps of the heat kernel, the planes
    (``display.planes``), the padding and precision of the propagation, and the stopping rule; without it all steps are
    taken. It does not bound the error that remains because the array cannot form the images.
    """

    elsewhere: ClassVar[dict[str, str]] = {
        "modulator": "display describes the chip, by sigma_px or kernel, max_phase or max_temperature, and rad_per_K",
        "hologram": "display has shape, pitch, distance and planes",
        "solver": "steps is the largest number of steps",
        "scale": "the chip keeps its size; fewer pixels by display.shape, with a view.width to match, take less time",
    }

    experiment: Literal["joint"]
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    tolerance: Annotated[Number, Field(gt=0, lt=1)] | None = None
    volume: VolumeSource
    transfer: TransferSettings
    view: ViewSettings = ViewSettings()
    display: DisplaySettings
    wavelengths: Annotated[tuple[Wavelength, ...], BeforeValidator(several)]
    frames: Annotated[Count, Field(le=256)] = 8
    eye: EyeSettings = EyeSettings()
    light_weight: Annotated[Number, Field(ge=0, le=100)] = 0.0
    heat: HeatSettings | None = None
    steps: Annotated[Count, Field(le=100000)] = 60
    report: JointReport = JointReport()

    @property
    def limit(self) -> float:
        """Upper limit in rad on the phase after the heat has spread, of all colours.

        A limit on the temperature is that of the colour whose phase is smallest at this temperature.
        """
        display = self.display
        if display.max_temperature is None:
            return display.max_phase
        return display.max_temperature * display.rad_per_K * display.rad_per_K_at / max(self.wavelengths)

    @property
    def comparisons(self) -> tuple[Baseline, ...]:
        """``report.baselines``; of the default ones without "slabs", if frames are too few for it."""
        names = self.report.baselines
        few = names == BASELINES and self.frames < _least_planes(self)
        return tuple(name for name in names if not (few and name == "slabs"))


def _least_planes(settings: JointSettings) -> int:
    """Planes that a run has at least."""
    return settings.display.planes or (PLANES if settings.tolerance is None else 1)


def volume_settings(settings: JointSettings, planes: int | None = None) -> dict[str, Any]:
    """The same scene as settings of kind ``volume``, with ``planes`` in place of the number in the settings."""
    display = settings.display
    hologram = {"shape": display.shape, "pitch": display.pitch, "distance": display.distance}
    hologram["depths"] = (display.planes or PLANES) if planes is None else planes
    # A single wavelength shows the mean of three rendered colours.
    wavelengths = settings.wavelengths if len(settings.wavelengths) > 1 else settings.wavelengths * 3
    same = {name: getattr(settings, name) for name in ("seed", "device", "volume", "transfer", "view")}
    return {"experiment": "volume", "hologram": hologram, "wavelengths": wavelengths, **same}


def contradictions(settings: JointSettings) -> list[tuple[Key, str]]:
    """Settings that contradict each other: their keys, and what to change."""
    from holotorch.experiments.volume import config as volume

    problems: list[tuple[Key, str]] = []
    if not settings.wavelengths:
        return [(("wavelengths",), "expected 1 (grey), 3 (red, green, blue) or another number, got 0")]
    display = settings.display
    renamed: dict[Key, Key] = {("hologram", "distance"): ("display", "distance")}
    scene = volume.VolumeSettings.model_validate(volume_settings(settings))
    problems += [(renamed.get(key, key), words) for key, words in volume.contradictions(scene) if key != ("scale",)]
    if min(display.shape) < 11:
        problems.append((("display", "shape"), f"expected at least 11 x 11 px for ssim, got {display.shape}"))
    if display.depth is not None and display.depth >= 2 * display.distance:
        message = (
            f"expected less than twice the distance, {2 * display.distance:g} m, so that all lies behind the array"
        )
        problems.append((("display", "depth"), f"{message}, got {display.depth:g} m"))
    if min(display.pitch) < 0.9 * max(settings.wavelengths):
        least = f"at least 0.9 of the longest wavelength, {0.9 * max(settings.wavelengths):.3g} m"
        problems.append((("display", "pitch"), f"expected {least}, got {min(display.pitch):g} m"))
    planes = _least_planes(settings)
    if "slabs" in settings.comparisons and settings.frames < planes:
        others = ", ".join(name for name in settings.report.baselines if name != "slabs")
        cure = f"leave it out: 'report.baselines=[{others}]', or use {planes} frames, in as many times the time"
        words = f"the comparison 'slabs' shows one plane a frame, here {planes} planes, got {settings.frames} frames"
        problems.append((("report", "baselines"), f"{words}; {cure}"))
    return problems + _sampling(settings)


def _sampling(settings: JointSettings) -> list[tuple[Key, str]]:
    """What contradicts steps that take some of the views each."""
    eye, problems = settings.eye, list[tuple[Key, str]]()
    if eye.per_step is None:
        return problems
    if eye.per_step > eye.parallax:
        message = f"expected at most the {eye.parallax} parts of eye.parallax, got {eye.per_step}"
        problems.append((("eye", "per_step"), message))
    if settings.tolerance is not None:
        message = "a tolerance stops a solver whose views are the same in each step; leave eye.per_step or it out"
        problems.append((("tolerance",), message))
    return problems
