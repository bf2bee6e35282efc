"""What PyTorch users expect of a module, asked of every public one; ``modules.py`` says which cannot keep what."""

import copy
import importlib
import io
import pickle
import re
from collections.abc import Collection

import pytest
import torch
from host_reads import HostReads
from modules import CONTRACTS, EXAMPLES, WAVELENGTHS, Example, light
from paths import DEVICES, ROOT
from torch import Tensor, nn
from torch.func import functional_call

from holotorch import Grid, metrics
from holotorch.core import checks
from holotorch.core.complex import intensity, phasor, wrapped
from holotorch.correction import PECProblem, deconvolve
from holotorch.correction.stages import limit_peak_phase
from holotorch.hologram.encoding import double_phase, encoding_loss, kinoform
from holotorch.modulator import ThermalCrosstalk
from holotorch.modulator.panel import even_lut, snapped
from holotorch.optics import Fraunhofer, equal_power, gamut_map, propagate, tone_map

pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")

PACKAGES = ("optics", "modulator", "correction", "scene", "hologram", "metrics", "tracking", "perception")
ELSEWHERE = {
    "CatheterTracker": "frames in, poses out: refuses frames that require a gradient, see tests/tracking",
    "PhotometricFit": "a fit of poses to frames; its gradients, batches and dtypes are in tests/tracking",
    "PerceptualSimilarity": "a network with pretrained weights of an optional package, see tests/metrics",
}
ORDER = 1e-12  # sums over rays are added in another order each time on a GPU
ROUNDING = 1e-9  # relative; float64 sums of at most 200 terms, and phases of up to 1e4 rad


EVERYWHERE = [*EXAMPLES, *(each.on(device) for each in EXAMPLES for device in DEVICES[1:])]
FIXED = [each for each in EXAMPLES if not each.learned]


def keeping(contract: str, but: Collection[str] = ()):
    """Examples except those named, on every device there is. One that does not keep the contract must fail."""
    return pytest.mark.parametrize(
        "example",
        [
            pytest.param(
                each,
                id=each.name,
                marks=pytest.mark.xfail(reason=each.without[contract], strict=True) if contract in each.without else (),
            )
            for each in EVERYWHERE
            if each.name not in but
        ],
    )


def function_of(example: Example, module: nn.Module):
    """The module as a function of its parameters' relative changes and its inputs, and these arguments."""
    start = {name: value.detach() for name, value in module.named_parameters()}
    inputs = example.inputs()

    def function(*arguments: Tensor) -> Tensor:
        changes, given = arguments[: len(start)], arguments[len(start) :]
        values = {
            name: value + example.learned[name] * change
            for (name, value), change in zip(start.items(), changes, strict=True)
        }
        return example.call(lambda *args: functional_call(module, values, args), *(given or inputs))

    arguments = [torch.zeros_like(value).requires_grad_() for value in start.values()]
    if not example.rounded:
        arguments += [value.clone().requires_grad_() for value in inputs]
    return function, tuple(arguments)


def close(got: Tensor, wanted: Tensor, tolerance: float = ROUNDING) -> bool:
    return got.dtype == wanted.dtype and bool((got - wanted).abs().max() <= tolerance * wanted.abs().max())


def test_no_public_module_is_left_out():
    packages = [importlib.import_module(f"holotorch.{package}") for package in PACKAGES]
    exports = {name: getattr(package, name) for package in packages for name in package.__all__}
    public = {name for name, each in exports.items() if isinstance(each, type) and issubclass(each, nn.Module)}
    covered = {re.split(r"\W", each.name)[0] for each in EXAMPLES}
    assert public - set(ELSEWHERE) <= covered


@keeping("parameters")
def test_parameters_are_what_it_says_it_learns(example: Example):
    assert set(dict(example.build().named_parameters())) == set(example.learned)


@keeping("gradients")
def test_gradients_to_parameters_and_inputs(example: Example):
    function, arguments = function_of(example, example.build())
    if arguments:
        assert torch.autograd.gradcheck(function, arguments, fast_mode=True, nondet_tol=ORDER)


@keeping("second derivatives")
def test_second_derivatives(example: Example):
    function, arguments = function_of(example, example.build())
    if arguments:
        assert torch.autograd.gradgradcheck(function, arguments, fast_mode=True, nondet_tol=ORDER)


