import pytest
import torch

from holotorch import Grid
from holotorch.optics import AngularSpectrum, CroppedKernel, DepthStack, Fraunhofer, Fresnel
from holotorch.optics.free_space.propagators import SpectralFilter

GRID, WAVES, DISTANCES = Grid((12, 17), (5e-6, 4e-6)), (630e-9, 530e-9), (50e-6, -80e-6, 2e-3)
EXACT = 1e-12  # as for single operators: 204 samples, norms below 4
pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")

MEMBERS = {
    "angular spectrum": lambda z: AngularSpectrum(GRID, WAVES, z),
    "Fresnel": lambda z: Fresnel(GRID, WAVES, z, pad=1.5),
    "cropped": lambda z: CroppedKernel(GRID, WAVES, z, paraxial=True),
}
each_member = pytest.mark.parametrize("make", MEMBERS.values(), ids=MEMBERS)


def stack(make) -> DepthStack:
    return DepthStack([make(z) for z in DISTANCES])


def field(*shape: int, dtype: torch.dtype = torch.complex128) -> torch.Tensor:
    return torch.randn(*shape, *GRID.shape, dtype=dtype)


def relative(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((got - wanted).abs().max() / wanted.abs().max()).item()


@each_member
def test_equals_its_members(make):
    x = field(3, 2)
    out = stack(make)(x)
    assert out.shape == (3, 2, 3, *GRID.shape)
    for d, z in enumerate(DISTANCES):
        assert relative(out[..., d, :, :], make(z)(x)) <= EXACT


def test_one_depth_keeps_its_axis():
    assert DepthStack([Fresnel(GRID, WAVES, 1e-4)])(field(2)).shape == (2, 1, *GRID.shape)


@pytest.mark.parametrize(
    "other",
    [
        Fresnel(Grid((12, 17), (5e-6, 5e-6)), WAVES, 1e-4),
        Fresnel(Grid((12, 16), (5e-6, 4e-6)), WAVES, 1e-4),
        Fresnel(GRID, (630e-9, 531e-9), 1e-4),
        Fresnel(GRID, WAVES[:1], 1e-4),
        Fresnel(GRID, WAVES, 1e-4, pad=3),
    ],
    ids=["pitch", "shape", "wavelength", "channels", "padding"],
)
def test_refuses_members_that_differ(other):
    with pytest.raises(ValueError, match="DepthStack needs propagators of one grid"):
        DepthStack([Fresnel(GRID, WAVES, 1e-4), other])


def test_refuses_no_members_and_other_fields():
    with pytest.raises(ValueError, match="at least one propagator"):
        DepthStack([])
    kernel = torch.ones(2, 24, 34, dtype=torch.complex128)
    moved = SpectralFilter(GRID, WAVES, kernel, out_grid=Grid((10, 17), GRID.pitch))
    with pytest.raises(ValueError, match="result has the grid of the field"):
        DepthStack([moved, moved])
    with pytest.raises(ValueError, match="propagators of one grid"):
        DepthStack([SpectralFilter(GRID, WAVES, kernel), moved])
    with pytest.raises(TypeError, match="filters in frequency"):
        DepthStack([Fraunhofer(GRID, WAVES)])  # type: ignore[list-item]
    operator = stack(MEMBERS["Fresnel"])
    with pytest.raises(ValueError, match=r"field must end in \(C, H, W\) = \(2, 12, 17\), got \(2, 17, 12\)"):
        operator(field(2).mT)
    with pytest.raises(TypeError, match="field must be complex"):
        operator(field(2).real)
    for wrong in (field(2, 2), field(3, 3), field(2)):
        with pytest.raises(ValueError, match=r"field must end in \(C, D, H, W\) = \(2, 3, 12, 17\)"):
            operator.adjoint(wrong)
    with pytest.raises(TypeError, match="field must be complex"):
        operator.adjoint(field(2, 3).real)
