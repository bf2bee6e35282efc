"""What every linear operator promises, asked of every operator in the list."""

import math
import re

import numpy as np
import pytest
import torch
from operators import CASES, GRID, SHALLOW, WAVELENGTHS, Case
from paths import DEVICES

from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import AngularSpectrum, CroppedKernel, Fresnel

pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")

# At most 5100 samples, operators of norm below 4: rounding of float64 sums stays under sqrt(5100) * 4 * 2e-16 = 1e-13.
EXACT = 1e-12


EVERYWHERE = [*CASES, *(case.on(device) for case in CASES for device in DEVICES[1:])]


def every_operator():
    """All cases, on every device that the machine has."""
    return pytest.mark.parametrize("case", EVERYWHERE, ids=[case.name for case in EVERYWHERE])


def relative(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((got - wanted).abs().max() / wanted.abs().max()).item()


@every_operator()
def test_adjoint_is_the_conjugate_transpose(case: Case):
    operator = case.build()
    x, y = case.input(2), case.output(2)
    out, back = operator(x), operator.adjoint(y)
    assert out.shape == y.shape and back.shape == x.shape
    assert ((out.conj() * y).sum() - (x.conj() * back).sum()).abs() <= EXACT * out.norm() * y.norm()


@every_operator()
def test_equals_a_dense_matrix(case: Case):
    x, y = case.input(), case.output()
    channels = math.prod(case.channels)
    results = case.build()(x), case.build().adjoint(y)
    out, back, x, y = (each.cpu().reshape(channels, -1).numpy() for each in (*results, x, y))
    for c in range(channels):
        matrix = case.matrix(c)
        wanted = matrix @ x[c]
        np.testing.assert_allclose(out[c], wanted, rtol=0, atol=case.tolerance * np.abs(wanted).max())
        wanted = matrix.conj().T @ y[c]
        np.testing.assert_allclose(back[c], wanted, rtol=0, atol=case.tolerance * np.abs(wanted).max())


@every_operator()
def test_linear(case: Case):
    operator, x, y = case.build(), case.input(), case.input()
    factor = -0.3 if case.real else -0.3j
    assert relative(operator(2.5 * x + factor * y), 2.5 * operator(x) + factor * operator(y)) <= EXACT


@every_operator()
def test_batch_equals_its_items(case: Case):
    operator = case.build()
    for apply, x in ((operator, case.input(2, 3)), (operator.adjoint, case.output(2, 3))):
        batch = apply(x)
        for i in range(2):
            for j in range(3):
                assert relative(batch[i, j], apply(x[i, j])) <= EXACT


@every_operator()
def test_vmap_equals_a_batch(case: Case):
    operator, x = case.build(), case.input(3)
    assert relative(torch.vmap(operator)(x), operator(x)) <= EXACT
    assert relative(torch.vmap(operator, in_dims=-1)(x.movedim(0, -1)), operator(x)) <= EXACT


@every_operator()
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_input(case: Case, dtype: torch.dtype):
    operator, x = case.build(), case.input(dtype=dtype)
    assert operator(x).dtype == x.dtype
    assert operator.adjoint(case.output(dtype=dtype)).dtype == x.dtype
    exact = operator(x.to(torch.float64 if case.real else torch.complex128))
    # float32 rounding of an FFT of length n grows like log2(n); measured below 4 eps here.
    assert relative(operator(x).to(exact.dtype), exact) <= 20 * torch.finfo(dtype).eps


@every_operator()
def test_casting_the_module_keeps_the_kernel_whole(case: Case):
    x = case.input()
    wanted = case.build()(x)
    for cast in (
        lambda m: m.double(),
        lambda m: m.float(),
        lambda m: m.half().double(),
        lambda m: m.to(case.device, torch.bfloat16),
    ):
        assert torch.equal(cast(case.build())(x), wanted)


@pytest.mark.skipif(not DEVICES[1:], reason="no CUDA device")
@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_device_follows_the_module(case: Case):
    x, y = case.input(), case.output()
    for device in DEVICES[1:]:
        operator = case.build().to(device)
        for apply, value, wanted in (
            (operator, x, case.build()(x)),
            (operator.adjoint, y, case.build().adjoint(y)),
        ):
            exact = apply(value.to(device))
            single = apply(value.to(device, torch.float32 if case.real else torch.complex64))
            assert exact.device.type == single.device.type == device
            assert relative(exact.cpu(), wanted) <= EXACT
            assert relative(single.cpu().to(wanted.dtype), wanted) <= 2e-6


@every_operator()
def test_gradcheck(case: Case):
    operator = case.build()
    assert torch.autograd.gradcheck(operator, (case.input().requires_grad_(),), fast_mode=True)
    assert torch.autograd.gradcheck(operator.adjoint, (case.output().requires_grad_(),), fast_mode=True)


# Not compiled once more: operators whose graph has the operations of another one in the list, with other numbers.
SAME_GRAPH = {
    "cropped paraxial kernel, near",
    *(f"cropped exact kernel, {each}" for each in ("near", "far")),  # the planned one is such a kernel
    *(
        f"angular spectrum, {each}"
        for each in ("far, band-limited", "backwards", "evanescent", "evanescent, backwards")
    ),
    *(f"Fresnel, {each}" for each in ("backwards", "periodic")),
    "pixel shape, two orders",
}
# The box of ConvolutionHologram is compiled in tests/test_every_module.py.
COMPILED = [
    case
    for case in EVERYWHERE
    if case.name not in SAME_GRAPH | {case.name for case in SHALLOW} and not re.match("Direct|Convolution", case.name)
]


@pytest.mark.parametrize("case", [*COMPILED, *SHALLOW], ids=lambda case: case.name)
def test_compiles_without_graph_breaks(case: Case):
    torch.compiler.reset()
    operator, x = case.build(), case.input().requires_grad_()
    compiled = torch.compile(operator, fullgraph=True, backend="aot_eager")
    assert relative(compiled(x).detach(), operator(x).detach()) <= EXACT
    weight = case.output()
    (got,) = torch.autograd.grad((compiled(x) * weight).abs().square().sum(), x)
    (wanted,) = torch.autograd.grad((operator(x) * weight).abs().square().sum(), x)
    assert relative(got, wanted) <= EXACT


def test_a_compiled_operator_does_not_compute_its_kernel_in_each_call():
    operations = []

    def backend(graph: torch.fx.GraphModule, inputs: list[torch.Tensor]):
        operations.extend(node.target for node in graph.graph.nodes)
        return graph.forward

    torch.compiler.reset()
    x = torch.ones(len(WAVELENGTHS), *GRID.shape, dtype=torch.complex128)
    torch.compile(Fresnel(GRID, WAVELENGTHS, 50e-6, pad=2), fullgraph=True, backend=backend)(x)
    assert operations and torch.cos not in operations


@pytest.mark.parametrize("case", [case for case in EVERYWHERE if case.unitary], ids=lambda case: case.name)
def test_unitary_operators_keep_power_and_are_undone_by_their_adjoint(case: Case):
    operator, x = case.build(), case.input()
    assert abs(operator(x).norm() / x.norm() - 1) <= EXACT
    assert relative(operator.adjoint(operator(x)), x) <= EXACT


@pytest.mark.parametrize(
    "operator",
    [
        AngularSpectrum(GRID, WAVELENGTHS, 0.0),
        AngularSpectrum(GRID, WAVELENGTHS, 0.0, pad=1),
        AngularSpectrum(GRID, 20e-6, 0.0),
        Fresnel(GRID, WAVELENGTHS, 0.0),
        CroppedKernel(GRID, WAVELENGTHS, 0.0),
        ThermalCrosstalk(0.0),
    ],
    ids=["angular spectrum", "periodic", "all evanescent", "Fresnel", "cropped", "no crosstalk"],
)
def test_zero_distance_and_zero_width_are_the_identity(operator):
    channels = len(getattr(operator, "wavelengths", WAVELENGTHS))
    x = torch.randn(channels, *GRID.shape, dtype=torch.float64)
    x = x if isinstance(operator, ThermalCrosstalk) else torch.complex(x, torch.randn_like(x))
    assert relative(operator(x), x) <= EXACT


@every_operator()
def test_refuses_other_shapes_and_dtypes(case: Case):
    operator, x, y = case.build(), case.input(), case.output()
    if case.refusal:
        with pytest.raises(ValueError, match=case.refusal):
            operator(x[..., :-1])
    if case.real:
        for apply, value in ((operator, x), (operator.adjoint, y)):
            with pytest.raises(TypeError, match="real floating-point"):
                apply(torch.complex(value, value))
            with pytest.raises(TypeError, match="real floating-point"):
                apply(value.to(torch.int32))
    else:
        with pytest.raises(ValueError, match="field must end in"):
            operator.adjoint(y[..., :-1])
        with pytest.raises(TypeError, match="must be .*complex"):
            operator(x.real)
        with pytest.raises(TypeError, match="field must be complex"):
            operator.adjoint(y.real)
