"""Phong shading of a volume by the gradient of its values."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.scene.compositing import safe_sqrt
from holotorch.scene.volume import Triple, Volume

_FLAT = 1e-3  # difference between neighbouring voxels, relative to the range of values, at which shading fades in


@dataclass(frozen=True)
class Lighting:
    """A distant white light and the reflectance of the volume in the Phong model (1975).

    The shaded colour is colour * (ambient + diffuse * (n . l)) + specular * (r . v)^shininess, where n is the direction
    of the gradient, oriented towards the observer (both sides of a surface are lit), l the direction to the light, r
    its reflection and v the direction to the observer along the axis. Where the value is constant there is no surface:
    the colour is multiplied by ambient + diffuse, without highlight. In between, at differences of about a thousandth
    of the range of values from voxel to voxel, shading fades in as |g|^2 / (|g|^2 + flat^2), so that the result and its
    gradient stay finite for every volume.

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
            if checks.finite(name, getattr(self, name)) < 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        if checks.finite("shininess", self.shininess) < 1:
            raise ValueError(f"shininess must be at least 1, got {self.shininess}")

    def shade(self, colour: Tensor, slopes: Tensor, rotation: Tensor, observer: float) -> Tensor:
        """Shaded colour [3, n] of n points.

        Args:
            colour: Colour without lighting, red, green, blue, [3, n].
            slopes: Result of :func:`slopes` at the points, along the axes (z, y, x) of the volume, [3, n].
            rotation: Offset in the scene = rotation @ offset in the volume, [3, 3].
            observer: Sign of the axial direction to the observer: -1 where the hologram is between volume and observer.
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
    """Differences between neighbours along (z, y, x) that count as a slope of 1.

    They are a thousandth of the range of values along the axis of the smallest spacing, and proportional to the spacing
    along the others. For a constant volume, whose slopes vanish, they are 1.
    """
    least, most = volume.value_range()
    z, y, x = (_FLAT * (most - least or 1 / _FLAT) * spacing / min(volume.spacing) for spacing in volume.spacing)
    return z, y, x


def slopes(values: Tensor, steps: Triple) -> Tensor:
    """Central differences of ``values`` [D, H, W] along (z, y, x), in :func:`flat_steps`: [3, D, H, W].

    One-sided at the faces, zero along an axis of one sample.
    """
    return torch.stack([_difference(values, axis, step) for axis, step in enumerate(steps)])


def slice_slopes(slices: Sequence[Tensor], k: int, steps: Triple, dtype: torch.dtype) -> Tensor:
    """One slice of :func:`slopes`, [3, H, W], from the ``slices`` [H, W] of the values."""
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
