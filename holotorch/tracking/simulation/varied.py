"""The second synthetic world: random scenes that no tracker was tuned on, with exact truth, by condition.

A scene is determined by its seed. Seeds below 1000 (:data:`TUNING_SEEDS`) are for development; reported figures use
others. Nothing here depends on how a tracker works.
"""

import colorsys
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.simulation import surfaces
from holotorch.tracking.simulation.ray_camera import Light, Rod, Shot, paint_rods, take
from holotorch.tracking.simulation.world import Case

TUNING_SEEDS = 1000
CONDITIONS = (
    "clean",
    "any hue",
    "hue of band 1",
    "hue of band 2",
    "hue of band 3",
    "skin on drape",
    "gauze",
    "steel",
    "monitor",
    "photograph",
    "coloured lights",
    "gloss",
    "gloves and instruments",
    "occlusion",
    "blood",
    "strong distortion",
    "rolling shutter",
    "video 4:2:0",
    "jpeg",
    "defocus",
    "motion",
    "noise",
    "exposure",
    "partial view",
)
NEGATIVES = ("no catheter", "other colours", "wrong order", "thicker", "near miss")
_EDGE_SD = 0.05  # pixels: error of an edge that a good measurement reaches
_VAGUE = 5e-4  # metres: largest standard deviation of the tip with such edges; beyond it, the view limits any tracker
_MARGIN = 0.002  # metres that an edge must be clear of an occluder or the border to count as visible


@dataclass(frozen=True, eq=False)
class Trial:
    """A random scene and the truth about it.

    Attributes:
        condition: One of :data:`CONDITIONS` or :data:`NEGATIVES`.
        seed: Seed of the scene.
        shot: All that the frame depends on.
        answerable: Whether two neighbouring bands show all their edges.
    """

    condition: str
    seed: int
    shot: Shot
    answerable: bool

    @property
    def camera(self) -> Camera:
        """Camera of the scene."""
        return self.shot.camera

    @property
    def rolling_shutter(self) -> bool:
        """Whether the camera reads the rows of the frame one after another."""
        return any(self.shot.rolling)

    @property
    def tip(self) -> Tensor:
        """[3] float64, in metres, in the camera's coordinates."""
        return torch.from_numpy(np.asarray(self.shot.tip, np.float64))

    @property
    def direction(self) -> Tensor:
        """Unit vector [3] float64 from the tip to the rear."""
        return torch.from_numpy(np.asarray(self.shot.direction, np.float64))

    def frame(self) -> Tensor:
        """The frame, uint8 [3, H, W], RGB; the same at each call."""
        return take(self.shot, self.seed)

    @property
    def case(self) -> Case:
        """The scene as a case, named after its condition; the pose of an object that is not the catheter is unknown."""
        known = (self.tip, self.direction) if self.condition in CONDITIONS else (None, None)
        return Case(self.condition, self.frame, *known, self.answerable, "")


