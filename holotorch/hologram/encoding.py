"""Encodings of complex holograms as phases for phase-only modulators, and the error that they cause."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import intensity, phasor


def kinoform(field: Tensor) -> Tensor:
    """Phase of a complex hologram [..., H, W] in rad; the amplitude is discarded. Gradients as :func:`double_phase`.

    Raises:
        TypeError, ValueError: Not complex [..., H, W], no pixels, or values that are not finite.
    """
    return _phase(_checked(field))


def double_phase(field: Tensor) -> Tensor:
    """Double-phase encoding: two phases in a checkerboard whose phasors average to the field, real [..., H, W] in rad.

    The field is scaled to a largest amplitude of 1. The difference between neighbours lies at the highest frequencies,
    which an aperture in the Fourier plane removes. A black hologram gives two phases that cancel. Source: Hsueh and
    Sawchuk (1978), as used by Maimone et al. (2017).

    Gradients are finite everywhere. Two terms without a derivative have gradient zero: the phase of a dark pixel, and
    the arccosine of the pixel with the largest amplitude, whose scaled amplitude is always 1.

    Raises:
        TypeError, ValueError: Not complex [..., H, W], no pixels, or values that are not finite.
    """
    field = _checked(field)
    amplitude = field.abs()
    peak = amplitude.amax((-2, -1), keepdim=True)
    scaled = amplitude / torch.where(peak > 0, peak, 1)
    below_peak = scaled < 1
    offset = torch.where(below_peak, torch.acos(torch.where(below_peak, scaled, 0)), 0)
    height, width = field.shape[-2:]
    rows, columns = torch.arange(height, device=field.device), torch.arange(width, device=field.device)
    sign = 1 - 2 * ((rows[:, None] + columns) % 2)
    return _phase(field) + sign * offset


def error_diffused(field: Tensor) -> Tensor:
    """Phase in rad of a complex hologram [..., H, W] by error diffusion to the four next neighbours of each pixel.

    Rows are scanned in alternating direction. The error moves to high frequencies, where it is less visible. The scan
    is sequential and takes half a second for 512 x 512 pixels. Source: Floyd and Steinberg (1976), applied to fields
    by Tsang and Poon (2013).

    Raises:
        TypeError, ValueError: Not complex [..., H, W], no pixels, or values that are not finite.
    """
    field = _checked(field)
    peak = field.abs().amax((-2, -1), keepdim=True)
    flat = (field / torch.where(peak > 0, peak, 1)).reshape(-1, *field.shape[-2:]).cpu()
    encoded = []
    for item in flat:
        rows, phases = [list(map(complex, row)) for row in item.tolist()], []
        for i, row in enumerate(rows):
            below = rows[i + 1] if i + 1 < len(rows) else None
            step = 1 if i % 2 == 0 else -1
            phase = [0.0] * len(row)
            for j in range(len(row))[::step]:
                value = row[j]
                size = abs(value)
                shown = value / size if size else 1.0
                phase[j] = math.atan2(shown.imag, shown.real)
                error = value - shown
                ahead, behind = j + step, j - step
                if 0 <= ahead < len(row):
                    row[ahead] += error * (7 / 16)
                if below is not None:
                    below[j] += error * (5 / 16)
                    if 0 <= behind < len(row):
                        below[behind] += error * (3 / 16)
                    if 0 <= ahead < len(row):
                        below[ahead] += error * (1 / 16)
            phases.append(phase)
        encoded.append(phases)
    return torch.tensor(encoded, dtype=field.real.dtype, device=field.device).reshape(field.shape)


def iterated(
    field: Tensor, propagate: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor], *, steps: int = 30
) -> Tensor:
    """Phase in rad whose propagated field has the amplitude of the propagated hologram, by Gerchberg-Saxton.

    Args:
        field: Complex hologram [..., H, W].
        propagate: Propagation to the plane at which amplitudes are compared.
        adjoint: Conjugate transpose of ``propagate``, used as its approximate inverse.
        steps: Number of iterations.

    Raises:
        TypeError, ValueError: Not complex [..., H, W], no pixels, or values that are not finite.
    """
    field = _checked(field)
    if not field.numel():  # an empty batch, which transforms refuse
        return torch.angle(field)
    wanted = propagate(field)
    power = field.abs().square().mean((-2, -1), keepdim=True)
    strength = wanted.abs() * power.clamp(min=torch.finfo(power.dtype).tiny).rsqrt()
    phase = torch.angle(field)
    for _ in range(steps):
        there = propagate(phasor(phase))
        phase = torch.angle(adjoint(strength * phasor(torch.angle(there))))
    return phase


def encoding_loss(field: Tensor, phase: Tensor, view: Callable[[Tensor], Tensor]) -> Tensor:
    """Relative squared error [...] of the image |view(.)|^2 of a phase against that of the field, optimally scaled.

    ``view`` maps holograms [..., H, W] to the image plane, including any aperture.
    """
    wanted, shown = intensity(view(field)), intensity(view(phasor(phase)))
    scale = (wanted * shown).sum((-2, -1)) / shown.square().sum((-2, -1)).clamp(min=torch.finfo(shown.dtype).tiny)
    error = (scale[..., None, None] * shown - wanted).square().sum((-2, -1))
    return error / wanted.square().sum((-2, -1)).clamp(min=torch.finfo(shown.dtype).tiny)


def _checked(field: Tensor) -> Tensor:
    """The checked field, with subnormal values, whose derivatives overflow, set to zero."""
    if not isinstance(field, Tensor) or not field.is_complex():
        raise TypeError(f"field must be a complex tensor (..., H, W), got {getattr(field, 'dtype', type(field))}")
    if field.ndim < 2 or 0 in field.shape[-2:]:
        raise ValueError(f"field must end in (H, W), both at least 1, got {tuple(field.shape)}")
    checks.all_finite("field", field)
    return torch.where(field.detach().abs() >= torch.finfo(field.dtype).tiny, field, 0)


def _phase(field: Tensor) -> Tensor:
    """Phase in rad, 0 where the field is 0.

    It is computed from the unit phasor, since the derivative of torch.angle squares the amplitude, which may underflow.
    """
    amplitude = field.abs()
    return torch.angle(field / torch.where(amplitude > 0, amplitude, 1))
