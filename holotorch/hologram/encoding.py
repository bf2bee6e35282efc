"""Encodings of complex holograms as phases for phase-only modulators, and the error that they cause.

Each encoding raises TypeError unless the hologram is a complex tensor [..., H, W], and ValueError if it has no pixels,
or values that are not finite. The phases are real [..., H, W] in radians.
"""

import cmath
from collections.abc import Callable

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor


def kinoform(field: Tensor) -> Tensor:
    """Phase of a complex hologram [..., H, W]; the amplitude is discarded. The gradient at a dark pixel is zero."""
    return _phase(_checked(field))


def double_phase(field: Tensor) -> Tensor:
    """Double-phase encoding: arg(field) + acos(a) and arg(field) - acos(a), alternating in a checkerboard.

    Here a is the amplitude of the field [..., H, W], scaled to a maximum of 1. The phasors of the two phases average to
    the scaled field. Their alternation lies at the highest frequencies, which an aperture in the Fourier plane removes.
    In a black hologram the phases of neighbours differ by pi, so that they cancel. Source: Hsueh and Sawchuk (1978), as
    used by Maimone et al. (2017).

    Gradients are finite everywhere. They are set to zero where no derivative exists: for the phase of a dark pixel, and
    for the arccosine at the largest amplitude.
    """
    field = _checked(field)
    amplitude = field.abs()
    peak = amplitude.amax((-2, -1), keepdim=True)
    scaled = amplitude / torch.where(peak > 0, peak, 1)
    below_peak = scaled < 1
    offset = torch.where(below_peak, torch.acos(torch.where(below_peak, scaled, 0)), 0)
    rows, columns = (torch.arange(count, device=field.device) for count in field.shape[-2:])
    sign = 1 - 2 * ((rows[:, None] + columns) % 2)
    return _phase(field) + sign * offset


def error_diffused(field: Tensor) -> Tensor:
    """Phase of a complex hologram [..., H, W] by diffusion of the error of each pixel to four later neighbours.

    The error is the scaled field minus its unit phasor. Rows are scanned in alternating directions. Diffusion shifts
    the error to high frequencies, where it is less visible. The scan is sequential, takes half a second for 512 x 512
    pixels and has no gradient. Source: Floyd and Steinberg (1976), applied to fields by Tsang and Poon (2013).
    """
    field = _checked(field)
    peak = field.abs().amax((-2, -1), keepdim=True)
    flat = (field / torch.where(peak > 0, peak, 1)).reshape(-1, *field.shape[-2:]).cpu()
    height, width = field.shape[-2:]
    encoded = []
    for item in flat:
        # An additional column on either side and a row at the bottom receive the error that leaves the hologram.
        rows = [[0j, *row, 0j] for row in item.tolist()] + [[0j] * (width + 2)]
        for i in range(height):
            row, below, step = rows[i], rows[i + 1], 1 if i % 2 == 0 else -1
            for j in range(1, width + 1)[::step]:
                size = abs(row[j])
                unit = row[j] / size if size else 1.0
                error = row[j] - unit
                row[j] = cmath.phase(unit)
                row[j + step] += error * (7 / 16)
                below[j] += error * (5 / 16)
                below[j - step] += error * (3 / 16)
                below[j + step] += error * (1 / 16)
        encoded.append([row[1:-1] for row in rows[:height]])
    return torch.tensor(encoded, dtype=field.real.dtype, device=field.device).reshape(field.shape)


def iterated(
    field: Tensor, propagate: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor], *, steps: int = 30
) -> Tensor:
    """Phase [..., H, W] by Gerchberg-Saxton iterations, which match the amplitude of the hologram in another plane.

    Args:
        field: Complex hologram [..., H, W].
        propagate: Propagation of a field from the hologram to that plane.
        adjoint: Conjugate transpose of ``propagate``, used as its approximate inverse.
        steps: Number of iterations.
    """
    field = _checked(field)
    if not field.numel():  # an empty batch, for which FFTs raise an error
        return torch.angle(field)
    target = propagate(field)
    power = field.abs().square().mean((-2, -1), keepdim=True)
    strength = target.abs() * power.clamp(min=torch.finfo(power.dtype).tiny).rsqrt()
    phase = torch.angle(field)
    for _ in range(steps):
        there = propagate(phasor(phase))
        phase = torch.angle(adjoint(strength * phasor(torch.angle(there))))
    return phase


def encoding_loss(field: Tensor, phase: Tensor, view: Callable[[Tensor], Tensor]) -> Tensor:
    """Squared error of the intensity |view(exp(i phase))|^2 relative to |view(field)|^2, one per hologram: [...].

    The first intensity is multiplied by the factor that minimises the error. ``view`` propagates holograms [..., H, W]
    to the image plane, including any aperture.
    """
    target, shown = intensity(view(field)), intensity(view(phasor(phase)))
    tiny = torch.finfo(shown.dtype).tiny
    scale = (target * shown).sum((-2, -1)) / shown.square().sum((-2, -1)).clamp(min=tiny)
    error = (scale[..., None, None] * shown - target).square().sum((-2, -1))
    return error / target.square().sum((-2, -1)).clamp(min=tiny)


def _checked(field: Tensor) -> Tensor:
    """Check ``field``, and set values of subnormal amplitude to zero, since their derivatives overflow."""
    if not isinstance(field, Tensor) or not field.is_complex():
        raise TypeError(f"field must be a complex tensor (..., H, W), got {getattr(field, 'dtype', type(field))}")
    if field.ndim < 2 or 0 in field.shape[-2:]:
        raise ValueError(f"field must end in (H, W), both at least 1, got {tuple(field.shape)}")
    checks.all_finite("field", field)
    return torch.where(field.detach().abs() >= torch.finfo(field.dtype).tiny, field, 0)


def _phase(field: Tensor) -> Tensor:
    """Phase in rad, 0 where the field is 0."""
    amplitude = field.abs()
    # The field is divided by its amplitude, since the derivative of torch.angle squares it, which may underflow.
    return torch.angle(field / torch.where(amplitude > 0, amplitude, 1))
