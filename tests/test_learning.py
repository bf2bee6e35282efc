"""Nothing loses its gradient in silence, and what is learned is found by training, in one process and in two."""

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from paths import ROOT
from torch import Tensor, nn
from two_processes import run_in_two_processes

from holotorch import Grid
from holotorch.core.complex import intensity
from holotorch.correction import LBFGS, PECProblem, gerchberg_saxton
from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram
from holotorch.modulator import PhasedArray, PhaseModulator, ThermalCrosstalk
from holotorch.optics import (
    Aperture,
    Display,
    Eye,
    EyeLens,
    Fraunhofer,
    Fresnel,
    Lens,
    Propagator,
    Retina,
    SpectralFilter,
)
from holotorch.optics.light.spectral import spectral_image
from holotorch.scene import TransferFunction, Volume

GRID, WAVELENGTH = Grid((12, 14), 8e-6), 530e-9
DEPTHS = (0.3e-3, 0.4e-3)
COLOURS = ([0.0, 1.0], torch.rand(2, 3), torch.rand(2))


def axial(phase: Tensor | None = None) -> Callable[[Tensor], Tensor]:
    return lambda plane: AxialHologram(GRID, WAVELENGTH, DEPTHS).accumulate([plane, plane.detach()], phase)


REFUSED = {
    "sigma_px": (lambda p: ThermalCrosstalk(p), torch.tensor(0.7)),
    "patch": (lambda p: ThermalCrosstalk.from_patch(p), torch.tensor([[0.1, 1.0, 0.2]])),
    "lut": (lambda p: PhaseModulator(GRID, WAVELENGTH, bits=2, lut=p), torch.tensor([0.0, 1, 2, 3])),
    "crosstalk": (lambda p: PhaseModulator(GRID, WAVELENGTH, crosstalk=p), torch.tensor(0.7)),
    "shape": (lambda p: Aperture(GRID, WAVELENGTH, p), torch.rand(GRID.shape)),
    "kernel": (lambda p: SpectralFilter(GRID, WAVELENGTH, p), torch.rand(1, 24, 28, dtype=torch.complex64)),
    "focal_length": (lambda p: Lens(GRID, WAVELENGTH, p), torch.tensor(0.05)),
    "distance": (lambda p: Fresnel(GRID, WAVELENGTH, p), torch.tensor(0.05)),
    "wavelength": (lambda p: Fraunhofer(GRID, p), torch.tensor([530e-9])),
    "accommodation": (lambda p: EyeLens(GRID, WAVELENGTH, Eye(accommodation=p)), torch.tensor(0.5)),
    "Zernike coefficient 4": (lambda p: EyeLens(GRID, WAVELENGTH, Eye(aberrations={4: p})), torch.tensor(1e-7)),
    "AxialHologram has fixed wavelength and depths": (lambda p: AxialHologram(GRID, 530e-9, p), torch.tensor(DEPTHS)),
    "ConvolutionHologram has fixed": (lambda p: ConvolutionHologram(GRID, 530e-9, p), torch.tensor(DEPTHS)),
    "DirectHologram has fixed": (lambda p: DirectHologram(GRID, 530e-9, [p, 1e-3]), torch.tensor(5e-4)),
    "plane": (axial(), torch.rand(GRID.shape)),
    "phase": (lambda p: axial(p)(torch.rand(GRID.shape)), torch.rand(GRID.shape)),
    "start": (lambda p: gerchberg_saxton(Fraunhofer(GRID, WAVELENGTH), torch.ones_like(p), p), torch.rand(1, 12, 14)),
    "start of a solver": (
        lambda p: LBFGS()(PECProblem(ThermalCrosstalk(0.5), Fraunhofer(GRID, WAVELENGTH), torch.ones(1, 12, 14)), p),
        torch.rand(1, 12, 14),
    ),
    "target": (
        lambda p: PECProblem(ThermalCrosstalk(0.5), Fraunhofer(GRID, WAVELENGTH), p),
        torch.ones(1, 12, 14),
    ),
    "colours": (lambda p: TransferFunction(COLOURS[0], p, COLOURS[2], unit_distance=0.1), COLOURS[1]),
}


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
@pytest.mark.parametrize("name", REFUSED)
def test_a_gradient_that_a_module_cannot_keep_is_refused_by_name(name: str):
    build, value = REFUSED[name]
    build(value)  # without a gradient
    for carries in (value.clone().requires_grad_(), value.clone().requires_grad_() * 1):
        with pytest.raises((ValueError, TypeError), match=name.removesuffix(" of a solver")):
            build(carries)


def test_the_advice_of_the_refusal_works():
    mask = torch.rand(GRID.shape, dtype=torch.float64)
    own = nn.Parameter(mask.clone())
    for aperture in (Aperture(GRID, WAVELENGTH, own), Aperture(GRID, WAVELENGTH, mask, learnable=True)):
        field = torch.ones(1, *GRID.shape, dtype=torch.complex128)
        intensity(aperture(field)).sum().backward()
        (parameter,) = aperture.parameters()
        torch.testing.assert_close(parameter.grad, 2 * mask)
    assert own.grad is not None


