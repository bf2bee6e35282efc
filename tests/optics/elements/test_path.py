import pytest
import torch

from holotorch import Grid
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Aperture, Fraunhofer, Fresnel, Lens, OpticalPath, RayleighSommerfeld

GRID, OUT = Grid((12, 17), (5e-6, 4e-6)), Grid((9, 14), (3e-6, 7e-6))
WAVES = (630e-9, 530e-9)


def build() -> OpticalPath:
    elements = [Fresnel(GRID, WAVES, 50e-6), Lens(GRID, WAVES, 2e-3, radius=28e-6), Aperture(GRID, WAVES, 25e-6)]
    return OpticalPath([OpticalPath(elements), RayleighSommerfeld(GRID, WAVES, 700e-6, out_grid=OUT)])


def test_forward_is_one_after_the_other_and_adjoint_the_way_back():
    path = build()
    x = torch.randn(3, 2, *GRID.shape, dtype=torch.complex128)
    y = torch.randn(3, 2, *OUT.shape, dtype=torch.complex128)
    out, wanted = path(x), x
    for element in [*path[0].children(), path[1]]:
        wanted = element(wanted)
    assert len(list(path[0].children())) == 3
    torch.testing.assert_close(out, wanted)
    # 204 samples, operators of norm below 4, float64.
    assert abs((out.conj() * y).sum() - (x.conj() * path.adjoint(y)).sum()) < 1e-12 * out.norm() * y.norm()
    assert (path.grid, path.out_grid, path.wavelengths) == (GRID, OUT, WAVES)
    assert torch.autograd.gradcheck(path, (x[:1].requires_grad_(),), fast_mode=True)


def test_neighbours_are_checked():
    lens = Lens(GRID, WAVES, 2e-3)
    with pytest.raises(ValueError, match=r"elements 1 \(RayleighSommerfeld\) and 2 \(Lens\).* share their sampling"):
        OpticalPath([lens, RayleighSommerfeld(GRID, WAVES, 700e-6, out_grid=OUT), lens])
    with pytest.raises(ValueError, match=r"elements 0 \(Lens\) and 1 \(Lens\).* must share wavelengths"):
        OpticalPath([lens, Lens(GRID, WAVES[::-1], 2e-3)])
    with pytest.raises(ValueError, match="nothing can follow"):
        OpticalPath([Fraunhofer(GRID, WAVES), lens])
    assert OpticalPath([lens, Fraunhofer(GRID, WAVES)]).out_grid == GRID
    with pytest.raises(TypeError, match="got ThermalCrosstalk without grid and wavelengths"):
        OpticalPath([ThermalCrosstalk(1.0)])
    with pytest.raises(ValueError, match="at least one element"):
        OpticalPath([])
