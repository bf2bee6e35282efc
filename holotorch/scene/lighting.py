"""Light on a volume: Phong shading with the gradient as surface normal, and single scattering with shadows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from holotorch.core import checks
from holotorch.scene.compositing import extinction, safe_sqrt
from holotorch.scene.placement import Placement
from holotorch.scene.transfer import TransferFunction
from holotorch.scene.volume import Triple, Volume


@dataclass(frozen=True)
class Lighting:
    """A distant white light and the reflectance of the volume in the Phong model (1975).

    The shaded colour is colour * (ambient + diffuse * (n . l)) + specular * (r . v)^shininess. The normal n is the
    direction of the gradient of the values or its opposite, whichever points towards the observer. l is the direction
    to the light, r is l mirrored at n, and v is the direction to the observer along the axis. Where the value is
    constant there is no surface, and the result is colour * (ambient + diffuse). The first formula has the weight
    g^2 / (g^2 + 1), where g is the norm of the :func:`slopes`, so that the result and its derivative are finite.

    Attributes:
        towards: Direction to the light, (z, y, x) in the scene, of any length; z points away from the hologram.
        ambient: Strength of the ambient term, >= 0.
        diffuse: Strength of the diffuse term, >= 0.
        specular: Strength of the highlight, >= 0.
        shininess: Exponent of the highlight, >= 1; a larger exponent gives a sharper highlight.

    Raises:
        ValueError: A negative strength, a shininess below 1, or a direction of length zero.
    """

    towards: Triple = (-1.0, -0.5, -0.5)
    ambient: float = 0.2
    diffuse: float = 0.7
    specular: float = 0.1
    shininess: float = 20.0

    def __post_init__(self) -> None:
        _direction(self.towards)
        for name in ("ambient", "diffuse", "specular"):
            checks.nonnegative(name, getattr(self, name))
        if checks.finite("shininess", self.shininess) < 1:
            raise ValueError(f"shininess must be at least 1, got {self.shininess}")

    def shade(self, colour: Tensor, slopes: Tensor, rotation: Tensor, observer: float) -> Tensor:
        """Shaded colour [C, n] of n points from their ``colour`` without lighting, [C, n].

        ``slopes`` [3, n] are those of :func:`slopes` along the axes (z, y, x) of the volume. ``rotation`` [3, 3] maps
        vectors in these axes to the scene. ``observer`` is -1 if the observer is on the side of lower z, else 1.
        """
        light = _direction(self.towards).to(rotation) @ rotation
        view = rotation[0] * observer
        facing = (light @ view).item()
        light, view = light.to(slopes.dtype), view.to(slopes.dtype)
        square = slopes.square().sum(0)
        to_light, to_view = torch.einsum("ca,an->cn", torch.stack([light, view]), slopes)
        inverse = 1 / (square + 1)
        share = square * inverse
        lit = torch.where(to_view < 0, -to_light, to_light).clamp(min=0) * safe_sqrt(square) * inverse
        shaded = colour * (self.ambient + self.diffuse * (1 - share + lit))
        if not self.specular:
            return shaded
        mirrored = (2 * to_light * to_view * inverse - facing * share).clamp(min=0)
        return shaded + self.specular * mirrored.pow(self.shininess) * (lit > 0)


@dataclass(frozen=True)
class Scattering:
    """A distant white light that the volume scatters once: shadows, soft for a large light, and translucency.

    The light integral is computed at the samples of the volume, as thesis Sec. 6.4.3 proposes: L = 1 / N sum_i p_i T_i
    over N random directions within the light. T_i is the transmittance from the sample to the outside in direction i,
    with the opacities of the transfer function, and p_i the phase function. A source of colour c has the radiance
    c * (ambient + strength * L). Each direction is one sweep through the volume (:func:`optical_depth`).

    Attributes:
        towards: Direction to the middle of the light, (z, y, x) in the scene, of any length; z points away from the
            hologram.
        half_angle: Angle in radians between its middle and its edge; 0 for a point, pi for light from all sides.
        ambient: Light without shadows, >= 0.
        strength: Strength of the scattered light, >= 0.
        anisotropy: Mean cosine g of the angle of scattering, -1 < g < 1, in Henyey and Greenstein's phase function
            (1941), whose mean over all directions is 1 here. Tissue scatters forward, with g near 0.9.
        samples: Number N of directions; the error falls as 1 / sqrt(N), or faster, since they are stratified.
        seed: Of the random directions.

    Raises:
        ValueError: A number out of its range, or a direction of length zero.
    """

    towards: Triple = (-1.0, -0.5, -0.5)
    half_angle: float = 0.3
    ambient: float = 0.2
    strength: float = 0.8
    anisotropy: float = 0.0
    samples: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        _direction(self.towards)
        for name in ("ambient", "strength"):
            checks.nonnegative(name, getattr(self, name))
        if not 0 <= checks.finite("half_angle", self.half_angle, "radians") <= math.pi:
            raise ValueError(f"half_angle must be from 0 to pi radians, got {self.half_angle}")
        if not -1 < checks.finite("anisotropy", self.anisotropy) < 1:
            raise ValueError(f"anisotropy must be a mean cosine above -1 and below 1, got {self.anisotropy}")
        checks.whole("samples", self.samples, 1)

    def shade(self, colour: Tensor, lit: Tensor, rotation: Tensor, observer: float) -> Tensor:
        """Colour [C, n] of n points in the light ``lit`` [1, n] of :meth:`illumination`."""
        return colour * (self.ambient + self.strength * lit)

    def directions(self) -> Tensor:
        """Unit vectors [N, 3] (z, y, x) in the scene from a point to the light, uniform over its solid angle."""
        generator = torch.Generator().manual_seed(self.seed)
        first, second = torch.rand(2, self.samples, generator=generator, dtype=torch.float64)
        cosine = 1 - (torch.arange(self.samples) + first) / self.samples * (1 - math.cos(self.half_angle))
        around, sine = 2 * math.pi * second, (1 - cosine.square()).clamp(min=0).sqrt()
        middle = _direction(self.towards)
        across = torch.linalg.cross(middle, torch.eye(3, dtype=torch.float64)[middle.abs().argmin()])
        across = across / across.norm()
        down = torch.linalg.cross(middle, across)
        sideways = around.cos()[:, None] * across + around.sin()[:, None] * down
        return cosine[:, None] * middle + sine[:, None] * sideways

    def illumination(self, volume: Volume, place: Placement, transfer: TransferFunction, observer: float) -> Tensor:
        """Scattered light L at the samples of ``volume``, [D, H, W]; differentiable in values and opacities."""
        unit = transfer.unit_distance * max(place.half) * 2  # in metres
        # A few slices at a time, since a transfer function also gives the colours.
        density = torch.cat([extinction(transfer(part)[1]) / unit for part in volume.values.split(16)])
        rotation = torch.tensor(place.rotation, dtype=torch.float64)
        total = torch.zeros_like(density)
        for towards in self.directions():
            # Light travels along -towards, and to the observer along the axis.
            cosine, g = -towards[0].item() * observer, self.anisotropy
            phase = (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5
            total = total + phase / self.samples * torch.exp(-optical_depth(density, place.spacing, towards @ rotation))
        return total


def optical_depth(density: Tensor, spacing: Triple, towards: Tensor) -> Tensor:
    """Integral of ``density`` [D, H, W] per metre from each sample out of the volume along ``towards`` (z, y, x).

    Slices are swept along the axis that ``towards`` is nearest to, in coordinates that follow the rays: each slice is
    interpolated linearly once to add it to the integral along the rays, by the trapezoidal rule, and the integral once
    at its samples. Outside the volume the density is 0.
    """
    axis = int(towards.abs().argmax())
    order = [axis, *(other for other in range(3) if other != axis)]
    behind = towards[axis] > 0  # the light is behind the last slice
    swept = density.permute(order).flip(0) if behind else density.permute(order)
    step = spacing[axis] / abs(towards[axis].item())  # metres along the ray from one slice to the next
    y, x = (step * towards[other].item() / spacing[other] for other in order[1:])
    count, height, width = swept.shape
    # The ray through sample p of slice k has the number p + k * shift.
    (above, below), (left, right) = (
        (math.ceil(max(0.0, -shift * (count - 1))), math.ceil(max(0.0, shift * (count - 1)))) for shift in (y, x)
    )
    whole = swept.new_zeros(height + above + below, width + left + right)
    depths = []
    for k, here in enumerate(swept.unbind(0)):
        along = shifted(functional.pad(here, (left, right, above, below)), (-k * y, -k * x)) * step
        depth = shifted(whole + along / 2, (k * y, k * x))
        depths.append(depth[above : above + height, left : left + width])
        whole = whole + along
    result = torch.stack(depths[::-1] if behind else depths)
    return result.permute([order.index(i) for i in range(3)])


def shifted(image: Tensor, samples: tuple[float, float]) -> Tensor:
    """``image`` [h, w] read ``samples`` (y, x) beside each point, interpolated linearly, with zeros outside."""
    if not any(samples):
        return image
    for axis, shift in zip((-2, -1), samples, strict=True):
        size, first = image.shape[axis], math.floor(shift)
        index = torch.arange(size + 1, device=image.device) + first
        taken = image.index_select(axis, index.clamp(0, size - 1))
        inside = ((index >= 0) & (index < size)).to(image.dtype)
        taken = taken * (inside[:, None] if axis == -2 else inside)
        image = torch.lerp(taken.narrow(axis, 0, size), taken.narrow(axis, 1, size), shift - first)
    return image


def flat_steps(volume: Volume) -> Triple:
    """Unit of :func:`slopes`: difference of values between neighbouring samples along (z, y, x) at a slope of 1.

    Along the axis of the smallest spacing it is a thousandth of the range of values of ``volume``. Along the other axes
    it is larger in proportion to the spacing. For a volume of constant value, 1 replaces the thousandth of the range.
    """
    least, most = volume.value_range()
    flat = 1e-3 * (most - least) or 1.0
    z, y, x = (flat * spacing / min(volume.spacing) for spacing in volume.spacing)
    return z, y, x


def slopes(values: Tensor, steps: Triple) -> Tensor:
    """Gradient of ``values`` [D, H, W] along (z, y, x) per sample, divided by :func:`flat_steps`: [3, D, H, W].

    Differences are central, one-sided at the faces, and zero along an axis of one sample.
    """
    return torch.stack([_difference(values, axis, step) for axis, step in enumerate(steps)])


def slice_slopes(slices: Sequence[Tensor], k: int, steps: Triple, dtype: torch.dtype) -> Tensor:
    """Slice ``k`` of the result of :func:`slopes`, [3, H, W], from all slices [H, W] of the values, in ``dtype``."""
    before, after = max(k - 1, 0), min(k + 1, len(slices) - 1)
    along = (slices[after].to(dtype) - slices[before].to(dtype)) * (1 / (max(1, after - before) * steps[0]))
    here = slices[k].to(dtype)
    return torch.stack([along, _difference(here, 0, steps[1]), _difference(here, 1, steps[2])])


def _difference(values: Tensor, axis: int, step: float) -> Tensor:
    index = torch.arange(values.shape[axis], device=values.device)
    before, after = (index - 1).clamp(min=0), (index + 1).clamp(max=len(index) - 1)
    scale = 1 / ((after - before).clamp(min=1).to(values.dtype) * step)
    difference = values.index_select(axis, after) - values.index_select(axis, before)
    return difference * scale.reshape([-1 if other == axis else 1 for other in range(values.ndim)])


def _direction(towards: Triple) -> Tensor:
    """``towards`` as a float64 vector of length 1; ValueError unless it points somewhere."""
    if len(towards) != 3:
        raise ValueError(f"towards must be a direction (z, y, x), got {towards!r}")
    direction = torch.tensor([checks.finite("towards", part) for part in towards], dtype=torch.float64)
    if direction.norm() == 0:
        raise ValueError("towards must point to the light, got (0, 0, 0)")
    return direction / direction.norm()
