"""One list of small public modules and what they learn. A new module brings a constructor; contracts are shared."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from holotorch import Grid
from holotorch.correction import PECProblem
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram
from holotorch.modulator import HeatCycle, PhasedArray, PhaseModulator, Response, ThermalCrosstalk
from holotorch.optics import (
    AngularSpectrum,
    Aperture,
    ConvergingFresnel,
    CroppedKernel,
    DepthStack,
    Display,
    Eye,
    EyeLens,
    Fraunhofer,
    Fresnel,
    Lens,
    OpticalPath,
    PixelShape,
    Propagator,
    PupilViews,
    RayleighSommerfeld,
    ResampledKernel,
    Retina,
    RetinaViews,
    SpectralFilter,
    SpectralRetina,
    View,
    ZoomedFilter,
)
from holotorch.scene import DVRSampler, TransferFunction, Volume

GRID = Grid((10, 13), (5e-6, 4e-6))
WAVELENGTHS = (630e-9, 530e-9)
OTHER = Grid((9, 8), (3e-6, 7e-6))
DEPTHS = (0.21e-3, 0.26e-3)
RETINAL = Grid((12, 12), 8e-6)
CONTRACTS = ("second derivatives", "forward mode", "vmap", "copies", "meta", "autocast", "compile", "export")
BY_LENGTH = "the sizes of the arrays follow from the lengths that are learned; with fixed lengths these columns are yes"


@dataclass(frozen=True)
class Example:
    """A public module as small as it can be.

    Attributes:
        name: Of the class, with what is learned.
        build: Constructs it, with everything learned that can be.
        inputs: Constructs its inputs, float64 or complex128, without a batch axis.
        call: Calls it; by default ``module(*inputs)``.
        learned: Its parameters by name, with a change of each that is small against what changes its result.
        without: Contracts that it does not keep, by name, each with the reason.
        batched: Whether inputs may have a further leading axis.
        rounded: Whether the inputs are rounded and their gradient is an estimate (straight-through).
    """

    name: str
    build: Callable[[], nn.Module]
    inputs: Callable[[], tuple[Tensor, ...]]
    call: Callable[..., Tensor] = lambda module, *inputs: module(*inputs)
    learned: dict[str, float] = field(default_factory=dict)
    without: dict[str, str] = field(default_factory=dict)
    batched: bool = True
    rounded: bool = False

    def on(self, device: str) -> "Example":
        """The same module and inputs on another device."""
        return replace(
            self,
            name=f"{self.name}, {device}",
            build=lambda: self.build().to(device),
            inputs=lambda: tuple(value.to(device) for value in self.inputs()),
        )


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Uniform noise in [0.1, 0.9], float64."""
    return 0.1 + 0.8 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def light(*shape: int, seed: int = 0) -> Tensor:
    """Complex noise, complex128."""
    return torch.complex(noise(*shape, seed=seed) - 0.5, noise(*shape, seed=seed + 1) - 0.5)


def number(value: float) -> nn.Parameter:
    return nn.Parameter(torch.tensor(value, dtype=torch.float64))


def fields() -> tuple[Tensor, ...]:
    return (light(len(WAVELENGTHS), *GRID.shape),)


def phases() -> tuple[Tensor, ...]:
    return (3 * noise(len(WAVELENGTHS), *GRID.shape),)


def layers() -> tuple[Tensor, ...]:
    return (light(len(DEPTHS), *GRID.shape),)


def bump(sigma: float = 0.8) -> Tensor:
    y, x = torch.arange(-1.0, 2, dtype=torch.float64), torch.arange(-2.0, 3, dtype=torch.float64)
    return torch.exp(-(y[:, None] ** 2 + 1.2 * x**2) / sigma**2)


def waves() -> nn.Parameter:
    return nn.Parameter(torch.tensor(WAVELENGTHS, dtype=torch.float64))


def measured_lut() -> Tensor:
    return torch.linspace(0, 6.0, 16, dtype=torch.float64) + 0.05 * torch.linspace(0, 3, 16, dtype=torch.float64).sin()


def eye() -> Eye:
    return Eye(
        pupil_radius=number(1.5e-3), axial_length=number(22e-3), accommodation=number(0.3),
        aberrations={4: number(0.05e-6), 12: 0.02e-6}, softness=20e-6,
    )  # fmt: skip


def retina() -> Retina:
    look = Eye(pupil_radius=1.2e-3, accommodation=number(0.25), softness=30e-6)
    return Retina(RETINAL, 530e-9, Display.planar(0.2), look, tolerance=0.3)