@keeping("forward mode")
def test_forward_mode_equals_two_backward_passes(example: Example):
    function, arguments = function_of(example, example.build())
    generator = torch.Generator().manual_seed(1)
    tangents = tuple(torch.randn(a.shape, dtype=a.dtype, generator=generator).to(a.device) for a in arguments)
    got = torch.func.jvp(function, tuple(a.detach() for a in arguments), tangents)[1]
    _, wanted = torch.autograd.functional.jvp(function, arguments, tangents)
    assert isinstance(wanted, Tensor) and close(got, wanted)


@keeping("vmap")
def test_vmap_equals_a_batch(example: Example):
    if not example.batched:
        return
    module, inputs = example.build(), example.inputs()
    batch = [torch.stack([value, 0.9 * value]) for value in inputs]
    got = torch.vmap(lambda *values: example.call(module, *values))(*batch)
    wanted = torch.stack([example.call(module, *(values[k] for values in batch)) for k in range(2)])
    assert close(got, wanted)
    assert close(example.call(module, *batch).reshape(wanted.shape), wanted) or example.name.startswith(
        "TransferFunction"
    )


@keeping("copies")
def test_copies_and_saved_states_give_the_same_and_can_be_trained_twice(example: Example):
    module, inputs = example.build(), example.inputs()
    wanted = example.call(module, *inputs)
    for _ in range(2):
        result = example.call(module, *inputs)
        if example.learned:
            result.abs().sum().backward()
    for twin in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        result = example.call(twin, *inputs)
        assert torch.equal(result, wanted)
        if example.learned:
            result.abs().sum().backward()
    other, file = example.build(), io.BytesIO()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(1.01)
    torch.save(module.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(example.call(other, *inputs), wanted)


@keeping("meta")
def test_the_meta_device_gives_the_shape(example: Example):
    inputs = example.inputs()
    wanted = example.call(example.build(), *inputs)
    result = example.call(example.build().to("meta"), *(value.to("meta") for value in inputs))
    assert result.is_meta and result.shape == wanted.shape and result.dtype == wanted.dtype


@keeping("autocast")
def test_autocast_does_not_round_a_phase(example: Example):
    module = example.build()
    single = [value.to(torch.complex64 if value.is_complex() else torch.float32) for value in example.inputs()]
    wanted = example.call(module, *single)
    with torch.autocast(single[0].device.type, torch.bfloat16):
        assert close(example.call(module, *single), wanted, 1e-5)
        if not single[0].is_complex():
            halves = [value.bfloat16() for value in single]
            exact = example.call(module, *(value.float() for value in halves))
            assert close(example.call(module, *halves).to(exact.dtype), exact, 1e-5)


# Fixed linear operators, which tests/test_operator_contracts.py compiles with the same assertions.
COMPILED_THERE = {
    "Propagator, fixed",
    "Fraunhofer",
    "RayleighSommerfeld",
    "ResampledKernel",
    "ConvergingFresnel",
    "ZoomedFilter",
    "PixelShape",
    "PupilViews",
    "DirectHologram",
    "AxialHologram",
    "AxialHologram, uneven depths",
}


@keeping("compile", but=COMPILED_THERE)
def test_compiles_without_graph_breaks(example: Example):
    torch.compiler.reset()
    module, inputs = example.build(), [value.requires_grad_() for value in example.inputs()]
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    result, wanted = example.call(compiled, *inputs), example.call(module, *inputs)
    assert close(result.detach(), wanted.detach())
    learned = [*module.parameters(), *inputs]
    got, exact = (torch.autograd.grad(value.abs().square().sum(), learned) for value in (result, wanted))
    assert all(close(one, other, 1e-7) for one, other in zip(got, exact, strict=True))


@keeping("export")
def test_exports(example: Example):
    module, inputs = example.build(), example.inputs()
    exported = torch.export.export(_Called(module, example), inputs).module()
    assert close(exported(*inputs), example.call(module, *inputs))


class _Called(nn.Module):
    def __init__(self, module: nn.Module, example: Example):
        super().__init__()
        self.module, self.example = module, example

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.example.call(self.module, *inputs)


READS = {  # on a CPU, where this costs nothing
    "DirectHologram": "is a slow reference that skips rows without light",
    "ConvolutionHologram": "asks of each plane whether it has light",
    "AxialHologram": "asks of each plane whether it has light",
    "AxialHologram, uneven depths": "asks of each plane whether it has light",
}


@pytest.mark.parametrize("example", FIXED, ids=lambda each: each.name)
def test_a_step_of_a_fixed_module_reads_nothing_back(example: Example):
    module, inputs = example.build(), [value.requires_grad_() for value in example.inputs()]
    example.call(module, *inputs)  # what is kept from the first call
    with HostReads() as reads:
        example.call(module, *inputs).abs().sum().backward()
    assert (reads.count == 0) == (example.name not in READS)


@pytest.mark.parametrize("example", FIXED, ids=lambda each: each.name)
def test_a_step_reads_nothing_back_where_it_costs(example: Example, monkeypatch):
    """As on a GPU: nothing is taken to be readable at no cost. That a GPU is none of this is in tests/core."""
    module, inputs = example.build(), [value.requires_grad_() for value in example.inputs()]
    wanted = example.call(module, *inputs)
    monkeypatch.setattr(checks, "readable", lambda *tensors: False)
    with HostReads() as reads:
        result = example.call(module, *inputs)
        got = torch.autograd.grad(result.abs().square().sum(), inputs)
    assert reads.count == 0
    assert close(result.detach(), wanted.detach())
    exact = torch.autograd.grad(wanted.abs().square().sum(), inputs)
    assert all(close(one, other) for one, other in zip(got, exact, strict=True))


WAITING = {
    "Retina, accommodation": "its sizes follow from lengths, which it reads",
    "DVRSampler": "asks which rays have ended, and where the volume is empty",
}


@pytest.mark.skipif(not DEVICES[1:], reason="no CUDA device")
@pytest.mark.parametrize("example", [each for each in EXAMPLES if each.name not in WAITING], ids=lambda each: each.name)
def test_a_step_never_waits_for_the_device(example: Example):
    """CUDA itself refuses to wait, whatever the operation that would."""
    for device in DEVICES[1:]:
        there = example.on(device)
        module, inputs = there.build(), [value.requires_grad_() for value in there.inputs()]
        there.call(module, *inputs).abs().sum().backward()  # what is kept from the first call
        torch.cuda.set_sync_debug_mode("error")
        try:
            there.call(module, *inputs).abs().sum().backward()
        finally:
            torch.cuda.set_sync_debug_mode("default")


# Behind an intensity, the derivative with respect to a distance is what is left of ik, 1e4 to 1e6 times as large.
CANCELLED = {"Retina, accommodation": 0.02, "PECProblem": 1e-3}


@pytest.mark.skipif(not DEVICES[1:], reason="no CUDA device")
@pytest.mark.parametrize("example", [each for each in EXAMPLES if not each.rounded], ids=lambda each: each.name)
def test_single_precision_elsewhere_equals_double_precision_here(example: Example):
    """Results, and gradients with respect to the inputs and all that is learned."""
    function, arguments = function_of(example, example.build())
    wanted = function(*arguments)
    # The power would hardly depend on a distance, nor that of a pixel on its phase; a sum of the results does.
    weight = light(*wanted.shape, seed=9)
    exact = torch.autograd.grad((weight * wanted).real.sum(), arguments) if arguments else ()
    for device in DEVICES[1:]:
        there = example.on(device)
        function, arguments = function_of(there, there.build())
        single = tuple(
            value if value.ndim == 0 else value.detach().to(torch.complex64 if value.is_complex() else torch.float32)
            for value in arguments
        )
        single = tuple(value.detach().requires_grad_() for value in single)
        got = function(*single)
        assert near(got, wanted, 2e-6)
        if single:
            gradients = torch.autograd.grad((weight.to(device) * got).real.sum(), single)
            tolerance = CANCELLED.get(example.name, 2e-6)
            assert all(near(one, other, tolerance) for one, other in zip(gradients, exact, strict=True))


def near(got: Tensor, wanted: Tensor, tolerance: float) -> bool:
    return bool((got.cpu().to(wanted.dtype) - wanted).abs().max() <= tolerance * wanted.abs().max())


def test_the_guide_has_this_table():
    """The table of scripts/docs/learning.md; if it is out of date, the failure prints the one to put there."""
    text = (ROOT / "scripts" / "docs" / "learning.md").read_text()
    assert table() in text, f"\n{table()}"


def table() -> str:
    """Every example and contract, "yes" or the number of the reason why not, in Markdown."""
    reasons = list(dict.fromkeys(reason for each in EXAMPLES for reason in each.without.values()))
    rows = [["module", "learns", *CONTRACTS], ["---"] * (2 + len(CONTRACTS))]
    for each in EXAMPLES:
        learns = ", ".join(f"`{name}`" for name in each.learned) or "nothing"
        cells = [f"no ({reasons.index(each.without[c]) + 1})" if c in each.without else "yes" for c in CONTRACTS]
        rows.append([each.name, learns, *cells])
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([*lines, "", *(f"{i}. {reason}." for i, reason in enumerate(reasons, 1))])


EDGES = {
    "0": torch.zeros,
    "1": torch.ones,
    "equal": lambda *shape: torch.full(shape, 0.5),
    "one lit pixel": lambda *shape: torch.zeros(shape).index_put(
        tuple(torch.tensor([n // 2]) for n in shape), torch.tensor([1.0])
    ),
    "saturated": lambda *shape: torch.full(shape, 3.0),
}
PAIR = (2, 16, 16)  # as large as the window of SSIM


def as_field(picture: Tensor) -> Tensor:
    return torch.complex(picture, torch.zeros_like(picture))


FUNCTIONS = {
    "kinoform": lambda x: kinoform(as_field(x)),
    "double_phase": lambda x: double_phase(as_field(x)),
    "intensity": lambda x: intensity(as_field(x)),
    "phasor": lambda x: phasor(x).real,
    "wrapped": wrapped,
    "snapped": lambda x: snapped(x, even_lut(3)),
    "encoding_loss": lambda x: encoding_loss(as_field(x), torch.rand(PAIR), Fraunhofer(Grid(16, 8e-6), WAVELENGTHS)),
    "psnr, equal": lambda x: metrics.psnr(x, x.detach(), data_range=1.0),
    "psnr": lambda x: metrics.psnr(x, torch.rand(PAIR), data_range=1.0),
    "ssim": lambda x: metrics.ssim(x, torch.rand(PAIR), data_range=1.0),
    "ssim, equal": lambda x: metrics.ssim(x, x.detach(), data_range=1.0),
    "speckle_contrast": metrics.speckle_contrast,
    "squared_error": lambda x: metrics.squared_error(x, torch.rand(3, *PAIR)),
    "tone_map": lambda x: tone_map(x[:1].expand(3, 16, 16)),
    "gamut_map": lambda x: gamut_map(x[:1].expand(3, 16, 16)),
    "equal_power": lambda x: equal_power(x, torch.rand(PAIR)),
    "deconvolve": lambda x: deconvolve(ThermalCrosstalk(0.66), x, max_steps=3),
    "PECProblem": lambda x: PEC(x),
    "PECProblem, amplitude": lambda x: PEC_AMPLITUDE(x),
    "PECProblem, its target": lambda x: PEC(torch.rand(PAIR), x),
    "propagate": lambda x: intensity(propagate(as_field(x), Grid(16, 8e-6), 530e-9, 1e-3)),
    "limit_peak_phase": lambda x: limit_peak_phase(2.0, x, ThermalCrosstalk(0.66)),
}
SPECTRUM = Fraunhofer(Grid(16, 8e-6), WAVELENGTHS)
PEC = PECProblem(ThermalCrosstalk(0.66), SPECTRUM, torch.ones(PAIR), scale_free=True)
PEC_AMPLITUDE = PECProblem(ThermalCrosstalk(0.66), SPECTRUM, torch.ones(PAIR), amplitude=True, limit=1.0)


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradients_are_finite_at_edge_values(name: str, edge: str):
    picture = EDGES[edge](*PAIR).requires_grad_()
    result = FUNCTIONS[name](picture)
    finite = torch.where(torch.isfinite(result), result, 0)  # the PSNR of equal pictures is infinite
    (gradient,) = torch.autograd.grad(finite.sum(), picture)
    assert torch.isfinite(gradient).all()
