"""Large runs for the model: what they compute, in transforms and passes over memory."""

import math
from dataclasses import dataclass

from holotorch.experiments.runs.processes import share
from holotorch.experiments.scaling.model import Cluster, Work
from holotorch.experiments.volume.experiment import Part

# Passes over float32 values, counted in the code: elementwise operations and their gradients, reads and writes.
_SOLVER = 60  # per heater phase and evaluation: heat, loss, step of L-BFGS with its memory, each with its gradient
_IMAGE = 30  # per value of an image and evaluation: kernel, intensity, and their gradients
_GATHERED = 4  # per value of an image that a process receives: mean over the frames, loss, and their gradients
_RAY = 125  # per sample of a ray: interpolation of the volume and of its gradient, colour, opacity
_NODE = 48  # per sample of a plane: the nodes to which it is added, complex
_COMPLEX, _REAL = 8, 4  # bytes


@dataclass(frozen=True)
class Display:
    """The display of the large runs."""

    side: int = 2048  # pixels along each side
    colours: int = 3
    frames: int = 24  # shown in turn
    views: int = 22  # of a joint run: five foci and 17 smaller pupils, as in configs/joint/bonsai.yaml
    padded: int = 2304  # samples along each side of a view
    planes: int = 290  # of a volume: Hand, the deepest scene of the dissertation (Table 5.2)
    nodes: int = 115  # on which these planes are collected (scripts/charts/volume/verdict.txt)
    voxels: float = 1024.0**3  # of one byte


def tasks(cluster: Cluster, display: Display = Display()) -> list[Work]:
    """A volume, frames of one picture, and a volume on a chip, each on the same display."""
    return [_volume(cluster, display), _pec(cluster, display), _joint(cluster, display)]


def _transforms(count: int, side: int, cluster: Cluster) -> float:
    return count * 5 * side**2 * math.log2(side**2) / cluster.fft


def _passes(count: float, values: float, cluster: Cluster) -> float:
    return count * values * _REAL / cluster.memory


def largest_part(planes: int, colours: int, count: int) -> int:
    """Planes times colours in the largest share of a volume."""
    parts = [Part(rank, count, planes, colours) for rank in range(count)]
    return max(sum(part.takes(c, j) for c in range(colours) for j in range(planes)) for part in parts)


def largest_share(frames: int, colours: int, count: int) -> int:
    """Frames times colours in the largest share of an evaluation."""
    return max(math.prod(map(len, share(frames, colours, rank, count))) for rank in range(count))


def _volume(cluster: Cluster, display: Display) -> Work:
    colours, planes, rays = display.colours, display.planes, (display.side // 2) ** 2
    # The transforms have room for cones of light as wide as the display.
    divided = _transforms(colours * display.nodes, 2 * display.side, cluster)
    divided += _passes(_NODE, colours * planes * rays, cluster)
    return Work(
        f"volume, {planes} planes",
        colours * planes,
        lambda count: largest_part(planes, colours, count),
        divided,
        cluster.overhead + _passes(_RAY, planes * rays, cluster),
        _COMPLEX * colours * display.side**2,
        1,
        rounds=8,
        file=display.voxels,
    )


def _pec(cluster: Cluster, display: Display) -> Work:
    fields, pixels = display.frames * display.colours, display.side**2
    return Work(
        f"pec, {display.frames} frames",
        fields,
        lambda count: largest_share(display.frames, display.colours, count),
        _transforms(2 * fields, display.side, cluster) + _passes(_IMAGE, fields * pixels, cluster),
        cluster.overhead + _passes(_SOLVER + _GATHERED, fields * pixels, cluster),
        (_REAL + _COMPLEX) * fields * pixels,
        3,
        rounds=300,
    )


def _joint(cluster: Cluster, display: Display) -> Work:
    fields, pixels = display.frames * display.colours, display.side**2
    images = fields * display.views * pixels
    return Work(
        f"joint, {display.frames} frames, {display.views} views",
        fields,
        lambda count: largest_share(display.frames, display.colours, count),
        _transforms(2 * fields * (1 + display.views), display.padded, cluster) + _passes(_IMAGE, images, cluster),
        cluster.overhead + _passes(_SOLVER, fields * pixels, cluster) + _passes(_GATHERED, images, cluster),
        _REAL * images + _COMPLEX * fields * pixels,
        3,
        rounds=60,
        file=display.voxels,
    )