@dataclass(frozen=True, eq=False)
class VariedWorld:
    """Random scenes of one catheter.

    Attributes:
        catheter: The catheter to be tracked.
        size: (H, W) of the frames in pixels.
        photographs: uint8 [3, h, w] images for backgrounds; without any, the condition "photograph" shows a monitor.
    """

    catheter: Catheter = THESIS
    size: tuple[int, int] = (1080, 1920)
    photographs: tuple[Tensor, ...] = ()

    def trial(self, seed: int, condition: str | None = None) -> Trial:
        """The scene of a seed; by default, the seeds take :data:`CONDITIONS` in turn."""
        condition = _named("condition", condition, CONDITIONS, checks.whole("seed", seed, 0))
        rng = np.random.default_rng([seed, *condition.encode()])
        shot = self._shot(rng, condition)
        hidden = (math.inf, math.inf)
        if condition == "occlusion":
            shot, hidden = self._occluded(rng, shot)
        elif condition == "partial view":
            shot, hidden = self._cut(rng, shot)
        visible = [not hidden[0] - _MARGIN <= edge <= hidden[1] + _MARGIN for edge in self.catheter.edges]
        answerable = any(all(three) for three in zip(visible, visible[1:], visible[2:], strict=False))
        return Trial(condition, seed, shot, answerable)

    def negative(self, seed: int, kind: str | None = None) -> Trial:
        """A scene without the catheter, or with a stick that differs in one thing; ``kind`` is of :data:`NEGATIVES`."""
        kind = _named("kind", kind, NEGATIVES, checks.whole("seed", seed, 0))
        rng = np.random.default_rng([seed, *kind.encode()])
        shot = self._shot(rng, CONDITIONS[int(rng.integers(13))])
        stick = None if kind == "no catheter" else self._stick(rng, kind)
        return Trial(kind, seed, replace(shot, catheter=stick), False)

    def camera(self, rng: np.random.Generator, strong: bool = False) -> Camera:
        """A random camera: focal length 0.65 to 0.85 widths, distortion of a webcam or of a wide lens."""
        height, width = self.size
        focal = width * rng.uniform(0.65, 0.85)
        centre = np.array([width / 2, height / 2]) + rng.uniform(-0.01, 0.01, 2) * width
        matrix = torch.tensor([[focal, 0, centre[0]], [0, focal * rng.uniform(0.995, 1.005), centre[1]], [0, 0, 1]])
        k1 = rng.uniform(-0.28, -0.15) if strong else rng.uniform(-0.08, 0.06)
        k2 = rng.uniform(0.02, 0.08) if strong else rng.uniform(-0.02, 0.02)
        return Camera(matrix.double(), torch.tensor([k1, k2, *rng.uniform(-1e-3, 1e-3, 2), 0.0], dtype=torch.float64))

    def _pose(self, rng: np.random.Generator, camera: Camera, clean: bool) -> tuple[np.ndarray, np.ndarray]:
        """A tip and direction whose bands, with 15 mm on either side, lie within the frame and determine the tip."""
        height, width = self.size
        low, high = (0.35, 0.65) if clean else (0.1, 0.9)
        ends = np.array([self.catheter.edges[0] - 0.015, self.catheter.edges[-1] + 0.015])
        for _ in range(500):
            depth = 0.52 if clean else rng.uniform(0.36, 0.66)
            tilt = math.radians(rng.uniform(5, 30) if clean else rng.uniform(-25, 50))
            roll = rng.uniform(0, 2 * math.pi)
            direction = np.array([math.cos(tilt) * math.cos(roll), math.cos(tilt) * math.sin(roll), -math.sin(tilt)])
            pixel = torch.tensor([rng.uniform(low, high) * width, rng.uniform(low, high) * height], dtype=torch.float64)
            tip = depth * np.append(camera.undistort(pixel).numpy(), 1.0) - ends.mean() * direction
            image = camera.project(torch.from_numpy(tip + ends[:, None] * direction)).numpy()
            inside = np.isfinite(image).all() and (image > 10).all() and (image < np.array([width, height]) - 10).all()
            if inside and tip_deviation(camera, self.catheter, tip, direction) < _VAGUE:
                return tip, direction
        raise ValueError(f"no pose shows all bands in a frame of {width} x {height} px; take a larger frame")

    def _shot(self, rng: np.random.Generator, condition: str) -> Shot:
        camera = self.camera(rng, condition == "strong distortion")
        clean = condition == "clean"
        tip, direction = self._pose(rng, camera, clean)
        lights = self._lights(rng, coloured=condition == "coloured lights")
        background = self._background(rng, condition)
        background = self._lit(rng, background, shadows=condition == "coloured lights")
        if condition in ("gloves and instruments", "photograph", "steel"):
            paint_rods(background, self._rods(rng, int(rng.integers(2, 7))), 0.5)
        if not clean:
            background = self._shadow(rng, background, camera, tip, direction)
        white = rng.uniform(0.92, 1.08, 3)
        level = float(np.exp(rng.uniform(math.log(0.25), math.log(1.6)))) if condition == "exposure" else 1.0
        if condition not in ("exposure", "clean"):
            level = rng.uniform(0.6, 1.15)
        tints = rng.uniform(0.85, 1.12, (len(self.catheter.colours), 1)) * rng.uniform(
            0.95, 1.05, (len(self.catheter.colours), 3)
        )
        return Shot(
            camera,
            background,
            self.catheter,
            tip,
            direction,
            lights,
            ambient=tuple(rng.uniform(0.2, 0.45) * rng.uniform(0.9, 1.1, 3)),
            clear=tuple(surfaces.linear(np.full(3, rng.uniform(0.8, 0.93))) * rng.uniform(0.9, 1.0, 3)),
            opacity=rng.uniform(0.2, 0.6),
            tints=tints,
            blur_px=rng.uniform(0.55, 1.0),
            gain=tuple(level * white),
            **self._errors(rng, condition, camera, tip, direction),
        )

    def _errors(
        self, rng: np.random.Generator, condition: str, camera: Camera, tip: np.ndarray, direction: np.ndarray
    ) -> dict[str, Any]:
        """Gloss, noise and what the condition adds, as fields of a :class:`Shot`."""
        fields: dict[str, Any] = {
            "gloss": rng.uniform(0.02, 0.3),
            "shot_noise": rng.uniform(5e-5, 3e-4),
            "read_noise": 2e-3,
        }
        if condition == "gloss":
            return fields | {"gloss": rng.uniform(0.4, 1.5), "sharpness": rng.uniform(15, 200)}
        if condition == "blood":
            return fields | {"stain": self._stain(rng)}
        if condition == "rolling shutter":
            return fields | {"rolling": tuple(rng.uniform(-6e-4, 6e-4, 3) * (1, 1, 0.5))}
        if condition == "video 4:2:0":
            return fields | {"video": True}
        if condition == "jpeg":
            return fields | {"jpeg": int(rng.integers(60, 96))}
        if condition == "defocus":
            return fields | {"disc_px": rng.uniform(1, 4)}
        if condition == "motion":
            return fields | {"motion": self._motion(rng, camera, tip, direction)}
        if condition == "noise":
            return fields | {"shot_noise": rng.uniform(5e-4, 2e-3), "read_noise": rng.uniform(5e-3, 1.2e-2)}
        return fields

    def _stain(self, rng: np.random.Generator) -> tuple[float, float, float, float]:
        """A stain within one band, at least 4 mm from its edges."""
        band = int(rng.integers(len(self.catheter.colours)))
        low, high = self.catheter.edges[band] + 0.004, self.catheter.edges[band + 1] - 0.004
        start = rng.uniform(low, high - 0.008)
        return start, min(start + rng.uniform(0.003, 0.015), high), rng.uniform(-3.1, 3.1), rng.uniform(0.5, 2.5)

    def _background(self, rng: np.random.Generator, condition: str) -> np.ndarray:
        size = self.size
        if condition.startswith("hue of band"):
            colour = self.catheter.colours[int(condition[-1]) - 1]
            hue = colorsys.rgb_to_hsv(*(level / 255 for level in colour))[0] + rng.uniform(-10, 10) / 360
            near = surfaces.of_hue(hue, rng.uniform(0.4, 1), rng.uniform(0.3, 0.9))
            return (surfaces.cloth if rng.random() < 0.5 else surfaces.plain)(rng, size, near)
        if condition == "skin on drape":
            drape = surfaces.of_hue(rng.uniform(140, 240) / 360, rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.8))
            return surfaces.skin_on_drape(rng, size, drape)
        if condition == "clean":
            return surfaces.plain(rng, size, surfaces.of_hue(rng.random(), rng.uniform(0, 0.15), rng.uniform(0.4, 0.8)))
        if condition == "photograph" and self.photographs:
            images = tuple(image.numpy().transpose(1, 2, 0) for image in self.photographs)
            return surfaces.photograph(rng, size, images)
        own = {"gauze": surfaces.gauze, "steel": surfaces.steel, "monitor": surfaces.monitor}
        if condition in own or condition == "photograph":
            return own.get(condition, surfaces.monitor)(rng, size)
        turn = rng.integers(3)
        if turn == 0:
            return surfaces.skin_on_drape(rng, size, surfaces.any_colour(rng))
        return (surfaces.cloth if turn == 1 else surfaces.plain)(rng, size, surfaces.any_colour(rng))

    def _lights(self, rng: np.random.Generator, coloured: bool) -> tuple[Light, ...]:
        lights = []
        for _ in range(int(rng.integers(1, 4))):
            towards = np.array([*rng.uniform(-1, 1, 2), -rng.uniform(0.3, 1)])
            tone = np.asarray(surfaces.of_hue(rng.random(), rng.uniform(0.3, 0.6), 1.0)) if coloured else np.ones(3)
            lights.append(Light(tuple(towards / np.linalg.norm(towards)), tuple(rng.uniform(0.3, 0.8) * tone)))
        bright = sum(np.asarray(light.colour).mean() * -light.direction[2] for light in lights)
        return tuple(replace(light, colour=tuple(np.asarray(light.colour) * 0.75 / bright)) for light in lights)

    def _lit(self, rng: np.random.Generator, background: np.ndarray, shadows: bool) -> np.ndarray:
        """The background under uneven light, with shadows of things outside the frame."""
        height, width = self.size
        y, x = np.mgrid[:height, :width].astype(np.float32)
        spot = np.hypot(x - rng.uniform(0, width), y - rng.uniform(0, height)) / width
        light = 1 - rng.uniform(0, 0.5) * spot
        if shadows:
            edge = (x - rng.uniform(0, width)) * math.cos(turn := rng.uniform(0, 6.3)) + y * math.sin(turn)
            light *= 1 - rng.uniform(0.2, 0.6) / (1 + np.exp(np.clip(edge / rng.uniform(3, 60), -50, 50)))
        return np.maximum(light, 0.1)[..., None] * background

    def _shadow(
        self, rng: np.random.Generator, background: np.ndarray, camera: Camera, tip: np.ndarray, direction: np.ndarray
    ) -> np.ndarray:
        """The catheter's soft shadow beside it."""
        ends = np.array([[0.0], [self.catheter.length]])
        first, last = camera.project(torch.from_numpy(tip + ends * direction)).nan_to_num(0.0).numpy()
        shift = rng.uniform(-60, 60, 2)
        paint = np.zeros_like(background)
        rod = Rod(tuple(first + shift), tuple(last + shift), rng.uniform(3, 6), (1.0, 1.0, 1.0))
        paint_rods(paint, (rod,), rng.uniform(1, 8))
        return background * (1 - rng.uniform(0, 0.5) * np.clip(paint, 0, 1))

    def _rods(self, rng: np.random.Generator, count: int) -> tuple[Rod, ...]:
        """Fingers, gloves, instruments and cables of any colour."""
        rods = []
        for _ in range(count):
            start = rng.uniform(0, 1, 2) * self.size[::-1]
            turn, long = rng.uniform(0, 2 * math.pi), rng.uniform(100, 900)
            end = start + long * np.array([math.cos(turn), math.sin(turn)])
            wide = rng.uniform(15, 45) if rng.random() < 0.5 else rng.uniform(2.5, 12)
            rods.append(Rod(tuple(start), tuple(end), wide, surfaces.any_colour(rng), rng.uniform(0, 0.8)))
        return tuple(rods)

    def _motion(
        self, rng: np.random.Generator, camera: Camera, tip: np.ndarray, direction: np.ndarray
    ) -> tuple[float, float, float]:
        """Up to 8 pixels along the catheter and 3 across it."""
        focal, depth = float(camera.matrix[0, 0]), float(tip[2])
        across = np.array([-direction[1], direction[0], 0.0]) / np.hypot(*direction[:2])
        along = np.array([direction[0], direction[1], 0.0]) / np.hypot(*direction[:2])
        moved = rng.uniform(-8, 8) * along + rng.uniform(-3, 3) * across
        return tuple(moved * depth / focal)

    def _occluded(self, rng: np.random.Generator, shot: Shot) -> tuple[Shot, tuple[float, float]]:
        """A finger or an instrument across part of the bands, at an angle of 45 degrees or more to the catheter."""
        edges = self.catheter.edges
        centre, long = rng.uniform(edges[0], edges[-1]), rng.uniform(0.004, 0.022)
        ends = np.array([[centre - long / 2], [centre + long / 2]])
        first, last = shot.camera.project(torch.from_numpy(shot.tip + ends * shot.direction)).numpy()
        slant = math.pi / 2 + rng.uniform(-math.pi / 4, math.pi / 4)  # angle between the object and the catheter
        turn = math.atan2(*(last - first)[::-1]) + slant
        radius = max(float(np.linalg.norm(last - first)) / 2 * math.sin(slant), 2.0)
        middle, step = (first + last) / 2, np.array([math.cos(turn), math.sin(turn)])
        skin = surfaces.of_hue(rng.uniform(8, 32) / 360, rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.95))
        colour, gloss = skin if rng.random() < 0.5 else surfaces.any_colour(rng), rng.uniform(0, 0.3)
        rod = Rod(tuple(middle - (radius + 20) * step), tuple(middle + 1500 * step), radius, colour, gloss)
        # The oblique sides of the object cover up to twice the catheter's width more on either side.
        half = long / 2 + 2 * self.catheter.radius / math.tan(
            max(slant if slant < math.pi / 2 else math.pi - slant, 0.1)
        )
        return replace(shot, before=(rod,)), (centre - half, centre + half)

    def _cut(self, rng: np.random.Generator, shot: Shot) -> tuple[Shot, tuple[float, float]]:
        """The border of the frame cuts through the first or the last band."""
        edges, (height, width) = self.catheter.edges, self.size
        rear = rng.random() < 0.5
        cut = rng.uniform(edges[-2] + 0.006, edges[-1]) if rear else rng.uniform(edges[0], edges[1] - 0.006)
        tilt, turn = math.radians(rng.uniform(5, 40)), rng.uniform(-math.pi / 3, math.pi / 3)
        side = 0.0 if rng.random() < 0.5 else width - 1.0
        outward = 1.0 if (side > 0) == rear else -1.0
        direction = np.array(
            [outward * math.cos(tilt) * math.cos(turn), math.cos(tilt) * math.sin(turn), -math.sin(tilt)]
        )
        pixel = torch.tensor([side, rng.uniform(0.4, 0.6) * height], dtype=torch.float64)
        tip = rng.uniform(0.4, 0.6) * np.append(shot.camera.undistort(pixel).numpy(), 1.0) - cut * direction
        hidden = (cut, math.inf) if rear else (-math.inf, cut)
        return replace(shot, tip=tip, direction=direction), hidden

    def _stick(self, rng: np.random.Generator, kind: str) -> Catheter:
        tool, colours = self.catheter, self.catheter.colours
        if kind == "wrong order":
            orders = [order for order in itertools.permutations(colours) if order not in (colours, colours[::-1])]
            return replace(tool, colours=orders[int(rng.integers(len(orders)))])
        if kind == "other colours":
            turn = rng.uniform(60, 100) / 360 * (1 if rng.random() < 0.5 else -1)
            return replace(tool, colours=tuple(_turned(colour, turn) for colour in colours))
        if kind == "thicker":
            return replace(tool, radius=tool.radius * rng.uniform(2, 4))
        edges, band = np.array(tool.edges), int(rng.integers(len(colours)))
        change = rng.uniform(0.10, 0.35) * (1 if rng.random() < 0.5 else -1)
        edges[band + 1 :] += change * (edges[band + 1] - edges[band])
        return replace(tool, edges=tuple(edges.tolist()), length=max(tool.length, float(edges[-1]) + 0.05))