@pytest.mark.parametrize(
    ("message", "build"),
    [
        ("a hard edge has no gradient in its radius", lambda: Aperture(GRID, WAVELENGTH, 30e-6, learnable=True)),
        ("a learned sigma must be above 0", lambda: ThermalCrosstalk(0.0, learnable=True)),
        (
            "learns distance and wavelengths only for a result of the same pitch",
            lambda: Propagator(GRID, WAVELENGTH, 2e-3, out_grid=Grid(9, 6e-6), learnable=True),
        ),
    ],
)
def test_what_cannot_be_learned_says_what_can(message: str, build: Callable[[], nn.Module]):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_retina_offers_the_parameters_of_its_eye():
    accommodation = nn.Parameter(torch.tensor(0.25, dtype=torch.float64))
    eye = Eye(pupil_radius=1.2e-3, accommodation=accommodation)
    retina = Retina(GRID, WAVELENGTH, Display.planar(0.2), eye, tolerance=0.4)
    assert dict(retina.named_parameters()) == {"eye_accommodation": accommodation}


def test_training_finds_sigma_and_distance():
    """A chip of sigma 0.7 at 2 mm, seen through random phases; the model starts 20 % and 0.1 mm off."""
    grid, generator = Grid(24, 8e-6), torch.Generator().manual_seed(0)
    phases = 6 * torch.rand(4, 1, 24, 24, generator=generator, dtype=torch.float64)
    true = nn.Sequential(PhasedArray(WAVELENGTH, ThermalCrosstalk(0.7, 7)), Fresnel(grid, WAVELENGTH, 2e-3))
    captured = intensity(true(phases))
    model = nn.Sequential(
        PhasedArray(WAVELENGTH, ThermalCrosstalk(0.84, 7, learnable=True)),
        Fresnel(grid, WAVELENGTH, 2.1e-3, learnable=True),
    )
    sigma, distance = model.parameters()
    optimiser = torch.optim.LBFGS([sigma], max_iter=60, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        error = (intensity(model(phases)) - captured).square().mean()
        error.backward()
        return error

    for _ in range(3):
        optimiser.step(loss)
        # Newton's method for the distance, whose unit differs by orders of magnitude.
        for _ in range(4):
            error = (intensity(model(phases)) - captured).square().mean()
            (slope,) = torch.autograd.grad(error, distance, create_graph=True)
            (curvature,) = torch.autograd.grad(slope, distance)
            with torch.no_grad():
                distance -= slope / curvature.abs()
    assert sigma.item() == pytest.approx(0.7, rel=1e-3)
    assert distance.item() == pytest.approx(2e-3, rel=1e-3)


def model_and_data() -> tuple[nn.Module, Tensor]:
    model = nn.Sequential(
        PhasedArray(WAVELENGTH, ThermalCrosstalk(0.7, 5, learnable=True)),
        Fresnel(GRID, WAVELENGTH, 1e-3, pad=2.2, learnable=True),
        Aperture(GRID, WAVELENGTH, torch.full(GRID.shape, 0.5), learnable=True),
    )
    generator = torch.Generator().manual_seed(0)
    return model, 6 * torch.rand(4, 1, *GRID.shape, generator=generator, dtype=torch.float64)


def train(model: nn.Module, phases: Tensor) -> None:
    optimiser = torch.optim.SGD(model.parameters(), lr=1e-9)  # small enough for the distance
    for _ in range(3):
        optimiser.zero_grad()
        intensity(model(phases)).square().mean().backward()
        optimiser.step()


def train_together(rank: int) -> dict[str, Tensor]:
    model, phases = model_and_data()
    assert not list(model.buffers())  # nothing but parameters is sent
    train(nn.parallel.DistributedDataParallel(model), phases[2 * rank : 2 * rank + 2])
    return model.state_dict()


def test_two_processes_train_as_one(tmp_path):
    together = run_in_two_processes(train_together, tmp_path)
    model, phases = model_and_data()
    start = {name: value.clone() for name, value in model.state_dict().items()}
    train(model, phases)
    for name, value in together.items():
        torch.testing.assert_close(value, model.state_dict()[name], rtol=1e-12, atol=0)
        assert not torch.equal(value, start[name]) and math.isfinite(value.sum())


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
def test_the_examples_of_the_guide_run():
    """Among them a module whose Parameter are the values of a volume, here given to an optimiser."""
    text = (ROOT / "scripts" / "docs" / "learning.md").read_text()
    names: dict[str, Any] = {}
    exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.S)), names)
    learned, sampler = names["learned"], names["learned"].sampler
    assert learned.values.grad.norm() > 0 and "values" in learned.state_dict()
    with torch.no_grad():
        true = Volume(torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(1)), (1.0, 1.0, 1.0), "relative")
        wanted = sampler.render(true)[0]
    optimiser, losses = torch.optim.Adam([learned.values], lr=0.05), []
    for _ in range(40):
        optimiser.zero_grad()
        loss = (learned() - wanted).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
def test_the_width_of_a_source_has_a_gradient_through_its_weights():
    wavelengths = torch.tensor([526e-9, 530e-9, 534e-9], dtype=torch.float64)
    field = torch.polar(torch.ones(12, 14), 6 * torch.rand(12, 14)).to(torch.complex128)
    eye = Eye(pupil_radius=1.2e-3, accommodation=0.25)

    def image(width_nm: Tensor) -> Tensor:
        power = 1 / (1 + ((wavelengths - 530e-9) / (width_nm * 0.5e-9)).square())
        return spectral_image(field, GRID, wavelengths, power / power.sum(), Display.planar(0.2), eye, count=1)

    assert torch.autograd.gradcheck(image, torch.tensor(5.0, dtype=torch.float64, requires_grad=True))
