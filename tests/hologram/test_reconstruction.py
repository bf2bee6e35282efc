import pytest
import torch

from holotorch import Grid
from holotorch.core.complex import intensity, phasor
from holotorch.hologram import (
    ConvolutionHologram,
    double_phase,
    encoding_loss,
    error_diffused,
    focal_stack,
    iterated,
    kinoform,
    perspective,
    refocused,
)

GRID, WAVE = Grid(96, 3.74e-6), 520e-9
DEPTHS = (3e-3, 6e-3)


def hologram() -> torch.Tensor:
    """A bright point at 3 mm on the left and one at 6 mm on the right."""
    layers = torch.zeros(2, 96, 96, dtype=torch.complex128)
    layers[0, 48, 30] = layers[1, 48, 66] = 1.0
    return ConvolutionHologram(GRID, WAVE, DEPTHS, cone="taper")(layers)


def test_refocusing_sharpens_what_is_there():
    field = hologram()
    near, far = focal_stack(field, GRID, WAVE, DEPTHS)
    assert divmod(int(near.argmax()), 96) == (48, 30) and divmod(int(far.argmax()), 96) == (48, 66)
    assert near[48, 30] > 5 * near[48, 66] and far[48, 66] > 2 * far[48, 30]
    assert torch.equal(near, intensity(refocused(field, GRID, WAVE, DEPTHS[0])))


def test_a_pupil_at_the_side_sees_near_things_move():
    """Followed back to the far plane, the near point moves by the difference of depth times the tangent."""
    layers = torch.zeros(1, 96, 96, dtype=torch.complex128)
    layers[0, 48, 48] = 1.0
    field, sine = ConvolutionHologram(GRID, WAVE, DEPTHS[:1], cone="taper")(layers), 0.02
    columns, places = torch.arange(96, dtype=torch.float64), []
    for s in (-sine, sine):
        seen = perspective(field, GRID, WAVE, direction=(0.0, s), aperture=0.02)
        image = intensity(refocused(seen, GRID, WAVE, 6e-3)).sum(0)
        places.append(((image * columns).sum() / image.sum()).item())
    # What diffracts at the pupil's rim leaves the window of 96 samples, more of it on the nearer side.
    assert (places[0] - places[1]) * 3.74e-6 == pytest.approx(2 * 3e-3 * sine, rel=0.1)
    with pytest.raises(ValueError, match="outside the hologram's band of sines up to 0.0695"):
        perspective(field, GRID, WAVE, direction=(0.0, 0.5), aperture=0.02)


def view(field: torch.Tensor) -> torch.Tensor:
    """The far point's plane through an aperture of half the band."""
    return refocused(perspective(field, GRID, WAVE, direction=(0.0, 0.0), aperture=0.035), GRID, WAVE, 6e-3)


def test_encodings_lose_as_much_as_is_known_of_them():
    torch.manual_seed(0)
    layers = torch.zeros(1, 96, 96, dtype=torch.complex128)
    layers[0, 30:66, 30:66] = torch.rand(36, 36).double().sqrt() * phasor(2 * torch.pi * torch.rand(36, 36).double())
    field = ConvolutionHologram(GRID, WAVE, (6e-3,), cone="taper")(layers)
    found = {
        "kinoform": kinoform(field),
        "double": double_phase(field),
        "diffused": error_diffused(field),
        "iterated": iterated(
            field, lambda u: refocused(u, GRID, WAVE, 6e-3), lambda u: refocused(u.conj(), GRID, WAVE, 6e-3).conj()
        ),
    }
    loss = {name: encoding_loss(field, phase, view).item() for name, phase in found.items()}
    assert all(phase.shape == field.shape and phase.dtype == torch.float64 for phase in found.values())
    assert loss["double"] < 0.5 * loss["kinoform"] and loss["diffused"] < 0.5 * loss["kinoform"]
    assert encoding_loss(field, torch.angle(field), lambda u: field).item() < 1e-20


def test_double_phases_have_the_field_as_their_mean():
    field = torch.randn(2, 8, 8, dtype=torch.complex128)
    phase = double_phase(field)
    sign = 1 - 2 * ((torch.arange(8)[:, None] + torch.arange(8)) % 2)
    other = 2 * torch.angle(field) - phase
    peak = field.abs().amax((-2, -1), keepdim=True)
    assert torch.allclose((phasor(phase) + phasor(other)) / 2 * peak, field, atol=1e-12)
    assert ((phase - torch.angle(field)) * sign >= 0).all()
