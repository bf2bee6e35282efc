"""Chart of predicted errors on the retina: what ``Retina`` says of itself against propagation of far more samples."""

import math
import random
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from holotorch.core.checks import SamplingWarning
from holotorch.core.complex import intensity
from holotorch.core.fourier import good_length
from holotorch.core.grid import Grid
from holotorch.experiments.runs.figures import figure_png
from holotorch.io.images import fit_image, load_image
from holotorch.optics import Display, Eye, plan_retina, propagate, propagate_collapsed, propagate_elements
from holotorch.optics.viewing.elementwise import ElementSampling, least_oversampling
from holotorch.optics.viewing.imaging import collapse_sampling
from holotorch.optics.viewing.line_errors import field_lines, line_errors, noise_lines

SEED = 20261126  # of the settings; fixed before any of them was measured, and used for nothing else
FACTOR = 3.0  # between predicted and true errors that the documentation promises
CLEAR = 3.0  # factor on the reference's own error above which a measured error counts
SPECKLED = ("noise", "random phases", "hologram of a photograph")  # kinds of light meant without an example
CUT = "light cut off"  # how the names of settings begin whose eyepiece is narrower than the light
METHODS: dict[str, Callable[..., Tensor]] = {"collapse": propagate_collapsed, "elements": propagate_elements}


@dataclass(frozen=True)
class Setting:
    """A hologram, its colours in metres, a display and an eye.

    ``finer`` and ``wider`` are the samples and the width of the reference's window, relative to what element-by-element
    propagation needs; ``lights`` is the number of kinds of light.
    """

    name: str
    grid: Grid
    wavelengths: tuple[float, ...]
    display: Display
    eye: Eye
    finer: float = 1.25
    wider: float = 2.0
    lights: int = 6

    @property
    def arguments(self) -> tuple[Grid, tuple[float, ...], Display, Eye]:
        """What all methods take first."""
        return self.grid, self.wavelengths, self.display, self.eye

    @property
    def plane(self) -> float:
        """Distance in metres from the hologram to the plane in focus."""
        return float(self.display.focus_plane(self.eye.accommodation))

    @property
    def reference(self) -> ElementSampling:
        """Samples of the reference."""
        least = least_oversampling(*self.arguments)
        return replace(
            least,
            oversampling=tuple(self.finer * m for m in least.oversampling),
            padded=tuple(good_length(math.ceil(self.wider * n)) for n in least.padded),
            fine=tuple(good_length(math.ceil(self.wider * self.finer * n)) for n in least.fine),
        )


@dataclass(frozen=True)
class Amount:
    """Size of the measurement: numbers of drawn settings, and the settings at full size."""

    drawn: int = 14
    cut: int = 4
    whole: tuple[str, ...] = ("eyepiece", "planar")
    lights: int | None = None  # kinds of light of each setting; None for all
    memory: float = 2e9  # bytes that a reference may need; settings that need more are drawn again


FULL, QUICK = Amount(), Amount(1, 1, (), 2, memory=0.1e9)


def retina(quick: bool = False) -> tuple[list[dict], dict[str, list[dict]], dict[str, bytes], list[str]]:
    """Table rows of settings, kinds of light and methods, further tables (none), PNG pictures, and lines of text."""
    amount = QUICK if quick else FULL
    rows = []
    for setting in tqdm(_settings(amount), desc="retina", unit="setting"):
        rows += _measured(setting, amount.lights)
    return rows, {}, {"chart": _draw(rows)}, _verdict(rows, amount)


def _settings(amount: Amount) -> list[Setting]:
    """Settings drawn at random, those with a narrow eyepiece, and those at the size at which a step is timed."""
    generator = random.Random(SEED)
    drawn = [_drawn(generator, f"drawn {k + 1}", amount.memory) for k in range(amount.drawn)]
    drawn += [_drawn(generator, f"{CUT} {k + 1}", amount.memory, cut=True) for k in range(amount.cut)]
    grid, colours = Grid(256, 8e-6), (640e-9, 520e-9, 450e-9)
    magnified, planar = Display(0.05, 0.05, 0.05), Display.planar(0.25)
    # In windows twice as wide, these references would need 18 and 50 GB.
    whole = {
        "eyepiece": Setting("256 px, eyepiece", grid, colours, magnified, Eye(accommodation=1.0), 1.25, 1.0, 4),
        "planar": Setting("256 px, planar", grid, colours, planar, Eye(accommodation=0.25), 1.0, 1.0, 4),
    }
    return drawn + [whole[name] for name in amount.whole]


