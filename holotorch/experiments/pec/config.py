"""Settings of a configuration of kind ``pec``, proximity effect correction."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError

from holotorch.core.quantities import SIGMA_PX
from holotorch.experiments.config.settings import (
    Count,
    Distance,
    ExistingPath,
    GridSettings,
    Number,
    Phase,
    Settings,
    Side,
    TemperatureRise,
    Wavelength,
    existing,
    number,
    pair,
    plausible,
    several,
)
from holotorch.experiments.config.source import Key
from holotorch.io.bundled import BUNDLED_IMAGES, no_such_picture

_MOST_WAVELENGTHS = 32  # each takes a hologram of its own


def _not_zero(value: float) -> float:
    if abs(value) < 1e-6:
        raise PydanticCustomError("distance", "expected a distance of 1 um or more: closer, a phase forms no image")
    return value


Picture = Annotated[str, existing(lambda name: name in BUNDLED_IMAGES or Path(name).is_file(), no_such_picture)]
# Kinds of start phases of the solver; ``plan._START_REASONS`` describes them.
Start = Literal["hot", "cool", "flat", "quadratic", "retrieved"]
SIGMA_MEANING = (
    "a pixel heated alone warms one d px away by exp(-d^2/sigma^2) of its own rise; sigma is the usual Gaussian sigma "
    "times sqrt 2"
)


class PeripheralWeightSettings(Settings):
    """Weight (1 + E / e2_deg)^-2 on the squared error of a pixel, where E is the angle between the pixel and the gaze.

    ``field_deg``: angle that the picture spans from left to right; every pixel spans the same angle. ``gaze_deg``:
    elevation and azimuth of the gaze from the middle of the picture. ``least``: lower limit of the weight, relative to
    the weight at the gaze.
    """

    kind: Literal["peripheral"]
    field_deg: Annotated[Number, Field(gt=0, le=360)]
    gaze_deg: tuple[Annotated[Number, Field(ge=-90, le=90)], Annotated[Number, Field(ge=-180, le=180)]] = (0.0, 0.0)
    e2_deg: Annotated[Number, Field(gt=0, le=180)] = 1.746  # cortical magnification by Cowey and Rolls
    least: Annotated[Number, Field(ge=0, le=1)] = 0.0


class TargetSettings(Settings):
    """A bundled photograph or a picture file, cropped or padded to the aspect ratio of the grid or of ``region``.

    ``region``: size in pixels of the middle part of the image that shows the picture; the rest of the image is free
    (thesis Eqs. 4.7, 4.8). ``depths``: ``bands`` divides the picture into as many vertical bands as there are
    distances, and each band is the target at one distance only; with ``full`` the whole picture is the target at every
    distance. ``weight``: weights of the squared errors of the pixels.
    """

    image: Picture
    fit: Literal["crop", "pad"] = "crop"
    region: Annotated[tuple[Side, Side], BeforeValidator(pair)] | None = None
    depths: Literal["bands", "full"] = "bands"
    weight: PeripheralWeightSettings | None = None


class ModulatorSettings(Settings):
    """The phased array and the heat that spreads between its pixels.

    ``sigma_px``: width of the heat kernel. ``kernel``: in its place a measured one, a NumPy or CSV file of the
    temperature rises around one heated pixel, which is the warmest and in the middle, in any unit. ``kernel_size``:
    taps of the kernel along each axis, by default as many as its width needs. ``max_phase``: upper limit on the phase
    of every pixel after the heat has spread, such as 4pi (700 degC at 630 nm); no limit by default, as in the thesis.
    ``max_temperature``: in its place a limit on the temperature of every pixel above ambient, such as 500 degC. All
    colours have one limit in phase, so that only the one with the smallest phase per kelvin gets as warm.
    ``rad_per_K``: phase per kelvin at the wavelength ``rad_per_K_at``, by default that of the thesis, pi / 175 K; other
    wavelengths in inverse proportion. ``bits``: resolution of the heaters, whose levels are evenly spaced from 0 to the
    largest phase. ``power_weight``: weight of the sum of the heater phases in the loss.
    """

    sigma_px: Annotated[Annotated[Number, plausible(SIGMA_PX)] | None, Field(description=SIGMA_MEANING)] = None
    kernel: ExistingPath | None = None
    kernel_size: Annotated[Count, Field(le=401)] | None = None
    max_phase: Phase | None = None
    max_temperature: TemperatureRise | None = None
    rad_per_K: Annotated[Number, Field(ge=1e-5, le=10)] = math.pi / 175
    rad_per_K_at: Wavelength = 630e-9
    bits: Annotated[Count, Field(le=16)] | None = None
    power_weight: Annotated[Number, Field(ge=0, le=1e6)] = 0.0

    @property
    def reference_response(self) -> float:
        """Phase in rad per kelvin at the reference wavelength of ``PhasedArray``, 630 nm."""
        return self.rad_per_K * self.rad_per_K_at / 630e-9


class FraunhoferSettings(Settings):
    """An image in the far field."""

    kind: Literal["fraunhofer"]


class NearFieldSettings(Settings):
    """An image at one or more distances, from a single array (``isolated``) or its periodic repetition (thesis)."""

    kind: Literal["fresnel", "angular_spectrum"]
    distance: Annotated[
        tuple[Annotated[Distance, AfterValidator(_not_zero)], ...], BeforeValidator(several), Field(min_length=1)
    ]
    boundary: Literal["isolated", "periodic"] = "isolated"


class _SolverSettings(Settings):
    """Solver settings. A run stops after ``patience`` successive relative changes of the loss below ``tolerance``.

    By default, that follows from the tolerance of the run; if the run has none, it is 1e-3, or 1e-4 for L-BFGS.
    ``reruns``: how often at most a hologram with speckle noise (bright pixels that come out dark) is solved again from
    other random phases; the one with the fewest is kept.
    """

    kind: Any  # name of the solver, stated by each of the classes below
    max_steps: Annotated[Count, Field(le=100000)] = 400
    tolerance: Annotated[Number, Field(ge=0)] | None = None
    patience: Count = 10
    start: Start | None = None
    reruns: Annotated[int, BeforeValidator(number), Field(ge=0, le=20)] = 0


def _by_kind(value: Any) -> Any:
    """``solver: lbfgs`` for ``solver: {kind: lbfgs}``."""
    return {"kind": value} if isinstance(value, str) else value


class APGSettings(_SolverSettings):
    """Accelerated proximal gradient, thesis Algorithm 2; options as in ``holotorch.correction.APG``."""

    kind: Literal["apg"]
    step: Annotated[Number, Field(ge=1e-6, le=1e6)] = 1.0
    shrink: Annotated[Number, Field(gt=0, lt=1)] = 0.5
    grow: Annotated[Number, Field(ge=1, le=10)] = 1.0
    restart: bool = False


class AdamSettings(_SolverSettings):
    """Adam with projection onto phases >= 0."""

    kind: Literal["adam"]
    learning_rate: Annotated[Number, Field(ge=1e-6, le=10)] = 0.1


class LBFGSSettings(_SolverSettings):
    """Preconditioned L-BFGS in stages: the first compares amplitudes, the others intensities under any limit."""

    kind: Literal["lbfgs"]
    memory: Annotated[Count, Field(le=100)] = 3
    max_steps: Annotated[Count, Field(le=100000)] = 300


# Methods that the result is compared with; "unweighted" is the solver of the configuration without target.weight.
Baseline = Literal["none", "basic_ipec", "ipec", "chopping", "shifting", "nonnegative", "unweighted"]


class ReportSettings(Settings):
    """Metrics of the report, and the methods that the corrected hologram is compared with."""

    metrics: Annotated[tuple[Literal["ssim", "psnr"], ...], BeforeValidator(several), Field(min_length=1)] = (
        "ssim",
        "psnr",
    )
    baselines: Annotated[tuple[Baseline, ...], BeforeValidator(several)] = ("none", "basic_ipec")
    kernel_noise: Annotated[Number, Field(gt=0, le=1)] | None = None


class PECSettings(Settings):
    """Proximity effect correction of one picture on a thermally driven phased array.

    ``tolerance``: allowed relative L2 error of the intensity, divided between the taps of the heat kernel
    (``modulator.kernel_size``), the propagation with its precision, and the stopping rule of the solver
    (``solver.tolerance``); it does not bound the error of the picture that the array cannot form.
    """

    experiment: Literal["pec"]
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    tolerance: Annotated[Number, Field(gt=0, lt=1)] | None = None
    grid: GridSettings
    wavelengths: Annotated[tuple[Wavelength, ...], BeforeValidator(several)]
    target: TargetSettings
    modulator: ModulatorSettings
    propagator: Annotated[FraunhoferSettings | NearFieldSettings, Field(discriminator="kind")]
    frames: Annotated[Count, Field(le=64)] = 1
    multiplexing: Literal["joint", "independent"] = "joint"
    solver: Annotated[
        APGSettings | AdamSettings | LBFGSSettings, Field(discriminator="kind"), BeforeValidator(_by_kind)
    ]
    report: ReportSettings = ReportSettings()


def contradictions(settings: PECSettings) -> Iterator[tuple[Key, str]]:
    """Key and message of each setting that is valid by itself but contradicts another one."""
    shape, light, size = settings.grid.shape, settings.propagator, settings.modulator.kernel_size
    region, weight, scored_by_ssim = settings.target.region, settings.target.weight, "ssim" in settings.report.metrics
    if not 1 <= (count := len(settings.wavelengths)) <= _MOST_WAVELENGTHS:
        most = f"another number up to {_MOST_WAVELENGTHS}"
        yield ("wavelengths",), f"expected 1 (grey), 3 (red, green, blue) or {most}, got {count}"
    if scored_by_ssim and min(shape) < 11:
        hint = "use a larger grid, or report.metrics: [psnr]"
        yield ("grid", "shape"), f"expected at least 11 x 11 px for ssim, got {shape}; {hint}"
    if size is not None and size % 2 == 0:
        yield ("modulator", "kernel_size"), f"expected an odd number of taps, got {size}; use {size + 1}"
    elif size is not None and size > min(shape):
        message = f"expected at most {min(shape)}, the smaller side of the grid, got {size}"
        yield ("modulator", "kernel_size"), message
    finest, longest = min(settings.grid.pitch), max(settings.wavelengths, default=0.0)
    if isinstance(light, NearFieldSettings) and finest < 0.9 * longest:
        least = f"at least 0.9 of the longest wavelength, {0.9 * longest:.3g} m, for an image at a distance"
        yield ("grid", "pitch"), f"expected {least}, got {finest:g} m"
    if region and (region[0] > shape[0] or region[1] > shape[1]):
        yield ("target", "region"), f"expected at most the grid, {shape}, got {region}"
    if region and scored_by_ssim and min(region) < 11:
        yield ("target", "region"), f"expected at least 11 x 11 px for ssim, got {region}"
    chip = settings.modulator
    if (chip.sigma_px is None) == (chip.kernel is None):
        got = f"both; to use the file give 'modulator={{kernel: {chip.kernel}}}'" if chip.kernel else "neither"
        yield ("modulator", "sigma_px"), f"expected sigma_px, or kernel with a file in its place, got {got}"
    if chip.kernel is not None and size is not None:
        yield ("modulator", "kernel_size"), "a measured kernel has the size of its file; leave this out"
    for name in ("max_phase", "max_temperature"):
        if getattr(chip, name) is not None and settings.solver.kind != "lbfgs":
            message = "only the solver lbfgs keeps a limit; use solver=lbfgs, or leave it out"
            yield ("modulator", name), message
    if chip.max_phase is not None and chip.max_temperature is not None:
        yield ("modulator", "max_temperature"), "expected one limit, max_phase or max_temperature"
    several = isinstance(light, NearFieldSettings) and len(light.distance) > 1
    if several and region:
        yield ("target", "region"), "expected one distance beside a region"
    if weight and (several or region):
        yield ("target", "weight"), "expected one distance and no region beside a weight"
    if weight and (high := weight.field_deg * shape[0] / shape[1]) > 360:
        message = f"expected a picture of at most 360 deg in height as well, got {high:g}"
        yield ("target", "weight", "field_deg"), message
    if "unweighted" in settings.report.baselines and not weight:
        yield ("report", "baselines"), "unweighted asks for a target.weight that can be left out"
