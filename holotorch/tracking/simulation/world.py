"""Synthetic scenes with exact truth, some of which a catheter tracker must answer and others refuse."""

import itertools
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.quantities import CAMERA_DEPTH
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.simulation import scenery
from holotorch.tracking.simulation.exposure import sensed
from holotorch.tracking.simulation.render import Look, mean_levels, render

# Side of the sheet of Sec. 3.5.2 and distance of the holes of Sec. 3.5.3 of the thesis, in metres.
_GRID, _SPACING = 0.0816, 0.010
_ROLL = math.radians(25)  # default angle of the catheter within the frame


@dataclass(frozen=True, eq=False)
class Case:
    """A frame that is rendered on demand, and the truth about it.

    Attributes:
        name: Description of the frame, unique in its list.
        frame: Renders the frame, uint8 [3, H, W]; each call gives the same one.
        tip: [3] in metres, in the camera's coordinates; None if the catheter is not in the frame.
        direction: Unit vector [3] from the tip to the rear, or None.
        answerable: Whether the frame determines a pose.
        why: The reason for ``answerable``, in a few words.
    """

    name: str
    frame: Callable[[], Tensor]
    tip: Tensor | None
    direction: Tensor | None
    answerable: bool
    why: str


def synthetic_camera(size: tuple[int, int] = (1080, 1920), tone: str = "srgb") -> Camera:
    """Camera of the synthetic frames: focal length 1400 pixels at a width of 1920, weak distortion.

    Its principal point is (W / 2, H / 2), half a pixel right of and below the frame's centre.
    """
    height, width = size
    focal = 1400 * width / 1920
    matrix = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(matrix, torch.tensor([-0.05, 0.02, 1e-3, -5e-4, 0], dtype=torch.float64), tone)


