"""Synthetic frames of a catheter with exactly known poses, for tests of trackers."""

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
from holotorch.tracking.simulation.look import Look
from holotorch.tracking.simulation.render import mean_levels, render

_ROLL = math.radians(25)  # default angle of the catheter within the frame


@dataclass(frozen=True, eq=False)
class Case:
    """A frame that is rendered on demand, and the true pose.

    Attributes:
        name: Description of the frame, different for each case of a list.
        frame: Renders the frame, uint8 [3, H, W], the same at each call.
        tip: [3] in metres, in the camera's frame; None if the frame does not show the catheter.
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
    """Camera of the synthetic frames: focal length of 1400 pixels at a width of 1920, weak distortion.

    The principal point is (W / 2, H / 2), half a pixel right of and below the centre of the frame.
    """
    height, width = size
    focal = 1400 * width / 1920
    matrix = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(matrix, torch.tensor([-0.05, 0.02, 1e-3, -5e-4, 0], dtype=torch.float64), tone)


def aimed(tilt: float, roll: float = _ROLL) -> Tensor:
    """Direction [3] of a catheter at an angle ``roll`` from x to y, its rear tilted to the camera; both in radians."""
    flat = math.cos(tilt)
    return torch.tensor([flat * math.cos(roll), flat * math.sin(roll), -math.sin(tilt)], dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class World:
    """Cases of one catheter in front of one camera.

    Attributes:
        size: (H, W) in pixels.
        camera: By default :func:`synthetic_camera`.
        catheter: The catheter to be tracked.
        look: Blur, noise and light of all frames, which a case may change. Its background is not used.
        photographs: Images uint8 [3, h, w] of any size for backgrounds, in addition to procedural ones.
        seed: Seed of backgrounds, poses and noise.
    """

    size: tuple[int, int] = (1080, 1920)
    camera: Camera = None  # type: ignore[assignment]  # the default depends on ``size``
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
        """A case with the catheter at a pose (tip, direction), or without a catheter if ``pose`` is None.

        ``background`` makes the background, by default :meth:`desk`. ``shown`` is another catheter to render instead;
        the case then has no true pose. ``changes`` replace fields of the look. Seed and name determine the noise.
        """

        def frame() -> Tensor:
            look = replace(self.look, background=(background or self.desk)(), **changes)
            tip, direction = pose or (None, None)
            catheter = None if pose is None else shown or self.catheter
            return render(catheter, self.camera, tip, direction, self.size, look, generator=self._noise(name))

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
        """Tip in metres and direction, float64 [3] each, with the bands' middle on the ray (x, y, 1), ``at`` = (x, y).

        ``depth`` is the coordinate z in metres of the point ``point`` metres from the tip, by default of the middle of
        the bands. For ``tilt`` and ``roll`` see :func:`aimed`. Raises ValueError for a ``depth`` not above 0, a
        ``point`` that is not finite, and if the middle of the bands is not in front of the camera.
        """
        checks.quantity(CAMERA_DEPTH, depth)
        direction = aimed(tilt, roll)
        middle = (self.catheter.edges[0] + self.catheter.edges[-1]) / 2
        ahead = depth + (0.0 if point is None else (middle - checks.finite("point", point)) * float(direction[2]))
        if ahead <= 0:
            raise ValueError(
                f"the middle of the bands must lie in front of the camera, got {ahead:.3g} m with the point {point:g} "
                f"m from the tip at depth {depth:g} m; tilt less or go farther"
            )
        return ahead * torch.tensor([*at, 1.0], dtype=torch.float64) - middle * direction, direction

    def _noise(self, name: str) -> torch.Generator:
        """Generator of the noise of the case of this name."""
        return torch.Generator().manual_seed(zlib.crc32(f"{self.seed} {name}".encode()))

    def desk(self) -> Tensor:
        """The default background, a plain table."""
        return self._desk

    @cached_property
    def _desk(self) -> Tensor:
        return scenery.desk(self.size, self.seed)

    def still(
        self, depth: float, tilt: float, count: int, at: Sequence[float] = (0.0, 0.0), point: float | None = None
    ) -> list[Case]:
        """``count`` frames of a catheter at rest; they differ in noise only. Sec. 3.5.1 of the thesis."""
        pose = self.pose(depth, tilt, at=at, point=point)
        suffix = f", {1e3 * at[0]:.3f} {1e3 * at[1]:.3f}" if any(at) else ""

        @cache
        def levels() -> np.ndarray:  # cached, since they take most of the time and are the same in all frames
            look = replace(self.look, background=self.desk())
            return mean_levels(self.catheter, self.camera, pose, self.size, look)

        def frame(name: str) -> Tensor:
            look = self.look
            return torch.from_numpy(sensed(levels(), look.noise_dn, look.video, look.jpeg_quality, self._noise(name)))

        names = [f"still {i}{suffix}" for i in range(checks.whole("count", count, 1))]
        return [Case(name, partial(frame, name), *pose, True, "") for name in names]

    def grid_2d(self, depth: float = 0.52, tilt: float = math.radians(20)) -> list[Case]:
        """The sheet of Sec. 3.5.2 of the thesis: the tip at 9 x 9 points of a square of 8.16 cm that faces the camera.

        The cases are in rows. With the tip at the central point, the middle of the bands lies on the optical axis at
        ``depth`` metres. The thesis does not state this distance.
        """
        centre, direction = self.pose(depth, tilt)
        steps = [0.0816 * (i / 8 - 0.5) for i in range(9)]
        return [
            self.case(f"2d {row} {column}", (centre + torch.tensor([x, y, 0.0], dtype=torch.float64), direction))
            for (row, y), (column, x) in itertools.product(enumerate(steps), repeat=2)
        ]

    def grid_3d(self) -> dict[str, list[Case]]:
        """The block of Sec. 3.5.3 of the thesis: 8 x 8 holes, 10 mm apart, in three faces.

        A is the upper, B the left, C the right face. The cases of each face are in rows, with one direction that a hand
        would give. The block is a cube of 90 mm with its centre at z = 560 mm, seen from 37 degrees above. The thesis
        does not state this view.
        """
        up, front, side = (torch.tensor(v, dtype=torch.float64) for v in ([0, -0.8, -0.6], [0, 0.6, -0.8], [1.0, 0, 0]))
        left, right = (front - side) / math.sqrt(2), (front + side) / math.sqrt(2)
        centre = torch.tensor([0, 0.06, 0.56], dtype=torch.float64)
        faces = {
            "A": (up, left, right, aimed(math.radians(9), math.radians(-55))),
            "B": (left, up, right, aimed(math.radians(20), math.radians(-174))),
            "C": (right, up, left, aimed(math.radians(25), math.radians(-20))),
        }
        steps = [0.010 * (i - 3.5) for i in range(8)]
        return {
            face: [
                self.case(f"3d {face} {row} {column}", (centre + 0.045 * normal + y * down + x * along, direction))
                for (row, y), (column, x) in itertools.product(enumerate(steps), repeat=2)
            ]
            for face, (normal, down, along, direction) in faces.items()
        }