def _drawn(generator: random.Random, name: str, memory: float, *, cut: bool = False) -> Setting:
    """The next random setting that ``Retina`` accepts and whose reference fits into ``memory`` bytes."""

    def between(low: float, high: float) -> float:
        return low * (high / low) ** generator.random()

    while True:
        grid = Grid((generator.randrange(32, 97, 4), generator.randrange(32, 97, 4)), between(8e-6, 24e-6))
        wavelength, radius = between(440e-9, 650e-9), between(0.5e-3, 2e-3)
        if not cut and generator.random() < 0.4:
            distance = between(15e-3, 150e-3)
            setting = Setting(name, grid, (wavelength,), Display.planar(distance), Eye(radius, accommodation=distance))
        else:
            focal_length = between(15e-3, 50e-3)
            lens_distance, eye_distance = focal_length * between(0.6, 1.1), between(10e-3, 50e-3)
            # Half of the light's width on the eyepiece, or less.
            half = (grid.extent[0] + lens_distance * wavelength / grid.pitch[0]) / 2
            lens_radius = half * between(0.3, 0.8) if cut else None
            display = Display(lens_distance, focal_length, eye_distance, lens_radius)
            setting = Setting(name, grid, (wavelength,), display, Eye(radius, accommodation=between(0.15, 3)))
        try:
            with warnings.catch_warnings(action="ignore"):
                plan_retina(*setting.arguments)
                collapse_sampling(*setting.arguments, setting.plane)
        except ValueError:
            continue
        if setting.reference.memory_bytes() < memory:
            return setting