def aimed(tilt: float, roll: float = _ROLL) -> Tensor:
    """Direction [3] of a catheter at the angle ``roll`` in the frame, its rear tilted to the camera; in radians."""
    flat = math.cos(tilt)
    return torch.tensor([flat * math.cos(roll), flat * math.sin(roll), -math.sin(tilt)], dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class World:
    """Scenes of one catheter in front of one camera. Each method returns cases, whose frames are rendered on demand.

    Attributes:
        size: (H, W) in pixels.
        camera: By default :func:`synthetic_camera`.
        catheter: The catheter to be tracked; similar objects in negative cases differ from it.
        look: Blur, noise and light of all frames, which a case may change. Its background is not used.
        photographs: Images uint8 [3, h, w] of any size for backgrounds, in addition to procedural ones.
        seed: Seed of backgrounds, poses and noise.
    """

    size: tuple[int, int] = (1080, 1920)
    camera: Camera = None  # type: ignore[assignment]  # filled in below
    catheter: Catheter = THESIS
    look: Look = field(default_factory=Look)
    photographs: tuple[Tensor, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if self.camera is None:
            object.__setattr__(self, "camera", synthetic_camera(self.size))
        checks.whole("seed", self.seed, 0)

    def case(
        self,
        name: str,
        pose: tuple[Tensor, Tensor] | None,
        background: Callable[[], Tensor] | None = None,
        why: str = "",
        *,
        answerable: bool = True,
        shown: Catheter | None = None,
        **changes: Any,
    ) -> Case:
        """A case of the catheter, or of another one ``shown``, at a pose (tip, direction); without a pose, of none.

        The default background is the desk. ``changes`` replace fields of the look. The noise depends on the world's
        seed and the name.
        """

        def frame() -> Tensor:
            look = replace(self.look, background=(background or self.desk)(), **changes)
            tip, direction = pose or (None, None)
            tool = None if pose is None else shown or self.catheter
            return render(tool, self.camera, tip, direction, self.size, look, generator=self._noise(name))

        true = None if shown is not None else pose
        return Case(name, frame, *(true or (None, None)), answerable, why)

    def pose(
        self,
        depth: float,
        tilt: float,
        roll: float = _ROLL,
        at: Sequence[float] = (0.0, 0.0),
        point: float | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Tip in metres and direction, float64 [3] each, with the bands' middle on the ray through ``at`` on z = 1.

        At ``depth``, in metres along the optical axis, lies the ``point`` so many metres from the tip; None for that
        middle. ``tilt`` and ``roll`` are in radians, as of :func:`aimed`.

        Raises:
            TypeError, ValueError: ``depth`` not above 0, ``point`` not finite, or the bands' middle not in front of the
                camera.
        """
        checks.quantity(CAMERA_DEPTH, depth)
        direction = aimed(tilt, roll)
        middle = (self.catheter.edges[0] + self.catheter.edges[-1]) / 2
        ahead = depth + (0.0 if point is None else (middle - checks.finite("point", point)) * float(direction[2]))
        if ahead <= 0:
            got = f"{ahead:.3g} m with the point {point:g} m from the tip at depth {depth:g} m"
            raise ValueError(
                f"the middle of the bands must lie in front of the camera, got {got}; tilt less or go farther"
            )
        return ahead * torch.tensor([*at, 1.0], dtype=torch.float64) - middle * direction, direction

    def _noise(self, name: str) -> torch.Generator:
        """Of the frame of this name: the same at each call."""
        return torch.Generator().manual_seed(zlib.crc32(f"{self.seed} {name}".encode()))

    def desk(self) -> Tensor:
        """The table of the measurements."""
        return self._desk

    @cached_property
    def _desk(self) -> Tensor:
        return scenery.desk(self.size, self.seed)

    def still(
        self, depth: float, tilt: float, count: int, at: Sequence[float] = (0.0, 0.0), point: float | None = None
    ) -> list[Case]:
        """``count`` frames of a catheter at rest, differing in noise only: Sec. 3.5.1; at a pose as :meth:`pose`'s."""
        place = self.pose(depth, tilt, at=at, point=point)
        where = f", {1e3 * at[0]:.3f} {1e3 * at[1]:.3f}" if any(at) else ""

        @cache
        def levels() -> np.ndarray:  # the same of all frames, and most of their making
            look = replace(self.look, background=self.desk())
            return mean_levels(self.catheter, self.camera, place, self.size, look)

        def frame(name: str) -> Tensor:
            seen = self.look.noise_dn, self.look.video, self.look.jpeg_quality
            return torch.from_numpy(sensed(levels(), *seen, self._noise(name)))

        names = [f"still {i}{where}" for i in range(checks.whole("count", count, 1))]
        return [Case(name, partial(frame, name), *place, True, "") for name in names]

    def grid_2d(self, depth: float = 0.52, tilt: float = math.radians(20)) -> list[Case]:
        """The sheet of Sec. 3.5.2: the tip at 9 x 9 places over 8.16 cm, row by row, always in the same direction.

        The sheet faces the camera. At its centre the middle of the bands is at ``depth`` on the axis; the thesis does
        not print its distance.
        """
        centre, direction = self.pose(depth, tilt)
        steps = [_GRID * (i / 8 - 0.5) for i in range(9)]
        cases = []
        for (row, y), (column, x) in itertools.product(enumerate(steps), repeat=2):
            tip = centre + torch.tensor([x, y, 0.0], dtype=torch.float64)
            cases.append(self.case(f"2d {row} {column}", (tip, direction)))
        return cases

    def grid_3d(self) -> dict[str, list[Case]]:
        """The block of Sec. 3.5.3: on each of its three faces A, B, C 8 x 8 holes, 10 mm apart, row by row.

        A cube of 90 mm with its centre 560 mm away, seen from 37 degrees above its edge to the front: A is on top, B
        and C are on its left and right. Tips are 505 to 570 mm away. In each face the catheter keeps a direction that
        a hand would give it: A up and right, rear 9 degrees to the camera, B left, 20, C right, 25. (The thesis prints
        no distance.)
        """
        up, front, side = (torch.tensor(v, dtype=torch.float64) for v in ([0, -0.8, -0.6], [0, 0.6, -0.8], [1.0, 0, 0]))
        left, right = (front - side) / math.sqrt(2), (front + side) / math.sqrt(2)
        centre = torch.tensor([0, 0.06, 0.56], dtype=torch.float64)
        faces = {
            "A": (up, left, right, aimed(math.radians(9), math.radians(-55))),
            "B": (left, up, right, aimed(math.radians(20), math.radians(-174))),
            "C": (right, up, left, aimed(math.radians(25), math.radians(-20))),
        }
        steps = [_SPACING * (i - 3.5) for i in range(8)]
        cases: dict[str, list[Case]] = {}
        for face, (normal, down, along, direction) in faces.items():
            cases[face] = []
            for (row, y), (column, x) in itertools.product(enumerate(steps), repeat=2):
                tip = centre + 0.045 * normal + y * down + x * along
                cases[face].append(self.case(f"3d {face} {row} {column}", (tip, direction)))
        return cases
