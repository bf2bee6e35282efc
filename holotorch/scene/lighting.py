"""Phong shading of a volume, with the gradient of its values as surface normal."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.scene.compositing import safe_sqrt
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
        if len(self.towards) != 3:
            raise ValueError(f"towards must be a direction (z, y, x), got {self.towards!r}")
        direction = torch.tensor([checks.finite("towards", part) for part in self.towards], dtype=torch.float64)
        if direction.norm() == 0:
            raise ValueError("towards must point to the light, got (0, 0, 0)")
        for name in ("ambient", "diffuse", "specular"):
            checks.nonnegative(name, getattr(self, name))
        if checks.finite("shininess", self.shininess) < 1:
            raise ValueError(f"shininess must be at least 1, got {self.shininess}")

    def shade(self, colour: Tensor, slopes: Tensor, rotation: Tensor, observer: float) -> Tensor:
        """Shaded colour [3, n] of n points from their ``colour`` without lighting, [3, n].

        ``slopes`` [3, n] are those of :func:`slopes` along the axes (z, y, x) of the volume. ``rotation`` [3, 3] maps
        vectors in these axes to the scene. ``observer`` is -1 if the observer is on the side of lower z, else 1.
        """
        light = rotation.new_tensor(self.towards)
        light = (light / light.norm()) @ rotation
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