def _lights(setting: Setting) -> dict[str, Tensor]:
    """Fields, complex128 [C, H, W], on the plane of the hologram, by name."""
    grid, wavelengths, shape = setting.grid, setting.wavelengths, (len(setting.wavelengths), *setting.grid.shape)
    generator = torch.Generator().manual_seed(SEED)
    cycles = torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    phases = torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles)
    amplitude = fit_image(load_image("coffee").double(), grid.shape).sqrt()
    amplitude = amplitude if shape[0] == 3 else amplitude[1:2]
    points = torch.zeros(shape, dtype=torch.complex128)
    for _ in range(5):
        place = [int(torch.randint(n // 8, n - n // 8, (), generator=generator)) for n in grid.shape]
        points[:, place[0], place[1]] = phases[0, :, 0, len(place)]
    y, x = grid.coordinates()
    width = 0.12 * grid.extent[0]
    beam = torch.exp(-((y - 1.3 * width).square() + (x + width).square()) / (2 * width**2))

    def hologram(light: Tensor) -> Tensor:
        return propagate(light, grid, wavelengths, -setting.plane, tolerance=0.05)

    return {
        "noise": torch.randn(shape, dtype=torch.complex128, generator=generator),
        "hologram of points": hologram(points),
        "random phases": phases[1],
        "hologram of a photograph": hologram(amplitude * phases[0]),
        "photograph": amplitude.to(torch.complex128),
        "beam": beam.expand(shape).to(torch.complex128),
    }


def _measured(setting: Setting, lights: int | None) -> list[dict]:
    """Table rows of a setting: one for each kind of light and method."""
    with warnings.catch_warnings(action="ignore", category=SamplingWarning):
        return [
            row
            for light, field in list(_lights(setting).items())[: min(lights or 99, setting.lights)]
            for row in _rows(setting, light, field)
        ]  # fmt: skip


def _rows(setting: Setting, light: str, field: Tensor) -> list[dict]:
    """Table rows of both methods for one field [C, H, W]."""
    arguments, wavelengths = setting.arguments, setting.wavelengths
    narrow = field.to(torch.complex64)
    exact = intensity(propagate_elements(narrow, *arguments, sampling=setting.reference)).double()
    sizes = [collapse_sampling(*arguments, setting.plane), least_oversampling(*arguments)]

    def predicted(lines: list, samplings: Sequence[Any]) -> list[float]:
        return line_errors(lines, *arguments, setting.plane, samplings, dtype=torch.complex64)

    *of_example, floor = predicted([field_lines(each) for each in field], [*sizes, setting.reference])
    of_noise = predicted([noise_lines(setting.grid)] * len(wavelengths), sizes)
    rows = []
    for (name, method), sampling, example, noise in zip(METHODS.items(), sizes, of_example, of_noise, strict=True):
        if sampling == setting.reference:
            continue
        image = intensity(method(narrow, *arguments)).double()
        error = ((image - exact).norm() / exact.norm()).item()
        rows.append(
            {
                "setting": setting.name,
                "light": light,
                "method": name,
                "measured": f"{error:.3e}",
                "predicted": f"{example:.3e}",
                "without_example": f"{noise:.3e}",
                "reference_error": f"{floor:.3e}",
                "counts": error > CLEAR * floor,
            }
        )
    return rows


def _ratios(rows: list[dict], column: str = "predicted", **chosen: Any) -> list[float]:
    """Predicted / measured error of the rows that count and have the ``chosen`` values, in order of size."""
    selected = (row for row in rows if row["counts"] and all(row[key] in value for key, value in chosen.items()))
    return sorted(float(row[column]) / float(row["measured"]) for row in selected)


def _range(ratios: list[float]) -> str:
    if not ratios:
        return "none above the reference's own error"
    within = sum(1 / FACTOR <= each <= FACTOR for each in ratios)
    return f"{ratios[0]:.2f} to {ratios[-1]:.2f}, {within} of {len(ratios)} within a factor {FACTOR:g}"


def _verdict(rows: list[dict], amount: Amount) -> list[str]:
    """Ranges of predicted / measured error by kind of setting, method and light."""
    names = list(dict.fromkeys(row["setting"] for row in rows))
    cut = [name for name in names if name.startswith(CUT)]
    drawn = [name for name in names if name.startswith("drawn")]
    counted = sum(row["counts"] for row in rows)
    lines = [
        f"torch {torch.__version__}; {len(names)} settings ({amount.drawn} drawn, {amount.cut} drawn with a narrow "
        f"eyepiece, {len(amount.whole)} at 256 px in three colours); {counted} of {len(rows)} errors are above "
        f"{CLEAR:g} times that of their reference and count. Predicted / measured error:"
    ]
    for method in METHODS:
        lines.append(
            f"{method}, the field as example: {_range(_ratios(rows, setting=drawn, method=method))}; without example, "
            f"speckled light: {_range(_ratios(rows, 'without_example', setting=drawn, method=method, light=SPECKLED))}"
        )
        lines.append(f"{method}, eyepiece that cuts light off: {_range(_ratios(rows, setting=cut, method=method))}")
        for name in names:
            if name not in drawn + cut:
                chosen = {"setting": [name], "method": method}
                speckled = _range(_ratios(rows, "without_example", light=SPECKLED, **chosen))
                lines.append(
                    f"{method}, {name}: {_range(_ratios(rows, **chosen))}; without example, speckled light: {speckled}"
                )
    off = [
        (max(ratio, 1 / ratio), f"{row['setting']}, {row['light']}, {row['method']} ({ratio:.2f})")
        for row in rows
        if row["counts"] and not 1 / FACTOR <= (ratio := float(row["predicted"]) / float(row["measured"])) <= FACTOR
    ]
    if off:
        lines.append(f"beyond a factor {FACTOR:g}: " + "; ".join(text for _, text in sorted(off, reverse=True)[:8]))
    return lines


def _draw(rows: list[dict]) -> bytes:
    """Predicted against measured error of both methods, by kind of light."""
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    kinds = list(dict.fromkeys(row["light"] for row in rows))
    for k, method in enumerate(METHODS):
        axes = figure.add_subplot(1, 2, k + 1)
        chosen = [row for row in rows if row["method"] == method and row["counts"]]
        for row in chosen:
            axes.loglog(
                float(row["measured"]), float(row["predicted"]), "os^vDP"[kinds.index(row["light"])],
                color=f"C{kinds.index(row['light'])}", fillstyle="none" if row["setting"].startswith(CUT) else "full",
            )  # fmt: skip
        for index, light in enumerate(kinds):
            axes.plot([], [], "os^vDP"[index], color=f"C{index}", label=light)
        values = [float(row[key]) for row in chosen for key in ("measured", "predicted")] or [1e-3, 1e-1]
        ends = [min(values), max(values)]
        axes.plot(ends, ends, "k-", linewidth=1)
        for factor in (1 / FACTOR, FACTOR):
            axes.plot(ends, [factor * end for end in ends], "k:", linewidth=1)
        axes.set(title=f"{method} (hollow: eyepiece cuts light off)", xlabel="measured error", ylabel="predicted error")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    return figure_png(figure)
