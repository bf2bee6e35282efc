"""What every linear operator promises, asked of every operator in the list."""

import numpy as np
import pytest
import torch
from operators import CASES, GRID, WAVES, Case

from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import AngularSpectrum, CroppedKernel, Fresnel

pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
every_operator = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def unless_exempt(contract: str):
    """Parametrise over the operators to which a contract applies."""
    return pytest.mark.parametrize(
        "case",
        [
            pytest.param(case, marks=[pytest.mark.skip(reason=why)] if (why := case.exempt.get(contract)) else [])
            for case in CASES
        ],
        ids=lambda case: case.name,
    )


# 204 samples, operators of norm below 4: rounding of float64 sums stays under 204 * 4 * 1e-16 = 1e-13.
EXACT = 1e-12


def relative(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((got - wanted).abs().max() / wanted.abs().max()).item()


@every_operator
def test_adjoint_is_the_conjugate_transpose(case: Case):
    operator = case.build()
    x, y = case.input(), case.output()
    left = (operator(x).conj() * y).sum()
    right = (x.conj() * operator.adjoint(y)).sum()
    assert (left - right).abs() <= EXACT * operator(x).norm() * y.norm()


@every_operator
def test_equals_a_dense_matrix(case: Case):
    x, y, matrix = case.input(), case.output(), case.matrix()
    for got, given, dense in ((case.build()(x), x, matrix), (case.build().adjoint(y), y, matrix.conj().T)):
        wanted = dense @ given.numpy().ravel()
        np.testing.assert_allclose(got.numpy().ravel(), wanted, rtol=0, atol=case.tolerance * np.abs(wanted).max())


@every_operator
def test_linear(case: Case):
    operator, x, y = case.build(), case.input(), case.input()
    assert relative(operator(2.5 * x - 0.3 * y), 2.5 * operator(x) - 0.3 * operator(y)) <= EXACT


@every_operator
def test_batch_equals_its_items(case: Case):
    operator, x, y = case.build(), case.input(2, 3), case.output(2, 3)
    batch, back = operator(x), operator.adjoint(y)
    assert batch.shape == y.shape and back.shape == x.shape
    for i in range(2):
        for j in range(3):
            assert relative(batch[i, j], operator(x[i, j])) <= EXACT
            assert relative(back[i, j], operator.adjoint(y[i, j])) <= EXACT


@every_operator
def test_vmap_equals_a_batch(case: Case):
    operator, x, y = case.build(), case.input(3), case.output(3)
    assert relative(torch.vmap(operator)(x), operator(x)) <= EXACT
    assert relative(torch.vmap(operator.adjoint)(y), operator.adjoint(y)) <= EXACT


@every_operator
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_input(case: Case, dtype: torch.dtype):
    operator, x, y = case.build(), case.input(dtype=dtype), case.output(dtype=dtype)
    assert operator(x).dtype == operator.adjoint(y).dtype == x.dtype
    exact = operator(x.to(torch.float64 if case.real else torch.complex128))
    # float32 rounding of an FFT of length n grows like log2(n); measured below 4 eps here.
    assert relative(operator(x).to(exact.dtype), exact) <= 20 * torch.finfo(dtype).eps


@every_operator
def test_casting_the_module_keeps_the_kernel_whole(case: Case):
    x = case.input()
    wanted = case.build()(x)
    for cast in (
        lambda m: m.double(),
        lambda m: m.float(),
        lambda m: m.half().double(),
        lambda m: m.to("cpu", torch.bfloat16),
    ):
        assert torch.equal(cast(case.build())(x), wanted)


@every_operator
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_device_follows_the_module(case: Case):
    x = case.input()
    out = case.build().to("cuda")(x.cuda())
    assert out.device.type == "cuda"
    assert relative(out.cpu(), case.build()(x)) <= EXACT


@every_operator
def test_gradcheck(case: Case):
    operator = case.build()
    assert torch.autograd.gradcheck(operator, (case.input().requires_grad_(),), fast_mode=True)
    assert torch.autograd.gradcheck(operator.adjoint, (case.output().requires_grad_(),), fast_mode=True)


@unless_exempt("compiles")
def test_compiles_without_graph_breaks(case: Case):
    torch.compiler.reset()
    operator, x = case.build(), case.input().requires_grad_()
    compiled = torch.compile(operator, fullgraph=True, backend="aot_eager")
    assert relative(compiled(x).detach(), operator(x).detach()) <= EXACT
    weight = case.output()
    (got,) = torch.autograd.grad((compiled(x) * weight).abs().square().sum(), x)
    (wanted,) = torch.autograd.grad((operator(x) * weight).abs().square().sum(), x)
    assert relative(got, wanted) <= EXACT


@pytest.mark.parametrize("case", [case for case in CASES if case.unitary], ids=lambda case: case.name)
def test_unitary_operators_keep_power_and_are_undone_by_their_adjoint(case: Case):
    operator, x = case.build(), case.input()
    assert abs(operator(x).norm() / x.norm() - 1) <= EXACT
    assert relative(operator.adjoint(operator(x)), x) <= EXACT


@pytest.mark.parametrize(
    "operator",
    [
        AngularSpectrum(GRID, WAVES, 0.0),
        AngularSpectrum(GRID, WAVES, 0.0, pad=1),
        AngularSpectrum(GRID, 20e-6, 0.0),
        Fresnel(GRID, WAVES, 0.0),
        CroppedKernel(GRID, WAVES, 0.0),
        ThermalCrosstalk(0.0),
    ],
    ids=["angular spectrum", "periodic", "all evanescent", "Fresnel", "cropped", "no crosstalk"],
)
def test_zero_distance_and_zero_width_are_the_identity(operator):
    channels = len(getattr(operator, "wavelengths", WAVES))
    x = torch.randn(channels, *GRID.shape, dtype=torch.float64)
    x = x if isinstance(operator, ThermalCrosstalk) else torch.complex(x, torch.randn_like(x))
    assert relative(operator(x), x) <= EXACT


@every_operator
def test_refuses_a_field_of_another_shape_or_kind(case: Case):
    operator, x, y = case.build(), case.input(), case.output()
    if case.real:
        for wrong in (torch.complex(x, x), x.to(torch.int32)):
            with pytest.raises(TypeError, match="real floating-point"):
                operator(wrong)
        return
    for call, given, wrong in ((operator, x, case.wrong(x)), (operator.adjoint, y, y[..., 1:])):
        with pytest.raises(ValueError, match=r"(field|layers) must end in \([CDHWhw, ]+\)"):
            call(wrong)
        with pytest.raises(TypeError, match=r"(field|layers) must be (a )?complex"):
            call(given.real)