def transfer() -> TransferFunction:
    module = TransferFunction(
        [0.0, 0.4, 1.0], noise(3, 3).tolist(), noise(3, seed=4).tolist(), unit_distance=1 / 8
    ).double()
    return module.requires_grad_()


class Render(nn.Module):
    """A DVRSampler as function of the volume's values."""

    def __init__(self):
        super().__init__()
        self.sampler = DVRSampler(transfer(), Grid((5, 6), 1e-4), [0.01, 0.011, 0.012], width=6e-4)

    def forward(self, values: Tensor) -> Tensor:
        return self.sampler.render(Volume(values, (1.0, 1.0, 1.0), "relative"))[0]


EXAMPLES = [
    Example(
        "ThermalCrosstalk, sigma", lambda: ThermalCrosstalk(0.9, 5, learnable=True), phases, learned={"sigma": 0.1}
    ),
    Example(
        "ThermalCrosstalk, patch",
        lambda: ThermalCrosstalk.from_patch(bump(), learnable=True),
        phases,
        learned={"patch": 0.1},
    ),
    Example(
        "ThermalCrosstalk, by FFT",
        lambda: ThermalCrosstalk.from_patch(
            noise(7, 7).index_put((torch.tensor(3), torch.tensor(3)), torch.tensor(1.0, dtype=torch.float64))
        ),
        phases,
    ),
    Example(
        "PhasedArray",
        lambda: PhasedArray(WAVELENGTHS, ThermalCrosstalk(0.9, 5, learnable=True)),
        phases,
        learned={"crosstalk.sigma": 0.1},
    ),
    Example("Response", lambda: Response(3.0, learnable=True), phases, learned={"phases": 0.1}),
    Example(
        "PhaseModulator",
        lambda: PhaseModulator(
            GRID,
            WAVELENGTHS,
            bits=4,
            lut=measured_lut(),
            learnable=True,
            crosstalk=ThermalCrosstalk(0.7, 5, learnable=True),
        ),  # fmt: skip
        phases,
        learned={"lut": 0.1, "crosstalk.sigma": 0.1},
        rounded=True,
    ),
    Example(
        "AngularSpectrum, distance and wavelengths",
        lambda: AngularSpectrum(GRID, waves(), 60e-6, learnable=True, band_limit=False),
        fields,
        learned={"distance": 1e-8, "wavelength": 1e-10},
    ),
    Example(
        "Fresnel, distance and wavelengths",
        lambda: Fresnel(GRID, waves(), 60e-6, learnable=True),
        fields,
        learned={"distance": 1e-8, "wavelength": 1e-10},
    ),
    Example(
        "CroppedKernel, distance and wavelengths",
        lambda: CroppedKernel(GRID, waves(), 150e-6, learnable=True),
        fields,
        learned={"distance": 1e-8, "wavelength": 1e-10},
    ),
    Example(
        "Propagator, distance",
        lambda: Propagator(GRID, WAVELENGTHS, 150e-6, learnable=True),
        fields,
        learned={"operator.distance": 1e-8},
    ),
    Example("Propagator, fixed", lambda: Propagator(GRID, WAVELENGTHS, 150e-6), fields),
    Example(
        "SpectralFilter, transfer function",
        lambda: SpectralFilter(GRID, WAVELENGTHS, light(2, 14, 16), learnable=True),
        fields,
        learned={"kernel": 1.0},
    ),
    Example("Fraunhofer", lambda: Fraunhofer(GRID, WAVELENGTHS), fields),
    Example("RayleighSommerfeld", lambda: RayleighSommerfeld(GRID, WAVELENGTHS, 300e-6), fields),
    Example("ResampledKernel", lambda: ResampledKernel(GRID, WAVELENGTHS, 300e-6, OTHER), fields),
    Example("ConvergingFresnel", lambda: ConvergingFresnel(GRID, WAVELENGTHS, 2e-3, 5e-3), fields),
    Example("ZoomedFilter", lambda: ZoomedFilter(GRID, WAVELENGTHS, light(2, 14, 16), OTHER), fields),
    Example("PixelShape", lambda: PixelShape(GRID, fill=0.9, orders=1), fields),
    Example(
        "DepthStack, distances",
        lambda: DepthStack([Fresnel(GRID, WAVELENGTHS, z, learnable=True) for z in (50e-6, 80e-6)]),
        fields,
        learned={"filters.0.distance": 1e-8, "filters.1.distance": 1e-8},
    ),
    Example(
        "Lens, focal length",
        lambda: Lens(GRID, WAVELENGTHS, 2e-3, radius=28e-6, learnable=True),
        fields,
        learned={"focal_length": 1e-4},
    ),
    Example(
        "Aperture, radius",
        lambda: Aperture(GRID, WAVELENGTHS, 18e-6, softness=4e-6, learnable=True),
        fields,
        learned={"shape": 1e-6},
    ),
    Example(
        "Aperture, transmission",
        lambda: Aperture(GRID, WAVELENGTHS, noise(*GRID.shape), learnable=True),
        fields,
        learned={"shape": 0.05},
    ),
    Example(
        "EyeLens",
        lambda: EyeLens(Grid((10, 13), 0.2e-3), WAVELENGTHS, eye()),
        fields,
        learned={
            "eye_pupil_radius": 1e-5,
            "eye_axial_length": 1e-5,
            "eye_accommodation": 1e-2,
            "eye_aberrations_4": 1e-8,
        },
    ),
    Example(
        "OpticalPath",
        lambda: OpticalPath([Lens(GRID, WAVELENGTHS, 2e-3, learnable=True), Fresnel(GRID, WAVELENGTHS, 60e-6)]),
        fields,
        learned={"0.focal_length": 1e-4},
    ),
    Example(
        "Retina, accommodation",
        retina,
        lambda: (light(1, *RETINAL.shape),),
        learned={"eye_accommodation": 1e-3},
        without={name: BY_LENGTH for name in ("meta", "compile", "export")},
    ),
    Example(
        "Retina, fixed",
        lambda: Retina(
            RETINAL, 530e-9, Display.planar(0.2), Eye(pupil_radius=1.2e-3, accommodation=0.25), tolerance=0.3
        ),
        lambda: (light(1, *RETINAL.shape),),
    ),
    Example(
        "RetinaViews",
        lambda: RetinaViews(
            [
                Retina(RETINAL, 530e-9, Display.planar(0.2), Eye(1.2e-3, accommodation=focus), tolerance=0.3)
                for focus in (0.2, 0.25)
            ]
        ),
        lambda: (light(1, *RETINAL.shape),),
    ),
    Example(
        "SpectralRetina",
        lambda: SpectralRetina(
            RETINAL,
            [([525e-9, 530e-9, 535e-9], [0.3, 0.4, 0.3])],
            Display.planar(0.2),
            Eye(1.2e-3, accommodation=0.25),
            tolerance=0.3,
        ),
        lambda: (light(1, *RETINAL.shape),),
    ),
    Example("PupilViews", lambda: PupilViews(GRID, WAVELENGTHS, [View(70e-6, 0.03), View(50e-6, 0.04)]), fields),
    Example(
        "HeatCycle",
        lambda: HeatCycle(ThermalCrosstalk(0.9, 5, learnable=True), 1.0, 0.7, moments=(0.4, 1.0), learnable=True),
        lambda: (3 * noise(3, len(WAVELENGTHS), *GRID.shape),),
        learned={"time_constant": 0.1, "crosstalk.sigma": 0.1},
    ),
    Example(
        "PECProblem",
        lambda: PECProblem(
            ThermalCrosstalk(0.9, 5, learnable=True), Fresnel(GRID, WAVELENGTHS, 60e-6, learnable=True), limit=2.5
        ),
        lambda: (*phases(), 2 * noise(len(WAVELENGTHS), *GRID.shape, seed=7)),
        learned={"crosstalk.sigma": 0.1, "propagator.distance": 1e-8},
    ),
    Example("DirectHologram", lambda: DirectHologram(GRID, 630e-9, DEPTHS), layers),
    Example("ConvolutionHologram", lambda: ConvolutionHologram(GRID, 630e-9, DEPTHS), layers),
    Example("AxialHologram", lambda: AxialHologram(GRID, 630e-9, DEPTHS), layers),
    Example(
        "AxialHologram, uneven depths",
        lambda: AxialHologram(GRID, 630e-9, (*DEPTHS, 0.27e-3)),
        lambda: (light(3, *GRID.shape),),
    ),
    Example(
        "TransferFunction",
        transfer,
        lambda: (noise(5, 4),),
        call=lambda module, values: torch.cat([module(values)[0], module(values)[1][None]]),
        learned={"colours": 0.05, "opacities": 0.05},
    ),
    Example(
        "DVRSampler",
        Render,
        lambda: (noise(4, 5, 6),),
        learned={"sampler.transfer.colours": 0.05, "sampler.transfer.opacities": 0.05},
        batched=False,
    ),
]