def _named(name: str, value: str | None, known: Sequence[str], seed: int) -> str:
    """The ``value``, or without one the entry of ``known`` at ``seed`` modulo their number."""
    if value is not None and value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    return value or known[seed % len(known)]


def tip_deviation(camera: Camera, catheter: Catheter, tip: np.ndarray, direction: np.ndarray) -> float:
    """Standard deviation of the tip in metres that edges with errors of 0.05 pixels leave, by linear propagation."""
    beside = np.linalg.svd(direction[None])[2][1:]  # two unit vectors perpendicular to the direction
    step = 1e-6
    moves = np.concatenate([np.eye(3), np.zeros((2, 3))]) * step
    turns = np.concatenate([np.zeros((3, 3)), beside]) * step
    edges = np.asarray(catheter.edges)[:, None]
    points = np.concatenate([tip + s * moves[:, None] + edges * (direction + s * turns[:, None]) for s in (1, -1)])
    ahead, behind = camera.project(torch.from_numpy(points)).numpy().reshape(2, 5, -1)
    slopes = (ahead - behind) / (2 * step * _EDGE_SD)
    return float(np.sqrt(np.trace(np.linalg.pinv(slopes @ slopes.T)[:3, :3])))


def _turned(colour: tuple[int, int, int], turn: float) -> tuple[int, int, int]:
    """The colour with its hue moved by ``turn``, as a share of the circle."""
    hue, saturation, value = colorsys.rgb_to_hsv(*(level / 255 for level in colour))
    red, green, blue = (round(255 * level) for level in colorsys.hsv_to_rgb((hue + turn) % 1, saturation, value))
    return red, green, blue
